"""The Warp engine's step equals MuJoCo Warp's own to the bit, with any element of a model and any field of World."""

import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import step_table as table
import warp as wp
from mujoco_warp._src import constraint
from step_table import Case

from lyceum_warp.engines.deterministic.deterministic_engine import DeterministicEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.fields import Stage, describe, early_sensor_columns

N = 2
SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> wp.Device:
    """A device on which steps repeat to the bit; on a GPU in the deterministic mode."""
    return wp.get_device(request.param)


def make(model: mujoco.MjModel, names: list[str], device: wp.Device) -> WarpEngine:
    fields = [describe(model, name) for name in dict.fromkeys(("qpos", "qvel", *names))]
    kind = DeterministicEngine if device.is_cuda else WarpEngine
    return kind(model, N, device, fields, nconmax=64, njmax=256)


def begin(engine: WarpEngine, mask: wp.array, seed: int) -> None:
    """Episodes in the masked worlds, in states drawn at random."""
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
    """A step or a forward pass of MuJoCo Warp's own, with the velocities that its constraints read.

    ``make_constraint`` reads the velocities of bodies that the last forward pass computed. Here they are the current
    ones, in every stage of a step: the engine's steps are functions of the state alone by design.
    """

    def make_constraint(m: mjw.Model, d: mjw.Data) -> None:
        mjw.com_vel(m, d)
        original(m, d)

    original = constraint.make_constraint
    with pytest.MonkeyPatch.context() as patch, wp.ScopedDevice(d.qpos.device):
        patch.setattr(constraint, "make_constraint", make_constraint)
        function(m, d)


def check(case: Case, device: wp.Device) -> None:
    """Steps and fields of an engine against MuJoCo Warp's own."""
    model, names = table.model_of(case), table.fields_of(case)
    engine = make(model, names, device)
    everyone = wp.full(N, True, dtype=bool, device=device)
    begin(engine, everyone, 1)
    m, d = engine.bare()
    fresh = engine.bare()
    rng = np.random.default_rng(2)
    for t in range(3):
        if t == 2:
            begin(engine, wp.array([False, True], dtype=bool, device=device), 3)
        before = wp.array(state_of(engine, engine.m, engine.d), dtype=float, device=device)
        mjw.set_state(m, d, before, SPEC)
        controls = rng.uniform(-1, 1, size=engine.ctrl.shape).astype(np.float32)
        engine.ctrl.assign(controls)
        d.ctrl.assign(controls)
        nstep = 1 + t % 2
        engine.step(nstep)
        for _ in range(nstep):
            plain(mjw.step, m, d)
        found, wanted = state_of(engine, engine.m, engine.d), state_of(engine, m, d)
        assert np.isfinite(wanted).all() and (found != before.numpy()).any()
        np.testing.assert_array_equal(found, wanted, err_msg="state")
    mjw.set_state(*fresh, wp.array(found, dtype=float, device=device), SPEC)
    plain(mjw.forward, *fresh)
    for name in names:
        stage = engine.fields[name].reset
        current = fresh[1] if stage < Stage.ACCELERATION or name == "sensordata" else d
        value = engine.arrays[name].numpy()
        expected = getattr(current, name).numpy().reshape(value.shape)
        if name == "sensordata":
            late = np.setdiff1d(np.arange(model.nsensordata), early_sensor_columns(model))
            expected[:, late] = d.sensordata.numpy()[:, late]
        np.testing.assert_array_equal(value, expected, err_msg=name)


def refused_on(device: wp.Device, case: Case) -> bool:
    return device.is_cuda and case["flex"] != "none"  # the deterministic mode cannot sort a flex's contacts


@pytest.mark.parametrize("case", table.covering(2), ids=table.title)
def test_a_step_equals_mujoco_warps_own_to_the_bit(case: Case, device: wp.Device) -> None:
    if refused_on(device, case):
        with pytest.raises(ValueError, match="can't sort the contacts of flexes"):
            make(table.model_of(case), [], device)
    else:
        check(case, device)
