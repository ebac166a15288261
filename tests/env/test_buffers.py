import gc
import tracemalloc

import pytest
import torch
from conftest import settle
from full_task import Full

import lyceum_warp as lw
from lyceum_warp.kernels.step_types import OUTCOMES

TASKS = ["hopper", "adroit_pen", Full]


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
@pytest.mark.parametrize("task", TASKS)
def test_spaces_describe_the_buffers(task: str | type[lw.Task], engine: str) -> None:
    env = lw.make(task, engine=engine, nworld=3)
    assert env.obs is env.obs_groups["policy"] and env.final_obs is env.final_obs_groups["policy"]
    pairs = [(env.action_space, env.action), (env.reward_space, env.reward), (env.eval_space, env.eval),
             (env.state_space, env.get_state())]  # fmt: skip
    for name, space in env.obs_spaces.items():
        pairs += [(space, env.obs_groups[name]), (space, env.final_obs_groups[name])]
        assert torch.equal(env.get_obs(group=name), env.obs_groups[name])
    for space, buffer in pairs:
        assert (buffer.shape, buffer.dtype) == ((3, *space.shape), space.dtype)
        ends = [0, *(part.stop for part in space.parts.values())]
        assert [part.start for part in space.parts.values()] == ends[:-1]
        if space.low is not None and space.high is not None:
            assert space.low.shape == space.high.shape == space.shape and (space.low <= space.high).all()
    assert {getattr(env, name).device.type for name in (*OUTCOMES, "obs", "action", "time")} == {"cpu"}


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_time_grows_by_the_timestep_and_ended_worlds_go_on_without_automatic_resets(engine: str) -> None:
    env = lw.make("hopper", engine=engine, nworld=2, autoreset=False, horizon=3)
    for _ in range(2):
        env.rand_reset(0)
        assert (env.time == 0).all() and not env.done.any()
        for step in range(1, 7):
            env.step(torch.full((2, 3), 0.1))
            torch.testing.assert_close(env.time, torch.full_like(env.time, step * env.timestep))
            assert torch.equal(env.truncated, torch.tensor([step >= 3] * 2)) and torch.equal(env.final_obs, env.obs)
    env.rand_reset(mask=torch.tensor([True, False]))
    assert env.done.tolist() == [False, True]


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_steps_resets_and_states_leak_no_memory(engine: str) -> None:
    settle()
    env = lw.make("hopper", engine=engine, nworld=2)
    state, mask = env.get_state(), torch.tensor([True, False])

    def steps(number: int) -> tuple[int, int]:
        for i in range(number):
            env.step()
            if i % 16 == 0:
                env.get_state(out=state)
                env.rand_reset(mask=mask)
                env.set_state(state, mask)
                env.reset(mask)
        gc.collect()
        return tracemalloc.get_traced_memory()[0], sum(isinstance(each, torch.Tensor) for each in gc.get_objects())

    steps(64)
    tracemalloc.start()
    try:
        steps(64)
        bytes_before, tensors_before = steps(64)
        bytes_after, tensors_after = steps(300)
    finally:
        tracemalloc.stop()
    # the interpreter's caches may grow by 2 kB; one leaked float per step is 7 kB
    assert bytes_after - bytes_before < 2048 and tensors_after == tensors_before
