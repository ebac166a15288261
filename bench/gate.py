"""Test whether a robot walks: measure its tracking, falls and gait under fixed commands.

    lyceum-warp bench gate --policy runs/g1
    lyceum-warp bench gate --policy runs/go1-1 runs/go1-2

The mean policy controls the robot on the C engine under the task's exact physics.

A Unitree G1 must pass nanoG1's gate (kingjulio8238/nanoG1, eval.py): six commands of 20 s, each from four initial
states, without noise and pushes. The gate also measures the gait in 2,000 steps at 0.5 m/s. The unit of an action
change is nanoG1's: 0.25 rad of a servo's target.

Any other robot is tested in 100 episodes of 20 s with noise: ten commands from each of ten initial states. All episodes
run once without pushes and once with pushes.
"""

import dataclasses
import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import experiment
import torch
from experiment import Experiment, Row, Table

import lyceum_warp as lw
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.env import start_episodes
from lyceum_warp.tasks.velocity.g1 import LEGS
from lyceum_warp.training import Run

NEVER = 1e6
"""Seconds until the next push or command. No episode lasts this long, so neither happens."""
NOISES = ("linear_velocity_noise", "angular_velocity_noise", "gravity_noise", "joint_position_noise",
          "joint_velocity_noise")  # fmt: skip
STEPS = 1000
BATTERY = ((0.8, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.3, 0.0, 1.0), (0.3, 0.0, -1.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.0))
"""nanoG1's commands: forward and lateral velocity, m/s, and yaw rate, rad/s."""
GAIT = (0.5, 0.0, 0.0)
"""The command for nanoG1's measurement of the gait."""
COMMANDS = (
    (1.0, 0.0, 0.0), (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0),
    (0.5, 0.0, 0.5), (0.5, 0.0, -0.5), (0.5, 0.3, 0.0), (0.0, 0.0, 0.0),
)  # fmt: skip
STARTS, NOISY_STARTS, JOINT_NOISE = 10, 4, 0.05

LIMITS: dict[str, dict[str, tuple[str, float, str]]] = {
    "nanoG1": {
        "falls": ("at most", 1.0, "falls in 24 episodes"),
        "perf": ("at least", 0.90, "perf: mean of exp(-e² / 0.25), e the velocity error"),
        "action_change": ("at most", 0.21, "change of the leg actions in a step, rms"),
        "roll_pitch_rate": ("at most", 0.21, "roll and pitch rate, rms, rad/s"),
        "yaw_rate": ("at most", 0.20, "yaw rate, rms, rad/s"),
        "joint_velocity": ("at most", 1.22, "velocity of the leg joints, rms, rad/s"),
    },
    "walks": {
        "falls": ("at most", 0.0, "falls in 100 episodes of 20 s"),
        "velocity_error": ("at most", 0.2, "mean velocity error, m/s"),
    },
}
"""The limits of each gate, and their descriptions."""

BESIDE = {
    "worst_perf": "perf of the worst command", "yaw_rate_error": "mean yaw rate error, rad/s",
    "pushed_falls": "falls with pushes", "pushed_velocity_error": "velocity error with pushes, m/s",
    "pushed_yaw_rate_error": "yaw rate error with pushes, rad/s",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    policy: tuple[Path, ...] = ()
    """Folders of runs on a velocity task, for example g1_velocity."""
    which: str = "last"
    """Policy of each run: last, best, or the number of a saved iteration."""
    task: str | None = None
    """Velocity task on which to test the policy, instead of the run's task. The parameters of the run are not applied
    to this velocity task."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    gate: str
    run: str
    policy: str
    starts: int
    steps: int


def cases(options: Options) -> list[Case]:
    cases = []
    for folder in options.policy:
        run = Run.open(folder)
        task = options.task or run.task_name
        gate = "nanoG1" if Path(task).name.startswith("g1_") else "walks"
        starts = 1 if options.short else NOISY_STARTS if gate == "nanoG1" else STARTS
        steps = 50 if options.short else STEPS
        cases.append(Case(task, gate, folder.name, digest(folder, options), starts, steps))
    return cases


def digest(folder: Path, options: Options) -> str:
    return hashlib.sha256(Run.open(folder).policy_file(options.which).read_bytes()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True)
class Steps:
    """Results of every step in every world."""

    velocity_error: torch.Tensor
    yaw_rate_error: torch.Tensor
    fell: torch.Tensor
    action: torch.Tensor
    velocity: torch.Tensor
    """``qvel`` after the step, (steps, nworld, nv)."""


def curriculum(folder: Path, options: Options) -> lw.Curriculum:
    return (None if options.task else lw.load_curriculum(folder, which=options.which)) or lw.Curriculum()


@torch.no_grad()
def play(env: lw.Env, policy: Any, commands: Sequence[Sequence[float]], steps: int, start: torch.Tensor) -> Steps:
    """Run a policy from the states ``start``, under a command for each world. A robot that falls starts again."""
    parts = env.state_space.split(start)
    parts["drawn_velocity"][:] = torch.tensor(commands)
    parts["heading_controlled"][:], parts["standing"][:], parts["command_timer"][:] = 0.0, 0.0, NEVER
    env.set_state(start)
    rows = []
    for _ in range(steps):
        env.step(policy.act(env.obs))
        errors = env.metrics["velocity_error"].clone(), env.metrics["yaw_rate_error"].clone()
        velocity = env.state_space.split(env.get_state())["qvel"].clone()
        rows.append((*errors, env.terminated.clone(), env.action.clone(), velocity))
        if env.done.any():  # including faults
            env.set_state(start, mask=env.done.clone())
    return Steps(*map(torch.stack, zip(*rows, strict=True)))


def worlds(folder: Path, nworld: int, options: Options, **params: Any) -> lw.Env:
    place = {"engine": "mujoco", "device": "cpu", "nthread": options.threads, "physics": "exact"}
    env_options = place | {"horizon": 0, "seed": 1000}
    return run_worlds(Run.open(folder), env_options, params, nworld=nworld, task=options.task)


def calm(env: lw.Env) -> dict[str, Any]:
    slide, spin, roll = env.model.geom_friction[env.task.params["foot_geoms"][0]].tolist()
    return dict.fromkeys(NOISES, 0.0) | {
        "encoder_bias": 0.0, "trunk_offset": [0.0, 0.0, 0.0], "push_seconds": [NEVER, NEVER],
        "sliding_friction": [slide, slide], "spinning_friction": [spin, spin], "rolling_friction": [roll, roll],
    }  # fmt: skip


def home(env: lw.Env, memory: lw.Curriculum) -> torch.Tensor:
    start_episodes(env, None, memory)
    env.reset()
    state = env.get_state()
    env.state_space.split(state)["push_timer"][:] = NEVER
    return state


def rms(numbers: torch.Tensor) -> float:
    return float(numbers.double().square().mean().sqrt())


def nano_g1(case: Case, folder: Path, options: Options) -> dict[str, Any]:
    policy = lw.load(folder, which=options.which)
    quiet = calm(worlds(folder, 1, options))
    commands = [command for command in BATTERY for _ in range(case.starts)]
    env = worlds(folder, len(commands), options, **quiet)
    memory = curriculum(folder, options)
    start = home(env, memory)
    noise = 2.0 * torch.rand(env.nworld, env.model.nq - 7, generator=torch.Generator().manual_seed(0)) - 1.0
    env.state_space.split(start)["qpos"][:, 7:] += JOINT_NOISE * noise
    played = play(env, policy, commands, case.steps, start)
    perf = torch.exp(-played.velocity_error.square() / 0.25)
    by_command = perf.mean(0).reshape(len(BATTERY), -1).mean(1)

    env = worlds(folder, 1, options, **quiet)
    walk = play(env, policy, [GAIT], 2 * case.steps, home(env, memory))
    legs, params = len(LEGS), env.task.params
    change = walk.action.diff(dim=0)[:, 0, :legs] * torch.tensor(params["action_scale"][:legs]) / 0.25
    velocity = walk.velocity[:, 0]
    return {
        "falls": int(played.fell.sum()), "perf": float(perf.mean()), "action_change": rms(change),
        "roll_pitch_rate": 2**0.5 * rms(velocity[:, 3:5]), "yaw_rate": rms(velocity[:, 5]),
        "joint_velocity": rms(velocity[:, params["joint_dof"][:legs].tolist()]),
        "worst_perf": float(by_command.min()), "yaw_rate_error": float(played.yaw_rate_error.mean()),
        "perf_by_command": by_command.tolist(), "memory": memory.text,
    }  # fmt: skip


def walks(case: Case, folder: Path, options: Options) -> dict[str, Any]:
    """Run 100 episodes of the task with fixed commands, once without and once with pushes."""
    policy = lw.load(folder, which=options.which)
    commands = [command for command in COMMANDS for _ in range(case.starts)]
    memory = curriculum(folder, options)
    result: dict[str, Any] = {"memory": memory.text}
    for prefix, params in (("", {"push_seconds": [NEVER, NEVER]}), ("pushed_", {})):
        env = worlds(folder, len(commands), options, **params)
        start_episodes(env, None, memory)
        played = play(env, policy, commands, case.steps, env.get_state())
        result |= {
            f"{prefix}falls": int(played.fell.any(0).sum()),
            f"{prefix}velocity_error": float(played.velocity_error.mean()),
            f"{prefix}yaw_rate_error": float(played.yaw_rate_error.mean()),
        }
        by_command = played.velocity_error.mean(0).reshape(len(COMMANDS), -1).mean(1)
        result[f"{prefix}velocity_error_by_command"] = by_command.tolist()
    return result


def within(kind: str, value: float, limit: float) -> bool:
    return value <= limit if kind == "at most" else value >= limit


def passes(gate: str, result: dict[str, Any]) -> bool:
    return all(within(kind, result[name], limit) for name, (kind, limit, _) in LIMITS[gate].items())


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    folder = next(folder for folder in options.policy if digest(folder, options) == case.policy)
    result = {"nanoG1": nano_g1, "walks": walks}[case.gate](case, folder, options)
    return {"passed": passes(case.gate, result), **result}


def tables(rows: Sequence[Row]) -> list[Table]:
    tables = []
    for row in rows:
        case, result = row.case, row.result
        lines = []
        for name, (kind, limit, text) in LIMITS[case["gate"]].items():
            verdict = "pass" if within(kind, result[name], limit) else "FAIL"
            lines.append([text, f"{result[name]:.3g}", f"{kind} {limit:g}", verdict])
        lines += [[text, f"{result[name]:.3g}", "", ""] for name, text in BESIDE.items() if name in result]
        verdict = "passes" if result["passed"] else "does not pass"
        memory = f", begun at {result['memory']}" if result.get("memory") else ""
        title = (
            f"{case['task']}: the policy {case['policy'][:8]} of {case['run']} {verdict} on the C engine under exact "
        )
        title += f"physics{memory}."
        tables.append(Table(title, ["", "measured", "limit", ""], lines))
    return tables


EXPERIMENT = Experiment(
    name="gate", conditions="Robots run on the C engine with exact physics.",
    summary="Whether a policy of a velocity task walks: tracking, falls and gait, with limits.",
    cases=cases, estimate=lambda case: 20.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
