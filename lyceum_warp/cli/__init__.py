"""The command line: tasks, new, check, train, eval, export, plan, view, warmup, bench."""

import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from lyceum_warp.cli.bench import Bench
from lyceum_warp.cli.check import Check
from lyceum_warp.cli.evaluate import Eval
from lyceum_warp.cli.export import Export
from lyceum_warp.cli.list_tasks import Tasks
from lyceum_warp.cli.new_task import New
from lyceum_warp.cli.plan import Plan
from lyceum_warp.cli.train import Train
from lyceum_warp.cli.view import View
from lyceum_warp.cli.warmup import Warmup
from lyceum_warp.support.interrupts import Interrupted, signals
from lyceum_warp.viz.video import NoVideoError

_Command = Annotated[Tasks, tyro.conf.subcommand("tasks")] \
    | Annotated[New, tyro.conf.subcommand("new")] \
    | Annotated[Check, tyro.conf.subcommand("check")] \
    | Annotated[Train, tyro.conf.subcommand("train")] \
    | Annotated[Eval, tyro.conf.subcommand("eval")] \
    | Annotated[Export, tyro.conf.subcommand("export")] \
    | Annotated[Plan, tyro.conf.subcommand("plan")] \
    | Annotated[View, tyro.conf.subcommand("view")] \
    | Annotated[Warmup, tyro.conf.subcommand("warmup")] \
    | Annotated[Bench, tyro.conf.subcommand("bench")]  # fmt: skip

_DESCRIPTION = """Batched MuJoCo worlds for robot learning.

$ lyceum-warp tasks
$ lyceum-warp new my_task --model robot.xml
$ lyceum-warp check my_task.py
$ lyceum-warp train hopper --iterations 100
$ lyceum-warp eval runs/hopper-20260101-120000 --episodes 100 --video
$ lyceum-warp export runs/hopper-20260101-120000 --to policy.onnx
$ lyceum-warp plan reach --real-time
$ lyceum-warp view reach --mppi
$ lyceum-warp warmup hopper --device cuda:0
$ lyceum-warp bench throughput --short
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The program ``lyceum-warp``.

    Returns:
        0; 1 if --require-return was not met, or if check found a broken rule; 2 for bad input; 130 or 143 after
        Ctrl-C or SIGTERM.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"lyceum-warp {importlib.metadata.version('lyceum-warp')}")
        return 0
    # what follows the name of a program of bench/ is parsed by that program
    argv, rest = (argv[:2], argv[2:]) if argv[:1] == ["bench"] else (argv, [])
    try:
        with signals():
            command = tyro.cli(
                _Command, prog="lyceum-warp", description=_DESCRIPTION, args=argv,
                config=(tyro.conf.OmitSubcommandPrefixes,),
            )  # fmt: skip
            return int(command.run(*rest))
    except (ValueError, FileNotFoundError, FloatingPointError, ImportError, NoVideoError) as error:
        text = "; ".join([str(error), *getattr(error, "__notes__", [])])
        print(f"lyceum-warp: {' '.join(text.split())}", file=sys.stderr)
        return 2
    except Interrupted as signalled:
        return 128 + signalled.number
    except BrokenPipeError:  # as in: lyceum-warp tasks | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # as a full disk, or a folder that cannot be written
        text = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        print(f"lyceum-warp: {'; '.join([text, *getattr(error, '__notes__', [])])}", file=sys.stderr)
        return 2
