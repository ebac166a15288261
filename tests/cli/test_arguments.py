"""Flags made from options, and values as NAME=VALUE."""

import dataclasses
from pathlib import Path
from typing import Annotated

import pytest
import tyro

from lyceum_warp.cli.arguments import Physics, Words, optional_flags, parameter, portable, spelled
from lyceum_warp.options import PhysicsOptions


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
])  # fmt: skip
def test_a_parameter_is_read_with_its_type(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)
    assert parameter(f"a={spelled(parsed)}") == ("a", value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mass", "'mass' must be written as NAME=VALUE"),
        ("=3", "'=3' must be written as NAME=VALUE"),
        ("mass=", "'mass=' must be written as NAME=VALUE"),
        ("mass=heavy", "the value in 'mass=heavy' must be a number, true or false"),
    ],
)
def test_a_parameter_written_in_another_way_is_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parameter(text)


def test_portable_makes_the_path_of_a_file_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert portable("hopper") == "hopper"
    assert portable("mine.py") == str(tmp_path / "mine.py")
    assert portable("mine.py:Task") == f"{tmp_path / 'mine.py'}:Task"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    size: int = 3
    """Size of it,
    in metres."""
    name: str | None = None
    fast: bool = False
    limits: tuple[float, ...] = (1.0,)
    """Limits."""


@optional_flags(Options, default="(default: the best)")
class Flags:
    limits: Annotated[Words, tyro.conf.arg(metavar="NUMBER")] = ()
    extra: int = 4


def test_flags_are_the_fields_of_the_options_and_none_unless_given() -> None:
    assert [field.name for field in dataclasses.fields(Flags)] == ["size", "name", "fast", "limits", "extra"]
    assert vars(tyro.cli(Flags, args=[])) == {"size": None, "name": None, "fast": False, "limits": (), "extra": 4}
    argv = ["--size", "5", "--name", "a", "--fast", "--limits", "1", "--limits", "2"]
    given = vars(tyro.cli(Flags, args=argv))
    assert given == {"size": 5, "name": "a", "fast": True, "limits": ("1", "2"), "extra": 4}


def test_help_texts_of_flags_are_the_docstrings_of_the_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        tyro.cli(Flags, args=["--help"])
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--size INT Size of it, in metres. (default: the best)" in out
    assert "--name STR (default: the best)" in out and "--limits NUMBER Limits." in out


def test_every_option_of_the_physics_has_a_flag() -> None:
    names = [field.name for field in dataclasses.fields(Physics)]
    assert names == [field.name for field in dataclasses.fields(PhysicsOptions)]
    assert Physics().options() == PhysicsOptions()


def test_physics_flags_become_checked_options() -> None:
    argv = ["--frame-skip", "2", "--cone", "elliptic", "--integrator", "euler", "--solver", "iterations=4",
            "--solver", "ls_iterations=9", "--njmax", "40", "--deterministic"]  # fmt: skip
    assert tyro.cli(Physics, args=argv).options() == PhysicsOptions(
        frame_skip=2, cone="elliptic", integrator="euler", solver={"iterations": 4, "ls_iterations": 9}, njmax=40,
        deterministic=True,
    )  # fmt: skip
    with pytest.raises(ValueError, match="no integrator 'rk5'"):
        tyro.cli(Physics, args=["--integrator", "rk5"]).options()


@pytest.mark.parametrize(
    ("saved", "options"),
    [
        (None, PhysicsOptions()),  # a run from before there was a choice
        ({"integrator": None, "solver": {}, "deterministic": False, "unroll": False}, PhysicsOptions()),
        (
            {"integrator": "euler", "solver": {"iterations": 7}, "deterministic": True, "unroll": False},
            PhysicsOptions(integrator="euler", solver={"iterations": 7}, deterministic=True),
        ),
        ({"solver": None, "njmax": 30}, PhysicsOptions(njmax=30)),
    ],
)
def test_physics_of_a_run_are_read_from_its_configuration(saved: dict[str, object], options: PhysicsOptions) -> None:
    config = {} if saved is None else {"physics": saved}
    assert Physics.of(config).options() == options
    assert Physics.of({"physics": options.given()}).options() == options
