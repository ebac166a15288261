import math
from typing import Any

import fidelity
import pytest
import torch

import lyceum_warp as lw


def test_trajectories_with_different_dynamics_diverge(monkeypatch: pytest.MonkeyPatch) -> None:
    make = fidelity.lw.make

    def replaced(task: str, **words: Any) -> lw.Env:
        """Replace the Warp engine by a C engine that takes longer steps."""
        return make(task, **(words | ({"engine": "mujoco", "frame_skip": 60} if words["engine"] == "warp" else {})))

    monkeypatch.setattr(fidelity.lw, "make", replaced)
    pairs = fidelity.measure(fidelity.Case("point_mass", 3, 4, "cpu", 0), fidelity.Options(threads=1))["pairs"]
    assert pairs["engines"]["half_apart"] <= 4 and pairs["moved"]["half_apart"] is None


def test_worlds_count_as_diverged_after_their_first_divergence() -> None:
    error = torch.zeros(6, 4)
    error[2:, 0], error[4:, 1], error[3, 2] = 1.0, 1.0, 1.0
    assert fidelity.half_apart(error) == 4
    assert fidelity.half_apart(error[:, [1, 3]]) == 5
    assert fidelity.half_apart(error[:, [3]]) is None and fidelity.half_apart(error[:, []]) is None


def test_worlds_with_faults_are_excluded() -> None:
    error = torch.tensor([[0.0, 2.0, 4.0, math.nan], [math.nan] * 4])
    assert fidelity.quantiles(error, [1, 2]) == {"median": [2.0, None], "p99": [pytest.approx(3.96), None]}
