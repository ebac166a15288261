import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.tuning import trial
from lyceum_warp.tuning.candidates import Setting
from lyceum_warp.tuning.judgement import verdict
from lyceum_warp.tuning.ranking import Rankings, rank_correlations
from lyceum_warp.tuning.trial import Effort, Trials

BRIEF = Effort(repeats=2, block_seconds=0.001, judging_seconds=1.0, steps=60, recorded_at=(5, 30))
SAME = Setting("", "", {})
CRUDE = Setting("crude", "", {"frame_skip": 1, "timestep": 0.05, "solver": {"iterations": 1}})


@pytest.fixture(autouse=True)
def judge_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "buys", lambda speedup, memory: True)


def lean(obs: torch.Tensor) -> torch.Tensor:
    return torch.sin(3.0 * obs[:, :6])


def trials(task: str = "half_cheetah", *, policy: bool = False, episodes: int | None = 16, **options: object) -> Trials:
    env = lw.make(task, autoreset=False, **{"nworld": 16, **options})
    return Trials(env, lean if policy else None, effort=BRIEF, episodes=episodes)


def test_unchanged_task_gives_unchanged_returns() -> None:
    row = trials(policy=True).measure(SAME)
    assert row["memory"] == 1.0
    assert set(row["returns"]) == set(row["clearly_worse"]) == {"random", "policy"}
    for found in row["returns"].values():
        assert found == {"mean": 0.0, "low": 0.0, "high": 0.0, "episodes": 16}
    assert row["faults_per_million"] == row["reference_faults_per_million"] == 0.0


def test_coarse_physics_change_returns() -> None:
    row = trials(policy=True).measure(CRUDE)
    assert verdict({**row, "speedup_low": 2.0}, "loose") in ("different", "faults")


def test_rows_of_tasks_with_terminations_have_no_clearly_worse_episodes() -> None:
    assert "clearly_worse" not in trials("hopper", nworld=8).measure(SAME)


@pytest.mark.long
def test_too_small_buffers_of_the_warp_engine_are_reported_as_faults() -> None:
    own = trials("hopper", engine="warp", nworld=8, nconmax=16, njmax=64)
    assert own.measure(SAME)["returns"]["random"]["mean"] == 0.0
    row = own.measure(Setting("", "", {"nconmax": 1, "njmax": 2}))
    assert row["memory"] < 0.95 and row["faults_per_million"] > row["reference_faults_per_million"]
    assert verdict(row, "strict") == "faults"


FAILED = float("-inf")


def test_rank_correlation_gives_tied_values_their_mean_rank() -> None:
    order = [1.0, 2.0, 3.0, 4.0]
    first = torch.tensor([order, [1.0, 2.0, 2.0, 3.0], [0.0, 1.0, 5.0, FAILED], [7.0] * 4, order])
    second = torch.tensor([[1.0, 3.0, 2.0, 4.0], order, [9.0, 4.0, 1.0, 90.0], order, [2.0] * 4])
    found = rank_correlations(first, second)
    assert found.tolist() == pytest.approx([0.8, 0.9487, -1.0, 0.0], abs=1e-4)


@pytest.fixture(scope="module")
def rankings() -> Rankings:
    return Rankings(find_task("half_cheetah"), states=3, repeats=1, samples=24, horizon=16, nthread=1)


def test_rank_correlation_of_unchanged_physics_is_one(rankings: Rankings) -> None:
    row = rankings.measure(Setting("", "", {}))
    assert list(row["ranks"]) == ["standing", "moving", "fallen"]
    assert [found["mean"] for found in row["ranks"].values()] == pytest.approx([1.0, 1.0, 1.0], abs=1e-12)
    assert row["plan_ms"] > 0.0


def test_sparse_jacobian_keeps_the_ranks_of_samples_but_coarse_physics_change_them(rankings: Rankings) -> None:
    sparse = rankings.measure(Setting("", "", {"jacobian": "sparse"}))
    assert all(found["low"] > 0.999 for found in sparse["ranks"].values())
    crude = rankings.measure(Setting("", "", {"frame_skip": 1, "timestep": 0.05, "solver": {"iterations": 1}}))
    assert min(found["mean"] for found in crude["ranks"].values()) < 0.9
    assert verdict(crude, "strict") in ("ranks badly", "not shown") and verdict(crude, "any") in ("same", "no gain")


def test_each_kind_of_start_state_comes_from_its_own_range_of_steps(rankings: Rankings) -> None:
    columns = rankings.reference.state_space.parts["step"]
    steps = {kind: start[:, columns] for kind, start in rankings.starts.items()}
    assert (steps["standing"] == 0).all() and steps["moving"].flatten().tolist() == [30, 75, 120]
    assert (steps["fallen"] > 100).all()


def test_ranking_of_an_invalid_setting_gives_the_error_of_mujoco() -> None:
    own = Rankings(find_task("soft_ball"), states=1, repeats=1, samples=2, horizon=2, nthread=1)
    assert "flex elasticity" in own.measure(Setting("", "", {"integrator": "implicitfast"}))["refused"]
