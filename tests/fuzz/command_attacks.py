"""Run ``lyceum-warp`` with random command lines.

A case is "COMMAND SEED" or the name of a case in ``minimal_cases.py``.
"""

import contextlib
import functools
import io
import os
import re
import shlex
import shutil
import warnings
from pathlib import Path
from random import Random

import guarded
import torch
from file_attacks import SLIDE, content
from guarded import ProblemError
from minimal_cases import COMMANDS
from mutations import NUMBERS, TEXTS

import lyceum_warp.cli.view
from lyceum_warp import cli

RUN, HERE = Path("commands/good").absolute(), Path("commands/here").absolute()

SMALL: dict[str, dict[str, tuple[str, ...]]] = {
    "tasks": {},
    "new": {"--model": ("gymnasium:hopper.xml",)},
    "check": {"--nworld": ("2",), "--steps": ("2",), "--rule": ("graphs",)},
    "train": {
        "--iterations": ("1",), "--samples": ("8",), "--nworld": ("2",), "--hidden": ("4",), "--value-hidden": ("4",),
        "--mean-every": ("0",), "--horizon": ("4",), "--out": ("out",), "--no-video": (), "--no-plot": (),
    },
    "train --resume good": {"--iterations": ("2",), "--no-video": (), "--no-plot": ()},
    "train --from good": {"--iterations": ("1",), "--no-video": (), "--no-plot": ()},
    "compile": {"--horizon": ("4",)},
    "eval": {"--episodes": ("2",)},
    "export": {"--to": ("policy.pt2",)},
    "plan": {
        "--steps": ("2",), "--samples": ("2",), "--horizon": ("2",), "--out": ("out",), "--no-video": (),
    },
    "view": {},
    "bench": {},
}  # fmt: skip
"""The commands under test, with flags that make them quick."""

FIRST = {"tasks": "", "new": "my_task", "eval": "good", "export": "good"} | dict.fromkeys(
    ("train --resume good", "train --from good"), ""
)

_OMIT = ("--help", "--video", "--video-every", "--frame-skip", "--seeds", "--wandb")
"""Flags that no case uses, because they print help, start other processes, or make native calls run for hours."""


@functools.cache
def flags(command: str) -> tuple[str, ...]:
    """Return the flags that a command's help text lists."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        cli.main([command.split()[0], "--help-all"])
    found = re.findall(r"^\W*(--[\w.-]+(?:, --[\w.-]+)*)", out.getvalue(), re.MULTILINE)
    return tuple(name for names in found for name in names.split(", ") if name not in _OMIT)


MODELS = ("~x.xml", "\udcff.xml", "a\nb.xml", "[red].xml", "'\".xml")
"""Unusual names of model files in the working directory."""

_WORDS = (
    "1", "2", "3", "0.5", "cpu", "cuda:99", "warp", "mujoco", "auto", "True", "None", "last", "best", "good", "here",
    ".", "point_mass", "hopper.py", "x.onnx", "x.pt2", "free", "azimuth=9", "-", "--", "success_distance=1",
    "success_distance=nan", "x=1", "=", "a=b=c", "iterations=2", "nworld=3", *MODELS,
)  # fmt: skip


def _line(command: str, first: str, flags: dict[str, tuple[str, ...]]) -> list[str]:
    name, *rest = command.split()
    return [name, *([first] if first else []), *rest, *(word for flag in flags for word in (flag, *flags[flag]))]


def words(command: str, random: Random) -> list[str]:
    choices = (*map(str, NUMBERS), *(text for text in TEXTS if "\0" not in text), *_WORDS)
    first, options = FIRST.get(command, "point_mass"), dict(SMALL[command])
    known = flags(command)
    for _ in range(random.choice((1, 1, 2, 3)) if known else 0):
        flag = random.choice(known)
        options.pop(flag.replace("--no-", "--"), None)
        options.pop(flag.replace("--", "--no-", 1), None)
        short = flag.startswith("--no-") or f"--no-{flag[2:]}" in known
        options[flag] = () if short else (random.choice(choices),)
    extra = [random.choice(choices)] if random.random() < 0.1 else []
    return [*_line(command, first if random.random() < 0.9 else random.choice(choices), options), *extra]


def attack(case: str) -> None:
    run(COMMANDS[case].split() if case in COMMANDS else words(case.rpartition(" ")[0], Random(case)))


def run(line: list[str]) -> None:
    os.chdir(HERE.parent)
    shutil.rmtree(HERE, ignore_errors=True)
    HERE.mkdir()
    shutil.copytree(RUN, HERE / "good")
    for name in MODELS:
        (HERE / name).write_text(SLIDE)
    os.chdir(HERE)
    before = content(Path())
    out, err = io.StringIO(), io.StringIO()
    parsed = True
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            code = cli.main(line)
        except SystemExit as end:
            code, parsed = end.code, False
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise ProblemError(_spelled(line), error) from error
    if code not in (0, 1, 2, 130, 143):  # the last two are interruptions
        raise ProblemError(f"{_spelled(line)} ended with {code}")
    if code == 2:
        lines = err.getvalue().splitlines()
        errors = [text for text in lines if text.startswith("lyceum-warp: ")]
        if parsed and (not errors or lines[-1] != errors[-1]):
            raise ProblemError(f"{_spelled(line)}: stderr does not end with a one-line error: {lines[-3:]}")
        if (after := content(Path())) != before:
            changed = [name for name in after | before if before.get(name) != after.get(name)]
            raise ProblemError(f"{_spelled(line)}: ended with 2, but changed {', '.join(changed)}: {lines[-1:]}")


def _spelled(line: list[str]) -> str:
    return ascii(shlex.join(["lyceum-warp", *(word[:80] for word in line)]))[1:-1]


def warm_up() -> None:
    lyceum_warp.cli.view.view = lambda *args, **options: None  # no window
    os.execve = lambda *args: None  # no program of bench/
    torch.set_num_threads(1)
    HERE.mkdir(parents=True, exist_ok=True)
    if not RUN.exists():
        os.chdir(HERE)
        assert cli.main(_line("train", "point_mass", SMALL["train"])) == 0
        (HERE / "out").rename(RUN)
    for command in SMALL:
        if command != "bench":
            run(_line(command, FIRST.get(command, "point_mass"), SMALL[command]))


if __name__ == "__main__":
    guarded.serve(attack, warm_up)
