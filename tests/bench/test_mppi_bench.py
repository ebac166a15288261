from typing import Any

import mppi
import pytest
import torch

import lyceum_warp as lw


@pytest.mark.parametrize("task", ["reach", "half_cheetah", "adroit_pen"])
def test_plain_python_environments_return_the_rewards_of_the_package(task: str) -> None:
    if task == "adroit_pen":
        pytest.importorskip("gymnasium_robotics")
    env = lw.make(task, autoreset=False, nthread=1, seed=3)
    theirs = mppi.python_mppi.ENVS[task](lw.make(task, nthread=1).model)
    env.step(torch.full_like(env.action, 0.1))
    theirs.set_state(env.get_state()[0].numpy())
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        env.step(2.0 * torch.rand(env.action.shape, generator=generator) - 1.0)
        assert theirs.step(env.action[0].numpy().astype(float))[1] == pytest.approx(env.reward.item(), abs=2e-4)


def test_episode_that_was_measured_in_two_blocks_counts_once() -> None:
    def block(contestant: str, first: int, seconds: list[float]) -> Any:
        each = [[first + i, i != 1, -100.0, value] for i, value in enumerate(seconds)]
        where = {"part": "episodes", "task": "reach", "contestant": contestant, "repeat": 1, "threads": 2}
        return mppi.Row(where | {"first": first}, {"each": each}, {}, 1.0)

    rows = [block("mppi", 1000, [1.0, 1.0, 1.0]), block("mppi", 1000, [1.0, 1.0]), block("python", 1000, [3.0])]
    (table,) = mppi.tables(rows)
    ours, python = table.rows
    assert (ours[2:4], python[2:4], python[-1]) == (["2", "2 of 3"], ["2", "1 of 1"], "3.00")
