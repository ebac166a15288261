"""Parse a command's options, print its help, and suggest options for misspelt ones."""

import contextlib
import dataclasses
import io
import itertools
import re
import shutil
import textwrap
import typing
from collections.abc import Sequence
from typing import Any

import tyro

from lyceum_warp.support.suggestions import closest

_ERRORS = (
    (r"Error parsing (\S+): no type matching INT .* from \[(.*?)\]", "{0} takes a whole number, not {1}"),
    (r"Error parsing (\S+): no type matching FLOAT .* from \[(.*?)\]", "{0} takes a number, not {1}"),
    (
        r"Error parsing (\S+): no type matching \S*\[\w+ .* from \[(.*?)\]",
        "{0} takes numbers separated by spaces, not {1}",
    ),
    (r"Missing value for argument '(\S+)'", "{0} needs a value"),
    (r"Missing from .*?: (\S+)", "{0} is missing"),
    (r"invalid choice '(\S*)' for argument '(\S+)'. Expected one of \((.*)\)", "{1} takes {2}, not '{0}'"),
)
"""Patterns of tyro's errors, each with a message in one line."""

_CONFIG = (tyro.conf.DisallowNone,)  # refuse the word None as an option's value


def parse(command: type, prog: str, words: Sequence[str]) -> Any:
    """Parse the options of a command, and return an instance of its class.

    If the class has an attribute ``USUAL``, --help describes only the options in it.
    """
    if {"-h", "--help"} & set(words):
        _print_help(command, prog)
    if "--help-all" in words:
        words = ["--help"]
    options: Any = dict(prog=prog, config=_CONFIG, return_unknown_args=True)
    with contextlib.redirect_stderr(io.StringIO()) as printed:
        try:
            found, unknown = tyro.cli(command, args=words, **options)
        except SystemExit as error:
            if error.code:
                raise ValueError(f"{_in_one_line(printed.getvalue())} ({prog} --help)") from None
            raise
    if unknown:
        flags = [flag for group in _options(command).values() for flag in group]
        raise ValueError(_unknown(unknown[0], flags, prog))
    return found


def _in_one_line(box: str) -> str:
    """Shorten tyro's error message, a box of several lines."""
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()[1:]]
    text = " ".join(itertools.takewhile(lambda line: not line.startswith("─"), lines))
    for pattern, short in _ERRORS:
        if match := re.search(pattern, text):
            return short.format(*match.groups())
    return text


def _print_help(command: type, prog: str) -> None:
    usual = getattr(command, "USUAL", None)
    shown = command if usual is None else _with_only(command, usual)
    try:
        tyro.cli(shown, prog=prog, args=["--help"], config=_CONFIG)
    finally:
        if usual is not None:
            print(f"{prog} --help-all also describes")
            width = min(shutil.get_terminal_size().columns, 80)
            for group, flags in _options(command).items():
                if others := [flag for flag, name in flags.items() if name not in usual]:
                    text = f"{group}: {' '.join(others)}"
                    indent: dict[str, Any] = {"initial_indent": "  ", "subsequent_indent": "    "}
                    print(textwrap.fill(text, width, break_on_hyphens=False, **indent))


def _unknown(word: str, options: Sequence[str], prog: str) -> str:
    flag = word.partition("=")[0].replace("_", "-")
    if not flag.startswith("-"):
        return f"{prog} does not take the argument {word!r}: see {prog} --help"
    names = {option.strip("-").replace("-", "_"): option for option in options}
    close = closest(flag.strip("-").replace("-", "_"), names, 1)
    hint = f"did you mean {names[close[0]]}?" if close else f"{prog} --help-all lists the options"
    return f"{prog} has no option {flag}: {hint}"


def _nested(hint: Any) -> Any:
    """Return the dataclass of a group of options, or None for a single option."""
    inner = next(iter(typing.get_args(hint)), None)
    return inner if dataclasses.is_dataclass(inner) else None


def _options(command: Any, group: str = "options") -> dict[str, dict[str, str]]:
    """Return the flags of a command by group, each with the name of its field."""
    found: dict[str, dict[str, str]] = {group: {}}
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        own = next(filter(None, (getattr(marker, "name", None) for marker in _markers(hint))), name)
        if (inner := _nested(hint)) is not None:
            found |= _options(inner, f"{own.replace('_', ' ')} options")
        elif name in command.__dataclass_fields__ and tyro.conf.Positional not in _markers(hint):
            found[group]["--" + own.replace("_", "-")] = name
    return found


def _markers(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())


def _with_only(command: Any, usual: Sequence[str]) -> type:
    """Make a subclass whose help shows only the usual options. ``command`` is a command or a group of its options."""
    own = _options(command)["options"].values()
    body: dict[str, Any] = {"__annotations__": {}, "__doc__": command.__doc__}
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        if (group := _nested(hint)) is not None:
            group = _with_only(group, usual)
            body["__annotations__"][name] = typing.Annotated[group, tyro.conf.OmitArgPrefixes]
            body[name] = dataclasses.field(default_factory=group)
        elif name in own and name not in usual:
            body["__annotations__"][name] = typing.Annotated[hint, tyro.conf.Suppress]
    return dataclasses.dataclass(frozen=True, kw_only=True)(type(command.__name__, (command,), body))
