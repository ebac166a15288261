"""MPPI's experiment, in the mechanics of its short mode."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import lyceum_warp as lw

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture
def mppi(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCH))
    import mppi

    return mppi


def main(mppi: ModuleType, out: Path, *words: str) -> int:
    import experiment

    return experiment.main(mppi.EXPERIMENT, ["--short", "--threads", "1", "--out", str(out), *words])


@pytest.mark.parametrize("task", ["reach", "half_cheetah", "adroit_pen"])
def test_python_environments_earn_our_rewards(mppi: ModuleType, task: str) -> None:
    if task == "adroit_pen":
        pytest.importorskip("gymnasium_robotics")
    env = lw.make(task, autoreset=False, nthread=1, seed=3)
    theirs = mppi.python_mppi.ENVS[task](lw.make(task, nthread=1).model)
    env.step(torch.full_like(env.action, 0.1))  # not from the initial state
    theirs.set_state(env.get_state()[0].numpy())
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        env.step(2.0 * torch.rand(env.action.shape, generator=generator) - 1.0)
        assert theirs.step(env.action[0].numpy().astype(float))[1] == pytest.approx(env.reward.item(), abs=2e-4)


def test_the_short_mode_runs_and_resumes(mppi: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mppi.jsonl"
    assert main(mppi, out, "--contestants", "mppi", "python", "python_stepwise") == 0
    text = capsys.readouterr().out
    assert "0 of 6 cases are there" in text and "| reach | 30 x 16 | ours, C engine |" in text
    assert main(mppi, out, "--contestants", "mppi", "python", "python_stepwise") == 0
    assert "6 of 6 cases are there" in capsys.readouterr().out
    import experiment

    rows = experiment.read(out)
    plans = {row.case["contestant"]: row.result for row in rows if row.case["part"] == "plans"}
    assert plans["mppi"]["kept"] > 0.0 and min(plans[name]["plan_ms"] for name in ("python", "python_stepwise")) > 0.0
    episodes = {row.case["contestant"]: row.result for row in rows if row.case["part"] == "episodes"}
    returns = [result["return"] for result in episodes.values()]
    assert max(returns) - min(returns) < 0.2 * abs(min(returns))  # the same planner on the same plant
    for shown in (rows, [row for row in rows if row.case["part"] == "plans"]):
        mppi.figure(shown).savefig(tmp_path / "mppi.svg")


def test_an_episode_that_two_blocks_share_counts_once(mppi: ModuleType) -> None:
    def block(contestant: str, first: int, seconds: list[float]) -> Any:
        each = [[first + i, i != 1, -100.0, value] for i, value in enumerate(seconds)]
        where = {
            "part": "episodes",
            "task": "reach",
            "samples": None,
            "contestant": contestant,
            "repeat": 1,
            "threads": 2,
        }
        return mppi.Row(where | {"first": first}, {"each": each}, {}, 1.0)

    rows = [block("mppi", 1000, [1.0, 1.0, 1.0]), block("mppi", 1000, [1.0, 1.0]), block("python", 1000, [3.0])]
    (table,) = mppi.tables(rows)
    ours, python = table.rows
    assert (ours[2:4], python[2:4], python[-1]) == (["2", "2 of 3"], ["2", "1 of 1"], "3.00")


def test_episodes_on_a_busy_machine_have_no_time(mppi: ModuleType, tmp_path: Path) -> None:
    assert main(mppi, tmp_path / "mppi.jsonl", "--parts", "episodes", "--contestants", "mppi", "--busy") == 0
    import experiment

    (busy,) = experiment.read(tmp_path / "mppi.jsonl")
    assert "seconds" not in busy.result and [episode[3] for episode in busy.result["each"]] == [None, None]
    ((line,),) = (table.rows for table in mppi.tables([busy]))
    assert (line[3][-4:], line[6:]) == ("of 2", ["", ""])
    timed = mppi.Row(busy.case | {"first": 1002}, {"each": [[1002, True, -9.0, 2.0]]}, {}, 1.0)
    ((line,),) = (table.rows for table in mppi.tables([busy, timed]))
    assert (line[3][-4:], line[6:]) == ("of 3", ["2", "1.00"])
    assert mppi.figure([busy, timed]) is None  # nothing to compare
    python = mppi.Row(timed.case | {"contestant": "python"}, timed.result, {}, 1.0)
    mppi.figure([busy, timed, python]).savefig(tmp_path / "mppi.svg")


@pytest.mark.parametrize("task", ["reach", "cartpole_swingup"])
def test_episodes_of_one_planner_for_all_plants_are_those_of_single_planners(mppi: ModuleType, task: str) -> None:
    alone, together = (
        mppi.run_episodes(mppi.Case("episodes", task, name, 1, 1000, 3, 8, None, 0.0, 1), mppi.Options())["each"]
        for name in ("mppi", "mppi_together")
    )
    assert [row[:2] for row in together] == [row[:2] for row in alone]
    np.testing.assert_allclose([row[2] for row in together], [row[2] for row in alone], rtol=1e-4)


def test_a_python_environment_that_cannot_be_made_is_skipped(mppi: ModuleType) -> None:
    import experiment

    with pytest.raises(experiment.Skipped, match="^Python's environment of cartpole cannot be made"):
        mppi.python_planner("cartpole", "python", 1)


def test_a_missing_model_is_skipped_with_one_line(
    mppi: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    assert main(mppi, tmp_path / "mppi.jsonl", "--tasks", "adroit_pen") == 0
    line = "skipped: gymnasium_robotics is not installed: pip install gymnasium-robotics\n"
    assert capsys.readouterr().out.count(line) == 1


def test_judo_is_skipped_where_it_cannot_be_installed(
    mppi: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mppi.peers, "_failure", lambda name, requirements: f"{name} cannot be installed: no network")
    words = ["--tasks", "cartpole_swingup", "--parts", "cartpole", "--contestants", "mppi", "judo"]
    assert main(mppi, tmp_path / "mppi.jsonl", *words) == 0
    text = capsys.readouterr().out
    assert text.count("skipped: judo cannot be installed: no network\n") == 1
    assert "| 16 | ours, C engine |" in text


def test_judos_worker_has_our_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    stub: Any = SimpleNamespace(
        Task=object, TaskConfig=object, MujocoState=None, Controller=None, ControllerConfig=None, MPPI=None,
        MPPIConfig=None,
    )  # fmt: skip
    stub.tasks = SimpleNamespace(base=stub)
    for name in ("judo", "judo.tasks", "judo.tasks.base", "judo.app", "judo.app.structs", "judo.controller",
                 "judo.controller.controller", "judo.optimizers", "judo.optimizers.mppi"):  # fmt: skip
        monkeypatch.setitem(sys.modules, name, stub)
    spec = importlib.util.spec_from_file_location("judo_worker", BENCH / "peers" / "judo" / "worker.py")
    worker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(worker)
    env = lw.make("cartpole_swingup", nworld=64, nthread=1)
    env.rand_reset(0)
    for _ in range(30):
        env.step(2.4 * torch.rand(env.action.shape) - 1.2)
        parts, state = env.state_space.parts, env.get_state().numpy()
        after = np.concatenate([state[:, parts["qpos"]], state[:, parts["qvel"]]], axis=1)
        controls = env.action.clamp(-1.0, 1.0).numpy()
        assert worker.rewards(after, controls) == pytest.approx(env.reward.numpy(), abs=2e-5)


def test_sets_of_seeds_are_chosen_by_number(mppi: ModuleType) -> None:
    options = {"parts": ("episodes",), "tasks": ("reach",), "contestants": ("mppi", "python"), "block": 40}
    chosen = mppi.cases(mppi.Options(**options, sets=(3, 1)))
    assert [(case.repeat, case.first, case.count) for case in chosen if case.contestant == "python"] == [
        (3, 3000, 40), (3, 3040, 40), (3, 3080, 20), (1, 1000, 40), (1, 1040, 40), (1, 1080, 20),
    ]  # fmt: skip
    assert set(chosen) < set(mppi.cases(mppi.Options(**options)))  # all three sets


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--parts", "episode"], "there is no part 'episode': did you mean episodes?"),
        (["--contestants", "hydrax"], "there is no contestant 'hydrax'"),
        (["--jobs", "2"], "so that jobs must be 1: or give --parts episodes"),
        (["--block", "0"], "block, repeats and the numbers of the sets must be at least 1"),
        (["--sets", "0", "3"], "the numbers of the sets must be at least 1"),
    ],
)
def test_bad_input_gets_one_line(
    mppi: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(mppi, tmp_path / "mppi.jsonl", *words) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
