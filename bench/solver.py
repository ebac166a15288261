"""Measure the speed and accuracy of physics options, on states that the model's own options produce.

    lyceum-warp bench solver --tasks hopper half_cheetah humanoid --nworld 4096 --engine warp --device cuda

Every setting takes the same steps: one step with the saved action from each saved state, including states at the start
of episodes. The error of a step is a world's largest difference of velocities, relative to the larger of 1 and the
largest velocity. Its scale is the difference between two passes with the model's own options ("own, again"), because a
GPU adds in any order. Settings take turns, under the same load.
"""

import dataclasses
import statistics
from pathlib import Path
from typing import Any

import measurements
import torch
import tyro
from kept import seconds
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.done import FAULTS


def limits(iterations: int, ls_iterations: int | None = None) -> dict[str, Any]:
    return {"solver": {"iterations": iterations} | ({"ls_iterations": ls_iterations} if ls_iterations else {})}


SETTINGS: dict[str, dict[str, Any]] = {
    "own": {},
    "own, again": {},
    "5 iterations": limits(5),
    "4 iterations": limits(4),
    "4, line search 6": limits(4, 6),
    "3 iterations": limits(3),
    "Euler": {"integrator": "euler"},
    "Euler, 4 iterations": {"integrator": "euler"} | limits(4),
    "implicitfast": {"integrator": "implicitfast"},
    "deterministic": {"deterministic": True},
}
"""Options of ``lw.make``."""

ON_A_GPU = ("deterministic",)
"""Options with an effect on a GPU only."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Speed and accuracy of physics options, as a table and as JSON."""

    tasks: tuple[str, ...] = ("hopper", "half_cheetah", "humanoid")
    """Tasks."""
    nworld: tuple[int, ...] = (256,)
    """Numbers of worlds."""
    engine: str = "auto"
    """Engine."""
    device: str = "cpu"
    """Device."""
    settings: tuple[str, ...] = tuple(SETTINGS)
    """Settings to compare with the model's own options."""
    states: int = 20
    """Number of steps of each setting; the saved states are five environment steps apart."""
    out: Path | None = None
    """JSON file for the results."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Results of one setting; errors are quantiles over worlds and steps."""

    task: str
    nworld: int
    setting: str
    step_ms: float
    gain: float
    """Time with the model's own options divided by the time with these, median over the steps."""
    error_median: float
    error_99: float
    error_max: float
    faults: int
    """Number of worlds whose step ended in a fault; the errors exclude them."""
    bytes_per_world: float


def saved_steps(task: str, nworld: int, options: Options) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return states and their actions, from steps with uniformly random actions."""
    env = lw.make(task, nworld=nworld, engine=options.engine, device=options.device)
    generator = torch.Generator(env.obs.device).manual_seed(0)
    low, high = (torch.as_tensor(x, device=env.obs.device) for x in (env.action_space.low, env.action_space.high))
    found = []
    for step in range(5 * (options.states + 4)):
        draws = torch.rand(env.action.shape, generator=generator, device=env.obs.device)
        env.action.copy_(draws * (high - low) + low)
        if step >= 20 and step % 5 == 0:
            found.append((env.get_state(), env.action.clone()))
        env.step()
    return found


def measure(task: str, nworld: int, options: Options) -> list[Row]:
    steps = saved_steps(task, nworld, options)
    envs: dict[str, lw.Env] = {}
    for name in dict.fromkeys(("own", *options.settings)):
        setting = SETTINGS[name]
        if options.device == "cpu" and any(option in setting for option in ON_A_GPU):
            continue
        env = lw.make(task, nworld=nworld, engine=options.engine, device=options.device, autoreset=False, **setting)
        if "integrator" in setting and env.model.opt.integrator == envs["own"].model.opt.integrator:
            continue
        envs[name] = env
    velocity = envs["own"].state_space.parts["qvel"]
    times: dict[str, list[float]] = {name: [] for name in envs}
    errors: dict[str, list[torch.Tensor]] = {name: [] for name in envs}
    for state, action in [*steps[:3], *steps]:  # three steps to warm up, captures included
        wanted = None
        for name, env in envs.items():
            env.set_state(state)
            env.action.copy_(action)
            times[name].append(seconds(env, env.step))
            found = env.get_state()[:, velocity].double()
            wanted = found if wanted is None else wanted
            error = (found - wanted).abs().amax(1) / wanted.abs().amax(1).clamp(min=1.0)
            errors[name].append(error.masked_fill(env.done_reason & int(FAULTS) != 0, torch.nan))
    rows = []
    for name in envs:
        mine = times[name][3:]
        gain = statistics.median(a / b for a, b in zip(times["own"][3:], mine, strict=True))
        error = torch.cat(errors[name][3:])
        finite = error.isfinite()
        ordered = error[finite].sort().values
        at = [ordered[int(q * (len(ordered) - 1))].item() for q in (0.5, 0.99, 1.0)]
        rows.append(Row(
            task, nworld, name, 1e3 * statistics.median(mine), gain, *at, int((~finite).sum()),
            envs[name].bytes_per_world,
        ))  # fmt: skip
    return rows


def main(options: Options) -> None:
    if unknown := set(options.settings) - SETTINGS.keys():
        raise SystemExit(f"there is no setting {', '.join(sorted(unknown))}: choose among {', '.join(SETTINGS)}")
    torch.set_num_threads(1)
    table = Table("task", "worlds", "setting", "step, ms", "gain", "error: median", "99 %", "max", "faults", "kB/world")
    for column in table.columns[3:]:
        column.justify = "right"
    rows: list[Row] = []
    for task in options.tasks:
        for nworld in options.nworld:
            for row in measure(task, nworld, options):
                rows.append(row)
                table.add_row(row.task, str(row.nworld), row.setting, f"{row.step_ms:.3f}", f"{row.gain:.2f}",
                              f"{row.error_median:.0e}", f"{row.error_99:.0e}", f"{row.error_max:.0e}",
                              str(row.faults), f"{row.bytes_per_world / 1e3:,.1f}")  # fmt: skip
    Console(width=120).print(table)
    if options.out is not None:
        measurements.write(options.out, rows, options.device, states=options.states)


if __name__ == "__main__":
    main(tyro.cli(Options))
