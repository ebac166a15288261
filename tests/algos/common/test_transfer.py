import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos import task_physics
from lyceum_warp.algos.common.transfer import Comparison, Episodes, PairedDifference, _compared
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
    assert PairedDifference(quantity="return", first=0.0, second=0.0, low=low, high=high, margin=1.0).verdict == verdict


def comparison(first: np.ndarray, second: np.ndarray) -> Comparison:
    """Compare two simulations of a task without terminations, whose episodes have the given returns."""

    def episodes(returns: np.ndarray) -> Episodes:
        zeros = torch.zeros(len(returns))
        return Episodes(torch.from_numpy(returns), zeros + 100.0, zeros, zeros, zeros, zeros)

    return _compared("a", "b", (episodes(first), 0), (episodes(second), 0), margin=0.05, terminates=False)


def verdicts(pairs: int, loss: float, share: float, noise: float, both: float = 0.0) -> dict[str, float]:
    """Simulate comparisons in which ``share`` more episodes of the second simulation lose ``loss`` of their return.

    Return how often each verdict is given, in percent. In the fraction ``both``, episodes of both simulations lose.
    """
    rng, counts = np.random.default_rng(0), {"same": 0, "different": 0, "not shown": 0}
    for _ in range(1000):
        first, second = 1.0 + noise * rng.normal(size=(2, pairs))
        first -= loss * (rng.random(pairs) < both)
        second -= loss * (rng.random(pairs) < both + share)
        counts[comparison(first, second).verdict] += 1
    return {name: count / 10 for name, count in counts.items()}


@pytest.mark.parametrize("pairs", [32, 64, 256])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_rare_failures_that_end_no_episode_are_seldom_called_the_same(pairs: int, noise: float) -> None:
    """In each case, the second simulation's mean return is 5 % lower. The nominal rate is 2.5 %."""
    for loss in (1.0, 0.7, 0.5, 0.3):
        assert verdicts(pairs, loss, 0.05 / loss, noise)["same"] <= 5.0


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_equal_simulations_are_called_the_same(noise: float) -> None:
    equal = verdicts(64, 0.0, 0.0, noise)
    assert equal["same"] >= 95.0 and equal["different"] == 0.0
    rare = verdicts(256, 1.0, 0.0, noise, both=0.02)
    assert rare["same"] >= 75.0 and rare["different"] <= 0.5
    assert verdicts(256, 1.0, 0.2, noise)["different"] >= 95.0


def test_failures_are_terminations_only_if_the_task_terminates(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", horizon=20, integrator="implicitfast")
    (point,) = lw.transfer(env, lambda obs: obs[:, :2], 4, warp=False).comparisons
    assert [one.quantity for one in point.differences] == ["return", "length", "clearly worse"]
    first = np.full(64, 10.0)
    found = comparison(first, np.where(np.arange(64) < 2, 0.0, first)).differences[2]
    assert (found.quantity, found.first, found.second) == ("clearly worse", 0.0, 2 / 64)
    assert found.low < 2 / 64 < found.high and found.verdict == "not shown"


def test_wrong_arguments_raise_a_one_line_error(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", horizon=200)
    with pytest.raises(ValueError, match="episodes must be"):
        lw.transfer(env, still, 1)
    with pytest.raises(ValueError, match="margin must be"):
        lw.transfer(env, still, margin=-1.0)
    with pytest.raises(ValueError, match=r"policy must return .*3"):
        lw.transfer(env, lambda obs: obs, 2, warp=False)
