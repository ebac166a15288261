import gc
import os
from pathlib import Path

import mujoco
import pytest
import torch
import warp as wp
from conftest import TaskFile
from toy_engine import ToyEngine

import lyceum_warp as lw
from lyceum_warp.core.fields import describe
from lyceum_warp.engines import Engine
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine

TASK = """
import mujoco
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    ctrl: Row[float]
    sensordata: Row[float]


@wp.struct
class Params:
    dt: float
    memory_of_control: float = 0.9


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.sensordata[0]
    obs[2] = s.ctrl[0]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = p.memory_of_control * ctrl[0] + (1.0 - p.memory_of_control) * action[0]


@wp.func
def initialize(s: World, p: Params):
    s.qpos[0] = 0.5


def pendulum():
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.01
    body = spec.worldbody.add_body(name="rod")
    body.add_joint(name="hinge", axis=(0, 1, 0))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0, 0, 0, 0, 0, -1), size=(0.05, 0, 0))
    motor = spec.add_actuator(name="motor", target="hinge", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.ctrllimited, motor.ctrlrange = True, (-1, 1)
    spec.add_sensor(name="angle", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT,
                    objname="hinge")
    return spec


class Filtered(lw.Task):
    model = staticmethod(pendulum)
    lagged = ("sensordata",)
    obs = {"angle": 1, "sensed_angle": 1, "control": 1}
    horizon = 6
"""


@pytest.fixture(scope="module")
def file(task_file: TaskFile) -> Path:
    return task_file("filtered.py", TASK)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_fields_of_the_last_substep_are_current_after_a_reset(file: Path, engine: str) -> None:
    env = lw.make(file, engine=engine, nworld=2)
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))
    for _ in range(6):
        env.step(torch.ones(2, 1))
        if not env.done.any():  # these fields still have the values of the previous substep
            assert (env.obs[:, 0] != env.obs[:, 1]).all()
    assert env.truncated.all()
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))


CLEARED = TASK.replace('lagged = ("sensordata",)', 'lagged = cleared = ("sensordata",)').replace("Filtered", "Cleared")


@pytest.mark.parametrize("fields", [[], ["xpos"], ["qacc"]])
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_fields_listed_as_cleared_are_zero_when_an_episode_begins(
    task_file: TaskFile, engine: str, fields: list[str]
) -> None:
    env = lw.make(task_file("cleared.py", CLEARED), engine=engine, nworld=2, fields=fields)
    assert torch.equal(env.obs[:, :2], torch.tensor([[0.5, 0.0]] * 2))
    for _ in range(6):
        env.step(torch.ones(2, 1))
        assert env.done.any() or env.obs[:, 1].all()
    assert env.truncated.all() and env.final_obs[:, 1].all()
    assert torch.equal(env.obs[:, :2], torch.tensor([[0.5, 0.0]] * 2))
    state = env.get_state()
    env.step(torch.ones(2, 1))
    stepped = env.obs.clone()
    env.set_state(state)
    assert torch.equal(env.obs[:, :2], torch.tensor([[0.5, 0.0]] * 2))
    env.step(torch.ones(2, 1))
    assert torch.equal(env.obs, stepped)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_view_of_a_field_stays_valid_after_its_environment_is_deleted(engine: str) -> None:
    field = lw.make("point_mass", engine=engine, nworld=64).field("qpos")
    before = field.clone()
    gc.collect()
    junk = [torch.full((64, 4), 7.0) for _ in range(200)]
    assert torch.equal(field, before), junk[0][0]


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_additional_fields_do_not_change_the_simulation(file: Path, engine: str) -> None:
    plain = lw.make(file, engine=engine, nworld=2, seed=3)
    other = lw.make(file, engine=engine, nworld=2, seed=3, fields=["qacc_warmstart", "xpos", "qacc"])
    parts = list(plain.state_space.parts)
    assert set(other.state_space.parts) - set(parts) == {"qacc"}
    for _ in range(8):
        plain.step(torch.ones(2, 1))
        other.step(torch.ones(2, 1))
        for name in parts:
            found, wanted = (env.state_space.split(env.get_state())[name] for env in (other, plain))
            assert torch.equal(found, wanted), name


@pytest.mark.parametrize("engine", [MujocoEngine, WarpEngine, ToyEngine])
def test_engine_has_arrays_for_the_requested_fields_and_the_controls(engine: type[Engine]) -> None:
    model = lw.gymnasium_model("hopper.xml").spec().compile()
    lagged, current = describe(model, "xpos", lagged=True), describe(model, "qpos")
    made = engine(model, 3, wp.get_device("cpu"), [lagged, current, current])
    assert made.fields == {"ctrl": describe(model, "ctrl"), "xpos": lagged, "qpos": current}
    assert made.arrays.keys() == made.fields.keys() and made.arrays["ctrl"] is made.ctrl
    assert made.snapshots == [lagged] and made.state_size == made.integration_size + lagged.size
    for name, field in made.fields.items():
        array = made.arrays[name]
        assert array.shape == (3, *field.shape) and array.dtype == field.dtype
    with pytest.raises(ValueError, match="the field 'xpos' is listed twice, as lagged and as current: list it once"):
        engine(model, 3, wp.get_device("cpu"), [lagged, describe(model, "xpos")])


def test_reset_does_not_change_faults_of_other_worlds() -> None:
    env = lw.make("hopper", nworld=3)
    env.step()
    env.engine.batch.warning[2, mujoco.mjtWarning.mjWARN_INERTIA.value, 1] = 1  # type: ignore[attr-defined]
    env.rand_reset(mask=torch.tensor([True, False, False]))
    env.step()
    assert env.done_reason.tolist() == [0, 0, int(lw.Done.ENGINE_WARNING)]


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_listed_fields_are_computed_even_if_the_task_does_not_read_them(engine: str) -> None:
    env = lw.make("adroit_pen", engine=engine, fields=["sensordata", "cfrc_ext"])
    size = env.state_space.size
    env.step()
    assert env.field("sensordata").abs().max() > 0
    assert env.field("cfrc_ext").shape == (1, env.model.nbody, 6)
    assert env.state_space.size == env.replicate(nworld=2).state_space.size == size
    for task, name in (("hopper", "cfrc_ext"), ("hopper", "sensordata"), ("adroit_pen", "sensordata")):
        with pytest.raises(ValueError, match=f"'{name}' only for a sensor.*task's World.*fields=\\['{name}'\\]"):
            lw.make(task, engine=engine).field(name)


def test_option_deterministic_has_no_effect_on_the_cpu() -> None:
    for engine in ("mujoco", "warp"):
        env = lw.make("point_mass", engine=engine, deterministic=True)
        assert env.replicate().options.physics.deterministic
        assert type(env.engine) is type(lw.make("point_mass", engine=engine).engine)
        env.step()


@pytest.mark.parametrize("partial", [True, False])
def test_an_overflow_in_the_first_state_of_an_episode_is_reported(
    partial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The initial state has more contacts than the buffer can hold."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
    spec = lw.gymnasium_model("humanoid.xml").spec()
    spec.body("torso").pos[2] = 0.1
    env = lw.make("humanoid", engine="warp", nworld=2, model=spec, nconmax=1, njmax=128, reset_noise_scale=0.0,
                  autoreset=False)  # fmt: skip
    env.reset(torch.tensor([True, False]))
    assert not env.done.any()
    env.step()
    assert env.done_reason[0] & int(lw.Done.CONTACT_OVERFLOW)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_threads_of_the_c_engine_fit_the_cores_that_the_process_may_use() -> None:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        engine = lw.make("hopper", nworld=4).engine
    finally:
        os.sched_setaffinity(0, cores)
    assert isinstance(engine, MujocoEngine) and engine.batch.nthread == 1
