"""Run a task on an engine, and check that the task follows the package's rules.

The AssertionError of a check names the task, the engine, the rule, the values, the seed and a world's state.
"""

import dataclasses
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from lyceum_warp.core import Task
from lyceum_warp.engines import EngineFactory
from lyceum_warp.env import Env, make
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.validate import whole_number
from lyceum_warp.testing import (
    fault_rules as faults,
    form_rules as form,
    index_rules as indices,
    physics_rules as physics,
    state_rules as state,
)
from lyceum_warp.testing.context import OUTCOMES, Context

log = logging.getLogger(__name__)

CHECKS: tuple[Callable[[Context], None], ...] = tuple(
    value
    for module in (state, indices, faults, form, physics)
    for name, value in vars(module).items()
    if name.startswith("check_")
)
"""All checks in order: the functions ``check_*`` of the rule modules."""


@document_attributes
@dataclasses.dataclass
class Report:
    """The result of ``check_task`` for a task that follows every rule."""

    task: str
    engine: str
    device: str
    nworld: int
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """Duration of each check in seconds, by the rule's name."""

    def __str__(self) -> str:
        head = f"{self.task} on the {self.engine} engine ({self.device}, {self.nworld} worlds) keeps the rules:"
        rules = (f"  {name:<20} {value:6.2f} s" for name, value in self.seconds.items())
        return "\n".join([head, *rules])


def check_task(
    task: str | type[Task],
    *,
    engine: str | EngineFactory = "auto",
    device: str | None = None,
    nworld: int = 4,
    steps: int = 1000,
    seed: int = 0,
    checks: Sequence[Callable[[Context], None]] = CHECKS,
    **options: Any,
) -> Report:
    """Run a task on an engine, and check that the task follows every rule in ``checks``.

    Args:
        task: A task's name, file or class.
        engine: The engine's name, as in ``make``, or an engine class (see ``engines.base``).
        device: See ``make``.
        nworld: Number of worlds, at least 2.
        steps: Number of steps in long checks.
        seed: Seed of the worlds and of the random actions.
        checks: The rules to check, a selection of ``CHECKS``.
        options: More options of ``make`` and parameters of the task. On a CUDA device, ``deterministic`` is True by
            default, because numbers are compared bit for bit.

    Returns:
        A report that can be printed.

    Raises:
        AssertionError: The task breaks at least one rule. The message lists all broken rules.

    Example:
        >>> print(check_task("hopper", engine="mujoco"))
    """
    if nworld < 2:
        raise ValueError(f"the checks compare worlds with one another: nworld must be at least 2, not {nworld}")
    steps = whole_number("steps", steps, low=1)
    if str(device or "").startswith("cuda"):
        options = {"deterministic": True} | options

    options = {"nworld": nworld, "device": device, "engine": engine, "seed": seed} | options

    def another(**changes: Any) -> Env:
        return make(task, **options | changes)

    a = another()
    ctx = Context(a, another(), another, steps, seed)
    report = Report(a.task.name, a.engine.name, a.device.alias, nworld)
    broken = []
    for check in checks:
        ctx.rule = check.__name__.removeprefix("check_")
        start = time.perf_counter()
        ctx.restart()
        try:
            check(ctx)
        except AssertionError as error:
            broken.append(str(error))
        report.seconds[ctx.rule] = time.perf_counter() - start
    if broken:
        raise AssertionError("\n".join(broken))
    log.info("%s", report)
    return report


__all__ = ["CHECKS", "OUTCOMES", "Context", "Report", "check_task"]
