"""Compare a policy's results between engines and physics options, on pairs of episodes with equal initial states."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.common.evaluation import Episodes, evaluate, evaluation_worlds
from lyceum_warp.core import PhysicsOptions, Task
from lyceum_warp.engines.placement import options_on_cores
from lyceum_warp.env import Curriculum, Env, Policy
from lyceum_warp.support.intervals import clear_losses, mean_interval, share_interval
from lyceum_warp.support.validate import check_kind, finite_number, whole_number

EXACT = "exact"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """A quantity's means in two simulations, and the difference of the means with a 95 % confidence interval."""

    quantity: str
    """The quantity: "return", "length" (in steps), "terminated" (the fraction of episodes that ended by termination,
    such as a fall) or "clearly worse" (the fraction of pairs in which this simulation's return is clearly lower)."""
    first: float
    """The quantity's mean in the first simulation."""
    second: float
    """The quantity's mean in the second simulation."""
    low: float
    """Lower end of the confidence interval of ``second - first``."""
    high: float
    """Upper end of the confidence interval of ``second - first``."""
    margin: float
    """The largest difference at which the two means count as equal."""

    @property
    def verdict(self) -> str:
        """Compare the confidence interval with the range from -margin to margin.

        "same" means that the interval lies inside this range. "different" means that the interval lies outside. "not
        shown" means that the interval contains -margin or margin.
        """
        if -self.margin <= self.low and self.high <= self.margin:
            return "same"
        return "different" if self.low > self.margin or self.high < -self.margin else "not shown"

    @property
    def text(self) -> str:
        """Format the interval, for example "return +1.2 ± 0.5"."""
        return f"{self.quantity} {0.5 * (self.low + self.high):+.3g} ± {0.5 * (self.high - self.low):.2g}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Comparison:
    """Differences between two simulations of the same episodes.

    A simulation is named after its engine or its physics options. Comparisons of physics options use the C engine.
    """

    first: str
    """Name of the first simulation, "C engine" or "exact physics"."""
    second: str
    """Name of the second simulation, such as "Warp engine on cuda:0" or "coarse physics"."""
    faults: tuple[int, int]
    """Number of faults in each simulation."""
    differences: tuple[PairedDifference, ...]
    """Differences of returns, of lengths and of the fraction of failures. A failure is a terminated episode. If the
    task never terminates episodes, it is an episode that is clearly worse than the other one of its pair."""

    @property
    def verdict(self) -> str:
        """Combine the verdicts of all quantities.

        The result is "different" if any verdict is "different". It is "same" if all verdicts are "same". In all other
        cases, it is "not shown".
        """
        verdicts = {difference.verdict for difference in self.differences}
        return "different" if "different" in verdicts else "same" if verdicts == {"same"} else "not shown"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Transfer:
    """The result of ``transfer``: whether a policy's results depend on the engine or on physics options."""

    task: str
    """Name of the task."""
    episodes: int
    """Number of pairs of episodes."""
    seed: int
    """Seed of the initial states."""
    memory: str
    """The curriculum at which all episodes began, as in "level 4.2 (0 to 9)"; empty if the task has none."""
    comparisons: tuple[Comparison, ...]
    """One comparison for each engine and each set of physics options."""
    fitted: str = ""
    """The folder of the fit whose values the worlds had; empty if they had none."""

    @property
    def line(self) -> str:
        """Format all verdicts in one line."""
        texts = []
        for comparison in self.comparisons:
            differences = ", ".join(difference.text for difference in comparison.differences)
            texts.append(f"{comparison.second} against {comparison.first}: {comparison.verdict} ({differences})")
        return (
            "; ".join(texts)
            + (f"; begun at {self.memory}" if self.memory else "")
            + (f"; fitted by {self.fitted}" if self.fitted else "")
        )

    def to_dict(self) -> dict[str, Any]:
        """Convert the result to values that JSON supports."""
        content = dataclasses.asdict(self) | {"line": self.line}
        for comparison, entry in zip(self.comparisons, content["comparisons"], strict=True):
            entry["verdict"] = comparison.verdict
            for difference, numbers in zip(comparison.differences, entry["differences"], strict=True):
                numbers["verdict"] = difference.verdict
        return content


@torch.no_grad()
def transfer(
    env: Env,
    policy: Policy,
    episodes: int = 64,
    *,
    seed: int = 0,
    curriculum: Curriculum | None = None,
    margin: float = 0.05,
    device: str | None = None,
    warp: bool = True,
    physics: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> Transfer:
    """Compare a policy's results between the engines, and between physics options, on pairs of episodes.

    The Warp engine is compared with the C engine, both with the environment's physics options. On the C engine, the
    task's exact physics is compared with its other sets of physics options, and with the environment's set. Both
    episodes of a pair have the same initial state, the same randomized model fields, and the same pushes and commands.
    Student's t distribution gives the 95 % confidence intervals of the mean differences in return and length. Rare
    failures hardly change these intervals, so the fractions of failures are compared as well (``share_interval`` and
    ``clear_losses`` in ``support/intervals.py``). If the second simulation's mean return is lower by the margin because
    of failures that each cost a whole return, the verdict is "same" in 0, 4 and 3 % of comparisons with 32, 64 and 256
    pairs. Failures that cost several returns, and are too rare for the margin of the fraction, stay unnoticed.

    Args:
        env: An environment of the task; its worlds do not change.
        policy: A function that maps observations to actions without noise, or a module whose method ``act`` does this.
        episodes: Number of pairs of episodes.
        seed: Seed of the initial states.
        curriculum: How far curricula have come, such as ``lw.load_curriculum(run)``; by default as far as in ``env``.
        margin: Largest difference at which two means count as equal. For returns and lengths, the margin is a fraction
            of the mean absolute return or mean length in the first simulation. For failures, it is an absolute
            difference of fractions. A return is clearly lower if the difference exceeds the margin by more than
            three interquartile ranges of all differences.
        device: Device of the Warp engine. The default is a GPU, preferably the environment's. Without a GPU, it is the
            CPU, where Warp's kernels may take minutes to compile.
        warp: Whether to play episodes on the Warp engine.
        physics: Whether to play episodes with each of the task's sets of physics options. If False, use only two sets:
            the exact physics, and the environment's physics options.
        progress: Called every 50 steps with the number of steps so far and the maximum number.

    Raises:
        ValueError: An argument is out of range, or the policy does not fit the task.
    """
    check_kind("env of transfer", env, Env, "as lw.make(...) makes it")
    episodes, margin = whole_number("episodes", episodes, low=2), finite_number("margin", margin, low=0.0)
    curriculum = curriculum or Curriculum.of(env)
    named, current = task_physics(env)
    if not physics:
        named = {name: named[name] for name in dict.fromkeys((EXACT, current))}
    device = device or (env.device.alias if env.device.is_cuda else "cuda" if wp.is_cuda_available() else "cpu")
    simulations = {f"{name} physics": options_on_cores() | {"physics": options} for name, options in named.items()}
    warp_name = f"Warp engine on {device}"
    if warp:
        simulations[warp_name] = {"engine": "warp", "device": device, "nthread": None, "physics": env.options.physics}
    results: dict[str, tuple[Episodes, int]] = {}
    for number, (name, changes) in enumerate(simulations.items()):
        worlds = evaluation_worlds(env, episodes, **changes)
        report = functools.partial(_report, progress, number, len(simulations))
        result = evaluate(worlds, policy, episodes, seed=seed, curriculum=curriculum, progress=report)
        results[name] = result, sum(worlds.fault_counts.values())
        memory = result.curriculum.text
    exact = f"{EXACT} physics"
    compare = functools.partial(_compared, margin=margin, terminates=env.task.ends_by("terminated"))
    comparisons = []
    if warp:
        comparisons.append(compare("C engine", warp_name, results[f"{current} physics"], results[warp_name]))
    for name in simulations:
        if name not in (exact, warp_name):
            comparisons.append(compare(exact, name, results[exact], results[name]))
    return Transfer(
        task=env.task.name, episodes=episodes, seed=seed, memory=memory, comparisons=tuple(comparisons),
        fitted=env.options.fitted or "",
    )  # fmt: skip


def _report(progress: Callable[[int, int], object] | None, number: int, count: int, step: int, steps: int) -> None:
    if progress is not None:
        progress(number * steps + step, count * steps)


def task_physics(env: Env) -> tuple[dict[str, PhysicsOptions], str]:
    """Get the physics options of the task and the environment, and the name of the environment's options.

    Options that only the Warp engine has are ignored.
    """
    return _named_physics(env.task.definition, env.options.physics)


def _named_physics(task: type[Task], physics: PhysicsOptions) -> tuple[dict[str, PhysicsOptions], str]:
    named = {EXACT: PhysicsOptions(), **task.physics}
    current = dataclasses.replace(physics, nconmax=None, njmax=None, deterministic=None)
    name = next((name for name, options in named.items() if options == current), "own")
    return named | {name: current}, name


def simulation(env: Env) -> str:
    """Name an environment's engine and physics, such as "C engine, exact physics"."""
    engine = (
        "C engine" if env.engine.name == "mujoco" else f"{env.engine.name.capitalize()} engine on {env.device.alias}"
    )
    return f"{engine}, {physics_text(env.task.definition, env.options.physics)}"


def physics_text(task: type[Task], physics: PhysicsOptions) -> str:
    """Name physics options of a task, such as "coarse physics (integrator discrete)"."""
    named, name = _named_physics(task, physics)
    options = ", ".join(f"{option} {value}" for option, value in named[name].given().items())
    return f"{name} physics{f' ({options})' if options else ''}"


def _compared(
    first: str, second: str, one: tuple[Episodes, int], other: tuple[Episodes, int], *, margin: float, terminates: bool
) -> Comparison:
    (a, faults), (b, other_faults) = one, other
    x, y = a.returns.double().numpy(), b.returns.double().numpy()
    returns = _mean_difference("return", x, y, margin)
    lengths = _mean_difference("length", a.lengths.double().numpy(), b.lengths.double().numpy(), margin)
    if terminates:
        name, failures = "terminated", (a.terminated.numpy() > 0, b.terminated.numpy() > 0)
    else:
        name, failures = "clearly worse", clear_losses(x, y, returns.margin)
    shares = _difference(name, *failures, share_interval(*failures), margin)
    return Comparison(first=first, second=second, faults=(faults, other_faults), differences=(returns, lengths, shares))


def _mean_difference(quantity: str, first: np.ndarray, second: np.ndarray, margin: float) -> PairedDifference:
    mean, half = mean_interval(second - first)
    return _difference(quantity, first, second, (mean - half, mean + half), margin * np.abs(first).mean())


def _difference(
    quantity: str, first: np.ndarray, second: np.ndarray, interval: tuple[float, float], margin: float
) -> PairedDifference:
    low, high = interval
    return PairedDifference(
        quantity=quantity, first=float(first.mean()), second=float(second.mean()), low=low, high=high,
        margin=float(margin),
    )  # fmt: skip
