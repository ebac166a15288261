import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos.transfer import Difference, task_physics
from lyceum_warp.tasks import hopper


class Coarse(hopper.Hopper):
    physics = {"coarse": lw.PhysicsOptions(frame_skip=8)}


def still(obs: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(obs), 3)


def test_both_engines_play_the_same_episodes(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", horizon=200)
    before, shown = env.get_state(), []
    found = lw.transfer(env, still, 12, seed=3, physics=False, progress=lambda *now: shown.append(now))
    (engines,) = found.comparisons
    assert (engines.first, engines.second, engines.faults) == ("C engine", "Warp engine on cpu", (0, 0))
    returns, lengths, falls = engines.differences
    own = lw.evaluate(env.replicate(nworld=12), still, 12, seed=3)
    assert returns.first == pytest.approx(own.returns.mean().item())
    assert lengths.first == pytest.approx(own.lengths.mean().item())
    assert falls.first == pytest.approx(own.terminated.mean().item())
    # pairing the episodes removes the differences between initial states
    assert returns.verdict == lengths.verdict == "same" and own.lengths.std() > 1.0
    assert returns.high - returns.low < 0.2 * own.returns.std().item()
    assert shown[-1][0] <= shown[-1][1] == 400 and torch.equal(env.get_state(), before)
    assert found.line.startswith("Warp engine on cpu against C engine: ")
    assert found.to_dict()["comparisons"][0]["differences"][0]["verdict"] == "same"


def test_each_set_of_physics_options_is_compared_with_exact_physics() -> None:
    env = lw.make(Coarse, horizon=200)
    found = lw.transfer(env, still, 8, warp=False)
    ((exact, coarse),) = [(pair.first, pair.second) for pair in found.comparisons]
    assert (exact, coarse) == ("exact physics", "coarse physics")
    assert found.comparisons[0].verdict == "different"  # coarse steps are longer, so the robot falls after fewer steps
    own = lw.make(Coarse, horizon=200, frame_skip=2)
    assert task_physics(own)[1] == "own" and task_physics(lw.make(Coarse, frame_skip=8))[1] == "coarse"
    pairs = [pair.second for pair in lw.transfer(own, still, 2, warp=False, physics=False).comparisons]
    assert pairs == ["own physics"]


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(-0.5, 0.9, "same"), (0.1, 0.9, "same"), (0.5, 1.5, "not shown"), (1.1, 2.0, "different"),
     (-3.0, 3.0, "not shown"), (-2.0, -1.1, "different")],
)  # fmt: skip
def test_verdict_compares_the_interval_with_the_margin(low: float, high: float, verdict: str) -> None:
    assert Difference(quantity="return", first=0.0, second=0.0, low=low, high=high, margin=1.0).verdict == verdict


def test_wrong_arguments_raise_a_one_line_error(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", horizon=200)
    with pytest.raises(ValueError, match="episodes must be"):
        lw.transfer(env, still, 1)
    with pytest.raises(ValueError, match="margin must be"):
        lw.transfer(env, still, margin=-1.0)
    with pytest.raises(ValueError, match=r"policy must return .*3"):
        lw.transfer(env, lambda obs: obs, 2, warp=False)
