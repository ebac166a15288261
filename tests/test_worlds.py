"""Worlds: the phases of a step, a reset and a restored state, and what they leave in the arrays."""

import pytest
import torch
import warp as wp
from conftest import SharedEnv
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.kernels import steps

ENGINES = ["mujoco", "warp"]


@pytest.mark.parametrize("engine", ENGINES)
def test_phases_run_by_hand_have_the_numbers_of_a_step(engine: str) -> None:
    env, by_hand = (lw.make("reach", nworld=3, engine=engine, horizon=4, seed=2) for _ in range(2))
    for i in range(6):
        env.action.fill_(0.1 * i)
        by_hand.action.fill_(0.1 * i)
        env.step()
        for phase in by_hand.worlds.step_phases():
            phase.run()
        for name in steps.OUTCOMES:
            assert torch.equal(getattr(env, name), getattr(by_hand, name)), f"{name} at step {i}"
    assert torch.equal(env.get_state(), by_hand.get_state())


def test_metrics_of_a_step_and_of_its_episode_are_two_arrays() -> None:
    env = lw.make(Metered, nworld=3)
    for name in ("metrics", "episode_metrics"):
        array = getattr(env.worlds, name)
        assert array.shape == (3, 2)
        assert [values.data_ptr() - array.ptr for values in getattr(env, name).values()] == [0, 4]


def test_resets_and_restored_states_are_lists_of_phases(shared_env: SharedEnv) -> None:
    worlds = shared_env("reach").worlds
    assert [phase.name for phase in worlds.reset_phases(randomly=True)] == ["restart", "refresh", "judge"]
    assert [phase.name for phase in worlds.read_phases()] == ["read state"]
    assert [phase.name for phase in worlds.restore_phases()] == ["restore engine", "restore counters", "judge"]


def test_only_calls_into_the_engine_are_marked_as_such(shared_env: SharedEnv) -> None:
    worlds = shared_env("reach").worlds
    phases = [*worlds.step_phases(), *worlds.restore_phases()]
    assert {phase.name for phase in phases if phase.engine} == {"physics", "refresh", "restore engine"}


@pytest.mark.parametrize(("engine", "calls"), [("mujoco", 5), ("warp", 1)])
def test_a_step_with_graphs_is_one_call_between_calls_into_a_native_engine(engine: str, calls: int) -> None:
    env = lw.make("reach", engine=engine)
    assert len(env.worlds.step) == calls
    env.worlds.configure(horizon=env.horizon, autoreset=True, graphs=False)
    assert len(env.worlds.step) == len(env.worlds.step_phases()) == 6


def test_configure_returns_to_earlier_programs_without_making_them_again() -> None:
    env = lw.make("point_mass", nworld=2)
    first, horizon = env.worlds.programs, env.horizon
    env.worlds.configure(horizon=3, autoreset=False, graphs=True)
    assert env.worlds.programs is not first
    assert (env.horizon, env.autoreset) == (3, False)
    env.worlds.configure(horizon=horizon, autoreset=True, graphs=True)
    assert env.worlds.programs is first


def test_configure_takes_effect_with_the_next_step() -> None:
    env = lw.make("point_mass", nworld=2)
    env.worlds.configure(horizon=2, autoreset=False, graphs=True)
    for truncated in (False, True, True):
        env.step()
        assert env.truncated.tolist() == [truncated] * 2
    env.worlds.configure(horizon=2, autoreset=True, graphs=True)
    env.step()
    assert env.episode_step.tolist() == [0, 0]


@pytest.mark.parametrize("engine", ENGINES)
def test_parameters_that_become_one_a_world_reach_captured_graphs(engine: str) -> None:
    env = lw.make("hopper", nworld=2, engine=engine)
    action = torch.ones(2, 3)
    for _ in range(3):
        env.step(action)  # the third replays
    env.set_params(ctrl_cost_weight=[0.0, 1.0])
    env.reset()
    env.step(action)
    torch.testing.assert_close(env.reward[0] - env.reward[1], torch.tensor(3.0))


def test_set_mask_without_a_mask_chooses_every_world(shared_env: SharedEnv) -> None:
    worlds = shared_env("point_mass", nworld=3).worlds
    worlds.set_mask(torch.tensor([True, False, True]))
    assert worlds.mask_view.tolist() == [True, False, True]
    worlds.set_mask(None)
    assert worlds.mask_view.tolist() == [True, True, True]


@pytest.mark.parametrize("mask", [torch.ones(2, dtype=torch.bool), torch.ones(3), [True, True, True]])
def test_a_mask_of_another_shape_or_type_is_refused(mask: object, shared_env: SharedEnv) -> None:
    worlds = shared_env("point_mass", nworld=3).worlds
    with pytest.raises(ValueError, match=r"a mask .* bool tensor of shape \(3,\), not "):
        worlds.set_mask(mask)  # type: ignore[arg-type]


def test_streams_depend_on_the_number_of_a_world_among_all_processes() -> None:
    whole, part = lw.make("point_mass", nworld=4), lw.make("point_mass", nworld=2, first_world=2)
    for env in (whole, part):
        env.rand_reset(7)
    assert torch.equal(whole.get_state()[2:], part.get_state())


def test_judge_transition_uses_the_kept_state_and_ignores_faults(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", nworld=2, autoreset=False)
    action = torch.full((2, 3), 0.5)
    before = env.get_state()
    env.step(action)
    after, reward = env.get_state(), env.reward.clone()
    env.set_state(before)
    env.worlds.keep_before()
    env.set_state(after)
    assert not env.reward.any()
    env.worlds.judge_transition(action)
    assert torch.equal(env.reward, reward)


def test_every_array_is_made_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    env = lw.make("hopper", nworld=2)
    state = env.get_state()

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("an array was made after construction")

    for name in ("zeros", "full", "empty", "zeros_like"):
        monkeypatch.setattr(wp, name, refuse)
    for _ in range(3):
        env.step()
        env.reset()
        env.rand_reset()
        env.set_state(state)
        env.get_state(out=state)
