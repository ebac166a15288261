from pathlib import Path

import equivalence
import experiment
import numpy as np
import pytest


@pytest.mark.long
def test_short_experiment_resumes_and_reports_whether_the_engines_are_equivalent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--short", "--out", str(tmp_path / "equivalence.jsonl"), "--threads", "1"]
    assert experiment.main(equivalence.EXPERIMENT, [*out, "--seeds", "0"]) == 0
    assert "| inverted_double_pendulum" not in capsys.readouterr().out
    assert experiment.main(equivalence.EXPERIMENT, out) == 0
    shown = capsys.readouterr().out
    assert "equivalence: 2 of 4 cases are stored" in shown
    (line,) = [line for line in shown.splitlines() if line.startswith("| inverted_double_pendulum")]
    assert line.split(" | ")[1:4] == ["2,000", "cpu", "2, 2"]
    rows = experiment.read(tmp_path / "equivalence.jsonl")
    areas = {(row.case["engine"], row.case["seed"]): row.result["area"] for row in rows}
    assert len(areas) == 4 and all(30.0 < area < 200.0 for area in areas.values())
    assert [row.result["curve"][-1][0] for row in rows] == [2000] * 4


def test_engines_are_equivalent_only_with_a_small_difference_and_enough_seeds() -> None:
    random = np.random.default_rng(0)
    for difference, seeds, verdict in ((0.0, 20, "equivalent"), (0.0, 4, "not shown"), (1.0, 20, "not shown"),
                                       (2.0, 20, "different")):  # fmt: skip
        a, b = random.normal(size=(2, 40, seeds))
        found = [equivalence.equivalence(one, other + difference)["verdict"] for one, other in zip(a, b, strict=True)]
        assert found.count(verdict) > 28


def test_a_margin_above_the_mean_permits_no_verdict() -> None:
    (table,) = equivalence.tables(experiment.read(experiment.RESULTS / "equivalence.jsonl"))
    verdicts = {line[0]: line[-1] for line in table.rows}
    assert verdicts["hopper"] == "equivalent" and verdicts["half_cheetah"] == "margin exceeds the mean"
