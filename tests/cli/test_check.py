import pytest
import tiny_task
from conftest import TaskFile
from training_runs import refused

from lyceum_warp import cli
from lyceum_warp.testing import CHECKS


def test_check_command_lists_all_rules_with_their_durations(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "point_mass", "--nworld", "2", "--steps", "5", "--param", "success_distance=0.1"]) == 0
    head, *lines, what_next = capsys.readouterr().out.splitlines()
    assert head == "point_mass on the mujoco engine (cpu, 2 worlds) keeps the rules:"
    assert what_next == "next:       lyceum-warp check point_mass --engine warp, then lyceum-warp train point_mass"
    assert [line.split()[0] for line in lines] == [check.__name__.removeprefix("check_") for check in CHECKS]
    assert all(float(line.split()[1]) >= 0 and line.endswith(" s") for line in lines)


def test_check_command_runs_only_the_named_rules(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "point_mass", "--rule", "graphs", "--rule", "reset"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:-1]] == ["graphs", "reset"]
    assert cli.main(["check", "point_mass", "--rule", "graph"]) == 2
    refused(capsys, "no rule 'graph'", "did you mean graphs")


def test_check_command_prints_a_violated_rule_and_exits_with_1(
    task_file: TaskFile, capsys: pytest.CaptureFixture[str]
) -> None:
    fixed = "def randomize(s: World, p: Params, rng: Row[wp.uint32]):\n    s.qpos[0] = 0.5"
    file = task_file("alike.py", tiny_task.with_function(fixed))
    assert cli.main(["check", str(file), "--rule", "graphs", "--rule", "rand_reset"]) == 1
    out = capsys.readouterr().out
    broken, state = out.splitlines()
    assert broken == "tiny on the mujoco engine breaks the rule 'rand_reset': two consecutive draws are the same"
    assert state.startswith("  with seed 0, world 0 in step 0 of its episode: time [0.0], qpos [0.5, ")
