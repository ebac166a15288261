from typing import Any

import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import gates


def test_velocity_error_of_a_standing_robot_equals_its_command(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=2, horizon=0, push_seconds=[gates.NEVER, gates.NEVER])
    env.reset()
    play = gates.Play(env, [(0.8, 0.6, 0.0), (0.0, 0.0, 0.5)], env.get_state())
    play.step(lambda obs: torch.zeros(2, 12), 50)
    velocity_error, yaw_rate_error, *_ = play.results()
    torch.testing.assert_close(velocity_error[30:].mean(0), torch.tensor([1.0, 0.0]), atol=0.1, rtol=0.0)
    torch.testing.assert_close(yaw_rate_error[30:].mean(0), torch.tensor([0.0, 0.5]), atol=0.1, rtol=0.0)
    assert not play.falls.any()


@pytest.mark.parametrize("limit", [name for name, limit in gates.NanoG1.limits.items() if limit.range])
def test_number_beyond_any_limit_fails_the_gate(limit: str) -> None:
    ends = {name: each.high if each.low < 0.0 else each.low for name, each in gates.NanoG1.limits.items()}
    content: dict[str, Any] = {"task": "g1", "seed": 0, "memory": "", "limits": gates.NanoG1.limits}
    assert lw.Verdict(numbers=ends, **content).passed
    beyond = ends[limit] * 1.01 if limit != "perf" else ends[limit] * 0.99
    assert not lw.Verdict(numbers=ends | {limit: beyond}, **content).passed
    missing = {name: number for name, number in ends.items() if name != limit}
    assert not lw.Verdict(numbers=missing, **content).passed


def test_a_quick_test_ends_at_the_fall_that_decides_it(shared_env: SharedEnv) -> None:
    class Short(gates.Walks):
        COMMANDS, starts = ((0.0, 0.0, 0.0),), 1

    steps = 0

    def act(obs: torch.Tensor) -> torch.Tensor:
        nonlocal steps
        steps += 1
        return torch.zeros(1, 12) if steps <= 150 else torch.full((1, 12), 8.0)  # stands, then falls

    def worlds(nworld: int, **params: Any) -> lw.Env:
        return shared_env("go1_velocity", nworld=nworld, horizon=0, **params)

    parts = Short().measure(worlds, act)
    assert next(parts)["falls"] == 0 and next(part["falls"] for part in parts if part["falls"]) == 1
    assert 150 < steps < gates.STEPS // 2
