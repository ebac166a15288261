"""Judge a policy that sees, with its own pictures and with those of MuJoCo's renderer (OpenGL).

The same episodes are played on the C engine under exact physics. The policy sees the pictures of this package, those of
``mujoco.Renderer`` without shadows, reflections and antialiasing, or those of ``mujoco.Renderer`` as it is.
"""

import copy
import functools
import time
from pathlib import Path
from typing import Any

import mujoco
import torch
from experiment import Skipped

import lyceum_warp as lw
from lyceum_warp.algos import EXACT, evaluation_seed
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.core.model_fields import SEEN
from lyceum_warp.engines import options_on_cores
from lyceum_warp.training import Run

RENDERERS = ("this package", "mujoco.Renderer, plain", "mujoco.Renderer")
VISIBLE = {"rgb": 24, "depth": 0.05}
"""Differences that count: of 256 levels, and in metres."""


class Rendered:
    """A policy that gets the pictures of ``mujoco.Renderer`` instead of those of its environment."""

    def __init__(self, policy: Any, env: lw.Env, *, plain: bool) -> None:
        if seen := SEEN.intersection(field.name for field in env.task.dynamics):
            raise Skipped(
                f"worlds of {env.task.name!r} differ in {', '.join(sorted(seen))}, and mujoco.Renderer has one model"
            )
        self.policy, self.env = policy, env
        self.state_size, self.groups = policy.state_size, policy.groups
        self.cameras = {camera.group: camera for camera in env.task.cameras if camera.group in policy.groups}
        self.shares: list[float] = []
        self._model, self._plain = copy.copy(env.model), plain
        if plain:
            self._model.vis.quality.offsamples = 0
        self._data = mujoco.MjData(self._model)
        try:
            self._renderers = {
                group: mujoco.Renderer(self._model, camera.height, camera.width)
                for group, camera in self.cameras.items()
            }
        except Exception as error:  # each GL backend raises its own errors
            raise Skipped(f"mujoco.Renderer has no OpenGL ({error}): set MUJOCO_GL=egl or MUJOCO_GL=osmesa") from error
        self._far = 0.99 * self._model.vis.map.zfar * self._model.stat.extent
        for group, camera in self.cameras.items():
            if camera.kind == "depth":
                self._renderers[group].enable_depth_rendering()

    def act(self, obs: tuple[torch.Tensor, ...], *state: torch.Tensor) -> Any:
        parts = dict(zip(self.groups, obs, strict=True))
        rendered = {group: torch.empty_like(parts[group]) for group in self.cameras}
        for world, row in enumerate(self.env.get_state().numpy()):
            physics = row[: self.env.engine.integration_size]
            mujoco.mj_setState(self._model, self._data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(self._model, self._data)
            for group, camera in self.cameras.items():
                rendered[group][world] = self._render(self._renderers[group], camera.name).view_as(
                    rendered[group][world]
                )
        for group, camera in self.cameras.items():
            difference = (rendered[group].float() - parts[group].float()).abs().amax(-1)
            self.shares.append((difference > VISIBLE[camera.kind]).float().mean().item())
        return self.policy.act(tuple((parts | rendered).values()), *state)

    def _render(self, renderer: mujoco.Renderer, name: str) -> torch.Tensor:
        renderer.update_scene(self._data, name)
        if self._plain:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                renderer.scene.flags[flag] = 0
        picture = torch.tensor(renderer.render().copy())
        return torch.where(picture < self._far, picture, 0.0) if picture.is_floating_point() else picture


def gap(run: str, renderer: str, seed: int, episodes: int, iterations: int) -> dict[str, Any]:
    """Play the episodes, and return their returns and the mean share of pixels that differ visibly."""
    torch.set_num_threads(1)
    env, policy, training = loaded(run, episodes) if run else trained(iterations, episodes)
    plain = renderer == RENDERERS[1]
    player = policy if renderer == RENDERERS[0] else Rendered(policy, env, plain=plain)
    with torch.no_grad():
        played = list(policy_episodes(env, player, episodes, seed=evaluation_seed(seed)))
    shares = getattr(player, "shares", [0.0])
    return {
        "returns": [round(episode.episode_return, 3) for episode in played],
        "differing": sum(shares) / len(shares), "training_seconds": training,
    }  # fmt: skip


@functools.cache
def loaded(run: str, episodes: int) -> tuple[lw.Env, Any, float]:
    options = {**options_on_cores(), "physics": EXACT, "autoreset": False}
    env = run_worlds(Run.open(Path(run)), options, {}, nworld=episodes)
    return env, lw.load(run), 0.0


@functools.cache
def trained(iterations: int, episodes: int) -> tuple[lw.Env, Any, float]:
    """Learn to balance a pole from 32 x 32 pixels and a teacher, as ``examples/pixels.py --teacher`` does."""
    start = time.process_time()
    cameras = [lw.Camera("near", 32, 32, pos=(0.0, -2.5, 1.0), lookat=(0.0, 0.0, 1.0))]
    blind = lw.make("cartpole", nworld=64, frame_skip=4, horizon=50)
    env = blind.replicate(cameras=cameras)
    common: dict[str, Any] = {"hidden": (128, 128), "mean_every": 0}
    ppo = lw.PPOConfig(value_hidden=(128, 128), epochs=4, gamma=0.98, entropy_coef=0.0, **common)
    config = lw.DistillConfig(policy_groups=("camera",), log_std=-1.5, **common)
    teacher = lw.PPO(blind, config=ppo)
    while teacher.iteration < iterations:
        next(teacher)
    student = lw.Distill(env, config=config, teacher=teacher.policy)
    while student.iteration < iterations:
        next(student)
    seconds = round(time.process_time() - start, 1)
    judge = env.replicate(nworld=episodes, horizon=250, autoreset=False, engine="mujoco", device="cpu")
    return judge, student.policy, seconds
