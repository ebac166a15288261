import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import Done
from lyceum_warp.core import FAULTS
from lyceum_warp.testing import OUTCOMES

ENGINES = ["mujoco", "warp"]
N, BAD = 4, 1


def hopper(engine: str, **options: Any) -> lw.Env:
    env = lw.make("hopper", engine=engine, nworld=N, terminate_when_unhealthy=False, **options)
    env.reset()
    return env


def lay_down(env: lw.Env, world: int) -> None:
    """Put a hopper on the floor, where it has five contacts."""
    state, start = env.get_state(), env.state_space.parts["qpos"].start
    state[world, start + 1 : start + 3] = torch.tensor([0.05, 1.5], dtype=state.dtype)
    env.set_state(state, torch.arange(N) == world)


def step_both(env: lw.Env, clean: lw.Env, steps: int) -> Done:
    """Step an environment with a faulty world and one without. Their other worlds must be equal, bit for bit."""
    others, found = torch.arange(N) != BAD, Done(0)
    generator = torch.Generator().manual_seed(0)
    for i in range(steps):
        action = 2 * torch.rand(env.action.shape, generator=generator) - 1
        before = env.obs[BAD].clone()
        env.step(action)
        clean.step(action)
        for name in OUTCOMES:
            assert torch.equal(getattr(env, name)[others], getattr(clean, name)[others]), f"{name} at step {i}"
        assert torch.equal(env.get_state()[others], clean.get_state()[others]), f"the state at step {i}"
        reason = Done(int(env.done_reason[BAD]))
        if reason & FAULTS:
            assert env.truncated[BAD] and not env.terminated[BAD] and env.done[BAD]
            assert env.reward[BAD] == 0 and env.time[BAD] == 0
            assert torch.equal(env.final_obs[BAD], before), "final_obs is not the last good observation"
        found |= reason
        assert torch.isfinite(env.get_state()).all() and torch.isfinite(env.obs).all()
    return found


def test_exhausted_memory_of_the_c_engine_is_reported_as_a_fault() -> None:
    """Depending on the size of its memory, MuJoCo drops constraints, raises an error, or drops contacts."""
    found = Done(0)
    for memory in range(3000, 14_000, 1000):
        spec = lw.gymnasium_model("hopper.xml").spec()
        spec.memory = memory
        env, clean = hopper("mujoco", model=spec), hopper("mujoco")
        lay_down(env, BAD)
        reason = step_both(env, clean, 3)
        assert reason & FAULTS, f"no fault with {memory} bytes"
        assert sum(env.fault_counts.values()) >= 1
        found |= reason
    assert Done.CONTACT_OVERFLOW in found
    assert Done.CONSTRAINT_OVERFLOW in found
    assert Done.ENGINE_WARNING in found


def test_constraint_overflow_of_the_warp_engine_causes_a_fault_in_one_world() -> None:
    env, clean = (hopper("warp", nconmax=16, njmax=8) for _ in range(2))
    lay_down(env, BAD)
    assert step_both(env, clean, 5) == Done.CONSTRAINT_OVERFLOW
    assert env.fault_counts.pop("constraint_overflow") == sum(env.fault_counts.values()) == 1


def test_contact_overflow_on_warp_is_a_fault_in_every_world_that_loses_contacts() -> None:
    env = hopper("warp", nconmax=1, njmax=64)
    lay_down(env, BAD)
    before = env.obs.clone()
    env.step()
    flagged = env.done_reason == int(Done.CONTACT_OVERFLOW)
    assert flagged[BAD] and (env.done_reason[~flagged] == 0).all()
    assert (env.reward[flagged] == 0).all() and env.truncated[flagged].all()
    assert torch.equal(env.final_obs[flagged], before[flagged])
    assert env.fault_counts["contact_overflow"] == int(flagged.sum())
    for _ in range(5):
        env.step()
        assert not (env.done_reason & int(FAULTS)).any(), "the overflow outlived the reset"
        assert torch.isfinite(env.get_state()).all()


def test_overflow_of_a_contact_sensor_in_the_warp_engine_is_an_engine_warning() -> None:
    def make() -> lw.Env:
        spec = lw.gymnasium_model("hopper.xml").spec()
        sensor = spec.add_sensor(
            name="touch", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname="floor"
        )
        sensor.intprm[:] = [1, 0, 1]
        env = hopper("warp", model=spec, nconmax=16, njmax=64)
        opt = env.engine.m.opt  # type: ignore[attr-defined]
        opt.contact_sensor_maxmatch = 1
        opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        return env

    env, clean = make(), make()
    lay_down(env, BAD)
    assert step_both(env, clean, 4) == Done.ENGINE_WARNING
    assert env.fault_counts["engine_warning"] == 1


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("number", [np.nan, 1e11])
def test_bad_number_in_a_quaternion_is_a_fault(number: float, engine: str) -> None:
    env, clean = (lw.make("ant", engine=engine, nworld=N) for _ in range(2))
    for each in (env, clean):
        each.reset()
    state, start = env.get_state(), env.state_space.parts["qpos"].start
    state[BAD, start + 4] = number
    env.set_state(state, torch.arange(N) == BAD, check=False)
    assert Done.NAN in step_both(env, clean, 3)
    assert env.fault_counts["nan"] == 1


@pytest.mark.parametrize("engine", ENGINES)
def test_faults_print_and_log_nothing_over_150_steps(
    engine: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A world gets a NaN every five steps."""
    monkeypatch.chdir(tmp_path)
    env, clean = (lw.make("hopper", engine=engine, nworld=N) for _ in range(2))
    start, only = env.state_space.parts["qvel"].start, torch.arange(N) == BAD
    capfd.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for i in range(30):
            state = env.get_state()
            state[BAD, start + i % 6] = (np.nan, np.inf, 1e200, -1e15)[i % 4]
            env.set_state(state, only, check=False)
            assert torch.isfinite(env.obs).all() and not env.done[BAD]
            assert Done.NAN in step_both(env, clean, 5)  # the state may also cause other faults
    assert env.fault_counts["nan"] == 30
    assert sum(clean.fault_counts.values()) == 0
    printed = capfd.readouterr()
    assert printed.out == "" and printed.err == ""
    assert not list(tmp_path.iterdir()), "a log was written"


@pytest.mark.parametrize("engine", ENGINES)
def test_without_automatic_resets_only_a_fault_restarts_a_world(engine: str) -> None:
    env = lw.make("hopper", engine=engine, nworld=N, autoreset=False, horizon=3)
    for _ in range(5):
        env.step()
    assert env.truncated.all() and not env.terminated.any()
    env.action[BAD, 2] = np.inf
    env.step()
    assert env.done_reason[BAD] == int(Done.TRUNCATED | Done.ACTION)
    assert env.time[BAD] == 0 and (env.time[[0, 2, 3]] > 0).all()


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("hopper", engine="mujoco", nworld=N)


def test_invalid_action_raises_an_error(env: lw.Env) -> None:
    for method in (env.step, env.set_action):
        with pytest.raises(ValueError, match=r"action must be .* of shape \(4, 3\), not a float32 tensor"):
            method(torch.zeros(3))
    action = torch.zeros(N, 3)
    action[2, 1] = np.nan
    with pytest.raises(ValueError, match="the action 'actuator_1' of world 2 is nan: it must be finite"):
        env.set_action(action)


def test_state_of_wrong_shape_or_with_non_finite_values_raises_an_error(env: lw.Env) -> None:
    state = env.get_state()
    with pytest.raises(ValueError, match=r"state must be a float64 tensor of shape \(4, \d+\), not a float32 tensor"):
        env.set_state(state.float())
    bad = state.clone()
    bad[1, env.state_space.parts["qpos"].start] = np.nan
    bad[2, env.state_space.parts["qvel"].start] = -np.inf
    for call in (env.set_state, env.get_obs, env.get_eval, env.get_terminated):
        with pytest.raises(ValueError, match="the state of world 1 has nan in its 'qpos': states .* be finite"):
            call(bad)
    mask = torch.tensor([True, False, True, False])
    with pytest.raises(ValueError, match="the state of world 2 has -inf in its 'qvel'"):
        env.set_state(bad, mask)
    assert torch.equal(env.get_state(), state), "a refused state has changed something"
    env.set_state(bad, ~mask & (torch.arange(N) != 1))  # actions of worlds outside the mask are not read
    assert torch.equal(env.get_state(), state)


def test_masks_and_outputs_of_wrong_shape_or_type_raise_an_error(env: lw.Env) -> None:
    state = env.get_state()
    calls = (env.reset, lambda mask: env.rand_reset(mask=mask), lambda mask: env.set_state(state, mask))
    for call in calls:
        with pytest.raises(ValueError, match=r"a mask must be a bool tensor of shape \(4,\), not "):
            call([True] * N)
    with pytest.raises(ValueError, match=r"out must be a float32 tensor of shape \(4, 11\), not a "):
        env.get_obs(out=torch.zeros(N, 10))
    with pytest.raises(ValueError, match="pass before, action and after, or none of the three"):
        env.get_reward(env.get_state())
    with pytest.raises(ValueError, match="action must be"):
        env.get_reward(env.get_state(), torch.zeros(3), env.get_state())
    with pytest.raises(ValueError, match="seed must be"):
        env.rand_reset(-3)
