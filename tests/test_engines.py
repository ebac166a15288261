"""What a task can do on one engine it can do on the other: fields, controls and resets beyond the package's tasks."""

import copy
import dataclasses
import gc
import re
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from conftest import TaskFile

import lyceum_warp as lw
from lyceum_warp.engines.deterministic import order_kernels as order
from lyceum_warp.engines.deterministic.contact_order import CanonicalOrder
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
def test_lagged_fields_are_those_of_the_new_state_after_a_reset(file: Path, engine: str) -> None:
    env = lw.make(file, engine=engine, nworld=2)
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))
    for _ in range(6):
        env.step(torch.ones(2, 1))
        if not env.done.any():  # one substep behind the state
            assert (env.obs[:, 0] != env.obs[:, 1]).all()
    assert env.truncated.all()
    torch.testing.assert_close(env.obs[:, :2], torch.full((2, 2), 0.5))


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_controls_belong_to_the_state(file: Path, engine: str) -> None:
    """A control that filters goes on from what was restored, and starts from zero after a reset."""
    env = lw.make(file, engine=engine, nworld=2, horizon=0)
    action = torch.ones(2, 1)

    def run() -> list[float]:
        controls = []
        for _ in range(4):
            env.step(action)
            controls.append(env.obs[0, 2].item())
        return controls

    env.reset()
    first, state = run(), env.get_state()
    np.testing.assert_allclose(first, 1 - 0.9 ** np.arange(1, 5), rtol=1e-5)
    after = run()
    env.set_state(state)
    assert run() == after
    env.reset()
    assert run() == first


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_view_of_a_field_outlives_its_environment(engine: str) -> None:
    field = lw.make("point_mass", engine=engine, nworld=64).field("qpos")
    before = field.clone()
    gc.collect()
    junk = [torch.full((64, 4), 7.0) for _ in range(200)]
    assert torch.equal(field, before), junk[0][0]


def test_asking_for_a_field_changes_nothing(file: Path) -> None:
    plain, curious = lw.make(file, nworld=2, seed=3), lw.make(file, nworld=2, seed=3)
    curious.field("qacc_warmstart")
    curious.field("xpos")
    for _ in range(8):
        plain.step(torch.ones(2, 1))
        curious.step(torch.ones(2, 1))
        assert torch.equal(plain.get_state(), curious.get_state())


def test_a_reset_leaves_the_faults_of_other_worlds_alone() -> None:
    env = lw.make("hopper", nworld=3)
    env.step()
    env.engine.batch.warning[2, mujoco.mjtWarning.mjWARN_INERTIA.value, 1] = 1  # type: ignore[attr-defined]
    env.rand_reset(mask=torch.tensor([True, False, False]))
    env.step()
    assert env.done_reason.tolist() == [0, 0, int(lw.Done.ENGINE_WARNING)]


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_integrator_and_solver(engine: str) -> None:
    solver = {"iterations": 3, "ls_iterations": 7, "noslip_iterations": 2}
    env = lw.make("point_mass", engine=engine, nworld=2, integrator="implicitfast", solver=solver)
    for other in (env, env.replicate(nworld=1)):
        options = other.model.opt
        assert options.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        assert (options.iterations, options.ls_iterations, options.noslip_iterations) == (3, 7, 2)
        other.step()
        assert torch.isfinite(other.obs).all()
    if engine == "warp":
        opt = env.engine.m.opt  # type: ignore[attr-defined]
        assert (int(opt.integrator), opt.iterations, opt.ls_iterations) == (int(options.integrator), 3, 7)
    assert lw.make("point_mass", engine=engine).model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def test_the_integrator_matters_and_both_engines_have_it() -> None:
    ends = {}
    for integrator in ("euler", "rk4"):
        for engine in ("mujoco", "warp"):
            env = lw.make("hopper", engine=engine, integrator=integrator, reset_noise_scale=0.0)
            env.reset()
            env.step(torch.ones(1, 3))
            ends[integrator, engine] = env.obs
        torch.testing.assert_close(ends[integrator, "warp"], ends[integrator, "mujoco"], rtol=1e-3, atol=1e-3)
    assert (ends["euler", "mujoco"] - ends["rk4", "mujoco"]).abs().max() > 3e-3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"integrator": "rk5"}, "no integrator 'rk5': use 'euler', 'rk4', 'implicit' or 'implicitfast'"),
        ({"integrator": 1}, "no integrator 1: use"),
        ({"solver": {"iteration": 3}}, "no limit 'iteration': it takes 'iterations', 'ls_iterations', 'noslip_"),
        ({"solver": {"iterations": 0}}, "solver's iterations must be a whole number from 1 to .*, not 0"),
        ({"solver": 4}, "solver has to be a dict of limits, as .*, not 4"),
        ({"iterations": 4}, r"no parameter 'iterations': did you mean solver=\{'iterations': ...\}"),
        ({"nvtx": True}, "nvtx=True marks phases through torch"),
    ],
)
def test_options_that_make_no_sense(options: dict[str, object], message: str) -> None:
    if "nvtx" in options and torch.backends.cuda.is_built():
        pytest.skip("this torch can")
    with pytest.raises(ValueError, match=message):
        lw.make("point_mass", **options)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_fields_that_the_task_does_not_read(engine: str) -> None:
    """Where a sensor is needed for one, it has to be said beforehand: else nobody pays for sensors."""
    env = lw.make("adroit_pen", engine=engine, fields=["sensordata", "cfrc_ext"])
    size = env.state_space.size  # contact forces belong to the state, and are there from the start
    env.step()
    assert env.field("sensordata").abs().max() > 0
    assert env.field("cfrc_ext").shape == (1, env.model.nbody, 6)
    assert env.state_space.size == env.replicate(nworld=2).state_space.size == size
    for task, name in (("hopper", "cfrc_ext"), ("hopper", "sensordata"), ("adroit_pen", "sensordata")):
        with pytest.raises(ValueError, match=f"'{name}' only for a sensor.*task's World.*fields=\\['{name}'\\]"):
            lw.make(task, engine=engine).field(name)
    for wrong in ("sensordata", 7, ["qpos", 7]):
        with pytest.raises(ValueError, match=f"as in fields=.*, not {re.escape(repr(wrong))}"):
            lw.make("adroit_pen", engine=engine, fields=wrong)
    with pytest.raises(ValueError, match="there is no field 'qacceleration'"):
        lw.make("adroit_pen", engine=engine, fields=["qacceleration"])


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_fields_are_current_however_little_is_computed_for_them(engine: str) -> None:
    """Each needs more of a forward pass than those before it, and all are asked for as time goes on."""
    env = lw.make("hopper", nworld=2, engine=engine, horizon=2, seed=1)
    parts = env.state_space.parts
    asked = []
    for name in ("xipos", "cinert", "cvel", "qfrc_bias"):
        env.field(name)
        asked.append(name)
        for _ in range(3):  # an episode ends, and another begins
            env.step(torch.ones_like(env.action))
            state, data = env.get_state()[1].numpy(), mujoco.MjData(env.model)
            data.qpos[:], data.qvel[:] = state[parts["qpos"]], state[parts["qvel"]]
            mujoco.mj_forward(env.model, data)
            for known in asked:
                found, wanted = env.field(known)[1].numpy(), getattr(data, known)
                np.testing.assert_allclose(found.reshape(wanted.shape), wanted, atol=1e-4, rtol=1e-4, err_msg=known)


def test_deterministic_is_given_on_the_cpu() -> None:
    for engine in ("mujoco", "warp"):
        env = lw.make("point_mass", engine=engine, deterministic=True)
        assert env.replicate()._options["deterministic"]
        env.step()


def test_an_unrolled_solver_gives_the_same_numbers() -> None:
    """Iterations that a world does not need leave it as it is."""
    looped, unrolled = (
        lw.make("half_cheetah", nworld=3, engine="warp", solver={"iterations": 6}, unroll=unroll)
        for unroll in (False, True)
    )
    actions = 2 * torch.rand(12, *looped.action.shape, generator=torch.Generator().manual_seed(0)) - 1
    for env in (looped, unrolled):
        for action in actions:
            env.step(action)
    assert torch.equal(looped.get_state(), unrolled.get_state())
    assert not unrolled.replicate().engine.m.opt.graph_conditional  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=r"unroll=True repeats all of the solver's 100 iterations .*'iterations': 4"):
        lw.make("half_cheetah", engine="warp", unroll=True)
    lw.make("half_cheetah", engine="mujoco", unroll=True).step()


PHASES = ["act", "physics", "judge", "restart", "refresh", "look"]


@pytest.mark.parametrize("record", [True, False])
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_profiler_sees_the_phases(engine: str, record: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, open_ranges = [], []
    monkeypatch.setattr(torch.backends.cuda, "is_built", lambda: True)
    monkeypatch.setattr(torch.cuda.nvtx, "range_push", lambda name: open_ranges.append(name))
    monkeypatch.setattr(torch.cuda.nvtx, "range_pop", lambda: seen.append(open_ranges.pop()))
    marked = lw.make("reach", engine=engine, nworld=2, nvtx=True, record=record)
    plain = lw.make("reach", engine=engine, nworld=2)
    for _ in range(4):
        seen.clear()
        marked.step()
        plain.step()
        assert seen == [phase for phase in PHASES if phase != "refresh" or marked.engine.reset_stage > 0]
        assert not open_ranges
    assert torch.equal(marked.get_state(), plain.get_state()) and torch.equal(marked.obs, plain.obs)


def test_worlds_that_begin_again_get_a_forward_pass_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether in a group of one world at a time or all together, a run is the same to the bit."""
    runs = []
    for partial in (True, False):
        monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
        env = lw.make("humanoid", engine="warp", nworld=3, horizon=5, seed=1)
        state = env.get_state()
        state[1, env.state_space.parts["step"]] = 3
        env.set_state(state)
        run = []
        for _ in range(8):
            env.step(torch.full_like(env.action, 0.3))
            run.append((env.done.clone(), env.obs.clone(), env.get_state()))
        runs.append(run)
    assert sum(int(done.sum()) for done, *_ in runs[0]) >= 4
    for one, other in zip(*runs, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_the_contact_pool_has_room_for_one_absurd_world() -> None:
    env = lw.make("humanoid", engine="warp", nworld=4)
    engine = env.engine
    assert isinstance(engine, WarpEngine)
    assert engine.naconmax == 4 * engine.nconmax + engine.spare == engine.d.naconmax and engine.spare >= 256
    model, data = engine.bare()
    assert (data.naconmax, data.njmax, model.opt.warn_overflow) == (engine.naconmax, engine.njmax, 0)
    assert lw.make("point_mass", engine="warp", nconmax=8).engine.naconmax == 8  # type: ignore[attr-defined]


@pytest.mark.parametrize("partial", [True, False])
def test_an_overflow_while_a_world_begins_again_is_told(partial: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a reset at once, within a step with the next one; here a world begins in more contacts than have room."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
    spec = lw.gymnasium_model("humanoid.xml")
    spec.body("torso").pos[2] = 0.1
    env = lw.make("humanoid", engine="warp", nworld=2, model=spec, nconmax=1, njmax=128, reset_noise_scale=0.0,
                  autoreset=False)  # fmt: skip
    env.reset(torch.tensor([True, False]))
    told = [bool(reason & int(lw.Done.CONTACT_OVERFLOW)) for reason in env.done_reason.tolist()]
    assert told[0]


# what MuJoCo Warp leaves to chance on a GPU is shuffled here by hand, and put in order again


@pytest.fixture(scope="module", params=["dense", "sparse"])
def forwarded(request: pytest.FixtureRequest) -> tuple[WarpEngine, CanonicalOrder]:
    """Humanoids on the ground after the position stage, with contacts and limits, and what puts them in order."""
    model = copy.copy(lw.make("humanoid").model)
    model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{request.param.upper()}")
    engine = WarpEngine(model, 3, wp.get_device("cpu"))
    qpos = engine.field("qpos").numpy()
    qpos[:, 2] = (1.2, 0.25, 0.3)
    qpos[1:, 3:7] = (0.7, 0.0, 0.7, 0.0)
    qpos[:, 7:] = np.random.default_rng(0).uniform(-1.5, 1.5, qpos[:, 7:].shape)
    sorter = CanonicalOrder(engine.m, engine.d)
    return engine, sorter


def contents(*owners: object) -> dict[str, np.ndarray]:
    return {f.name: getattr(o, f.name).numpy().copy() for o in owners for f in dataclasses.fields(o)}  # type: ignore[arg-type]


def test_contacts_get_into_the_same_order_whoever_came_first(forwarded: tuple[WarpEngine, CanonicalOrder]) -> None:
    engine, _ = forwarded
    m, d = engine.m, engine.d
    sort_rows, m.callback.passive = m.callback.passive, None
    mjw.fwd_position(m, d)
    n, wanted = int(d.nacon.numpy()[0]), contents(d.contact)
    assert n > 8 and len(set(wanted["worldid"][:n])) > 1
    assert (np.diff(wanted["worldid"][:n]) >= 0).all()
    shuffle = np.random.default_rng(1).permutation(n)
    assert (shuffle != np.arange(n)).any()
    for name, values in wanted.items():
        if len(values):
            getattr(d.contact, name).numpy()[:n] = values[:n][shuffle]
    m.callback.contactfilter(m, d)
    for name, values in contents(d.contact).items():
        np.testing.assert_array_equal(values[:n], wanted[name][:n], err_msg=name)
    m.callback.passive = sort_rows


def test_rows_get_into_the_same_order_whoever_came_first(forwarded: tuple[WarpEngine, CanonicalOrder]) -> None:
    engine, sorter = forwarded
    m, d = engine.m, engine.d
    mjw.fwd_position(m, d)
    sorter.sort_rows(m, d)
    wanted, counts = contents(d.efc), d.nefc.numpy()
    addresses = d.contact.efc_address.numpy().copy()
    assert counts.max() > 20
    names = [name for name in order.Rows.vars if not name.startswith("jtdaj")]  # type: ignore[attr-defined]
    rng = np.random.default_rng(2)
    for w, n in enumerate(counts):
        kinds = np.minimum(wanted["type"][w, :n], 5)
        groups = {key: rng.random() for key in zip(kinds, wanted["id"][w, :n], strict=True)}
        keys = [groups[kind, i] for kind, i in zip(kinds, wanted["id"][w, :n], strict=True)]
        shuffle = np.argsort(keys, kind="stable")  # rows of one constraint come together and in order
        place = np.argsort(shuffle)
        for name in names:
            array = getattr(d.efc, name).numpy()
            if not (name == "J" and m.is_sparse) and array.shape[1]:
                array[w, :n] = wanted[name][w, :n][shuffle]
        mine = d.contact.worldid.numpy()[: int(d.nacon.numpy()[0])] == w
        rows = d.contact.efc_address.numpy()[: len(mine)]
        rows[mine] = np.where(addresses[: len(mine)][mine] >= 0, place[addresses[: len(mine)][mine]], -1)
        if m.is_sparse:
            blocks = rng.permutation(nblock := wanted["jtdaj_nblock"][w])
            d.efc.jtdaj_adr.numpy()[w, :nblock] = place[wanted["jtdaj_adr"][w, blocks]]
            d.efc.jtdaj_nrow.numpy()[w, :nblock] = wanted["jtdaj_nrow"][w, blocks]
    assert (d.efc.id.numpy() != wanted["id"]).any()
    sorter.sort_rows(m, d)
    found = contents(d.efc)
    for name in names:
        for w, n in enumerate(counts):
            np.testing.assert_array_equal(found[name][w, :n], wanted[name][w, :n], err_msg=name)
    for w, nblock in enumerate(wanted["jtdaj_nblock"] if m.is_sparse else ()):
        for name in ("jtdaj_adr", "jtdaj_nrow"):
            np.testing.assert_array_equal(found[name][w, :nblock], wanted[name][w, :nblock], err_msg=name)
    n = int(d.nacon.numpy()[0])
    np.testing.assert_array_equal(d.contact.efc_address.numpy()[:n], addresses[:n])


def test_order_changes_no_more_than_rounding(forwarded: tuple[WarpEngine, CanonicalOrder]) -> None:
    engine, sorter = forwarded
    m, d = engine.m, engine.d
    mjw.forward(m, d)
    ordered = d.qacc.numpy().copy()
    m.callback.contactfilter = m.callback.passive = None
    mjw.forward(m, d)
    plain = d.qacc.numpy().copy()
    m.callback.contactfilter, m.callback.passive = sorter.sort_contacts, sorter.sort_rows
    np.testing.assert_allclose(ordered, plain, rtol=1e-3, atol=1e-3 * np.abs(plain).max())
