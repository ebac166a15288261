import dataclasses
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.cli.arguments import NO_FLAGS, EnvFlags, Physics, Placement, given, parameter, parameters
from lyceum_warp.core import EnvOptions, PhysicsOptions

COMMANDS = (
    "tasks",
    "new",
    "check",
    "train",
    "compile",
    "plot",
    "report",
    "sweep",
    "eval",
    "export",
    "fit",
    "plan",
    "tune",
    "view",
    "bench",
)


def help_of(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert not ended.value.code
    return capsys.readouterr().out.replace("│", " ")  # some terminals draw boxes without sides


def test_help_lists_commands_with_examples(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([]) == 0
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in COMMANDS) and all(len(line) <= 80 for line in out.splitlines())
    for name in COMMANDS:
        shown = help_of([name, "--help"], capsys)
        assert f"$ lyceum-warp {name}" in shown and "None)" not in shown and "(default: )" not in shown
        assert all(len(line) <= 80 or line.startswith("usage:") for line in shown.splitlines())


def test_help_all_describes_more_options_than_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for command in ("train", "plan", "eval", "view"):
        usual, every = help_of([command, "--help"], capsys), help_of([command, "--help-all"], capsys)
        assert len(usual.splitlines()) <= 100 < len(every.splitlines())
        described = [line.split()[0] for line in usual.splitlines() if line.startswith("  --")]
        described = [flag for flag in described if flag.strip("-")]  # rules between groups
        assert 9 <= len(described) <= 10 and all(f"  {flag}" in every for flag in described)
        others = usual.partition(f"lyceum-warp {command} --help-all also describes")[2]
        assert all(f"  {flag}" in every for flag in others.split() if flag.startswith("--"))


@pytest.mark.skipif(sys.platform != "linux", reason="torch uses GNU's OpenMP on Linux only")
def test_bash_completes_a_flag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "completion"
    script.write_text(help_of(["train", "--tyro-print-completion", "bash"], capsys))
    words = "COMP_WORDS=(lyceum-warp train --iter); COMP_CWORD=2; _tyro_lyceum_warp_train; echo ${COMPREPLY[*]}"
    shell = subprocess.run(["bash", "-c", f". {script}; {words}"], capture_output=True, text=True, check=True)
    assert shell.stdout.split() == ["--iterations"]


def test_openmp_threads_of_a_command_do_not_spin() -> None:
    """Spinning threads multiply the time of updates on busy cores."""
    command = [sys.executable, "-m", "lyceum_warp.cli", "train", "hopper", "--iterations", "0"]
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment["OMP_DISPLAY_ENV"] = "VERBOSE"
    shown = subprocess.run(command, env=environment, capture_output=True, text=True).stderr
    assert "GOMP_SPINCOUNT = '0'" in shown


@pytest.mark.parametrize("words, message", [
    ("trian hopper", "did you mean train?"),
    ("train hopper --iteration 5", "train has no option --iteration: did you mean --iterations?"),
    ("train hopper --lr=1e-3", "train has no option --lr: did you mean --learning-rate?"),
    ("view hopper --zzz=1", "view has no option --zzz: lyceum-warp view --help-all"),
    ("train hopper walker2d", "'walker2d': see lyceum-warp train --help"),
    ("train hopper --samples many", "--samples takes INT, not 'many'"),
    ("train hopper --gamma high", "--gamma takes FLOAT, not 'high'"),
    ("train hopper --hidden 64,64", "--hidden takes [INT [INT ...]], not '64,64'"),
    ("train hopper --seed None", "--seed takes INT, not 'None'"),
    ("plan hopper --smoothing 1 2", "--smoothing takes FLOAT FLOAT FLOAT, not '1', '2'"),
    ("plan hopper --risk best", "risk must be 'mean' or 'worst', not 'best'"),
    ("train hopper --iterations", "--iterations needs a value"),
    ("new robot --model robot.xml --template walk", "--template takes 'plain', 'velocity', 'tracking', not 'walk'"),
    ("new robot", "--model is missing"),
])  # fmt: skip
def test_invalid_command_line_prints_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words.split()) == 2
    refused(capsys, message)


@pytest.mark.parametrize(
    ("option", "shown"), [("--help", "Batched MuJoCo worlds"), ("--version", f"lyceum-warp {lw.__version__}\n")]
)
def test_help_and_version_do_not_import_torch_warp_or_mujoco(option: str, shown: str) -> None:
    program = f"""
import contextlib, sys
from lyceum_warp.cli import main
with contextlib.suppress(SystemExit):
    main([{option!r}])
print(*sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert shown in done.stdout
    loaded = set(done.stderr.split())
    assert "lyceum_warp.cli" in loaded and not {"torch", "warp", "mujoco"} & loaded


def test_keyboard_interrupt_of_a_task_file_prints_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "task.py").write_text("raise KeyboardInterrupt")
    assert cli.main(["check", str(tmp_path / "task.py")]) == 130
    refused(capsys, "KeyboardInterrupt")


def test_output_that_the_terminal_cannot_encode_is_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("\udcffä").mkdir()
    bytes_out = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(bytes_out, "ascii"))
    assert cli.main(["new", "\udcffä/walk", "--model", "gymnasium:hopper.xml"]) == 0
    sys.stdout.flush()
    assert bytes_out.getvalue().startswith(b"\\udcff\\xe4/walk.py: ")


@pytest.mark.long
def test_bench_forwards_options_and_returns_the_exit_code_of_the_program() -> None:
    command = [sys.executable, "-m", "lyceum_warp.cli", "bench", "plot", "no_experiment"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and "'no_experiment'" in done.stderr


def test_bench_refuses_unknown_programs_and_needs_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", "throughputs"]) == 2
    refused(capsys, "'throughputs'", "throughput?")
    monkeypatch.setattr("lyceum_warp.cli.bench.FOLDER", tmp_path / "bench")
    assert cli.main(["bench"]) == 2
    refused(capsys, str(tmp_path / "bench"))


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
    ("a=[[0,-1.3], [1, inf]]", [[0, -1.3], [1, float("inf")]]), ("a=[[1,2]]", [[1, 2]]),
])  # fmt: skip
def test_parameter_values_are_parsed_by_their_type(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)


@pytest.mark.parametrize("text", ["mass", "mass=", "mass=heavy", "mass=[[1,],[2]]"])
def test_malformed_parameter_raises_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"'{text}'")):
        parameter(text)


def test_every_option_has_a_flag_or_is_listed() -> None:
    physics = {field.name for field in dataclasses.fields(PhysicsOptions)} - {"base"} | {"physics"}
    assert {field.name for field in dataclasses.fields(Physics)} == physics
    names = {field.name for field in dataclasses.fields(EnvOptions)} - {*NO_FLAGS}
    assert {field.name for field in dataclasses.fields(EnvFlags)} == names
    assert {field.name for field in dataclasses.fields(Placement)} == names - {"horizon"}
    assert given(Physics()) == given(EnvFlags()) == {}


def test_last_value_of_a_repeated_parameter_is_used() -> None:
    assert parameters(["mass=1", "size=1,2", "mass=3"]) == {"mass": 3, "size": [1, 2]}


def test_option_given_as_a_parameter_raises_an_error() -> None:
    with pytest.raises(ValueError, match=r"horizon is an option.*--help-all"):
        parameters(["mass=1", "horizon=9"])
