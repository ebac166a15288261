from pathlib import Path

import pytest
from training_runs import refused

from lyceum_warp import cli
from lyceum_warp.training import Run, row_seconds

GATED = Path(__file__).parents[1] / "training" / "gated_tasks.py"

SWEEP = """
task = "point_mass"
trials = {trials}
out = "sweep"
heartbeat = 1
objective = "{objective}"
settings = {{ iterations = 1, samples = 512, nworld = 2, value_hidden = [8], mean_every = 1, mean_episodes = 1 }}
[ranges]
gamma = {{ low = 0.9, high = 0.99 }}
hidden = {{ choices = [[8], [8, 8]] }}
"""


def test_sweep_continues_and_names_its_best_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("def gamma(run):\n    return run.config['npg']['gamma']\n")
    for trials in (1, 3):
        Path("sweep.toml").write_text(SWEEP.format(trials=trials, objective="mine.py:gamma"))
        assert cli.main(["sweep", "sweep.toml"]) == 0
    runs = [Run.open(folder) for folder in sorted(Path("sweep").glob("trial-*/"))]
    gammas = [run.config["npg"]["gamma"] for run in runs]
    shown = capsys.readouterr().out
    assert len(set(gammas)) == 3 and f"best:       trial {gammas.index(max(gammas))}, " in shown
    assert "--seeds 5" in shown
    Path("other.toml").write_text(SWEEP.format(trials=1, objective="return").replace('"sweep"', '"other"'))
    assert cli.main(["sweep", "other.toml"]) == 0


def test_a_trial_that_does_not_pass_the_gate_is_pruned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    monkeypatch.chdir(tmp_path)
    text = SWEEP.format(trials=1, objective="gate").replace("iterations = 1", "iterations = 4, gate_every = 2")
    Path("sweep.toml").write_text(text.replace("point_mass", f"{GATED}:Impossible"))
    assert cli.main(["sweep", "sweep.toml"]) == 2
    shown = capsys.readouterr()
    assert "trial 0: pruned" in shown.out and "none has passed the gate" in shown.err
    Path("sweep.toml").write_text(text.replace("point_mass", f"{GATED}:Easy").replace('"sweep"', '"easy"'))
    assert cli.main(["sweep", "sweep.toml"]) == 0
    run, shown = Run.open("easy/trial-0000"), capsys.readouterr()
    seconds = sum(map(row_seconds, run.rows()[: run.config["passed"]["iteration"]]))
    assert f"trial 0: complete {seconds:.6g} " in shown.out and seconds > 0


def test_sweep_with_a_wrong_key_or_range_prints_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    monkeypatch.chdir(tmp_path)
    text = SWEEP.format(trials=1, objective="return")
    for wrong, words in [
        (text.replace("trials", "trails"), "sweep.toml: got an unexpected keyword argument 'trails'"),
        (text.replace("trials = 1", "trials = 'a'"), "trials must be of type int"),
        (text + "[x]", "sweep.toml: "),
        (text.replace('objective = "return"', 'sampler = "Guess"'), "sweep.toml: module 'optuna.samplers' has no"),
        (text.replace("low", "lo"), "the range gamma = "),
        (text.replace("0.99 ", "1.5 "), "gamma must be"),
        (text.replace("gamma", "gama"), "gama"),
        (text.replace("[[8]", "[[0]"), "hidden"),
        (text.replace('"return"', '"gate"'), "needs a task with a gate, and gate_every in settings"),
    ]:
        Path("sweep.toml").write_text(wrong)
        assert cli.main(["sweep", "sweep.toml"]) == 2
        refused(capsys, words)
        assert [path.name for path in tmp_path.iterdir()] == ["sweep.toml"]
