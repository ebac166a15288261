"""The experiment on the agreement of the engines."""

import json
import math
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

import lyceum_warp as lw

BENCH = Path(__file__).parents[2] / "bench"
TASK = "point_mass"
SMALL = ("--short", "--tasks", TASK, "--nworld", "3", "--steps", "4")


@pytest.fixture(scope="module")
def fidelity() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCH))
        import fidelity

        yield fidelity


def run(fidelity: ModuleType, *words: Any) -> int:
    import experiment

    return int(experiment.main(fidelity.EXPERIMENT, [str(word) for word in words]))


@pytest.fixture(scope="module")
def results(fidelity: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fidelity") / "fidelity.jsonl"
    assert run(fidelity, *SMALL, "--out", path) == 0
    return path


def rows_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def alike(fidelity: ModuleType, monkeypatch: pytest.MonkeyPatch, **other: Any) -> None:
    """Let the C engine stand for the Warp engine, with other parameters."""
    make = fidelity.lw.make

    def replaced(task: str, **words: Any) -> lw.Env:
        if words.get("engine") == "warp":
            words = words | {"engine": "mujoco"} | other
        return make(task, **words)

    monkeypatch.setattr(fidelity.lw, "make", replaced)


def train(folder: Path) -> None:
    """Make a run of one iteration."""
    config = lw.NPGConfig(samples=64, hidden=(8,), value_hidden=(8,), rollout="segments")
    lw.train(lw.NPG(lw.make(TASK, nworld=2, nthread=1), config=config), folder, iterations=1)


def options(fidelity: ModuleType, *words: str) -> Any:
    import tyro

    return tyro.cli(fidelity.Options, args=words)


def test_short_mode_compares_trajectories_and_returns(results: Path) -> None:
    rows = rows_of(results)
    assert [(row["case"]["policy"], row["case"]["cone"]) for row in rows] == [("zero", "own"), ("random", "own")]
    for row in rows:
        assert row["result"]["steps"] == [1, 2, 3, 4]
        for pair in ("engines", "rounded", "moved"):
            found = row["result"]["pairs"][pair]
            for quantity in ("obs", "reward", "qpos"):
                low, high = found[quantity]["median"], found[quantity]["p99"]
                assert all(0.0 <= a <= b < 1e-5 for a, b in zip(low, high, strict=True))
            assert found["half_apart"] is None and found["together"] == 1.0 and found["same_end"] == 1.0
        mean, low, high = row["result"]["returns"]["difference"]
        assert low <= mean <= high and abs(mean) < 0.1 and row["result"]["returns"]["episodes"] == 3
    # float32 leaves a difference where worlds move
    assert rows[1]["result"]["pairs"]["engines"]["qpos"]["median"][-1] > 0.0


def test_second_run_measures_nothing(
    fidelity: ModuleType, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = results.read_bytes()
    monkeypatch.setattr(fidelity.lw, "make", None)
    assert run(fidelity, *SMALL, "--out", results) == 0
    assert results.read_bytes() == before
    assert "fidelity: 2 of 2 cases are there" in capsys.readouterr().out


def test_tables_and_figure_need_results_alone(fidelity: ModuleType, results: Path) -> None:
    import experiment

    rows = experiment.read(results)
    first, second = fidelity.tables(rows)
    assert [cells[:3] for cells in first.rows] == [[TASK, "zero", "own"], [TASK, "random", "own"]]
    assert first.rows[0][7:10] == ["> 4"] * 3 and [cells[3] for cells in second.rows] == ["3", "3"]
    assert fidelity.tables(rows[::-1])[0].rows == first.rows  # jobs finish in any order
    drawn = fidelity.figure(rows)
    assert [axes.get_title(loc="left") for axes in drawn.axes] == [TASK]
    assert len(drawn.axes[0].lines) == 5  # two of the engines, two units, the tolerance
    with pytest.raises(ValueError, match="no trajectories"):
        fidelity.figure(rows[:1])


def test_equal_engines_never_differ(fidelity: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    alike(fidelity, monkeypatch)
    given = options(fidelity, *SMALL)
    for case in fidelity.cases(given):
        found = fidelity.measure(case, given)
        engines = found["pairs"]["engines"]
        assert engines["obs"]["p99"] == engines["reward"]["p99"] == engines["qpos"]["p99"] == [0.0] * 4
        assert found["pairs"]["moved"]["qpos"]["median"][0] > 0.0
        assert found["returns"]["difference"] == [0.0, 0.0, 0.0] and found["returns"]["same_length"] == 1.0


def test_other_dynamics_are_apart(fidelity: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    alike(fidelity, monkeypatch, frame_skip=60)
    given = options(fidelity, *SMALL)
    case = fidelity.cases(given)[1]
    engines = fidelity.measure(case, given)["pairs"]["engines"]
    assert engines["half_apart"] is not None and engines["half_apart"] <= 4 and engines["together"] < 0.5


def test_worlds_begin_with_numbers_of_float32(fidelity: ModuleType) -> None:
    env = lw.make(TASK, nworld=5, nthread=1)
    case = fidelity.Case(TASK, "random", "own", 5, 4, 0.01, 0, "cpu", 3)
    state = fidelity.start(env, fidelity.policy_of(case, env, None), 3, 20)
    parts = env.state_space.parts
    for name in ("qpos", "qvel"):
        values = state[:, parts[name]]
        assert torch.equal(values, values.float().double()) and values.abs().max() > 0.0
    assert torch.equal(state[:, parts["key"]], env.get_state()[:, parts["key"]])
    difference = (fidelity.moved(env, state, 0) - state).abs()
    assert 0.0 < difference.max() <= 2.0**-24 * state.abs().max().clamp(min=1.0)
    assert difference[:, parts["key"]].max() == 0.0


def test_steps_apart_are_those_of_a_share_of_the_worlds(fidelity: ModuleType) -> None:
    error = torch.zeros(6, 4)
    error[2:, 0], error[4:, 1], error[3, 2] = 1.0, 1.0, 1.0  # apart after 3, 5 and 4 steps, and never
    every = torch.ones(4, dtype=torch.bool)
    assert fidelity.apart(error, every, 0.5) == {"tenth_apart": 3, "half_apart": 4, "together": 0.25}
    assert fidelity.apart(error, error[2] == 0.0, 0.5)["half_apart"] == 5
    assert fidelity.apart(error, ~every, 0.5) == {"tenth_apart": None, "half_apart": None, "together": None}


def test_worlds_with_faults_are_left_out(fidelity: ModuleType) -> None:
    error = torch.tensor([[0.0, 2.0, 4.0, math.nan], [math.nan] * 4])
    assert fidelity.quantiles(error, [1, 2]) == {"median": [2.0, None], "p99": [pytest.approx(3.96), None]}


def test_interval_covers_the_mean_of_a_sample(fidelity: ModuleType) -> None:
    values = torch.randn(400, generator=torch.Generator().manual_seed(0)).double().numpy()
    mean, low, high = fidelity.interval(values, 0)
    spread = 1.96 * values.std() / 20.0
    assert mean == pytest.approx(values.mean())
    assert (high - mean, mean - low) == (pytest.approx(spread, rel=0.1), pytest.approx(spread, rel=0.1))


def test_trained_policy_and_that_of_a_run_act(
    fidelity: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    alike(fidelity, monkeypatch)
    run_folder = tmp_path / "a-run"
    train(run_folder)
    given = options(fidelity, *SMALL[1:], "--policy", str(run_folder), "--iterations", "1")
    found = {case.policy: case for case in fidelity.cases(given)}
    assert list(found) == ["zero", "random", "trained", str(run_folder)]
    means = {name: fidelity.measure(case, given)["returns"]["c"][0] for name, case in found.items()}
    assert len(set(means.values())) == 4 and fidelity.actor_name(str(run_folder)) == "a-run"


def test_tasks_on_a_plane_are_compared_with_elliptic_cones(fidelity: ModuleType) -> None:
    listed = fidelity.cases(options(fidelity, "--tasks", "ant", "reach", "--iterations", "0"))
    assert [(case.task, case.policy) for case in listed if case.cone == "elliptic"] == [("ant", "random")]
    assert all(fidelity.estimate(case) > 0.0 for case in listed)


def test_task_without_its_model_is_skipped_with_one_line(
    fidelity: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(task: str, **words: Any) -> None:
        raise FileNotFoundError("the model comes with a package that is not installed: pip install it")

    monkeypatch.setattr(fidelity.lw, "make", make)
    path = tmp_path / "fidelity.jsonl"
    assert run(fidelity, *SMALL, "--out", path) == 0
    out = capsys.readouterr().out
    assert out.count(f"skipped: {TASK}: the model comes with a package that is not installed") == 1
    assert not path.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--tasks", "hoper"), "there is no task 'hoper': did you mean hopper?"),
        (("--policy", "no-such-run"), "no-such-run"),
        (("--nworld", "0"), "--nworld"),
        (("--tolerance", "-1"), "--tolerance"),
    ],
)
def test_bad_input_gets_one_line(
    fidelity: ModuleType, words: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(fidelity, *words, "--dry-run") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fidelity: ") and message in line


def test_task_of_the_policy_must_be_among_the_tasks(fidelity: ModuleType, tmp_path: Path) -> None:
    train(tmp_path / "run")
    with pytest.raises(ValueError, match=f"acts in {TASK}, which is not among the tasks"):
        fidelity.cases(options(fidelity, "--tasks", "hopper", "--policy", str(tmp_path / "run")))
