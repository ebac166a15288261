import ast
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Run

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture):
    def lines(name: str, *args: str) -> list[str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [name, *args])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return lines


def output_of(name: str) -> str:
    """Run an example in a subprocess, because it registers a task of the module ``__main__``."""
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}
    command = [sys.executable, str(EXAMPLES / name)]
    process = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900)
    assert process.returncode == 0, process.stderr
    return process.stdout


def numbers(pattern: str, lines: list[str]) -> list[float]:
    return [float(match[1]) for line in lines if (match := re.search(pattern, line))]


def test_train_example_improves_and_saves_the_policy(run, tmp_path: Path) -> None:
    lines = run("train.py", "--iterations", "5", "--samples", "2000")
    returns = numbers(r"return +(-?[\d.]+)", lines)
    assert len(returns) == 6
    assert returns[-1] > 2 * returns[0] > 0
    assert lines[-1] == "saved in policy.pt: 5126 parameters"
    assert (tmp_path / "policy.pt").is_file()


@pytest.mark.long
def test_example_with_a_custom_network_increases_the_return(run) -> None:
    lines = run("own_policy.py", "--iterations", "8")
    returns = numbers(r"return +(-?[\d.]+)", lines)
    assert len(returns) == 9
    assert returns[-1] > max(returns[:3]) + 50
    assert lines[-1].endswith("370 parameters")


@pytest.mark.long
def test_random_search_example_writes_a_complete_run_folder(run, tmp_path: Path) -> None:
    once = numbers(r"return (-?[\d.]+)", run("random_search.py", "--out", "once", "--iterations", "6"))
    assert max(once) == 200.0 > 1.5 * once[0]
    run("random_search.py", "--out", "twice", "--iterations", "3")
    run("random_search.py", "--out", "twice", "--iterations", "6", "--resume", "--seed", "0")
    rows = [Run.open(tmp_path / name).rows() for name in ("once", "twice")]
    assert rows[0] == rows[1] and list(rows[0][0])[-1] == "weight_norm"
    assert cli.main(["eval", "twice", "--which", "best", "--episodes", "4"]) == 0
    assert cli.main(["export", "twice", "--to", "policy.pt2"]) == 0
    assert torch.export.load("policy.pt2").module()(torch.zeros(3, 4)).shape == (3, 1)
    assert cli.main(["train", "--resume", "twice", "--iterations", "9"]) == 2


@pytest.mark.long
def test_td3_example_learns_and_resumes_with_its_replay_buffer(run, tmp_path: Path) -> None:
    ended = numbers(r": (\d+) episodes", run("td3.py", "--out", "once", "--iterations", "4"))
    assert ended[0] > 50 > 25 > ended[-1]
    run("td3.py", "--out", "twice", "--iterations", "2")
    lines = run("td3.py", "--out", "twice", "--iterations", "4", "--resume")
    assert numbers(r"return ([\d.]+)", lines)[0] > 10.0
    assert Run.open(tmp_path / "once").rows() == Run.open(tmp_path / "twice").rows()


def test_plan_example_reaches_the_target_in_each_episode(run) -> None:
    lines = run("plan.py", "--episodes", "2")
    assert sum("success after" in line for line in lines) == 2
    assert "success: 100% of 2 episodes" in lines
    assert 0 < numbers(r"median ([\d.]+) ms", lines)[0] < 1000


@pytest.mark.long
def test_own_task_example_passes_check_task_and_runs() -> None:
    first, *_, last = output_of("own_task.py").splitlines()
    assert first.startswith("pendulum on the mujoco engine") and first.endswith("keeps the rules:")
    # the pendulum hangs almost straight down, and the action costs 0.1 * 0.5²
    assert last.startswith("reward after 0.04 s")
    assert numbers(r": (-[\d.]+)", [last])[0] == pytest.approx(-1.025, abs=2e-3)


@pytest.mark.long
def test_commanded_speed_example_passes_check_task_on_both_engines() -> None:
    output = output_of("commanded_speed.py")
    for engine in ("mujoco", "warp"):
        assert f"commanded_speed on the {engine} engine" in output
    reward, terms = re.fullmatch(r"reward (\S+) of (.*)", output.splitlines()[-1]).groups()
    terms = ast.literal_eval(terms)
    assert list(terms) == ["tracking", "imitation", "effort", "flight", "difficulty"]
    assert float(reward) == pytest.approx(sum(terms.values()) - terms["difficulty"], abs=1e-5)


def test_torch_loop_example_learns_to_approach_the_target(run) -> None:
    lines = run("torch_loop.py", "--iterations", "24")
    distances = numbers(r"256 episodes ended ([\d.]+) m", lines)
    assert len(distances) == 6  # an episode takes 128 steps, which are four iterations of 32 steps
    assert distances[-1] < 0.75 * distances[0]


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_examples_use_public_names_only(path: Path) -> None:
    source = path.read_text()
    modules = set(re.findall(r"^(?:from|import) (lyceum_warp[\w.]*)", source, re.MULTILINE))
    # a task may build on another
    modules = {module for module in modules if not module.startswith("lyceum_warp.tasks")}
    assert modules <= {"lyceum_warp", "lyceum_warp.testing"}
    assert not re.search(r"\b(env|plan|npg)\._", source)


@pytest.mark.long
@pytest.mark.parametrize(("name", "teacher"), [("seen_reach.py", "reach"), ("go1_depth.py", "go1_rough_velocity")])
def test_students_that_see_have_the_observations_of_their_teachers(name: str, teacher: str) -> None:
    env = lw.make(EXAMPLES / name, nworld=4, seed=1)
    env.step(torch.zeros_like(env.action))
    assert list(env.obs_spaces["teacher"].parts.items()) == list(lw.make(teacher).obs_space.parts.items())
    assert not {"error", "height_scan", "linear_velocity"} & env.obs_space.parts.keys()
    for camera in env.task.cameras:
        picture = env.obs_groups[camera.group].float()
        assert (picture[0] != picture[1]).any() and picture.std() > 0.0
