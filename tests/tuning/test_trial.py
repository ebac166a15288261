import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.tuning import trial
from lyceum_warp.tuning.candidates import Setting
from lyceum_warp.tuning.judgement import verdict
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
def test_number_of_episodes_depends_on_the_spread_of_returns_and_the_time_limit() -> None:
    own = trials("hopper", episodes=None, nworld=8)
    coarse = Setting("", "", {"integrator": "implicitfast", "frame_skip": 2, "timestep": 0.004})
    assert own.measure(coarse)["returns"]["random"]["episodes"] > 8
    assert own.measure(SAME)["returns"]["random"]["episodes"] == 8  # if the returns do not vary, one batch suffices


def test_trial_of_an_invalid_setting_gives_the_error_of_mujoco() -> None:
    refused = trials("soft_ball", nworld=2).measure(Setting("", "", {"integrator": "implicitfast"}))
    assert "flex elasticity" in refused["refused"] and verdict(refused, "strict") == "refused"


@pytest.mark.long
def test_too_small_buffers_of_the_warp_engine_are_reported_as_faults() -> None:
    own = trials("hopper", engine="warp", nworld=8, nconmax=16, njmax=64)
    assert own.measure(SAME)["returns"]["random"]["mean"] == 0.0
    row = own.measure(Setting("", "", {"nconmax": 1, "njmax": 2}))
    assert row["memory"] < 0.95 and row["faults_per_million"] > row["reference_faults_per_million"]
    assert verdict(row, "strict") == "faults"
