import equivalence
import experiment
import numpy as np


def test_engines_are_equivalent_only_with_a_small_difference_and_enough_seeds() -> None:
    random = np.random.default_rng(0)
    for difference, seeds, verdict in ((0.0, 20, "equivalent"), (0.0, 4, "not shown"), (1.0, 20, "not shown"),
                                       (2.0, 20, "different")):  # fmt: skip
        a, b = random.normal(size=(2, 40, seeds))
        verdicts = [
            equivalence.equivalence(one, other + difference)["verdict"] for one, other in zip(a, b, strict=True)
        ]
        assert verdicts.count(verdict) > 28


def test_a_margin_above_the_mean_permits_no_verdict() -> None:
    (table,) = equivalence.tables(experiment.read(experiment.RESULTS / "equivalence.jsonl"))
    verdicts = {line[0]: line[-1] for line in table.rows}
    assert verdicts["hopper"] == "equivalent" and verdicts["half_cheetah"] == "margin exceeds the mean"
