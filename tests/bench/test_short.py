"""Run experiments with --short, and check the results on which their claims depend."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import experiment
import mujoco
import numpy as np
import picture_gap
import pytest

import lyceum_warp as lw

Result = dict[str, Any]


def agreement(hopper: Result, ant: Result) -> None:
    assert hopper["obs"] < 1e-6 and hopper["reward"] < 1e-5 and hopper["agree_steps"] == 100
    assert hopper["terminations"] > 0 == hopper["different_terminations"]
    # Gymnasium computes the ant's contact forces after the last substep
    assert ant["obs"] < 1e-6 < 1e-3 < ant["contact_force"]


def equivalence(*results: Result) -> None:
    assert all(30.0 < result["area"] < 200.0 and result["curve"][-1][0] == 2000 for result in results)


def fidelity(result: Result) -> None:
    assert result["steps"] == [1, 4]
    for pair in result["pairs"].values():
        assert all(0.0 <= low <= high < 1e-5 for low, high in zip(*pair["obs"].values(), strict=True))
        assert pair["half_apart"] is None and pair["faults"] == 0
    assert result["pairs"]["engines"]["obs"]["p99"][-1] > 0.0


def fits(*results: Result) -> None:
    assert len(results) == 3  # policies from the fit, from wide draws and from the nominal robot
    for result in results:
        errors, falls = result["plants"]["0"].values()
        assert len(errors) == len(falls) == 4 and all(0.0 < error < 3.0 for error in errors)


def humanoid(*results: Result) -> None:
    assert all(not result["fell"] and result["up_share"] == 1.0 for result in results)


def integrators(*results: Result) -> None:
    policy, (exact, euler, _, discrete) = results[0], results[4:8]  # cartpole has one substep
    assert len(results) == 11 and len(policy["returns"]) == 4
    assert euler["returns"] == exact["returns"] != discrete["returns"]  # reach has Euler's method
    np.testing.assert_allclose(discrete["returns"], exact["returns"], rtol=0.02)


def latency(*results: Result) -> None:
    for result in results:
        assert result["plans"] > 1 and 0.0 < result["plan_ms"] <= result["max_ms"] and result["deadline_ms"] == 20.0
        assert result["age_steps"] <= result["age_steps_max"] and result["episodes"] == 1


def mppi(*results: Result) -> None:
    returns = [result["return"] for result in results if "return" in result]
    assert len(returns) == 2 and max(returns) - min(returns) < 0.2 * abs(min(returns))


def objects(*results: Result) -> None:
    assert len(results) == 2 and all(result["ratio"] > 0.0 for result in results)
    assert all(result["bytes_per_world"]["many"] > result["bytes_per_world"]["one"] for result in results)


def pictures(*results: Result) -> None:
    assert all(result["frames_per_second"] > 0.0 for result in results[:2])
    own, *rendered = results[2:]  # without OpenGL, nothing else is rendered
    assert own["differing"] == 0.0 and len(own["returns"]) == 2
    for result in rendered:
        assert 0.0 < result["differing"] < 0.5 and min(result["returns"]) > 0.0


def policies(result: Result) -> None:
    engines, physics = result["comparisons"]
    assert (engines["first"], engines["second"]) == ("C engine", "Warp engine on cpu")
    assert physics["second"] == "fast physics"


def soak(random: Result, memory: Result) -> None:
    assert random["steps"] == 1600 and random["first"] is None and not any(random["faults"].values())
    assert memory["bytes_per_env"] < 1e6


def throughput(*results: Result) -> None:
    assert len(results) == 6 and all(result["env_steps_per_second"] > 0.0 for result in results)
    assert results[-1]["kept"] > 0.0


SHORT: dict[Callable[..., None], str] = {
    agreement: "--tasks hopper ant",
    equivalence: "--threads 1",
    fidelity: "--tasks point_mass --nworld 3 --steps 4",
    fits: "--parts policies",
    humanoid: "--threads 1",
    integrators: "--threads 1",
    latency: "--threads 1 --samples 8",
    mppi: "--threads 1 --contestants mppi python",
    objects: "--engines mujoco",
    pictures: "",
    policies: "",
    soak: "--parts random memory --threads 1 --nworld 16 --steps 1600",
    throughput: "--tasks hopper --contestants native c gymnasium gym-sync --threads 1 --parts sampling single kept",
}
"""For each check, named like its experiment, the options of the experiment."""


@pytest.mark.quick("agreement", "fidelity", "humanoid", "policies", "throughput")
@pytest.mark.parametrize("check", SHORT, ids=lambda check: check.__name__)
def test_short_run_stores_plausible_results_once(
    check: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    definition = experiment.load(check.__name__)
    arguments = ["--short", "--out", "out.jsonl", *SHORT[check].split()]
    assert experiment.main(definition, arguments) == 0
    rows = experiment.read(tmp_path / "out.jsonl")
    check(*(row.result for row in rows))
    assert all(table.rows for table in definition.tables(rows))
    if (figure := definition.figure and definition.figure(rows)) is not None:
        figure.savefig("figure.png")
    capsys.readouterr()
    assert experiment.main(definition, arguments) == 0
    assert f"{definition.name}: {len(rows)} of {len(rows)} cases are stored" in capsys.readouterr().out


def test_policy_acts_with_each_object(tmp_path: Path) -> None:
    definition, out = experiment.load("objects"), tmp_path / "out.jsonl"
    policy = str(lw.pretrained_run("leap_reorient"))
    assert experiment.main(definition, ["--short", "--engines", "mujoco", "--policy", policy, "--out", str(out)]) == 0
    rows = experiment.read(out)
    (table,) = definition.tables(rows)
    assert [line[0] for line in table.rows[-2:]] == ["waterbottle", "held out"] and len(table.rows) == 30
    definition.figure(rows).savefig(tmp_path / "figure.png")


def test_tiles_are_the_ground() -> None:
    env = lw.make("go1_rough_velocity", nworld=1, engine="mujoco")
    rng, heights = np.random.default_rng(0), []
    points = rng.uniform((-80.0, -40.0, 20.0), (80.0, 40.0, 20.0), (200, 3))
    for model in (env.model, picture_gap.tiled(env)):
        data, geom = mujoco.MjData(model), np.zeros(1, np.int32)
        mujoco.mj_kinematics(model, data)
        heights.append([mujoco.mj_ray(model, data, point, [0.0, 0.0, -1.0], None, 1, -1, geom) for point in points])
    assert np.ptp(heights[0]) > 0.5
    np.testing.assert_allclose(*heights, atol=1e-5)
