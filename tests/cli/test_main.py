import subprocess
import sys

import pytest
from training_runs import refused

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


def help_of(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 0
    return capsys.readouterr().out.replace("│", " ")  # some terminals draw boxes without sides


def test_help_all_describes_more_options_than_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for command in ("train", "plan", "eval", "view"):
        usual, every = help_of([command, "--help"], capsys), help_of([command, "--help-all"], capsys)
        assert len(usual.splitlines()) <= 90 < len(every.splitlines())
        described = [line.split()[0] for line in usual.splitlines() if line.startswith("  --")]
        described = [flag for flag in described if flag.strip("-")]  # rules between groups
        assert 9 <= len(described) <= 10 and all(f"  {flag}" in every for flag in described)
        others = usual.partition(f"lyceum-warp {command} --help-all also describes")[2]
        assert all(f"  {flag}" in every for flag in others.split() if flag.startswith("--"))
    everything = help_of(["train", "--help-all"], capsys)
    assert all(f"  --{name} " in everything for name in ("iterations", "gamma", "require-return", "integrator"))
    assert "Discount factor." in everything
    assert "hyperparameter options: --samples" in help_of(["train", "-h"], capsys)


@pytest.mark.parametrize("words, message", [
    ("trian hopper", "there is no command 'trian': did you mean train?"),
    ("train hopper --iteration 5", "train has no option --iteration: did you mean --iterations?"),
    ("train hopper --task-param x=1", "train has no option --task-param: did you mean --param?"),
    ("plan reach --realtime", "plan has no option --realtime: did you mean --real-time?"),
    ("view hopper --zzz=1", "view has no option --zzz: lyceum-warp view --help-all lists the options"),
    ("train hopper walker2d", "train does not take the argument 'walker2d': see lyceum-warp train --help"),
])  # fmt: skip
def test_misspelt_command_or_option_prints_one_line_with_a_suggestion(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words.split()) == 2
    refused(capsys, message)


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_do_not_import_torch_warp_or_mujoco(option: str) -> None:
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


def test_invalid_flag_value_prints_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["train", "hopper", "--samples", "many"])
    assert ended.value.code == 2
    assert "--samples" in capsys.readouterr().err


def test_version_prints_the_package_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"lyceum-warp {lw.__version__}\n"
