"""Test whether a robot walks: tracking, falls and gait under fixed commands."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

import lyceum_warp as lw

NEVER = 1e6
"""Seconds until the next push or command. No episode lasts this long, so neither happens."""
STEPS = 1000
PART = 100
"""Steps between two looks at a test. A policy that stands or has fallen need not be tested further."""
NOISES = ("linear_velocity_noise", "angular_velocity_noise", "gravity_noise", "joint_position_noise",
          "joint_velocity_noise")  # fmt: skip


class Play:
    """Steps worlds under commands that do not change, and collects results. A robot that falls starts again."""

    def __init__(self, env: lw.Env, commands: Sequence[Sequence[float]], start: torch.Tensor) -> None:
        parts = env.state_space.split(start)
        parts["drawn_velocity"][:] = torch.tensor(commands)
        parts["heading_controlled"][:], parts["standing"][:], parts["command_timer"][:] = 0.0, 0.0, NEVER
        env.set_state(start)
        self.env, self.start = env, start
        self.falls = torch.zeros(env.nworld, dtype=torch.int)
        self._rows: list[tuple[torch.Tensor, ...]] = []

    def step(self, act: Callable[[torch.Tensor], torch.Tensor], steps: int) -> None:
        """Make steps of all worlds."""
        env = self.env
        for _ in range(steps):
            env.step(act(env.obs))
            errors = env.metrics["velocity_error"].clone(), env.metrics["yaw_rate_error"].clone()
            self._rows.append((*errors, env.action.clone(), env.field("qvel").clone()))
            self.falls += env.terminated
            if env.done.any():  # including faults
                env.set_state(self.start, mask=env.done.clone())

    def results(self) -> tuple[torch.Tensor, ...]:
        """Get velocity errors, yaw rate errors, actions and ``qvel``, each (steps, nworld, ...)."""
        return tuple(map(torch.stack, zip(*self._rows, strict=True)))


class Walks(lw.Gate):
    """100 episodes of 20 s with noise: ten commands, each from ten initial states, first without and then with pushes.

    Args:
        velocity_error: Largest mean velocity error without pushes, m/s.
    """

    COMMANDS = (
        (1.0, 0.0, 0.0), (0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0),
        (0.5, 0.0, 0.5), (0.5, 0.0, -0.5), (0.5, 0.3, 0.0), (0.0, 0.0, 0.0),
    )  # fmt: skip
    """Forward and lateral velocity, m/s, and yaw rate, rad/s."""
    starts = 10

    def __init__(self, *, velocity_error: float = 0.2) -> None:
        self.limits = {
            "falls": lw.Limit("falls in 100 episodes of 20 s", high=0),
            "start_error": lw.Limit("mean velocity error in the first 2 s, m/s", high=2.0 * velocity_error),
            "velocity_error": lw.Limit("mean velocity error, m/s", high=velocity_error),
            "yaw_rate_error": lw.Limit("mean yaw rate error, rad/s"),
            "pushed_falls": lw.Limit("falls with pushes"),
            "pushed_velocity_error": lw.Limit("velocity error with pushes, m/s"),
            "pushed_yaw_rate_error": lw.Limit("yaw rate error with pushes, rad/s"),
        }

    def measure(
        self, worlds: Callable[..., lw.Env], act: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[dict[str, float]]:
        """Yield falls every 2 s and errors after 2 and 20 s, first without and then with pushes."""
        commands = [command for command in self.COMMANDS for _ in range(self.starts)]
        for prefix, params in (("", {"push_seconds": [NEVER, NEVER]}), ("pushed_", {})):
            env = worlds(len(commands), **params)
            play = Play(env, commands, env.get_state())
            for part in range(STEPS // PART):
                play.step(act, PART)
                start = {"start_error": float(play.results()[0].mean())} if not prefix and part == 0 else {}
                yield {f"{prefix}falls": play.falls.count_nonzero().item()} | start
            velocity_error, yaw_rate_error, *_ = play.results()
            yield {
                f"{prefix}velocity_error": float(velocity_error.mean()),
                f"{prefix}yaw_rate_error": float(yaw_rate_error.mean()),
            }


class NanoG1(lw.Gate):
    """nanoG1's gate (kingjulio8238/nanoG1, eval.py): six commands of 20 s, each from four initial states.

    There are no noise and no pushes. The gate also measures the gait in 2,000 steps at 0.5 m/s. The unit of an action
    change is nanoG1's: 0.25 rad of a servo's target.

    Args:
        legs: Number of leg joints, which are the first of the robot's joints.
    """

    BATTERY = ((0.8, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.3, 0.0, 1.0), (0.3, 0.0, -1.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.0))
    """Forward and lateral velocity, m/s, and yaw rate, rad/s."""
    GAIT = (0.5, 0.0, 0.0)
    starts, joint_noise = 4, 0.05

    limits = {
        "falls": lw.Limit("falls in 24 episodes", high=1),
        "perf": lw.Limit("perf: mean of exp(-e² / 0.25), e the velocity error", low=0.90),
        "action_change": lw.Limit("change of the leg actions in a step, rms", high=0.21),
        "roll_pitch_rate": lw.Limit("roll and pitch rate, rms, rad/s", high=0.21),
        "yaw_rate": lw.Limit("yaw rate, rms, rad/s", high=0.20),
        "joint_velocity": lw.Limit("velocity of the leg joints, rms, rad/s", high=1.22),
        "worst_perf": lw.Limit("perf of the worst command"),
        "yaw_rate_error": lw.Limit("mean yaw rate error, rad/s"),
    }

    def __init__(self, *, legs: int) -> None:
        self.legs = legs

    def measure(
        self, worlds: Callable[..., lw.Env], act: Callable[[torch.Tensor], torch.Tensor]
    ) -> Iterator[dict[str, float]]:
        """Yield falls every 2 s, the results of the six commands, then the gait."""
        quiet = _without_noise(worlds(1))
        commands = [command for command in self.BATTERY for _ in range(self.starts)]
        env = worlds(len(commands), **quiet)
        start = _home(env)
        generator = torch.Generator().manual_seed(env.options.seed)
        noise = 2.0 * torch.rand(env.nworld, env.model.nq - 7, generator=generator) - 1.0
        env.state_space.split(start)["qpos"][:, 7:] += self.joint_noise * noise
        play = Play(env, commands, start)
        for _ in range(STEPS // PART):
            play.step(act, PART)
            yield {"falls": play.falls.sum().item()}
        velocity_error, yaw_rate_error, *_ = play.results()
        perf = torch.exp(-velocity_error.square() / 0.25)
        yield {
            "perf": float(perf.mean()), "yaw_rate_error": float(yaw_rate_error.mean()),
            "worst_perf": float(perf.mean(0).reshape(len(self.BATTERY), -1).mean(1).min()),
        }  # fmt: skip

        env = worlds(1, **quiet)
        play = Play(env, [self.GAIT], _home(env))
        play.step(act, 2 * STEPS)
        _, _, action, velocity = (result[:, 0] for result in play.results())
        params = env.task.params
        change = action.diff(dim=0)[:, : self.legs] * torch.tensor(params["action_scale"][: self.legs]) / 0.25
        yield {
            "action_change": _rms(change), "roll_pitch_rate": 2**0.5 * _rms(velocity[:, 3:5]),
            "yaw_rate": _rms(velocity[:, 5]),
            "joint_velocity": _rms(velocity[:, params["joint_dof"][: self.legs].tolist()]),
        }  # fmt: skip


def _without_noise(env: lw.Env) -> dict[str, Any]:
    """Return the parameters without noise, pushes and random friction."""
    slide, spin, roll = env.model.geom_friction[env.task.params["foot_geoms"][0]].tolist()
    return dict.fromkeys(NOISES, 0.0) | {
        "encoder_bias": 0.0, "trunk_offset": [0.0, 0.0, 0.0], "push_seconds": [NEVER, NEVER],
        "sliding_friction": [slide, slide], "spinning_friction": [spin, spin], "rolling_friction": [roll, roll],
    }  # fmt: skip


def _home(env: lw.Env) -> torch.Tensor:
    """Reset to the home position, and return its state."""
    env.reset()
    state = env.get_state()
    env.state_space.split(state)["push_timer"][:] = NEVER
    return state


def _rms(numbers: torch.Tensor) -> float:
    return float(numbers.double().square().mean().sqrt())
