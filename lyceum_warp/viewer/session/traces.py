"""Repeat a planner's rollouts in a thread, to get the paths of its plan and samples.

A planner does not store positions. If the task uses random numbers during an episode, these paths differ from those
that the planner simulated.
"""

import dataclasses
import math
import time
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.algos import Planner
from lyceum_warp.env import Env
from lyceum_warp.viewer.session.drivers import MOST_SAMPLES, PlanView, WorldControl

SHARE = 0.15
"""The share of a core that the thread may use."""


def trace_point(model: mujoco.MjModel, name: str | None = None) -> tuple[str, int]:
    """Choose the point whose path the viewer shows. Return its field in MjData, such as "site_xpos", and its index.

    The default for a robot with an unactuated base, such as a hopper or a humanoid, is the centre of mass. The default
    for an arm is the first site of the last body in the longest chain of actuated bodies. If this body has no site, the
    default is its centre of mass.
    """
    if name is not None:
        for kind, field in ((mujoco.mjtObj.mjOBJ_SITE, "site_xpos"), (mujoco.mjtObj.mjOBJ_BODY, "xpos")):
            if (index := mujoco.mj_name2id(model, kind, name)) >= 0:
                return field, index
        names = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
        raise ValueError(
            f"the model has no site and no body {name!r} to trace: it has {', '.join(filter(None, names)) or 'none'}"
        )
    driven = _driven_bodies(model)
    if not driven.any():
        return "subtree_com", 0
    root = int(model.body_rootid[driven.argmax()])
    moving = model.body_jntnum > 0
    if not driven[(moving & (model.body_rootid == root)).argmax()]:
        return "subtree_com", root
    depth = np.zeros(model.nbody, dtype=int)  # the number of moving bodies between the world and a body
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        driven[body] |= driven[parent]
        depth[body] = depth[parent] + moving[body]
    end = int(np.where(driven, depth, -1).argmax())
    sites = np.flatnonzero(model.site_bodyid == end).tolist()
    return ("site_xpos", sites[0]) if sites else ("xipos", end)


def _driven_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Find the bodies that actuators move through joints, tendons or sites; (nbody,) bool."""
    data, moment = mujoco.MjData(model), np.zeros((model.nu, model.nv))
    mujoco.mj_fwdPosition(model, data)
    if model.nu:
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
    driven = np.zeros(model.nbody, dtype=bool)
    driven[model.dof_bodyid[moment.any(axis=0)]] = True
    return driven


@dataclasses.dataclass(frozen=True)
class Traces:
    """The paths of a plan and its samples."""

    paths: np.ndarray
    """The paths, (samples + 1, points, 3), in metres: first the best sample's, and last the plan's."""
    final: np.ndarray
    """The state at the end of the plan."""
    rewards: np.ndarray
    """The rewards of the plan's steps, (horizon,)."""
    time: float
    """The time of the rollout on the clock ``time.perf_counter``."""


class TraceRollouts:
    """Rolls out plans and some of their samples in a few worlds."""

    def __init__(self, controller: Any, plant: Env) -> None:
        env = controller.env if isinstance(controller, Planner) else plant
        field, self._index = trace_point(env.task.model, env.task.definition.trace)
        self._nominal = isinstance(controller, Planner) and controller.config.nominal_model
        fields = tuple(dict.fromkeys((*env.options.fields, field)))
        threads = {"nthread": 1} if env.engine.name == "mujoco" else {}
        self.env = env.replicate_few(MOST_SAMPLES + 1, autoreset=False, fields=fields, **threads)
        self._states = self.env.get_state()
        self._positions = self.env.field(field)
        worlds = self.env.worlds
        self._transition = worlds.programs.graphs.sequence(worlds.transition_phases())
        for _ in range(3):  # capture CUDA graphs here, because the thread must not
            self.env.set_state(self._states, check=False)
            self._step(self.env.action)
            self.env.get_state(out=self._states)

    @torch.no_grad()
    def __call__(self, view: PlanView) -> Traces:
        """Roll out a plan."""
        env, count = self.env, view.samples.shape[1]
        self._states.copy_(view.state)
        if self._nominal:
            parts = env.state_space.parts
            held = self._states[:, parts["object"]].squeeze(1) if env.task.objects else None
            for name in env.engine.nominal:
                self._states[:, parts[name]] = env.worlds.nominal_rows(name, held).double()
        actions = view.actions[:, None].repeat(1, MOST_SAMPLES + 1, 1)  # worlds without a sample follow the plan
        actions[:, :count] = view.samples
        actions = actions.to(env.action.device)
        env.set_state(self._states, check=False)
        path, rewards = [self._positions[:, self._index].clone()], []
        for action in actions:
            self._step(action)
            path.append(self._positions[:, self._index].clone())
            rewards.append(env.reward[MOST_SAMPLES].clone())
        paths = torch.stack(path, dim=1)[[*range(count), MOST_SAMPLES]].cpu().numpy()
        final = env.get_state(out=self._states)[MOST_SAMPLES].cpu().numpy().copy()
        return Traces(paths, final, torch.stack(rewards).cpu().numpy(), time.perf_counter())

    def _step(self, action: torch.Tensor) -> None:
        """Make a step without events, as planners do."""
        self.env.action.copy_(action)
        for call in self._transition:
            call()


class TraceThread:
    """Rolls out plans in a thread that uses a limited share of a core."""

    def __init__(self, rollouts: TraceRollouts) -> None:
        self._rollouts = rollouts
        self._pool = ThreadPoolExecutor(1, "lyceum_warp traces")
        self._rollout: Future[Traces] | None = None
        self._traces: Traces | None = None
        self._next = 0.0

    def follow(self, control: WorldControl) -> Traces | None:
        """Roll out a new plan when the thread is free, and return the last traces.

        Raises:
            Exception: A rollout failed. No further rollouts are made.
        """
        if self._rollout is not None and self._rollout.done():
            rollout, self._rollout = self._rollout, None
            self._traces = rollout.result()
        if self._rollout is None and time.perf_counter() >= self._next and (plan := control.look()) is not None:
            self._rollout = self._pool.submit(self._roll_out, plan)
        return self._traces

    def forget(self) -> None:
        """Wait for a rollout in progress, and drop the traces."""
        if self._rollout is not None:
            wait([self._rollout])
        self._rollout = self._traces = None

    def close(self) -> None:
        """End the thread after a rollout in progress."""
        self._pool.shutdown()

    def _roll_out(self, plan: PlanView) -> Traces:
        self._next = math.inf
        start = time.thread_time()  # CPU time, because wall time would include other programs
        traces = self._rollouts(plan)
        self._next = time.perf_counter() + (time.thread_time() - start) / SHARE
        return traces
