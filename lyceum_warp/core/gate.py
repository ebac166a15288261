"""Define gates: tests with limits that a task's policy must keep."""

import abc
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class Limit:
    """The range of a measured number in which a policy passes."""

    text: str
    """What is measured, with its unit."""
    low: float = -math.inf
    """The smallest number that passes."""
    high: float = math.inf
    """The largest number that passes."""

    def allows(self, number: float) -> bool:
        """Check that a number is in the range; NaN is not."""
        return self.low <= number <= self.high

    @property
    def range(self) -> str:
        """Format the range, for example "at most 0.2"; empty if every number passes."""
        ends = {f"at least {self.low:g}": self.low, f"at most {self.high:g}": self.high}
        return " and ".join(text for text, end in ends.items() if math.isfinite(end))


class Gate(abc.ABC):
    """A test of a task's policy, for the attribute ``gate`` of ``lw.Task``; ``lw.gate`` runs it.

    Example:
        >>> class Reaches(lw.Gate):
        ...     limits = {"distance": lw.Limit("distance to the goal at the end, m", high=0.02)}
        ...
        ...     def measure(self, worlds, act):
        ...         env = worlds(100)
        ...         for _ in range(200):
        ...             env.step(act(env.obs))
        ...         yield {"distance": env.eval.mean().item()}
    """

    limits: Mapping[str, Limit]
    """The limit of each number, by the number's name. Numbers without a limit are only reported."""

    @abc.abstractmethod
    def measure(self, worlds: Callable[..., Any], act: Callable[[Any], Any]) -> Iterator[dict[str, float]]:
        """Measure a policy, and yield numbers by name, in one or several parts.

        A training run skips the parts after one that fails.

        Args:
            worlds: ``worlds(nworld, **params)`` makes an environment on the C engine under exact physics. Its episodes
                have begun at the curriculum of the policy, and have no time limit.
            act: Maps observations, (nworld, nobs), to actions without noise, (nworld, nact). It acts in the environment
                that ``worlds`` made last.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of ``lw.gate``."""

    task: str
    """Name of the task."""
    seed: int
    """Seed of the worlds."""
    memory: str
    """The curriculum at which all episodes began, as in "level 4.2 (0 to 9)"; empty if the task has none."""
    numbers: Mapping[str, float]
    """The measured numbers by name."""
    limits: Mapping[str, Limit]
    """The limits by the names of their numbers."""

    @property
    def passed(self) -> bool:
        """Whether every number with a limit was measured and keeps the limit."""
        limits = {name: limit for name, limit in self.limits.items() if limit.range}
        return all(limit.allows(self.numbers.get(name, math.nan)) for name, limit in limits.items())

    @property
    def line(self) -> str:
        """Format the numbers with limits in one line."""
        texts = [
            f"{limit.text} {self.numbers[name]:.3g}{'' if limit.allows(self.numbers[name]) else f' ({limit.range})'}"
            for name, limit in self.limits.items()
            if name in self.numbers
        ]
        return f"{'passes' if self.passed else 'does not pass'}: {'; '.join(texts)}"

    def to_dict(self) -> dict[str, Any]:
        """Convert the result to values that JSON supports."""
        limits = {name: {"low": limit.low, "high": limit.high} for name, limit in self.limits.items()}
        finite = {name: {end: x for end, x in ends.items() if math.isfinite(x)} for name, ends in limits.items()}
        entries = {"task": self.task, "seed": self.seed, "memory": self.memory, "passed": self.passed}
        return {**entries, "numbers": dict(self.numbers), "limits": finite}
