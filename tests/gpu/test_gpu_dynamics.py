import mujoco
import numpy as np
import pytest
import warp as wp
from test_gpu import nothing_waits

from lyceum_warp.core import gymnasium_model
from lyceum_warp.core.fields import describe
from lyceum_warp.core.model_fields import describe_model_field
from lyceum_warp.engines import Engine
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.deterministic.deterministic_engine import DeterministicEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.graphs.capture import Graphs, Phase

pytestmark = pytest.mark.gpu

DRAWN = "body_mass body_inertia geom_friction geom_quat dof_damping dof_armature actuator_gear gravity".split()
N = 200
CHOSEN = [0, 3, *range(50, 150)]


def draws(model: mujoco.MjModel, turn: int) -> dict[str, np.ndarray]:
    """Return factors for the model fields. ``turn`` changes the factors only in the worlds that ``CHOSEN`` lists."""
    found = {}
    for name in DRAWN:
        size = describe_model_field(model, name).size
        factors = np.random.default_rng(0).uniform(0.8, 1.2, size=(N, size))
        factors[CHOSEN] = np.random.default_rng(turn).uniform(0.8, 1.2, size=(len(CHOSEN), size))
        if name == "body_inertia":
            factors = np.repeat(factors[:, :1], size, axis=1)
        found[name] = (factors if name != "geom_quat" else np.ones_like(factors)).astype(np.float32)
    return found


def write(engine: Engine, name: str, factors: np.ndarray) -> None:
    array = engine.arrays[name]
    values = engine.nominal[name].numpy().reshape(1, -1) * factors
    if name == "geom_quat":
        angles = 0.1 * np.arange(N) / N
        values.reshape(N, -1, 4)[:, 0] = np.stack([np.cos(angles), 0 * angles, np.sin(angles), 0 * angles], axis=1)
    wp.copy(array, wp.array(values.reshape(array.numpy().shape), dtype=array.dtype, device=engine.device))


@pytest.mark.parametrize("kind", [WarpEngine, DeterministicEngine])
def test_gpu_graphs_agree_with_the_c_engine_if_models_differ_between_worlds(kind: type[Engine]) -> None:
    spec = gymnasium_model("hopper.xml").spec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    model = spec.compile()
    fields = [describe(model, name) for name in ("qpos", "qvel", "xpos", "qfrc_constraint")]
    dynamics = [describe_model_field(model, name) for name in DRAWN]
    results = []
    for engine in (
        kind(model, N, wp.get_device("cuda:0"), fields, dynamics),
        MujocoEngine(model, N, wp.get_device("cpu"), fields, dynamics),
    ):
        every = wp.full(N, True, dtype=bool, device=engine.device)
        mask = wp.array(np.isin(np.arange(N), CHOSEN), dtype=bool, device=engine.device)
        engine.reset(every)
        for name, factors in draws(model, 0).items():
            write(engine, name, factors)
        engine.apply_model(every)
        engine.refresh(every)
        phases = [
            Phase("reset", lambda e=engine, m=mask: e.reset(m)),
            Phase("model", lambda e=engine, m=mask: e.apply_model(m), engine=True),
            Phase("settle", lambda e=engine, m=mask: e.settle(m, 3), engine=True),
            Phase("refresh", lambda e=engine, m=mask: e.refresh(m), engine=True),
            Phase("step", lambda e=engine: e.step(2), engine=True),
        ]
        calls = Graphs(engine.device, capture_engine=engine.capturable).sequence(phases)
        for turn in range(1, 5):
            for name, factors in draws(model, turn).items():
                write(engine, name, factors)
            if turn > 2 and engine.device.is_cuda:
                with nothing_waits():
                    for call in calls:
                        call()
            else:
                for call in calls:
                    call()
        engine.find_faults(every)
        assert not engine.fault.numpy().any()
        results.append(np.hstack([engine.arrays[name].numpy().reshape(N, -1) for name in ("qpos", "qvel", "xpos")]))
    got, expected = results
    assert np.ptp(expected, axis=0).max() > 1e-3
    np.testing.assert_allclose(got, expected, atol=2e-4)
