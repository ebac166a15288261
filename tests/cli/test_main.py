import subprocess
import sys

import pytest

import lyceum_warp as lw
from lyceum_warp import cli

COMMANDS = ("tasks", "new", "check", "train", "eval", "export", "plan", "tune", "view", "bench")


def test_help_lists_commands_with_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert all(f"• {name} " in out and f"$ lyceum-warp {name}" in out for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_shows_examples_and_options(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert f"$ lyceum-warp {command}" in out
    if command == "train":
        assert all(f"--{name}" in out for name in ("iterations", "resume", "gamma", "value-hidden", "require-return"))
        assert all(f"--{name}" in out for name in ("integrator", "solver", "deterministic"))
        assert "Discount factor." in out


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_load_neither_torch_nor_warp_nor_mujoco(option: str) -> None:
    program = f"""
import contextlib, sys
from lyceum_warp.cli import main
with contextlib.suppress(SystemExit):
    main([{option!r}])
print(*sys.modules, file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert "lyceum" in done.stdout
    loaded = set(done.stderr.split())
    assert "lyceum_warp.cli" in loaded
    assert not {"torch", "warp", "mujoco"} & loaded


@pytest.mark.parametrize("options", [["--samples", "many"], ["--speed", "2"]])
def test_wrong_options_are_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["train", "hopper", *options])
    assert ended.value.code == 2
    assert options[0] in capsys.readouterr().err


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"lyceum-warp {lw.__version__}\n"
