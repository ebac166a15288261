"""The program: help texts, unknown commands, and its version."""

import pytest

import lyceum_warp as lw
from lyceum_warp import cli


@pytest.mark.parametrize("command", [[], ["train"], ["eval"]])
def test_help_shows_examples_and_options(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "$ lyceum-warp" in out  # an example
    if command == ["train"]:
        assert all(f"--{name}" in out for name in ("iterations", "resume", "gamma", "value-hidden", "require-return"))
        assert all(f"--{name}" in out for name in ("integrator", "solver", "deterministic"))
        assert "Discount." in out


@pytest.mark.parametrize(
    "argv", [["train", "hopper", "--samples", "many"], ["train", "hopper", "--speed", "2"], ["jump"]]
)
def test_unknown_options_and_commands_are_refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(argv)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"lyceum-warp {lw.__version__}\n"
