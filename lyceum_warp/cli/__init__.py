"""Run the commands of lyceum-warp, and print their errors."""

import importlib
import importlib.metadata
import io
import logging
import os
import sys
import textwrap
from collections.abc import Sequence

from lyceum_warp.cli.parsing import parse
from lyceum_warp.support.interrupts import Interrupted, signals
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.viz import NoVideoError

_COMMANDS = {
    "tasks": ("list_tasks", "List the tasks of the package, their sizes and the sources of their models."),
    "new": ("new_task", "Write a task file for a model."),
    "check": ("check", "Check that a task follows the package's rules."),
    "train": ("train", "Train a policy on a task, with NPG, PPO or SAC."),
    "compile": ("compile", "Compile the kernels of a task ahead of time, also for the GPU of another machine."),
    "sweep": ("sweep", "Search settings of training with Optuna."),
    "eval": ("evaluate", "Evaluate a run's policy, and print statistics of its episodes."),
    "plot": ("plot", "Plot runs, and compare their returns, settings and versions."),
    "report": ("report", "Write a page on a run: settings, curves, verdicts and an episode."),
    "gate": ("gate", "Test whether a run's policy passes the gate of its task, such as whether a robot walks."),
    "export": ("export", "Write a run's policy to an ONNX or .pt2 file."),
    "fit": ("fit", "Fit a model to a robot's log, and say what the log determines."),
    "plan": ("plan", "Control a task with a planner, and report rewards, success and planning times."),
    "tune": ("tune", "Find the fastest physics options that do not change a task's returns."),
    "view": ("view", "Show a task, a policy, a planner or saved episodes in a browser."),
    "bench": ("bench", "Run an experiment or another program of bench/."),
}
"""The module and the help line of each command. Each module has a class with the command's capitalised name.

Only the module of the given command is imported, because most modules import torch, Warp and MuJoCo.
"""

_HELP = """usage: lyceum-warp COMMAND [OPTIONS] ...

Batched MuJoCo worlds for robot learning.

lyceum-warp COMMAND --help describes a command and its usual options, with
examples. --help-all describes all options. The commands:
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program ``lyceum-warp``.

    Returns:
        The exit code: 0 on success, 2 for bad input, 130 after Ctrl-C, and 143 after SIGTERM. The code 1 means that
        ``check`` found a broken rule, or that the return did not exceed --require-return.
    """
    # on busy cores, OpenMP threads that spin at barriers slow updates by an order of magnitude; OpenMP reads the
    # variable when torch is imported
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"lyceum-warp {importlib.metadata.version('lyceum-warp')}")
        return 0
    if isinstance(sys.stdout, io.TextIOWrapper):  # print paths and symbols that the terminal cannot encode, too
        sys.stdout.reconfigure(errors="backslashreplace")
    log, messages = logging.getLogger("lyceum_warp"), logging.StreamHandler()
    messages.setLevel(logging.WARNING)
    messages.setFormatter(logging.Formatter("lyceum-warp: %(message)s"))
    log.addHandler(messages)
    try:
        with signals():
            return _run(argv)
    except Interrupted as signalled:
        return 128 + signalled.number
    except KeyboardInterrupt:  # raised by a task's code, because signals raise Interrupted
        print("lyceum-warp: interrupted by KeyboardInterrupt", file=sys.stderr)
        return 130
    except BrokenPipeError:  # a pipe may be closed early, as in lyceum-warp tasks | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, FloatingPointError, ImportError, NoVideoError) as error:
        text = str(error)
        if isinstance(error, OSError) and error.filename:  # the disk may be full, or a folder may be read-only
            text = f"{error.filename}: {error.strerror}"
        text = "; ".join([text, *getattr(error, "__notes__", [])])
        print(f"lyceum-warp: {' '.join(text.split())}", file=sys.stderr)
        return 2
    finally:
        log.removeHandler(messages)


def _run(argv: list[str]) -> int:
    if argv[:1] in ([], ["-h"], ["--help"]):
        print(_HELP)
        for name, (_, line) in _COMMANDS.items():
            print(textwrap.fill(f"  {name:8} {line}", 80, subsequent_indent=" " * 11))
        return 0
    name, *arguments = argv
    if name not in _COMMANDS:
        hint = did_you_mean(name, _COMMANDS, f"there are {', '.join(_COMMANDS)}")
        raise ValueError(f"there is no command {name!r}: {hint}")
    command = getattr(importlib.import_module(f"lyceum_warp.cli.{_COMMANDS[name][0]}"), name.capitalize())
    # arguments after the name of a bench/ program belong to that program
    count = 1 if name == "bench" else len(arguments)
    return parse(command, f"lyceum-warp {name}", arguments[:count]).run(*arguments[count:]) or 0
