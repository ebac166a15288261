"""Parse a command's options, print its help, and suggest options for misspelt ones."""

import contextlib
import dataclasses
import inspect
import io
import itertools
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Annotated, Any

import tyro

from lyceum_warp.support.docstrings import attribute_docs
from lyceum_warp.support.suggestions import closest

_ERRORS = (
    (r"Error parsing (\S+): no type matching \{?(.*?)\}? could .* from \[(.*?)\]", "{0} takes {1}, not {2}"),
    (r"Missing value for argument '(\S+)'", "{0} needs a value"),
    (r"Missing from .*?: (\S+)", "{0} is missing"),
    (r"invalid choice '(\S*)' for argument '(\S+)'. Expected one of \((.*)\)", "{1} takes {2}, not '{0}'"),
)
"""Patterns of tyro's errors, each with a message in one line."""

_CONFIG = (tyro.conf.DisallowNone, tyro.conf.OmitArgPrefixes)  # the word None is no value of an option


def parse(command: type, prog: str, argv: Sequence[str]) -> Any:
    """Parse the options of a command, and return an instance of its class.

    If the class has an attribute ``USUAL``, --help describes only the options in it.
    """
    if {"-h", "--help"} & set(argv):
        _print_help(command, prog)
    if "--help-all" in argv:
        _help(command, prog)
    if "--tyro-print-completion" in argv:
        command = _described(command)  # shells take each line of a description for a word
    options: Any
    with contextlib.redirect_stderr(io.StringIO()) as printed:
        try:
            options, unknown = tyro.cli(command, prog=prog, args=argv, config=_CONFIG, return_unknown_args=True)
        except SystemExit as error:
            if error.code:
                raise ValueError(f"{_in_one_line(printed.getvalue())} ({prog} --help)") from None
            raise
    if unknown:
        raise ValueError(_unknown(unknown[0], [option.flag for option in _options(command)], prog))
    return options


def _in_one_line(box: str) -> str:
    """Shorten tyro's error message, a box of several lines."""
    lines = [line.strip("│╭╮╰╯ ") for line in box.splitlines()[1:]]
    text = " ".join(itertools.takewhile(lambda line: not line.startswith("─"), lines))
    for pattern, short in _ERRORS:
        if match := re.search(pattern, text):
            return short.format(*match.groups())
    return text


def _unknown(word: str, flags: Sequence[str], prog: str) -> str:
    flag = word.partition("=")[0].replace("_", "-")
    if not flag.startswith("-"):
        return f"{prog} does not take the argument {word!r}: see {prog} --help"
    names = {flag.strip("-").replace("-", "_"): flag for flag in flags}
    close = closest(flag.strip("-").replace("-", "_"), names, 1)
    hint = f"did you mean {names[close[0]]}?" if close else f"{prog} --help-all lists the options"
    return f"{prog} has no option {flag}: {hint}"


@dataclasses.dataclass(frozen=True)
class _Option:
    field: str
    flag: str
    group: str
    hint: Any


def _options(command: Any, group: str = "") -> Iterator[_Option]:
    """Iterate over the options of a command, including those in its groups."""
    for name, hint in typing.get_type_hints(command, include_extras=True).items():
        markers = _markers(hint)
        kind = typing.get_args(hint)[0] if markers else hint
        title = next((marker.name for marker in markers if getattr(marker, "name", None)), name)
        if dataclasses.is_dataclass(kind):
            yield from _options(kind, f"{title.replace('_', ' ')} ")
        elif tyro.conf.Positional not in markers:
            yield _Option(name, f"--{title.replace('_', '-')}", f"{group}options", hint)


def _print_help(command: Any, prog: str) -> None:
    if not hasattr(command, "USUAL"):
        _help(command, prog)
    usual: Sequence[str] = command.USUAL
    hints = typing.get_type_hints(command, include_extras=True)
    hidden = [name for name, hint in hints.items() if name not in usual and tyro.conf.Positional not in _markers(hint)]
    from_groups = {option.field: option.hint for option in _options(command) if option.field in {*usual} - {*hints}}
    annotations = {name: Annotated[hints[name], tyro.conf.Suppress] for name in hidden} | from_groups
    body = {"__doc__": command.__doc__, "__annotations__": annotations, **dict.fromkeys(from_groups)}
    short: Any = dataclasses.dataclass(frozen=True, kw_only=True)(type(command.__name__, (command,), body))
    try:
        _help(short, prog)
    finally:
        print(f"{prog} --help-all also describes")
        unusual = [option for option in _options(command) if option.field not in usual]
        for group, options in itertools.groupby(unusual, lambda option: option.group):
            text = f"  {group}: {' '.join(option.flag for option in options)}"
            print(textwrap.fill(text, _width(), break_on_hyphens=False, subsequent_indent="    "))


def _described(command: Any) -> Any:
    """Return a command whose options have their descriptions in one line, and without the defaults None."""
    hints, docs = typing.get_type_hints(command, include_extras=True), attribute_docs(*reversed(command.__mro__[:-1]))
    body: dict[str, Any] = {"__doc__": command.__doc__, "__annotations__": {}}
    for field in dataclasses.fields(command):
        if field.name in docs:
            several = field.default is dataclasses.MISSING and "tuple[" in str(hints[field.name])
            empty = several or field.default in (None, (), "")
            hint = "" if empty else None
            text = tyro.conf.arg(help=" ".join(docs[field.name].split()), help_behavior_hint=hint)
            body["__annotations__"][field.name] = Annotated[hints[field.name], text]
            if field.default is not dataclasses.MISSING:
                body[field.name] = field.default
    return dataclasses.dataclass(frozen=True, kw_only=True)(type(command.__name__, (command,), body))


def _help(command: Any, prog: str) -> None:
    """Print the help of a command, wrapped."""
    paragraphs = inspect.cleandoc(command.__doc__ or "").split("\n\n")
    fill = partial(textwrap.fill, width=_width(), break_on_hyphens=False, break_long_words=False)
    texts = [text if text.startswith(("$", " ")) else fill(text) for text in paragraphs]
    print("\n\n".join(texts), end="\n\n")  # tyro would join the lines
    tyro.cli(_described(command), prog=prog, description=" ", args=["--help"], config=_CONFIG)


def _width() -> int:
    return min(shutil.get_terminal_size().columns, 80)


def _markers(hint: Any) -> tuple[Any, ...]:
    return getattr(hint, "__metadata__", ())
