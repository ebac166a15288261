"""Make the frames of worlds and of playbacks, and the messages beside them."""

import math
from typing import Any, Protocol

import mujoco
import numpy as np

from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import Frame, Ghost, SetGhosts, Status
from lyceum_warp.viewer.session.live import Live, Rows, pose
from lyceum_warp.viewer.session.playback import Playback, reasons
from lyceum_warp.viewer.session.traces import Traces

_COLOURS = (
    (0.20, 0.55, 0.95), (0.95, 0.60, 0.15), (0.35, 0.75, 0.35), (0.75, 0.40, 0.85), (0.90, 0.80, 0.20),
    (0.30, 0.80, 0.80),
)  # fmt: skip
_PAST, _FUTURE, _NEUTRAL, _PLAN = (0.90, 0.25, 0.20), (0.25, 0.40, 0.95), (0.70, 0.70, 0.75), (0.25, 0.90, 0.45)
_OPACITY = 0.35


class StatusOf(Protocol):
    """Completes a status with what its frame knows."""

    def __call__(self, **known: Any) -> Status:
        """The status."""
        ...


class FrameMaker:
    """Makes the frames of a session.

    Args:
        env: The worlds.
        curves: Number of the live curves.
    """

    def __init__(self, env: Env, curves: int) -> None:
        self.ghosts = SetGhosts()
        """Which ghosts are drawn."""
        self.text: dict[str, str] = {}
        """Further lines of the panel."""
        self._env, self._curves = env, curves
        self._messages: list[str] = []
        self._points: list[list[float]] = []
        self._seen_end = self._seen_fault = 0.0

    def say(self, text: str) -> None:
        """Show a message in the next frame."""
        self._messages.append(text)

    @property
    def has_messages(self) -> bool:
        """Whether the next frame has messages."""
        return bool(self._messages)

    def forget_seen(self, live: Live) -> None:
        """Report the ends and faults from now on."""
        self._seen_end = self._seen_fault = float(live.made)

    def add_point(self, playback: Playback) -> None:
        """Add the step of a playback to the curves."""
        episode, step = playback.episode, playback.step
        values = [episode.rewards[step - 1], episode.evals[step - 1]] if step else [math.nan, math.nan]
        unknown = [math.nan] * (self._curves - 2)
        self._points.append([step * self._env.timestep, *values, *unknown])

    def of_worlds(
        self, live: Live, main: Live, traces: Traces | None, status: "StatusOf", *, plan_ms: float, paused: bool
    ) -> Frame:
        """A frame of worlds that are stepped.

        Args:
            live: The worlds.
            main: All worlds, where ``live`` is a plant.
            traces: Paths of a planner's samples.
            status: Completes the status.
            plan_ms: Milliseconds of the controller's last call.
            paused: Whether the worlds must be shown as they are now.
        """
        wanted = self.ghosts.worlds if live is main else (), self.ghosts.burst
        rows, points = live.take(), []
        if rows is not None and rows.worlds[0] == live.world:
            points.append(rows.points)
        else:
            rows = None
        if rows is None or paused or not live.asynchronous:
            live.request(*wanted)
            rows = live.take()
            assert rows is not None
            points.append(rows.points)
        if live.asynchronous and not paused:  # the next frame shows the worlds as they are now
            live.request(*wanted)
        state, parts = rows.states[0], live.env.state_space.parts
        self._report(rows, main.world if live is not main else None)
        others = rows.states[1:]
        if live is not main and self.ghosts.worlds:  # they wait
            main.request(self.ghosts.worlds)
            waiting = main.take()
            others = others if waiting is None else waiting.states[1:]
        ghosts = [Ghost(self._pose(row), (*_COLOURS[i % len(_COLOURS)], _OPACITY)) for i, row in enumerate(others)]
        for rank, row in enumerate(rows.back):
            colour = _PAST if self.ghosts.doppler else _NEUTRAL
            ghosts.append(Ghost(self._pose(row), (*colour, _OPACITY * self.ghosts.fade ** (rank + 1))))
        if traces is not None:
            ghosts.append(Ghost(traces.final, (*_PLAN, _OPACITY)))
        text = [("return", f"{rows.episode_return:.6g}"), ("past", past_text(live)), *self.text.items()]
        shown = status(
            world=main.world, step=int(state[parts["step"]][0]), steps=live.env.horizon,
            time=float(state[parts["time"]][0]), plan_ms=plan_ms,
            text=tuple(text), seekable=_seekable(live, int(state[parts["step"]][0])),
        )  # fmt: skip
        return Frame(
            self._pose(state), self._physics(state), self._model_fields(state), shown, tuple(ghosts),
            None if traces is None else traces.paths, None if traces is None else traces.best,
            np.concatenate(points), self._take_messages(),
        )  # fmt: skip

    def of_playback(self, playback: Playback, status: "StatusOf") -> Frame:
        """A frame of an episode that is played back.

        Args:
            playback: The episode, and the step in it.
            status: Completes the status.
        """
        episode, state = playback.episode, playback.state
        ghosts = []
        for i, index in enumerate(self.ghosts.episodes):
            if index != playback.index:
                other = playback.episodes[index].states
                row = other[min(playback.step, len(other) - 1)]
                ghosts.append(Ghost(self._pose(row), (*_COLOURS[i % len(_COLOURS)], _OPACITY)))
        around = playback.around(self.ghosts.burst)
        for side, colour in ((-1, _PAST), (1, _FUTURE)):
            steps = sorted((s for s in around if (s - playback.step) * side > 0), key=lambda s: abs(s - playback.step))
            for rank, step in enumerate(steps):
                side_colour = colour if self.ghosts.doppler else _NEUTRAL
                opacity = _OPACITY * self.ghosts.fade ** (rank + 1)
                ghosts.append(Ghost(self._pose(episode.states[step]), (*side_colour, opacity)))
        text = [("episode", episode.name), *((("end", episode.end),) if episode.end else ())]
        if np.isfinite(episode.rewards).all() and episode.steps:
            text.append(("return", f"{episode.rewards[: playback.step].sum():.6g} of {episode.rewards.sum():.6g}"))
        shown = status(
            world=0, step=playback.step, steps=episode.steps, time=playback.step * self._env.timestep, plan_ms=math.nan,
            text=tuple(text), seekable=(0, episode.steps),
        )  # fmt: skip
        points, self._points = self._points, []
        return Frame(
            self._pose(state), self._physics(state), self._model_fields(state), shown, tuple(ghosts),
            samples=np.array(points, dtype=float).reshape(-1, 1 + self._curves), messages=self._take_messages(),
        )  # fmt: skip

    def _report(self, rows: Rows, plant_of: int | None) -> None:
        """Messages about an episode that ended, and about faults.

        Args:
            rows: What is shown.
            plant_of: The world of which they are a copy.
        """
        number, bits, returned, length = rows.end
        if number > self._seen_end:
            self.say(f"the episode ended after {length:.0f} steps ({reasons(int(bits))}), return {returned:.6g}")
        if rows.fault[0] > self._seen_fault:
            _, bits, world, count = rows.fault
            where = int(world) if plant_of is None else plant_of
            self.say(f"fault in world {where}: {reasons(int(bits))} ({count:.0f} so far)")
        self._seen_end = max(self._seen_end, number)
        self._seen_fault = max(self._seen_fault, rows.fault[0])

    def _pose(self, state: np.ndarray) -> Any:
        return pose(state, self._env.state_space.parts, self._env.task.model.nmocap)

    def _physics(self, state: np.ndarray) -> np.ndarray:
        return state[: mujoco.mj_stateSize(self._env.task.model, mujoco.mjtState.mjSTATE_INTEGRATION)].copy()

    def _model_fields(self, state: np.ndarray) -> dict[str, np.ndarray]:
        """The model fields of a state that differ from the model's."""
        found = {}
        for field in self._env.task.dynamics:
            owner = self._env.task.model if hasattr(self._env.task.model, field.name) else self._env.task.model.opt
            own = np.asarray(getattr(owner, field.name), dtype=float)
            value = state[self._env.state_space.parts[field.name]].reshape(own.shape)
            if not np.array_equal(value, own) and not np.array_equal(value, own.astype(np.float32)):
                found[field.name] = value.copy()
        return found

    def _take_messages(self) -> tuple[str, ...]:
        messages, self._messages = self._messages, []
        return tuple(messages)


def past_text(live: Live) -> str:
    """How far the past of worlds reaches."""
    past = live.past
    if not past.length:
        return "none: the worlds' states are too large"
    ahead = f", {past.ahead} ahead" if past.ahead else ""
    return f"{past.behind} of at most {past.length - 1} steps{ahead}"


def _seekable(live: Live, step: int) -> tuple[int, int]:
    """The steps of the episode that the past holds, as far as it reaches."""
    return max(0, step - live.past.behind), step + live.past.ahead


def model_bytes(model: mujoco.MjModel) -> bytes:
    """A model as ``mujoco.mj_saveModel`` writes it."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()
