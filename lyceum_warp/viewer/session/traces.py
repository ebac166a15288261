"""Roll out the plan and samples of a planner again, for their paths, in a thread that takes little time.

A planner keeps no positions on the way: it needs rewards alone. Its samples' actions are therefore rolled out once
more, from the state of the plan, in a few worlds of the planner's own task, model and time step. They draw from the
random streams of that state, where the planner's samples have streams of their own: in a task whose functions draw
during an episode, the paths are as likely as the planner's, and not the same.
"""

import dataclasses
import threading
import time
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.env import Env
from lyceum_warp.support.arrays import flat, torch_view
from lyceum_warp.viewer.protocol import Pose
from lyceum_warp.viewer.session.drivers import MOST_SAMPLES, PlanView
from lyceum_warp.viewer.session.live import pose

SHARE = 0.15
"""The share of a core that the thread takes at most: after t seconds of work it rests for t / SHARE."""


@dataclasses.dataclass(frozen=True)
class TracePoint:
    """The point of a robot whose path is drawn."""

    field: str
    """The field of its position: "site_xpos", "xpos", "xipos" or "subtree_com"."""
    index: int
    name: str
    """Its name for the panel."""


def trace_point(model: mujoco.MjModel, name: str | None = None) -> TracePoint:
    """Choose the point of a robot whose path is drawn.

    By default this is the centre of mass of a robot whose base moves freely, without an actuator of its own (a hopper,
    a humanoid). Otherwise it is the end of the longest chain of bodies that actuators move (an arm): its first site, or
    its centre of mass.

    Args:
        model: The model.
        name: A site or a body instead.

    Raises:
        ValueError: The model has neither a site nor a body of this name.
    """
    if name is not None:
        for kind, field in ((mujoco.mjtObj.mjOBJ_SITE, "site_xpos"), (mujoco.mjtObj.mjOBJ_BODY, "xpos")):
            if (index := mujoco.mj_name2id(model, kind, name)) >= 0:
                return TracePoint(field, index, name)
        known = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
        raise ValueError(
            f"the model has no site and no body {name!r} to trace: it has {', '.join(filter(None, known)) or 'none'}"
        )
    driven = _driven_bodies(model)
    if not driven.any():
        return TracePoint("subtree_com", 0, "centre of mass")
    root = int(model.body_rootid[driven.argmax()])
    moving = np.array([model.body_jntnum[body] > 0 for body in range(model.nbody)])
    first = next(body for body in range(model.nbody) if model.body_rootid[body] == root and moving[body])
    if not driven[first]:  # a base that no actuator moves
        return TracePoint("subtree_com", root, f"centre of mass of {model.body(root).name or 'the robot'}")
    depth = np.zeros(model.nbody, dtype=int)  # moving bodies from the world to a body that actuators move
    for body in range(1, model.nbody):
        parent = model.body_parentid[body]
        driven[body] |= driven[parent]
        depth[body] = depth[parent] + moving[body]
    end = int(np.where(driven, depth, -1).argmax())
    sites = np.flatnonzero(model.site_bodyid == end).tolist()
    if sites:
        return TracePoint("site_xpos", sites[0], model.site(sites[0]).name or f"site {sites[0]}")
    return TracePoint("xipos", end, model.body(end).name or f"body {end}")


def _driven_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies have joints that actuators move, directly, by tendons or at sites; (nbody,) bool."""
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
    """What the samples of a plan look like."""

    paths: np.ndarray
    """(samples, points, 3), metres: the samples, then the plan."""
    best: int | None
    """Index of the best sample."""
    final: Pose
    """The pose in which the plan ends."""
    made: float
    """When it was rolled out (``time.perf_counter``)."""


class TraceRollouts:
    """Rolls out the plan and some samples in a few worlds.

    Args:
        env: The planner's worlds, or the plant where a planner has none of its own.
        point: The point whose path is drawn.
        samples: The most samples.
        nominal_model: Whether the planner plans in the nominal model.
    """

    def __init__(
        self, env: Env, point: TracePoint, samples: int = MOST_SAMPLES, *, nominal_model: bool = False
    ) -> None:  # fmt: skip
        self.point, self.samples, self._nominal = point, samples, nominal_model
        fields = tuple(dict.fromkeys((*env.options.fields, point.field)))
        threads = {"nthread": 1} if env.engine.name == "mujoco" else {}
        self.env = env.replicate_few(samples + 1, autoreset=False, horizon=0, fields=fields, **threads)
        self._parts = env.state_space.parts
        self._states = self.env.get_state()
        self._positions = self.env.field(point.field)
        self._path: torch.Tensor | None = None
        for _ in range(3):  # captures its graphs, which must not happen beside another thread
            self.env.set_state(self._states, check=False)
            self.env.step()
            self.env.get_state(out=self._states)
        self.env.reset()
        self.env.get_state(out=self._states)

    @torch.no_grad()
    def __call__(self, view: PlanView) -> Traces:
        """Roll out."""
        env, horizon, count = self.env, len(view.actions), min(view.samples.shape[1], self.samples)
        self._put(view.state)
        if self._path is None or len(self._path) != horizon + 1:
            self._path = torch.empty(horizon + 1, self.samples + 1, 3, device=env.obs.device)
        actions = view.actions[:, None].repeat(1, self.samples + 1, 1)
        actions[:, :count] = view.samples[:, :count]
        actions = actions.to(env.action.device)
        env.set_state(self._states, check=False)
        self._path[0].copy_(self._positions[:, self.point.index])
        for t in range(horizon):
            env.action.copy_(actions[t])
            env.step()
            self._path[t + 1].copy_(self._positions[:, self.point.index])
        # worlds beyond the samples follow the plan
        paths = self._path.transpose(0, 1)[[*range(count), self.samples]].cpu().numpy().copy()
        final = env.get_state(out=self._states)[self.samples].cpu().numpy()
        ended = pose(final, env.state_space.parts, env.task.model.nmocap)
        return Traces(paths, view.best, ended, time.perf_counter())

    def _put(self, state: torch.Tensor) -> None:
        """Put a state of the planner into every row; further fields may have made the rows longer."""
        parts = self.env.state_space.parts
        state = state.to(self._states.device)
        for name, part in self._parts.items():
            self._states[:, parts[name]] = state[part]
        if self._nominal:
            nominal: dict[str, wp.array] = self.env.engine.nominal
            for name, row in nominal.items():
                self._states[:, parts[name]] = torch_view(flat(row))[0].double()
        self._states[:, parts["done_reason"]] = 0.0


class TraceThread:
    """A thread that rolls out the newest plan that it is given, and rests between.

    Args:
        rollouts: Rolls out. It belongs to the thread from then on.
        share: The share of a core that the thread takes at most.
    """

    def __init__(self, rollouts: TraceRollouts, share: float = SHARE) -> None:
        self.error: BaseException | None = None
        self._rollouts, self._share = rollouts, share
        self._view: PlanView | None = None
        self._newest: Traces | None = None
        self._wake, self._working, self._ending = threading.Event(), threading.Lock(), False
        self._thread = threading.Thread(target=self._run, name="lyceum_warp traces", daemon=True)
        self._thread.start()

    def give(self, view: PlanView) -> None:
        """Roll out this plan next, unless a newer one is given first."""
        self._view = view
        self._wake.set()

    def newest(self) -> Traces | None:
        """What was rolled out last."""
        return self._newest

    def forget(self) -> None:
        """Show no traces until another plan was rolled out. Waits for the end of a rollout."""
        self._view = None
        with self._working:
            self._newest = None

    def close(self) -> None:
        """End the thread after its rollout."""
        self._ending = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while True:
                self._wake.wait()
                self._wake.clear()
                if self._ending:
                    return
                view, self._view = self._view, None
                if view is None:
                    continue
                begun = time.thread_time()  # on a busy machine the wall clock would count other work
                with self._working:
                    self._newest = self._rollouts(view)
                self._rest((time.thread_time() - begun) / self._share)
        except BaseException as error:
            self.error = error

    def _rest(self, seconds: float) -> None:
        end = time.perf_counter() + seconds
        while not self._ending and (left := end - time.perf_counter()) > 0:
            time.sleep(min(left, 0.1))


def rollouts_for(controller: Any, plant: Env, name: str | None) -> TraceRollouts:
    """The rollouts for a planner's traces.

    Args:
        controller: The planner.
        plant: The world that it controls.
        name: A site or a body, or None for the task's, or the default.
    """
    own = getattr(controller, "env", None)
    env = own if isinstance(own, Env) else plant
    point = trace_point(env.task.model, name if name is not None else env.task.task.trace)
    nominal = bool(getattr(getattr(controller, "config", None), "nominal_model", False))
    return TraceRollouts(env, point, nominal_model=nominal)
