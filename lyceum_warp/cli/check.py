"""Check that a task follows the package's rules: lyceum-warp check."""

import dataclasses
from typing import Annotated, Any

import tyro

from lyceum_warp.cli.arguments import ParamWords, Physics, Placement, TaskWord, given, parameters
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.testing import CHECKS, check_task


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """Check that a task follows the package's rules, and print each rule and the time of its check.

    All tasks of the package follow the rules. For example, steps from a saved state give the same numbers, and a fault
    does not affect other worlds. Functions write only their outputs, and read within bounds. Check a new task on both
    engines. The exit code is 1 if a rule is broken. In Python, use lyceum_warp.testing.check_task.

    $ lyceum-warp check path/to/my_task.py
    $ lyceum-warp check path/to/my_task.py --engine warp --steps 50
    """

    USUAL = ("nworld", "steps", "seed", "rule", "param", "engine", "device", "physics")

    task: TaskWord
    nworld: int = 4
    """Number of worlds, at least 2."""
    steps: int = 200
    """Number of steps in long checks."""
    seed: int = 0
    """Seed of the worlds and of the random actions."""
    rule: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """The name of a rule to check, as the report prints it. The flag may be repeated. By default, all rules are
    checked."""
    param: ParamWords = ()
    env: Annotated[Placement, tyro.conf.arg(name="world")] = Placement()
    physics_options: Annotated[Physics, tyro.conf.arg(name="physics")] = Physics()

    def run(self) -> int:
        rules = {check.__name__.removeprefix("check_"): check for check in CHECKS}
        for rule in self.rule:
            if rule not in rules:
                hint = did_you_mean(rule, rules, f"there are {', '.join(rules)}")
                raise ValueError(f"there is no rule {rule!r}: {hint}")
        checks = [rules[rule] for rule in self.rule] or CHECKS
        kwargs: dict[str, Any] = {"nworld": self.nworld, "steps": self.steps, "seed": self.seed}
        kwargs |= given(self.env) | given(self.physics_options) | parameters(self.param)
        try:
            say(str(check_task(self.task, checks=checks, **kwargs)))
        except AssertionError as error:
            say(str(error))
            return 1
        warp = f"lyceum-warp check {self.task} --engine warp, then " if not given(self.env) else ""
        say_entries(next=f"{warp}lyceum-warp train {self.task}")
        return 0
