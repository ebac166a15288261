import copy
import itertools
from collections.abc import Callable, Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import step_table as table
import warp as wp
from mujoco_warp._src import constraint
from step_table import Case

from lyceum_warp.core.fields import Stage, describe, early_sensor_columns
from lyceum_warp.core.model_fields import PICTURED, VARYING_FIELDS, Constants, ModelField, describe_model_field
from lyceum_warp.engines.deterministic.deterministic_engine import DeterministicEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine

N = 2
SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> wp.Device:
    return wp.get_device(request.param)


def make(model: mujoco.MjModel, names: list[str], device: wp.Device, dynamics: Sequence[ModelField] = ()) -> WarpEngine:
    fields = [describe(model, name) for name in dict.fromkeys(("qpos", "qvel", *names))]
    kind = DeterministicEngine if device.is_cuda else WarpEngine
    return kind(model, N, device, fields, dynamics, nconmax=64, njmax=256)


def begin(engine: WarpEngine, mask: wp.array, seed: int) -> None:
    rng, chosen, model = np.random.default_rng(seed), mask.numpy(), engine.model
    engine.reset(mask)
    qpos, qvel = engine.arrays["qpos"].numpy(), engine.arrays["qvel"].numpy()
    for w in np.flatnonzero(chosen):
        row = qpos[w].astype(float)
        mujoco.mj_integratePos(model, row, 0.03 * rng.normal(size=model.nv), 1.0)
        qpos[w], qvel[w] = row, 0.3 * rng.normal(size=model.nv)
    engine.arrays["qpos"].assign(qpos)
    engine.arrays["qvel"].assign(qvel)
    engine.commit(mask)
    engine.refresh(mask)


def state_of(engine: WarpEngine, m: mjw.Model, d: mjw.Data) -> np.ndarray:
    state = wp.zeros((N, engine.integration_size), dtype=float, device=engine.device)
    mjw.get_state(m, d, state, SPEC)
    return state.numpy()


def plain(function: Callable[[mjw.Model, mjw.Data], None], m: mjw.Model, d: mjw.Data) -> None:
    """Run MuJoCo Warp's step or forward pass, but compute constraints from the current velocities.

    MuJoCo Warp's ``make_constraint`` uses the velocities of the last forward pass. The engine recomputes them, so that
    a step depends only on the state.
    """

    def make_constraint(m: mjw.Model, d: mjw.Data) -> None:
        mjw.com_vel(m, d)
        original(m, d)

    original = constraint.make_constraint
    with pytest.MonkeyPatch.context() as patch, wp.ScopedDevice(d.qpos.device):
        patch.setattr(constraint, "make_constraint", make_constraint)
        function(m, d)


def check(case: Case, device: wp.Device) -> None:
    model, names = table.model_of(case), table.fields_of(case)
    engine = make(model, names, device)
    begin(engine, wp.full(N, True, dtype=bool, device=device), 1)
    m, d = engine.bare()
    for t in range(2):
        if t == 1:
            begin(engine, wp.array([False, True], dtype=bool, device=device), 3)
        before = state_of(engine, engine.m, engine.d)
        set_state(m, d, before)
        controls = np.random.default_rng(t).uniform(-1, 1, size=engine.ctrl.shape).astype(np.float32)
        engine.ctrl.assign(controls)
        d.ctrl.assign(controls)
        engine.step(1 + t)
        for _ in range(1 + t):
            plain(mjw.step, m, d)
        found, wanted = state_of(engine, engine.m, engine.d), state_of(engine, m, d)
        assert np.isfinite(wanted).all() and (found != before).any()
        np.testing.assert_array_equal(found, wanted, err_msg="state")
    last = {name: getattr(d, name).numpy().copy() for name in names}
    set_state(m, d, found)
    plain(mjw.forward, m, d)
    if "energy" in names:  # with an energy sensor, MuJoCo Warp's forward pass loses the kinetic energy
        mjw.energy_pos(m, d)
        mjw.energy_vel(m, d)
    late = np.setdiff1d(np.arange(model.nsensordata), early_sensor_columns(model))
    for name in names:
        value, current = engine.arrays[name].numpy(), getattr(d, name).numpy()
        if name == "sensordata":
            current[:, late] = last[name][:, late]
        elif engine.fields[name].reset == Stage.ACCELERATION:
            current = last[name]
        np.testing.assert_array_equal(value, current.reshape(value.shape), err_msg=name)


def set_state(m: mjw.Model, d: mjw.Data, state: np.ndarray) -> None:
    mjw.set_state(m, d, wp.array(state, dtype=float, device=d.qpos.device), SPEC)


def check_or_refuse(case: Case, device: wp.Device) -> None:
    if device.is_cuda and case["flex"] != "none":
        with pytest.raises(ValueError, match="can't sort the contacts of flexes"):
            make(table.model_of(case), [], device)
    else:
        check(case, device)


@pytest.mark.parametrize("case", table.covering(1), ids=table.title)
def test_step_equals_that_of_mujoco_warp_bit_for_bit(case: Case, device: wp.Device) -> None:
    check_or_refuse(case, device)


@pytest.mark.long
@pytest.mark.parametrize("case", table.covering(2), ids=table.title)
def test_step_with_any_two_model_features_equals_that_of_mujoco_warp(case: Case, device: wp.Device) -> None:
    check_or_refuse(case, device)


LADEN = table.PLAIN | {
    "armature": "motors", "tendons": "springs", "equality": "weld", "fluid": "ellipsoid", "gravcomp": "passive",
}  # fmt: skip


@pytest.mark.quick("com", "tendon", "transmission", "com velocity", "energy", "acceleration")
@pytest.mark.parametrize("asked", table.STAGES)
def test_step_reuses_fields_that_are_already_computed(asked: str, device: wp.Device) -> None:
    check(LADEN | {"asked": asked}, device)


DRAWN = table.PLAIN | {
    "drives": "filtered", "asked": "bodies", "sensors": "position", "tendons": "limits", "adhesion": "pair",
    "equality": "connect", "armature": "none",
}  # fmt: skip
OF_ANOTHER_MODEL = {
    "wind": {"fluid": "box"}, "tendon_armature": {"tendons": "plain"}, "tendon_lengthspring": {"tendons": "springs"},
    "tendon_solref_fri": {"tendons": "friction"}, "tendon_solimp_fri": {"tendons": "friction"},
    "pair_solreffriction": {"cone": "elliptic"},
}  # fmt: skip
"""Each of these fields affects only certain models. Its value gives the levels of such a model. All other factors have
the levels in ``DRAWN``."""


def touching(model: mujoco.MjModel) -> np.ndarray:
    """Return states (N, integration size) with contacts, saturated actuators and joints at their limits."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[model.joint("elbow").qposadr[0]] = 0.1
    data.qvel[:] = 0.05 * rng.normal(size=model.nv)
    data.act[:] = 1.5
    data.ctrl[:] = 0.5
    state = np.empty(mujoco.mj_stateSize(model, SPEC))
    mujoco.mj_getState(model, data, state, SPEC)
    return np.tile(state, (N, 1))


@pytest.mark.quick(
    "body_mass", "body_inertia", "body_ipos", "qpos0", "dof_armature", "actuator_gear", "geom_size", "geom_gap",
    "cam_pos", "tendon_armature", "wind", "tendon_frictionloss", "body_gravcomp", "geom_quat", "jnt_pos",
)  # fmt: skip
@pytest.mark.parametrize("name", [name for name in VARYING_FIELDS if name not in PICTURED])
def test_randomized_field_has_the_same_effect_as_an_edited_model(name: str, device: wp.Device) -> None:
    """Require bitwise equality unless constants are derived from the field."""
    case = DRAWN | OF_ANOTHER_MODEL.get(name, {})
    spec = mujoco.MjSpec.from_string(table.xml(case))
    for body in spec.bodies[1:]:
        body.simple = 0
    model = spec.compile()
    edited, field = copy.copy(model), describe_model_field(model, name)
    value = field.value(edited)
    # most joints slip, and then solref does not affect their friction force
    most = 3.0 if name == "dof_solref" else 1.1
    drawn = value * np.random.default_rng(0).uniform(1.0, most, size=value.shape) + 0.03 * (value == 0)
    if name.endswith("quat"):
        drawn = value + 0.05
        drawn /= np.linalg.norm(drawn, axis=-1, keepdims=True)
    drawn = drawn.astype(np.float32)
    if field.option:
        setattr(edited.opt, name, drawn if drawn.ndim else float(drawn))
    else:
        value[...] = drawn
    mujoco.mj_setConst(edited, mujoco.MjData(edited))
    names = table.fields_of(case)
    engine, wanted = make(model, names, device, [field]), make(edited, names, device)
    rows = engine.arrays[name].numpy()
    rows[1] = drawn.reshape(rows[1].shape)
    engine.arrays[name].assign(rows)
    everyone = wp.full(N, True, dtype=bool, device=device)
    engine.apply_model(everyone)
    for made in (engine, wanted):
        made.reset(everyone)
        set_state(made.m, made.d, touching(model))
        made.refresh(everyone)
        for nstep in (1, 2):
            made.step(nstep)
    found, expected = state_of(engine, engine.m, engine.d), state_of(wanted, wanted.m, wanted.d)
    tolerance = 1e-4 if field.constants & ~Constants.PRIVATE else 0.0
    same = np.True_
    pairs = {shown: [made.arrays[shown].numpy().reshape(N, -1) for made in (engine, wanted)] for shown in names}
    for shown, pair in {"state": [found, expected], **pairs}.items():
        same &= (pair[0][1] == pair[0][0]).all()
        scale = tolerance * max(1.0, float(np.abs(pair[1]).max()))
        np.testing.assert_allclose(pair[0][1], pair[1][1], rtol=tolerance, atol=scale, err_msg=shown)
    assert same == (name == "geom_gap"), "only contacts within a gap, which exert no force, change nothing"


@pytest.mark.parametrize(("levels", "reason"), table.REFUSED)
def test_engines_reject_the_listed_combinations(levels: dict[str, tuple[str, ...]], reason: str) -> None:
    for chosen in itertools.product(*levels.values()):
        with pytest.raises((ValueError, NotImplementedError), match=reason):
            make(table.model_of(table.PLAIN | dict(zip(levels, chosen, strict=True))), [], wp.get_device("cpu"))
