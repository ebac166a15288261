import gymnasium
import numpy as np
import pytest
import torch
import warp as wp
from gymnasium.vector import AutoresetMode

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.adapters import GymnasiumEnv, GymnasiumVectorEnv

N = 16


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    phase: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float
    table: wp.array[float] = [0.0, 0.1, 0.2, 0.1, 0.0, -0.1, -0.2, -0.1]
    push: float = 1.0


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = action[0] * wp.sqrt(p.push)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[1]
    obs[1] = s.qvel[1]


@wp.func
def terminated(s: World, p: Params) -> bool:
    k = int(s.phase[0]) % p.table.shape[0]
    return wp.abs(s.qpos[1] - p.table[k]) > 0.25


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.phase[0] = s0.phase[0] + 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.phase[0] = wp.floor(lw.uniform(rng, 0.0, 8.0))
    s.qpos[1] += lw.uniform(rng, -0.4, 0.4)


class Leave(lw.Task):
    """A pole that may start in a terminal state and leave it again."""

    model, frame_skip, obs, horizon = "inverted_pendulum.xml", 2, {"angle": 1, "speed": 1}, 50


ENGINES = pytest.mark.parametrize("engine", ["mujoco", "warp"])


@ENGINES
@pytest.mark.parametrize("autoreset", [True, False])
def test_terminal_initial_state_does_not_end_an_episode(autoreset: bool, engine: str) -> None:
    env = lw.make(Leave, nworld=N, engine=engine, autoreset=autoreset)
    env.rand_reset(0)
    fresh = env.get_state()
    assert env.get_terminated(fresh).any()
    assert not env.done.any() and not env.done_reason.any()
    env.step()
    assert env.terminated.any()
    if not autoreset:
        assert torch.equal(env.terminated, env.get_terminated(env.get_state()))
    env.set_state(fresh)
    assert not env.done.any()


def test_reset_in_a_separate_step_does_not_increase_the_episode_count() -> None:
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(
        GymnasiumVectorEnv(Leave, N, autoreset_mode=AutoresetMode.NEXT_STEP)
    )
    envs.reset(seed=0)
    ended = np.zeros(N, dtype=bool)
    for _ in range(60):
        *_, terminations, truncations, infos = envs.step(np.zeros((N, 1), np.float32))
        assert not (ended & (terminations | truncations)).any()
        ended = terminations | truncations
        assert (infos["episode"]["l"][ended] > 0).all() if ended.any() else True
    assert envs.episode_count > N


def test_reset_clears_the_done_reason_of_the_previous_episode() -> None:
    env = GymnasiumEnv(Leave)
    for seed in range(8):
        _, info = env.reset(seed=seed)
        assert info["done_reason"] == 0
        *_, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        assert terminated == bool(env.env.get_terminated(env.env.get_state())[0]) and not truncated


@ENGINES
def test_fault_truncates_an_episode_for_the_same_reason_on_both_engines(engine: str) -> None:
    env = lw.make(Leave, nworld=3, engine=engine, push=[1.0, -1.0, 1.0])
    env.reset()
    env.step(torch.full_like(env.action, 0.5))
    assert [lw.Done(reason) for reason in env.done_reason.tolist()] == [0, lw.Done.NAN, 0]
    assert env.truncated.tolist() == [False, True, False] and not env.terminated.any()
