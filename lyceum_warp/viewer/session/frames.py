"""Make frames and messages from worlds and playbacks."""

import functools
import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import MAX_MESSAGES, MAX_POINTS, Frame, Ghost, Ghosts, Status
from lyceum_warp.viewer.session.driving import Driving
from lyceum_warp.viewer.session.live import Live, Rows
from lyceum_warp.viewer.session.live_settings import nominal_fields
from lyceum_warp.viewer.session.playback import Playback, reasons
from lyceum_warp.viewer.session.traces import Traces
from lyceum_warp.viz import REFERENCE, reference_states

_COLOURS = (
    (0.20, 0.55, 0.95), (0.95, 0.60, 0.15), (0.35, 0.75, 0.35), (0.75, 0.40, 0.85), (0.90, 0.80, 0.20),
    (0.30, 0.80, 0.80),
)  # fmt: skip
_PAST, _FUTURE, _PLAN = (0.90, 0.25, 0.20), (0.25, 0.40, 0.95), (0.25, 0.90, 0.45)
_OPACITY, _FADE = 0.35, 0.95  # _FADE is the ratio of opacities of successive ghosts


class FrameMaker:
    """Makes frames."""

    def __init__(self, env: Env, curves: int, driving: Driving) -> None:
        self.ghosts = Ghosts()
        self._env, self._curves, self._driving = env, curves, driving
        self._nominal = nominal_fields(env)
        self._messages: deque[str] = deque(maxlen=MAX_MESSAGES)
        self._points: deque[Sequence[float]] = deque(maxlen=MAX_POINTS)

    def say(self, text: str) -> None:
        """Show a message in the next frame."""
        self._messages.append(text)

    def news(self) -> dict[str, Any]:
        """Return the messages and the points of curves since the last call."""
        points = np.array(self._points, dtype=float).reshape(-1, 2 + self._curves)
        messages = tuple(self._messages)
        self._points.clear()
        self._messages.clear()
        return {"points": points, "messages": messages}

    def add_point(self, playback: Playback) -> None:
        """Add a step of a playback to the curves."""
        episode, step = playback.episode, playback.step
        values = [episode.rewards[step - 1], episode.evals[step - 1]] if step else [math.nan, math.nan]
        unknown = [math.nan] * (self._curves - 2)
        self._points.append([step * self._env.timestep, 0.0, *values, *unknown])

    def of_worlds(self, live: Live, main: Live, traces: Traces | None, status: Callable[..., Status]) -> Frame:
        """Make a frame of the displayed world, with other worlds as ghosts.

        Args:
            live: The worlds that are stepped now. They are either ``main`` or the plant, a copy of the displayed world.
            main: All worlds.
            traces: The paths of a planner's samples.
            status: A function that completes a ``Status``, given some of its fields.
        """
        nworld = main.env.nworld
        worlds = [(main.world + i) % nworld for i in range(1, min(self.ghosts.worlds, nworld - 1) + 1)]
        rows = live.rows(worlds if live is main else (), self.ghosts.burst)
        state, parts = rows.states[0], live.env.state_space.parts
        self._report(rows, main.world if live is not main else None)
        self._points.extend(rows.points.tolist())
        neighbours = rows.states[1:]
        if live is not main and worlds:  # the other worlds do not move
            neighbours = main.rows(worlds).states[1:]
        text, ghosts, predicted = [("return", f"{rows.episode_return:.6g}")], [], None
        if traces is not None:
            ghosts.append(Ghost(self._physics(traces.final), (*_PLAN, _OPACITY), what="end of the plan"))
            seconds = live.env.timestep * np.arange(len(traces.rewards))
            predicted = np.stack([seconds, traces.rewards], axis=1)
            text.append(("plan's return", f"{traces.rewards.sum():.6g} in {len(seconds) * live.env.timestep:.2g} s"))
        ghosts += self._beside(neighbours) if self.ghosts.grid else self._coloured(neighbours)
        ghosts += self._burst(rows.back, _PAST, "past")
        step, past = int(state[parts["step"]][0]), live.past
        complete = status(
            world=main.world, step=step, steps=live.env.horizon, time=float(state[parts["time"]][0]),
            text=tuple(text), command=self._driving.command(state),
            seekable=(max(0, step - past.behind), step + past.ahead),
            physics=tuple((name, float(state[parts[name]].sum() / n.sum())) for name, n in self._nominal.items()),
            clip=self._clip(state),
        )  # fmt: skip
        return self._frame(state, complete, ghosts, None if traces is None else traces.paths, predicted)

    def of_playback(self, playback: Playback, status: Callable[..., Status]) -> Frame:
        """Make a frame of a playback; for ``status``, see ``of_worlds``."""
        episode, state = playback.episode, playback.state
        around = playback.around(self.ghosts.burst)
        ghosts = self._burst((episode.states[s] for s in reversed(around) if s < playback.step), _PAST, "past")
        ghosts += self._burst((episode.states[s] for s in around if s > playback.step), _FUTURE, "future")
        text = [("episode", episode.name)]
        if episode.end:
            text.append(("end", episode.end))
        if np.isfinite(episode.rewards).all() and episode.steps:
            text.append(("return", f"{episode.rewards[: playback.step].sum():.6g} of {episode.rewards.sum():.6g}"))
        complete = status(
            world=0, step=playback.step, steps=episode.steps, time=playback.step * self._env.timestep,
            text=tuple(text), seekable=(0, episode.steps),
        )  # fmt: skip
        return self._frame(state, complete, ghosts)

    def _frame(
        self, state: np.ndarray, status: Status, ghosts: Sequence[Ghost], paths: np.ndarray | None = None,
        predicted: np.ndarray | None = None,
    ) -> Frame:  # fmt: skip
        parts = self._env.state_space.parts
        fields = {field.name: state[parts[field.name]] for field in self._env.task.dynamics if field.in_model}
        references = reference_states(self._env, state)
        ghosts = [*(Ghost(pose, REFERENCE, what="reference of the clip") for pose in references), *ghosts]
        arrows = self._driving.arrows(state)
        return Frame(self._physics(state), fields, status, tuple(ghosts), paths, arrows, predicted=predicted)

    def _clip(self, state: np.ndarray) -> tuple[int, int, int] | None:
        params, parts = self._env.task.params, self._env.state_space.parts
        if np.ndim(params.get("start_clip", ())):  # the task has no clips, or worlds begin in different ones
            return None
        clip, row = int(state[parts["clip"]][0]), int(state[parts["frame"]][0])
        return int(params["start_clip"]), clip, row - int(params["ranges"][clip, 0])

    def _report(self, rows: Rows, plant_of: int | None) -> None:
        """Report faults and the end of an episode. ``plant_of`` is the world that a plant copies."""
        if rows.end is not None:
            bits, returned, length, success = rows.end
            why = "success" if success else reasons(int(bits))
            self.say(f"the episode ended after {length:.0f} steps ({why}), return {returned:.6g}")
        if rows.fault is not None:
            bits, world, count = rows.fault
            where = int(world) if plant_of is None else plant_of
            self.say(f"fault in world {where}: {reasons(int(bits))} ({count:.0f} so far)")

    def _coloured(self, states: Iterable[np.ndarray]) -> list[Ghost]:
        colours = itertools.cycle(_COLOURS)
        rows = zip(states, colours, strict=False)
        return [Ghost(self._physics(row), (*colour, _OPACITY), what="other worlds") for row, colour in rows]

    def _beside(self, states: Iterable[np.ndarray]) -> list[Ghost]:
        cells = sorted(itertools.product(range(-3, 4), repeat=2), key=lambda cell: (max(map(abs, cell)), cell))[1:]
        step, paired = self._grid_step, zip(states, cells, strict=False)
        return [Ghost(self._physics(row), None, (step * x, step * y)) for row, (x, y) in paired]

    @functools.cached_property
    def _grid_step(self) -> float:
        """The distance between the worlds of a grid, in m: slightly more than the robot's size."""
        model = self._env.task.model
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        moving = model.body_weldid[model.geom_bodyid] > 0
        far = np.linalg.norm(data.geom_xpos - data.subtree_com[0], axis=1) + model.geom_rbound
        return 2.2 * float(far[moving].max(initial=0.1))

    def _burst(self, states: Iterable[np.ndarray], colour: tuple[float, float, float], what: str) -> list[Ghost]:
        """Make ghosts along a trajectory. The first states are the most opaque."""
        opacities = (_OPACITY * _FADE**i for i in itertools.count(1))
        rows = zip(states, opacities, strict=False)
        return [Ghost(self._physics(row), (*colour, opacity), what=what) for row, opacity in rows]

    def _physics(self, state: np.ndarray) -> np.ndarray:
        return state[: self._env.engine.integration_size]


def model_bytes(model: mujoco.MjModel) -> bytes:
    """Serialize a model with ``mujoco.mj_saveModel``."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()
