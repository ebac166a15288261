import math
import re
from pathlib import Path

import numpy as np
import pytest
from training_runs import TINY, metrics, refused, train

import lyceum_warp as lw
from lyceum_warp import cli, training
from lyceum_warp.training import Run, curve, group_runs, mean_curve, read_curves
from lyceum_warp.training.report import write_report


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "runs"
    for name, options in {"a": ["--seed", "0"], "b": ["--seed", "1"], "c": ["--gamma", "0.9"]}.items():
        assert train(folder / name, "--iterations", "4", *options) == 0
    return folder


def test_runs_are_grouped_by_the_settings_that_differ(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    groups = group_runs(read_curves([runs]))
    assert [(group.label, [run.folder.name for run in group.runs]) for group in groups] == [
        ("gamma 0.995", ["a", "b"]), ("gamma 0.9", ["c"]),
    ]  # fmt: skip
    x, mean, low, high = mean_curve(groups[0].runs, "samples")
    finals = [run.final for run in groups[0].runs]
    assert (x[0], x[-1], mean[-1]) == (1024, 2048, pytest.approx(np.mean(finals)))
    assert (low[-1], high[-1]) == pytest.approx((min(finals), max(finals)))  # of two runs
    assert cli.main(["plot", str(runs.parent), "--out", str(runs / "all.pdf")]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"gamma +0\.995 +0\.9", shown) and (runs / "all.pdf").read_bytes()[:4] == b"%PDF"
    with pytest.raises(ValueError, match="must end in one of .*pdf.* not 'all.doc'"):
        training.comparison_figure(groups, runs / "all.doc")


def test_a_run_of_rsl_rl_is_read_from_its_tensorboard_files(tmp_path: Path) -> None:
    writer = pytest.importorskip("torch.utils.tensorboard").SummaryWriter(tmp_path)
    for k in range(3):
        for tag, value in {"Train/mean_reward": 10.0 * k, "Perf/total_fps": int(96 / 0.3), "Perf/collection_time": 0.2,
                           "Perf/learning_time": 0.1}.items():  # fmt: skip
            writer.add_scalar(tag, value, k)
    writer.close()
    (run,) = read_curves([tmp_path])
    assert run.samples.tolist() == [96, 192, 288] and run.final == 20.0


def test_curve_has_a_panel_for_each_term_and_none_without_data(runs: Path) -> None:
    run = Run.open(runs / "a")
    row = {"samples": 1.0, "return_mean": 2.0, "success": math.nan, "kl": 0.1}
    row |= {f"{kind}/{name}": 3.0 for kind in ("metrics", "step_metrics") for name in ("upright", "error", "fell")}
    run.config["terms"] = {"rewards": {"upright": 0.5}, "ends": ["fell"]}
    run.metrics = runs / "terms.csv"
    run.append(row)
    panels = [(panel.group, panel.title, panel.unit) for panel in curve.curve_panels(run)]
    assert panels == [
        (curve.RETURNS, "return", "sum of rewards"), (curve.TERMS, "upright", "weight 0.5, sum of an episode"),
        (curve.METRICS, "error", "mean of a step"), (curve.ENDS, "fell", "fraction of episodes"),
        (curve.LEARNING, "kl", ""),
    ]  # fmt: skip


def test_report_is_one_page_without_paths(runs: Path) -> None:
    text = write_report(runs / "a").read_text()
    assert "srcdoc=" in text and "point_mass, npg, seed 0" in text and "npg.gamma" in text
    assert str(runs) not in text and not re.findall(r'(?:src|href)="(?!#)', text)


def test_report_without_an_episode_names_the_reason_but_no_folder(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "--iterations", "1") == 0
    (tmp_path / "run" / "policy.pt").write_bytes(b"damaged")
    text = write_report(tmp_path / "run").read_text()
    assert "no episode: the checkpoint policy.pt is damaged" in text and str(tmp_path) not in text


def test_report_shows_a_planners_episodes(tmp_path: Path) -> None:
    words = ["plan", "point_mass", "--steps", "3", "--samples", "4", "--no-video", "--out", str(tmp_path / "plan")]
    assert cli.main(words) == 0
    assert cli.main(["report", str(tmp_path / "plan")]) == 0
    assert "srcdoc=" in (tmp_path / "plan" / "report.html").read_text()


LEARNER = """
import dataclasses
import lyceum_warp as lw

@dataclasses.dataclass(frozen=True)
class Config:
    noise: float = 0.3

class Idle(lw.Learner):
    algorithm = "idle"

    def __init__(self, env, policy=None, value=None, config: Config | None = None, *, seed=0, team=None):
        super().__init__(env, seed=seed, team=team)
        self.config = config or Config()
        self.policy = policy or lw.GaussianPolicy(env.obs_space.size, env.action_space.size, hidden=())

    def __next__(self):
        self.iteration += 1
        self.samples += 1
        return lw.Iteration(iteration=self.iteration, samples=self.samples, mean_return=self.config.noise)

class Mean(lw.PlanUpdate):
    def weigh(self, samples):
        samples.weights.fill_(1.0 / samples.weights.shape[-1])
"""


def test_commands_take_classes_from_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "mine.py", tmp_path / "run"
    file.write_text(LEARNER)
    words = ["train", "point_mass", "--algorithm", f"{file}:Idle", "--nworld", "2", "--no-plot", "--continue"]
    for total in ("2", "3"):
        assert cli.main([*words, "--out", str(out), "--iterations", total]) == 0
    run = Run.open(out)
    assert run.config["idle"] == {"noise": 0.3} and [row["mean_return"] for row in run.rows()] == [0.3] * 3
    run.amend(idle={"noise": 0.5})  # as a run made in Python has it
    assert cli.main([*words, "--out", str(out), "--iterations", "4"]) == 0
    assert run.rows()[-1]["mean_return"] == 0.5
    for source in ("--resume", "--from"):  # without --algorithm
        assert cli.main(["train", source, str(out), "--iterations", "5"]) == 2
        refused(capsys, "was trained by mine.py:Idle", "add --algorithm path/to/mine.py:Idle")
    assert cli.main([*words, *TINY[:2], "--out", str(tmp_path / "x")]) == 2
    assert cli.main([*words[:3], f"{file}:Mean", "--out", str(tmp_path / "x")]) == 2
    assert "mine.py:Mean is not a subclass of Learner" in capsys.readouterr().err
    plan = ["plan", "point_mass", "--steps", "2", "--samples", "4", "--no-video", "--out", str(tmp_path / "plan")]
    assert cli.main([*plan, "--update", f"{file}:Mean"]) == 0


NETWORK = """
from sizes import UNITS
from torch import nn

class Mine(nn.Sequential):
    def __init__(self, nobs, nact):
        super().__init__(nn.Linear(nobs, UNITS), nn.ELU(), nn.Linear(UNITS, nact))
"""


def test_a_network_from_a_file_is_copied_into_the_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out, words = tmp_path / "mine.py", tmp_path / "run", [*TINY[:4], *TINY[6:]]
    file.write_text(NETWORK)
    (tmp_path / "sizes.py").write_text("UNITS = 4")
    command = ["train", "point_mass", "--network", f"{file}:Mine", *words, "--no-plot"]
    assert cli.main([*command, "--out", str(tmp_path / "whole"), "--iterations", "3"]) == 0
    assert cli.main([*command, "--out", str(out), "--iterations", "1"]) == 0
    assert cli.main([*command, "--out", str(out), "--continue", "--iterations", "2"]) == 0
    for path in (file, tmp_path / "sizes.py"):
        path.unlink()
    assert cli.main(["train", "--resume", str(out), "--iterations", "3"]) == 0
    assert metrics(out) == metrics(tmp_path / "whole") and Run.open(out).config["network"] == "mine.py:Mine"
    assert cli.main(["eval", str(out), "--episodes", "2"]) == 0
    assert cli.main(["train", "--from", str(out), *words, "--no-plot", "--iterations", "1", "--out", f"{out}-2"]) == 0
    assert lw.load(f"{out}-2").network[0].out_features == 4
    (out / "task" / "network" / "mine.py").write_text("this code must not run")
    with pytest.raises(ValueError, match="custom class .*Mine"):
        lw.load(out)
    capsys.readouterr()
    assert cli.main([*command, "--hidden", "8", "--out", str(tmp_path / "x")]) == 2
    refused(capsys, "--network replaces --from, --hidden")
    assert cli.main(["train", "hopper", "--algorithm", "sac", "--network", f"{file}:Mine"]) == 2
    refused(capsys, "sac takes no --network")


def test_wandb_gets_settings_and_curves_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    assert train(tmp_path / "run", "--iterations", "1", "--wandb", "tests") == 0
    (file,) = tmp_path.glob("run/wandb/offline-run-*/run-*.wandb")
    assert b"Train/mean_reward" in file.read_bytes() and Run.open(tmp_path / "run").config["wandb_id"] in file.name
