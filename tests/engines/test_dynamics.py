import copy

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from test_refresh import WholeWarpEngine
from toy_engine import ToyEngine

from lyceum_warp.core.fields import describe, state_columns
from lyceum_warp.core.model_fields import describe_model_field
from lyceum_warp.engines import Engine
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.placement import open_engine
from lyceum_warp.engines.warp import forward
from lyceum_warp.engines.warp.warp_engine import WarpEngine

XML = """<mujoco><option integrator="implicitfast" cone="elliptic" timestep=".004"/>
<worldbody><geom name="floor" type="plane" size="5 5 .1" friction=".3"/>
<body name="arm" pos="0 0 1"><joint name="h" axis="0 1 0" range="-60 60" damping=".1" armature=".01"/>
<geom type="capsule" size=".1 .2" mass="1"/><site name="s" pos=".05 0 -.2"/>
<body name="hand" pos="0 0 -.4"><joint name="k" axis="0 1 0"/><geom type="box" size=".05 .05 .2" mass=".5"/></body>
</body>
<body name="box" pos="1 0 .09"><freejoint/><geom size=".1 .1 .1" type="box" mass="1"/></body>
<body name="target" mocap="true" pos="0 1 1"><geom size=".02" contype="0" conaffinity="0"/></body>
<site name="w" pos=".3 0 1.5"/></worldbody>
<tendon><fixed name="t"><joint joint="h" coef="1"/><joint joint="k" coef="-1"/></fixed>
<spatial name="sp"><site site="w"/><site site="s"/></spatial></tendon>
<actuator><motor joint="h"/><position joint="k" kp="10"/><motor tendon="sp" gear="2"/></actuator>
<keyframe><key name="home" qpos=".2 -.1 1 0 .5 1 0 0 0" ctrl=".1 .2 .3"/></keyframe></mujoco>"""

DRAWN = (
    "body_mass body_inertia body_ipos geom_friction geom_size dof_damping dof_armature actuator_gainprm "
    "actuator_biasprm gravity"
).split()
ENGINES = [MujocoEngine, WarpEngine, ToyEngine]
CPU = wp.get_device("cpu")
N = 3


def compiled(spec: mujoco.MjSpec | None = None) -> mujoco.MjModel:
    spec = spec or mujoco.MjSpec.from_string(XML)
    for body in spec.bodies[1:]:
        body.simple = 0  # simple="false" allows inertial frames to move
    return spec.compile()


MODEL = compiled()
STATE = ("time", "qpos", "qvel", "act", "ctrl")


def make(
    engine: type[Engine],
    *names: str,
    fields: tuple[str, ...] = (),
    nworld: int = N,
    model: mujoco.MjModel = MODEL,
    initial: np.ndarray | None = None,
    written: tuple[str, ...] = (),
) -> Engine:
    kept = [describe(model, name) for name in (*STATE, *fields)]
    kept += [describe(model, name, written=True) for name in written]
    dynamics = [describe_model_field(model, name) for name in names]
    made = open_engine(engine, model, nworld, CPU, kept, dynamics, initial)
    made.reset(worlds(nworld))
    made.refresh(worlds(nworld))
    return made


def worlds(nworld: int = N, *chosen: int) -> wp.array:
    return wp.array([not chosen or w in chosen for w in range(nworld)], dtype=bool)


def draw(engine: Engine, seed: int = 0, *chosen: int) -> None:
    rng = np.random.default_rng(seed)
    for name in sorted(engine.dynamics):
        array, own = engine.arrays[name].numpy(), engine.nominal[name].numpy()
        # scaling all of a body's moments of inertia by one factor keeps them valid
        shape = (*array.shape[:-1], 1) if name == "body_inertia" else array.shape
        drawn = own * rng.uniform(0.8, 1.2, size=shape).astype(np.float32)
        if name == "body_ipos":
            drawn[:, 1:] += 0.01
        for w in chosen or range(engine.nworld):
            array[w] = drawn[w]
    engine.apply_model(worlds(engine.nworld, *chosen))


def run(engine: Engine, steps: int = 5, nstep: int = 2) -> np.ndarray:
    for _ in range(steps):
        engine.ctrl.numpy()[:] = (0.5, -0.3, 0.2)
        engine.step(nstep)
    return shown(engine)


def shown(engine: Engine) -> np.ndarray:
    return np.hstack([engine.arrays[name].numpy() for name in ("qpos", "qvel")])


def state_of(engine: Engine) -> wp.array:
    state = wp.zeros((engine.nworld, engine.state_size), dtype=wp.float64)
    engine.get_state(state)
    return state


@pytest.mark.parametrize("engine", [MujocoEngine, WarpEngine])
def test_worlds_with_their_own_models_step_like_plain_mujoco(engine: type[Engine]) -> None:
    made, plain = make(engine, *DRAWN), make(ToyEngine, *DRAWN)
    draw(made)
    draw(plain)
    steps = [(run(made, 1), run(plain, 1)) for _ in range(5)]
    assert np.ptp(steps[-1][1], axis=0).max() > 0.01
    for got, expected in steps:
        if engine is MujocoEngine:
            np.testing.assert_array_equal(got, expected)
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


def test_bare_model_has_the_worlds_fields() -> None:
    engine = make(WarpEngine, *DRAWN)
    assert isinstance(engine, WarpEngine)
    model, data = engine.bare()
    draw(engine)
    for _ in range(5):
        mjw.step(model, data)
    engine.step(5)
    np.testing.assert_array_equal(data.qpos.numpy(), engine.arrays["qpos"].numpy())
    assert np.ptp(data.qpos.numpy(), axis=0).max() > 1e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_restored_nominal_values_give_the_steps_of_the_shared_model(engine: type[Engine]) -> None:
    made, shared = make(engine, *DRAWN), make(engine)
    draw(made)
    for name, nominal in made.nominal.items():
        made.arrays[name].numpy()[:] = nominal.numpy()
    for _ in range(2):
        made.apply_model(worlds())
    np.testing.assert_array_equal(run(made), run(shared))


@pytest.mark.quick(
    "MujocoEngine-implicitfast-current0",
    "MujocoEngine-RK4-current1",
    "ToyEngine-implicitfast-current0",
    "WarpEngine-implicitfast-current0",
    "MujocoEngine-discrete-current2",
)
@pytest.mark.parametrize(
    ("integrator", "current"), [("implicitfast", ()), ("RK4", ("xpos",)), ("discrete", ("xpos", "actuator_force"))]
)
@pytest.mark.parametrize("engine", ENGINES)
def test_rollout_uses_the_model_fields_of_each_state(
    engine: type[Engine], integrator: str, current: tuple[str]
) -> None:
    model = copy.copy(MODEL)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    source, planner = (make(engine, *DRAWN, fields=current, model=model) for _ in range(2))
    draw(source)
    run(source, 2)
    state = state_of(source)
    controls = wp.array(np.full((4, N, MODEL.nu), 0.3), dtype=float)
    names = ("qpos", "qvel", "body_mass", *current)
    buffers = {name: wp.zeros((5, *source.arrays[name].shape), dtype=source.arrays[name].dtype) for name in names}
    for _ in range(2):
        planner.rollout(state, controls, 2, buffers)
        for t in range(4):
            for name, buffer in buffers.items():
                np.testing.assert_array_equal(buffer.numpy()[t], source.arrays[name].numpy())
            source.ctrl.numpy()[:] = 0.3
            source.step(2)
        for name, buffer in buffers.items():
            np.testing.assert_array_equal(buffer.numpy()[4], source.arrays[name].numpy())
            if name in planner.dynamics or name in STATE:
                np.testing.assert_array_equal(planner.arrays[name].numpy(), source.arrays[name].numpy())
        source.reset(worlds())
        source.set_state(state, worlds())


@pytest.mark.parametrize("engine", [*ENGINES, WholeWarpEngine])
def test_settle_advances_only_masked_worlds(engine: type[Engine]) -> None:
    fields = ("xpos", "qfrc_constraint")
    made, alone = make(engine, *DRAWN, fields=fields), make(engine, *DRAWN, fields=fields)
    for either in (made, alone):
        draw(either)
        run(either, 2)
    before = {name: made.arrays[name].numpy().copy() for name in (*STATE, *fields)}
    state = state_of(made).numpy().copy()
    made.settle(wp.zeros(N, dtype=bool), 3)
    made.settle(worlds(), 0)
    np.testing.assert_array_equal(state_of(made).numpy(), state)
    made.settle(worlds(N, 0, 2), 7)
    for name, values in before.items():
        np.testing.assert_array_equal(made.arrays[name].numpy()[1], values[1])
    np.testing.assert_array_equal(state_of(made).numpy()[1], state[1])
    alone.step(7)
    np.testing.assert_array_equal(shown(made)[[0, 2]], shown(alone)[[0, 2]])
    assert made.arrays["time"].numpy()[[0, 2]].tolist() == [0.0, 0.0]
    made.find_faults(worlds())
    assert not made.fault.numpy().any()


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("varied", [(), ("qpos0",)])
def test_worlds_reset_to_the_given_initial_state(engine: type[Engine], varied: tuple[str, ...]) -> None:
    data = mujoco.MjData(MODEL)
    mujoco.mj_resetDataKeyframe(MODEL, data, 0)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
    initial = np.empty(mujoco.mj_stateSize(MODEL, spec))
    mujoco.mj_getState(MODEL, data, initial, spec)
    made = make(engine, *varied, initial=initial)
    run(made, 2)
    made.reset(worlds(N, 1))
    home = initial[state_columns(MODEL, "qpos")].astype(np.float32)
    np.testing.assert_array_equal(made.arrays["qpos"].numpy()[1], home)
    np.testing.assert_array_equal(made.ctrl.numpy()[1], np.float32([0.1, 0.2, 0.3]))
    assert (made.arrays["qpos"].numpy()[0] != home).any()


SLIDERS = """<mujoco><worldbody>
<body><joint type="slide" axis="1 0 0" armature=".5"/><joint type="slide" axis="0 0 1"/>
<geom size=".1" mass="1"/></body>
<body><joint name="h" axis="0 1 0"/><geom size=".1" mass="1"/></body>
<body><joint type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
<body><joint type="slide" axis="0 0 1"/><geom size=".1" mass="2"/></body></body>
</worldbody><actuator><motor joint="h"/></actuator></mujoco>"""


def test_derived_constants_equal_those_of_a_compiled_model() -> None:
    """MuJoCo sets the inverse weight to 0 if a body cannot move in a direction."""
    model = mujoco.MjModel.from_xml_string(SLIDERS)
    engine = make(WarpEngine, "body_mass", "actuator_gear", nworld=2, model=model)
    for scale in (1.0, 2.0):
        engine.arrays["body_mass"].numpy()[1] = scale * model.body_mass
        engine.arrays["actuator_gear"].numpy()[1] = scale * model.actuator_gear
        engine.apply_model(worlds(2))
        wanted = copy.copy(model)
        wanted.body_mass[:] = (scale * model.body_mass).astype(np.float32)
        wanted.actuator_gear[:] = scale * model.actuator_gear
        mujoco.mj_setConst(wanted, mujoco.MjData(wanted))
        for name in ("body_invweight0", "dof_invweight0", "actuator_acc0"):
            found = getattr(engine.m, name).numpy()[1]  # type: ignore[attr-defined]
            np.testing.assert_allclose(found, getattr(wanted, name), rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(("kind", "size"), [("sphere", "0.02"), ("capsule", "0.02 0.1"), ("box", "0.02 0.03 0.03")])
def test_geoms_that_have_sunk_into_a_large_height_field_are_not_thrown_away(kind: str, size: str) -> None:
    spec = mujoco.MjSpec.from_string(
        f"<mujoco><worldbody><body><freejoint/><geom type='{kind}' size='{size}' mass='1'/></body></worldbody></mujoco>"
    )
    field = spec.add_hfield(name="ground", size=[84, 44, 1, 1], nrow=881, ncol=1681, userdata=np.zeros(881 * 1681))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=field.name)
    model, rng = spec.compile(), np.random.default_rng(0)
    qpos = np.column_stack([rng.uniform([60, 30, -0.02], [80, 40, 0.0], (64, 3)), rng.normal(size=(64, 4))])
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    m, data = mjw.put_model(model), mjw.make_data(model, nworld=64, nconmax=8, njmax=32)
    data.qpos = wp.array(qpos, dtype=float)
    forward.step(m, data)
    velocity = data.qvel.numpy()[:, :3]  # m/s; MuJoCo Warp alone: 45 to 56
    assert abs(velocity).max() < 1.0 and (kind != "sphere" or velocity[:, 2].min() > 0.0)
