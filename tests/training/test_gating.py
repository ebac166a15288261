import json
from pathlib import Path

import pytest
import torch
from training_runs import QUIET, TINY, refused

import lyceum_warp as lw
from lyceum_warp import cli

TASKS = Path(__file__).parent / "gated_tasks.py"


def verdicts(run: lw.Run) -> list[dict[str, object]]:
    rows = [json.loads(line) for line in (run.folder / "gate.jsonl").read_text().splitlines()]
    return sorted(rows, key=lambda row: row["seed"])


@pytest.fixture
def cores(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("lyceum_warp.training.gating.cpu_cores", lambda: request.param)
    return int(request.param)


@pytest.mark.parametrize("cores", [2, 4], indirect=True)
def test_run_ends_once_a_policy_passes_the_gate_with_two_seeds(cores: int, tmp_path: Path) -> None:
    words = ["train", f"{TASKS}:Easy", "--out", str(tmp_path / "run"), *TINY, *QUIET]
    assert cli.main([*words, "--iterations", "10000", "--gate-every", "2"]) == 0
    run = lw.Run.open(tmp_path / "run")
    assert len(run.rows()) < 10000
    number = run.config["passed"]["iteration"]
    assert [(row["iteration"], row["seed"], row["passed"]) for row in verdicts(run)] == [
        (number, 0, True), (number, 1, True),
    ]  # fmt: skip
    assert cli.main(["gate", str(run.folder), "--which", str(number)]) == 0
    env = lw.make(f"{TASKS}:Easy")
    again = lw.gate(env, lw.load(run, which=number), seed=1)
    assert again.numbers["distance"] == verdicts(run)[1]["numbers"]["distance"]  # type: ignore[index]


@pytest.mark.parametrize("cores", [2], indirect=True)
def test_policies_that_fail_the_gate_are_counted_and_not_kept(cores: int, tmp_path: Path) -> None:
    env = lw.make(f"{TASKS}:Impossible", nworld=2, physics="exact")
    npg = lw.NPG(env, config=lw.NPGConfig(samples=12, hidden=(4,), value_hidden=(4,)))
    run = lw.train(npg, tmp_path / "run", 4, callbacks=[lw.PassGate(4)])
    lw.train(npg, run, 8, callbacks=[lw.PassGate(4)])
    assert [(row["iteration"], row["seed"], row["passed"]) for row in verdicts(run)] == [
        (4, 0, False), (8, 1, False),
    ]  # fmt: skip
    assert all("largest" not in row["numbers"] for row in verdicts(run))  # type: ignore[operator]
    assert "passed" not in run.config and not list((run.folder / "policies").iterdir())
    assert cli.main(["gate", str(run.folder)]) == 1
    verdict = lw.gate(env, lambda obs: torch.zeros(len(obs), 2))
    assert not verdict.passed and verdict.numbers["largest"] > 0.0
    with pytest.raises(ValueError, match="policy must return"):
        lw.gate(env, lambda obs: torch.zeros(len(obs), 5))


def test_task_without_a_gate_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "hopper", "--out", str(tmp_path / "run"), "--gate-every", "5", *QUIET]) == 2
    refused(capsys, "'hopper'", "no gate")
    assert not (tmp_path / "run").exists()


def test_task_of_a_notebook_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gated = lw.make(f"{TASKS}:Easy", nworld=2)
    monkeypatch.setattr("lyceum_warp.training.runs.configuration.spelled_task", lambda task: None)
    npg = lw.NPG(gated, config=lw.NPGConfig(samples=12, hidden=(4,), value_hidden=(4,)))
    with pytest.raises(ValueError, match="'easy' in a file of its own"):
        lw.train(npg, tmp_path / "run", 4, callbacks=[lw.PassGate(4)])
    assert not (tmp_path / "run").exists()
