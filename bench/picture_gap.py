"""Judge a policy that sees, with its own pictures and with those of MuJoCo's renderer (OpenGL).

The same episodes are played on the C engine under exact physics. The policy sees the pictures of this package, those of
``mujoco.Renderer`` without shadows, reflections and antialiasing, or those of ``mujoco.Renderer`` as it is. With the
pictures of another world, the return shows how much the policy needs its eyes.
"""

import copy
import functools
import itertools
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from experiment import Skipped

import lyceum_warp as lw
from lyceum_warp.algos import EXACT, evaluation_seed
from lyceum_warp.binding.models import edited
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.core.model_fields import SEEN
from lyceum_warp.engines import options_on_cores
from lyceum_warp.training import Run

RENDERERS = ("this package", "mujoco.Renderer, plain", "mujoco.Renderer", "this package, of another world")
VISIBLE = {"rgb": 24, "depth": 0.05}
"""Differences that count: of 256 levels, and in metres."""

_TILE = 40
"""Cells along a tile of a height field."""


class Exchanged:
    """A policy that gets other pictures than those of its environment: those of another world."""

    def __init__(self, policy: Any, env: lw.Env) -> None:
        self.policy, self.env = policy, env
        self.state_size, self.groups = policy.state_size, policy.groups
        self.cameras = {camera.group: camera for camera in env.task.cameras if camera.group in policy.groups}
        self.shares: list[float] = []

    def pictures(self) -> dict[str, torch.Tensor]:
        return {group: self.env.obs_groups[group].roll(1, 0) for group in self.cameras}

    def act(self, obs: tuple[torch.Tensor, ...], *state: torch.Tensor) -> Any:
        pictures = self.pictures()
        for group, camera in self.cameras.items():
            difference = (pictures[group].float() - self.env.obs_groups[group].float()).abs().amax(-1)
            self.shares.append((difference > VISIBLE[camera.kind]).float().mean().item())
        return self.policy.act(tuple((dict(zip(self.groups, obs, strict=True)) | pictures).values()), *state)


class Rendered(Exchanged):
    """A policy that gets the pictures of ``mujoco.Renderer``."""

    def __init__(self, policy: Any, env: lw.Env, *, plain: bool) -> None:
        super().__init__(policy, env)
        if seen := SEEN.intersection(field.name for field in env.task.dynamics):
            raise Skipped(
                f"worlds of {env.task.name!r} differ in {', '.join(sorted(seen))}, and mujoco.Renderer has one model"
            )
        depth = all(camera.kind == "depth" for camera in self.cameras.values())
        if plain and depth:
            raise Skipped("mujoco.Renderer draws depth without shadows, reflections and antialiasing")
        self._model, self._plain = tiled(env) if depth and env.model.nhfield else copy.copy(env.model), plain
        self._tiles = np.flatnonzero(self._model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD) if depth else []
        if plain:
            self._model.vis.quality.offsamples = 0
        self._data = mujoco.MjData(self._model)
        try:
            kinds = {group: (camera.kind, camera.height, camera.width) for group, camera in self.cameras.items()}
            renderers = {kind: mujoco.Renderer(self._model, *kind[1:]) for kind in set(kinds.values())}
        except Exception as error:  # each GL backend raises its own errors
            raise Skipped(f"mujoco.Renderer has no OpenGL ({error}): set MUJOCO_GL=egl or MUJOCO_GL=osmesa") from error
        self._far = 0.99 * self._model.vis.map.zfar * self._model.stat.extent
        self._renderers = {group: renderers[kind] for group, kind in kinds.items()}  # contexts take turns slowly
        for (kind, *_), renderer in renderers.items():
            if kind == "depth":
                renderer.enable_depth_rendering()

    def pictures(self) -> dict[str, torch.Tensor]:
        pictures = {group: torch.empty_like(self.env.obs_groups[group]) for group in self.cameras}
        for world, row in enumerate(self.env.get_state().numpy()):
            physics = row[: self.env.engine.integration_size]
            mujoco.mj_setState(self._model, self._data, physics, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(self._model, self._data)
            for group, camera in self.cameras.items():
                target = pictures[group][world]
                target.copy_(self._render(self._renderers[group], camera.name).view_as(target))
        return pictures

    def _render(self, renderer: mujoco.Renderer, name: str) -> torch.Tensor:
        if len(self._tiles):
            self._model.geom_rgba[self._tiles, 3] = self._seen(self._data.camera(name), renderer)
        renderer.update_scene(self._data, name)
        if self._plain:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                renderer.scene.flags[flag] = 0
        picture = torch.tensor(renderer.render().copy())
        return torch.where(picture < self._far, picture, 0.0) if picture.is_floating_point() else picture

    def _seen(self, camera: Any, renderer: mujoco.Renderer) -> np.ndarray:
        """Say for each tile whether the sphere around it meets the camera's pyramid."""
        centers = (self._data.geom_xpos[self._tiles] - camera.xpos) @ camera.xmat.reshape(3, 3)
        radii, depth = self._model.geom_rbound[self._tiles], -centers[:, 2]
        seen = (depth > -radii) & (depth - radii < self._far)
        height = np.tan(np.deg2rad(self._model.cam_fovy[camera.id]) / 2.0)
        for offset, slope in zip(centers.T, (height * renderer.width / renderer.height, height), strict=False):
            seen &= abs(offset) - depth * slope < radii * np.hypot(1.0, slope)
        return seen


def tiled(env: lw.Env) -> mujoco.MjModel:
    """Compile the model with its height fields cut into tiles: MuJoCo draws all of a field in each picture."""
    spec = edited(env.task.definition, env.task.spec)
    for camera in env.task.cameras:
        camera.add_to(spec)
    for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD]:
        field = env.model.hfield(geom.hfieldname)
        size, (nrow,), (ncol,), heights = field.size, field.nrow, field.ncol, field.size[2] * field.data
        cell = 2.0 * size[:2] / (ncol - 1, nrow - 1)
        for row, column in itertools.product(range(0, nrow - 1, _TILE), range(0, ncol - 1, _TILE)):
            part = heights[row : row + _TILE + 1, column : column + _TILE + 1]
            name, half = f"{field.name} {row} {column}", cell * (part.shape[1] - 1, part.shape[0] - 1) / 2.0
            low, pos = part.min(), np.zeros(3)
            spec.add_hfield(
                name=name, size=[*half, max(np.ptp(part), 1e-9), size[3]], nrow=part.shape[0], ncol=part.shape[1],
                userdata=part.ravel(),
            )  # fmt: skip
            mujoco.mju_rotVecQuat(pos, np.array([*cell * (column, row) + half - size[:2], low]), geom.quat)
            geom.parent.add_geom(
                type=geom.type, hfieldname=name, pos=geom.pos + pos, quat=geom.quat, contype=0, conaffinity=0
            )
        # sensors may name the geom: it stays, invisible
        geom.type, geom.size, geom.rgba, geom.material = mujoco.mjtGeom.mjGEOM_SPHERE, [1.0] * 3, [0.0] * 4, ""
        geom.hfieldname = ""
        spec.delete(spec.hfield(field.name))
    spec.stat.extent = env.model.stat.extent
    return spec.compile()


def gap(run: str, renderer: str, seed: int, episodes: int, iterations: int) -> dict[str, Any]:
    """Play the episodes, and return their returns and the mean share of pixels that differ visibly."""
    torch.set_num_threads(1)
    env, policy, training = loaded(run, episodes) if run else trained(iterations, episodes)
    plain = renderer == RENDERERS[1]
    own = {RENDERERS[0]: policy, RENDERERS[-1]: Exchanged(policy, env)}
    player = own[renderer] if renderer in own else Rendered(policy, env, plain=plain)
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
