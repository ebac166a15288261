import dataclasses
import json
import signal
from pathlib import Path
from typing import Any

import mujoco
import pytest
import tiny_task
import torch
from training_runs import TINY, interrupted, refused

import lyceum_warp as lw
from lyceum_warp import Trajectory, cli, controllers
from lyceum_warp.binding import find_task
from lyceum_warp.cli.plan import Settings
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.training import Run

SMALL = ["--horizon", "10", "--samples", "8", "--temperature", "0.01", "--noise", "0.3", "--steps", "40"]


def plan(out: Path, *options: str, task: str = "point_mass") -> int:
    return cli.main(["plan", task, "--out", str(out), *SMALL, *options])


def test_command_plan_starts_no_episode_after_the_time_limit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert plan(out, "--no-video", "--steps", "3", "--episodes", "3", "--minutes", "1e-9") == 0
    assert "stopped after 1 of 3 episodes" in capsys.readouterr().out
    assert [file.name for file in out.glob("*.npz")] == ["episode-000.npz"]


def test_command_plan_writes_episodes_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "[" / "bold]x"  # rich must not parse this name as markup
    assert plan(out, "--episodes", "2", "--seed", "3", "--no-video") == 0
    shown = capsys.readouterr().out
    assert str(out) in shown and "episode 2/2" in shown and "planning time p50" in shown
    assert sorted(path.name for path in out.iterdir()) == [
        "config.json", "episode-000.npz", "episode-001.npz", "report.json",
    ]  # fmt: skip
    config = json.loads((out / "config.json").read_text())
    assert config["planner"]["horizon"] == 10 and config["planner"]["noise"] == 0.3 and config["seed"] == 3
    report = json.loads((out / "report.json").read_text())
    assert report["episodes"] == 2 and report["steps"] == 80
    # calling the same controller from Python gives the same episode
    env = lw.make("point_mass", autoreset=False, horizon=40)
    planner = lw.MPPI("point_mass", horizon=10, samples=8, temperature=0.01, noise=0.3)
    again = lw.control(env, planner, seed=4)
    assert torch.equal(again.states, Trajectory.load(out / "episode-001.npz").states)


def test_planner_uses_the_suggested_physics_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, flags, timestep in (("fast", [], 0.015), ("exact", ["--physics", "exact"], None)):
        small = ["--steps", "2", "--horizon", "2", "--no-video", *flags]
        assert plan(tmp_path / name, *small, task="humanoid") == 0
        assert json.loads((tmp_path / name / "config.json").read_text())["planner"].get("timestep") == timestep
        assert ("timestep 0.015" in capsys.readouterr().out) == (name == "fast")
    assert plan(tmp_path / "other", "--timestep", "0.013", "--no-video") == 2
    refused(capsys, "0.013 s", "0.02 s")
    assert not (tmp_path / "other").exists()


def test_flag_real_time_runs_the_plant_asynchronously_in_real_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(tmp_path / "run", "--no-video", "--real-time") == 0
    assert "async" in capsys.readouterr().out
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["mode"] == "async" and report["deadline_ms"] == pytest.approx(20.0)
    assert 0.5 < report["real_time_factor"] < 1.01  # 40 steps of 20 ms take longer on a busy machine


def measured_by(microseconds: float) -> Any:
    """Return a function that replaces ``planning_time``.

    Its result is proportional to samples and horizon.
    """
    return lambda plant, planner: 1e-6 * microseconds * planner.samples * planner.horizon


def test_flag_real_time_leaves_given_settings_unchanged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "planning_time", measured_by(30.0))
    for flags, samples in ((["--horizon", "10"], 32), (["--samples", "8", "--horizon", "10"], 8)):
        out = tmp_path / str(samples)
        assert (
            cli.main(["plan", "point_mass", "--out", str(out), "--steps", "3", "--real-time", "--no-video", *flags])
            == 0
        )
        config = json.loads((out / "config.json").read_text())
        assert (config["planner"]["samples"], config["planner"]["horizon"]) == (samples, 10)
        assert json.loads((out / "report.json").read_text())["deadline_ms"] == pytest.approx(20.0)


def test_flag_real_time_shortens_the_horizon_and_plans_less_often(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(controllers, "planning_time", measured_by(250.0))
    out = tmp_path / "run"
    argv = ["plan", "reach", "--out", str(out), "--steps", "3", "--knots", "4", "--real-time", "--no-video"]
    assert cli.main(argv) == 0
    assert "16 samples, horizon 16: 64 ms of 20 ms, so there is a plan every 80 ms" in capsys.readouterr().out
    config, report = (json.loads((out / name).read_text()) for name in ("config.json", "report.json"))
    assert config["replan_every"] == 4 and report["deadline_ms"] == pytest.approx(80.0)
    settings = find_task("humanoid_stand").planning.settings
    half = settings["horizon"] // 2
    argv = ["plan", "humanoid_stand", "--out", str(tmp_path / "knots"), "--steps", "2", "--real-time", "--no-video"]
    monkeypatch.setattr(controllers, "planning_time", measured_by(9000 / (16 * half)))
    assert cli.main(argv) == 0
    planner = json.loads((tmp_path / "knots" / "config.json").read_text())["planner"]
    assert (planner["horizon"], planner["knots"], planner["timestep"]) == (half, settings["knots"] // 2, 0.015)


def test_value_function_of_a_run_changes_the_plans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "npg"
    assert (
        cli.main(["train", "point_mass", "--out", str(run), *TINY, "--no-video", "--no-plot", "--iterations", "1"]) == 0
    )
    assert plan(tmp_path / "with", "--no-video", "--value", str(run), "--discount", "0.97") == 0
    assert plan(tmp_path / "without", "--no-video", "--discount", "0.97") == 0
    with_value, without = (Trajectory.load(tmp_path / name / "episode-000.npz") for name in ("with", "without"))
    assert torch.equal(with_value.states[0], without.states[0])
    assert not torch.equal(with_value.actions, without.actions)
    assert json.loads((tmp_path / "with" / "config.json").read_text())["value"] == str(run)
    capsys.readouterr()
    assert plan(tmp_path / "none", "--value", str(tmp_path / "nowhere")) == 2
    refused(capsys, "nowhere")
    assert plan(tmp_path / "none", "--value", str(run), task="reach") == 2
    refused(capsys, f"--value {run}", "'point_mass'", "'reach'")
    Run.open(run).amend(algorithm="sac")
    assert plan(tmp_path / "none", "--value", str(run)) == 2
    refused(capsys, f"--value {run}", "sac", "npg or ppo")
    assert not (tmp_path / "none").exists()


def test_physics_options_change_only_the_planner_worlds(tmp_path: Path, made_envs: list[lw.Env]) -> None:
    out = tmp_path / "run"
    options = ["--solver", "iterations=5", "--solver", "noslip_iterations=0", "--deterministic"]
    options += ["--engine", "mujoco", "--nthread", "2"]
    assert plan(out, "--no-video", "--steps", "3", "--episodes", "2", *options, task="hopper") == 0
    plant, planner = made_envs
    assert (plant.model.opt.integrator, plant.model.opt.iterations) == (mujoco.mjtIntegrator.mjINT_RK4, 100)
    assert (planner.model.opt.integrator, planner.model.opt.iterations) == (mujoco.mjtIntegrator.mjINT_EULER, 5)
    assert planner.options.physics.deterministic and not plant.options.physics.deterministic
    config = json.loads((out / "config.json").read_text())
    assert [env.options.nthread for env in made_envs] == [1, 2]
    assert (config["engine"], config["device"], config["nthread"]) == ("mujoco", "cpu", 2)
    settings = config["planner"]
    assert settings["solver"] == {"iterations": 5, "noslip_iterations": 0}
    assert (settings["integrator"], settings["deterministic"]) == ("euler", True)


@pytest.mark.parametrize(("update", "flags", "title"), [
    ("cem", ["--elites", "3", "--min-noise", "0.02"], "CEM, 8 samples"),
    ("predictive_sampling", [], "predictive sampling, 8 samples"),
])  # fmt: skip
def test_chosen_plan_update_is_saved_and_printed(
    update: str, flags: list[str], title: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shared = ["--update", update, "--knots", "4", "--include-plan", "--replan-every", "3", "--steps", "9"]
    assert plan(tmp_path / "run", "--no-video", *shared, *flags) == 0
    assert title in capsys.readouterr().out
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    planner = config["planner"]
    assert (config["algorithm"], config["replan_every"], planner["update"]) == (update, 3, update)
    assert (planner["knots"], planner["include_plan"]) == (4, True)
    assert Trajectory.load(tmp_path / "run" / "episode-000.npz").plan_steps.tolist() == [0, 3, 6]
    assert json.loads((tmp_path / "run" / "report.json").read_text())["deadline_ms"] == pytest.approx(60.0)


@pytest.mark.parametrize("options, words", [
    (["--horizon", "0"], ["horizon", "0"]),
    (["--replan-every", "11"], ["replan_every=11", "10"]),
    (["--replan-every", "2", "--real-time"], ["--replan-every 2", "--real-time"]),
    (["--predict"], ["--predict", "--real-time"]),
    (["--episodes", "0"], ["episodes", "0"]),
    (["--steps", "0"], ["--steps"]),
    (["--device", "cuda:7"], ["cuda:7"]),
    (["--camera", "track=elbow"], ["'elbow'"]),
    (["--no-video", "--camera", "0"], ["--camera", "--no-video"]),
])  # fmt: skip
def test_option_out_of_range_prints_one_line_and_makes_no_folder(
    options: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert plan(tmp_path / "run", *options) == 2
    refused(capsys, *words)
    assert not (tmp_path / "run").exists()


def test_complete_episodes_are_saved_after_an_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = []

    def seventh_of_the_third(work: LongWork, done: int, total: int) -> None:
        steps.append(done)
        if len(steps) == 2 * 40 + 7:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(LongWork, "__call__", seventh_of_the_third)
    out = tmp_path / "run"
    assert interrupted(["plan", "point_mass", "--out", str(out), *SMALL, "--no-video", "--episodes", "100000"]) == 130
    shown = capsys.readouterr().out
    files = sorted(out.glob("episode-*.npz"))
    assert f"interrupted by SIGINT after 2 episodes and 7 steps; files in {out}" in shown
    assert [Trajectory.load(path).steps for path in files] == [40, 40, 7]
    assert json.loads((out / "report.json").read_text())["episodes"] == 2


def test_every_planner_setting_but_fill_has_a_flag() -> None:
    flags = [field.name for field in dataclasses.fields(Settings)]
    assert flags == [field.name for field in dataclasses.fields(lw.MPPIConfig) if field.name != "fill"]
    assert Settings().on_top_of(lw.MPPIConfig(horizon=3)) == lw.MPPIConfig(horizon=3)
    given = Settings(noise=(0.25,), horizon=4)  # type: ignore[call-arg]
    assert given.on_top_of(lw.MPPIConfig(samples=3)) == lw.MPPIConfig(samples=3, noise=0.25, horizon=4)


def test_flag_param_sets_the_task_parameter_and_not_a_setting_of_the_same_name(tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, tiny_task.changed(("dt: float", "dt: float\n    temperature: float = 1.0")))
    options = ["--param", "temperature=0.5", "--temperature", "0.25", "--planner-param", "temperature=0.75"]
    assert plan(tmp_path / "run", "--no-video", "--steps", "1", *options, task=str(file)) == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["planner"]["temperature"] == 0.25
    assert config["params"] == {"temperature": 0.5} and config["planner_params"] == {"temperature": 0.75}
    assert Trajectory.load(tmp_path / "run" / "episode-000.npz").params["temperature"] == 0.5
