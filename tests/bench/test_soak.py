import json
import re
from pathlib import Path
from typing import Any

import experiment
import pytest
import soak

import lyceum_warp as lw
from lyceum_warp.binding import TaskSource, find_task

FAULTS = ("--short", "--parts", "faults", "--threads", "1", "--nworld", "16")


@pytest.fixture
def work(request: pytest.FixtureRequest, pytestconfig: pytest.Config, tmp_path: Path) -> Path:
    cache = getattr(pytestconfig, "cache", None)
    folder: Path = cache.mkdir(request.node.name) if cache else tmp_path / "work"
    for file in folder.glob("*.pt"):
        file.unlink()
    return folder


def run(out: Path, *words: str) -> list[dict[str, Any]]:
    assert experiment.main(soak.EXPERIMENT, ["--out", str(out), *words]) == 0
    return [json.loads(line)["result"] for line in out.read_text().splitlines()]


def test_every_injected_fault_is_found_and_counted(
    work: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = run(tmp_path / "soak.jsonl", *FAULTS, "--steps", "4800", "--work", str(work))
    assert len(results) == 2
    for result in results:
        assert result["found"] == result["injected"] and min(result["injected"].values()) > 1
        assert result["counts_agree"] and result["other"] == {} and result["not_finite"] == 0
        assert result["compared"] > 16 * 300 / 4 - 1 and result["different"] == 0
        assert len(result["memory"]) == soak.SAMPLES
    assert re.search(r"\| point_mass, cpu \| 16 \| 9,?600 \|", capsys.readouterr().out)


def test_soak_variant_uses_the_struct_of_its_task(tmp_path: Path) -> None:
    file, _, _ = soak.variant("dm/finger_turn_hard", tmp_path)
    variant = TaskSource(find_task(file), "soak")
    observe = variant.functions["observe"]
    assert variant.world.cls.__name__ == "TurnWorld" and observe and observe.func.__name__ == "soak_observe"
    assert (
        soak.Faults("dm/finger_turn_hard", 0, 8, 8, "auto", "cpu", False, 0.0, 0).state(tmp_path, 1).parent == tmp_path
    )


@pytest.mark.long
def test_soak_run_reports_missed_faults_and_faults_in_other_worlds(
    work: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(soak, "VARIANT", soak.VARIANT.replace("== 4.0", "== 7.0").replace("== 5.0", "== 6.0"))
    make, envs = soak.lw.make, []

    def other_twin(task: str, **words: Any) -> lw.Env:
        envs.append(make(task, **(words | ({"seed": 1} if len(envs) == 2 else {}))))
        return envs[-1]

    monkeypatch.setattr(soak.lw, "make", other_twin)
    result = run(tmp_path / "soak.jsonl", *FAULTS, "--steps", "4800", "--work", str(work))[0]
    assert result["found"]["reward"] == result["found"]["observation"] == 0 < result["injected"]["reward"]
    assert result["other"]["observation"] > 0 and result["counts_agree"] and result["different"] > 0


@pytest.mark.long
def test_killed_and_resumed_training_equals_uninterrupted_training(work: Path, tmp_path: Path) -> None:
    (kills,) = run(tmp_path / "soak.jsonl", "--short", "--parts", "kills", "--work", str(work))
    assert kills["kills"] == 1 and kills["exit_code"] == 0 and kills["iterations"] == 60
    assert kills["equal_rows"] and kills["equal_policy"]


def test_stored_random_runs_are_as_long_as_claimed_and_without_faults() -> None:
    rows = [row for row in experiment.read(experiment.RESULTS / "soak.jsonl") if row.case["part"] == "random"]
    on_c = [row for row in rows if row.result.get("engine", row.case["engine"]) == "mujoco"]
    steps = {row.case["task"]: row.result["steps"] for row in on_c}
    assert len(steps) >= 67 and min(steps.values()) >= 200_000
    assert not any(number for row in rows for number in row.result["faults"].values())
