"""A viewing session: it owns worlds, controllers and episodes, decides what is shown, and obeys the window's commands.

Policies act in all worlds, which the session steps by the clock. A controller of one world, such as a planner, controls
a plant as ``lw.control_async`` does: the session works only while the plant waits for its next step.
"""

import contextlib
import math
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from lyceum_warp.controllers.episode_collector import ControlProgress
from lyceum_warp.controllers.loop import control
from lyceum_warp.controllers.real_time import Clock, control_async
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.engines.placement import options_for_plant
from lyceum_warp.env import Env
from lyceum_warp.validate import check_kind, positive_number, whole_number
from lyceum_warp.viewer.controllers import Control, ControllerError, PolicyControl, WorldControl, controls
from lyceum_warp.viewer.frames import FrameMaker, model_bytes, past_text
from lyceum_warp.viewer.live import PLANT_HISTORY_BYTES, Live
from lyceum_warp.viewer.playback import Playback, episodes_of
from lyceum_warp.viewer.protocol import (
    MOST_BURST,
    MOST_GHOSTS,
    Camera,
    Close,
    Command,
    Frame,
    Mode,
    Perturb,
    Reset,
    Scene,
    Seek,
    SetBackwards,
    SetController,
    SetEpisode,
    SetGhosts,
    SetMode,
    SetPaused,
    SetSpeed,
    SetVideo,
    SetWorld,
    Status,
    StepBy,
)
from lyceum_warp.viewer.traces import Traces, TraceThread, rollouts_for, trace_point
from lyceum_warp.viewer.videos import VideoTaker
from lyceum_warp.viz.drawing import NoVideoError

SLOWEST, FASTEST = 1 / 16, 16.0
"""Bounds of the speed, simulated seconds per second."""

_LAG = 0.25  # seconds that the worlds may lie behind the clock; what is beyond is given up
_RESERVE = 0.0015  # seconds before a plant's step in which the session does not begin any work
_IDLE = 0.5  # seconds between two frames while nothing changes
_PART = 10_000  # steps of a plant in one run of the loop, which keeps all of their states
_OLD = 1.0  # seconds after which paths of samples are no longer shown
_POLL = 0.005  # seconds between two looks at the window's commands
_WARM_UP = 3  # calls of a controller in which it may capture graphs, which must not happen beside other work
_CHECK = 0.5  # seconds between two calls of a watcher


class SessionWindow(Protocol):
    """What a session needs of a window."""

    def show(self, frame: Frame, /) -> None:
        """Show a frame; never waits."""
        ...

    def commands(self) -> Iterable[Command]:
        """The commands since the last call; never waits."""
        ...

    def is_open(self) -> bool:
        """Whether the window is there."""
        ...

    def close(self) -> None:
        """Close the window."""
        ...

    # ``wants_frame``, a property, is optional: False while the frame before is on its way


Watcher = Callable[[], Sequence[str]]
"""Called about twice a second; returns new messages."""


class Session:
    """What a window shows, and how it goes on.

    Args:
        env: The worlds.
        controllers: Controllers by their names; see ``lw.view``.
        episodes: Episodes to play back.
        world: The world that is shown first.
        seed: Seed of a random reset at the start; by default the worlds stay as they are.
        paused: Whether the session starts paused.
        trace: The site or body whose path is drawn for a planner's samples.
        fps: The most frames per second.
        title: What the window is called.
        watchers: Called about twice a second.
        on_trajectory: Called with what a controller of one world did in real time, after each episode and after each
            command that interrupts one.

    Raises:
        ValueError: An argument does not fit.
    """

    def __init__(
        self,
        env: Env,
        *,
        controllers: Mapping[str, Any] | None = None,
        episodes: Any = None,
        world: int = 0,
        seed: int | None = None,
        paused: bool = False,
        trace: str | None = None,
        fps: float = 30.0,
        title: str | None = None,
        watchers: Sequence[Watcher] = (),
        on_trajectory: Callable[[Trajectory], object] | None = None,
    ) -> None:
        check_kind("env", env, Env, "as lw.make('hopper') returns it")
        check_world(world, env.nworld)
        self.env, self.fps = env, positive_number("fps", fps, "frames per second")
        self.controllers = controls(controllers or {}, env)
        self.playback = Playback([] if episodes is None else episodes_of(episodes, env))
        if seed is not None:
            env.rand_reset(whole_number("seed", seed, low=0))
        self._trace, self._watchers, self._on_trajectory = trace, watchers, on_trajectory
        self._main = Live(env)
        self._main.world = world
        self._plant: Live | None = None
        self._threads: dict[str, TraceThread | None] = {}
        self.mode: Mode = "passive"
        self.controller: str | None = None
        self.paused, self.speed = bool(paused), 1.0
        self.frames = 0
        """Frames that were shown."""
        modes: list[Mode] = ["playback"] if self.playback.episodes else []
        modes += ["controller"] if self.controllers else []
        modes.append("passive")
        if trace is not None:
            trace_point(env.task.model, trace)
        if any(isinstance(c, WorldControl) for c in self.controllers.values()):
            self._make_plant()
        self.scene = Scene(
            title=title or env.task.name, model=model_bytes(env.task.model), nworld=env.nworld, timestep=env.timestep,
            modes=tuple(modes), controllers=tuple(self.controllers),
            episodes=tuple(episode.name for episode in self.playback.episodes),
            curves=("reward", "eval", *env.metrics),
        )  # fmt: skip
        self._videos = VideoTaker(env.task.model, self.scene.title)
        self._window: SessionWindow | None = None
        self._frames = FrameMaker(env, len(self.scene.curves))
        self._closed = self._changed = False
        self._waiting: deque[Command] = deque()
        self._next_step = self._next_frame = self._next_check = self._last_frame = self._last_work = 0.0
        self._progress: deque[tuple[float, int]] = deque(maxlen=64)
        self._steps = 0
        self._external = self._dragging = False
        self._select(modes[0], next(iter(self.controllers), None))

    # the loop

    @torch.no_grad()
    def run(self, window: SessionWindow) -> None:
        """Show the session until its window is closed.

        Args:
            window: The window. It is closed at the end, also after an exception, and the session with it.
        """
        self._window = window
        now = time.perf_counter()
        self._next_frame = self._next_check = now
        self._next_step = now + self.env.timestep / self.speed
        with contextlib.ExitStack() as ends:  # in reverse order
            ends.enter_context(self._videos.finishing(print))
            ends.callback(self.close)
            ends.callback(window.close)
            while self._goes_on():
                try:
                    if self._by_the_clock():
                        self._run_plant()
                    else:
                        self._tick()
                except ControllerError as error:
                    self._give_up_control(error)

    def close(self) -> None:
        """End the threads of the session. A second call does nothing."""
        threads, self._threads = self._threads, {}
        for thread in threads.values():
            if thread is not None:
                thread.close()

    def _goes_on(self) -> bool:
        """Obey commands; returns whether the window is still open."""
        self._poll()
        return not self._closed

    def _tick(self) -> None:
        """Step what is due, show a frame, and wait."""
        now = time.perf_counter()
        if self.paused:
            self._next_step = now
        else:
            period = self.env.timestep / self.speed
            self._next_step = max(self._next_step, now - max(_LAG, period))
            until = max(now + 0.5 / self.fps, self._next_frame)
            while self._next_step <= now and not self._by_the_clock():
                self.advance()
                self._next_step += period
                if (now := time.perf_counter()) >= until:
                    break
        self._show_when_due(now)
        now = time.perf_counter()
        wake = max(self._next_frame, now + _POLL)
        if not self.paused:
            wake = min(wake, self._next_step)
        if wake > now:
            time.sleep(min(wake - now, _POLL))

    def _poll(self) -> None:
        """Obey the window's commands, and call the watchers now and then."""
        assert self._window is not None
        if not self._window.is_open():
            self._waiting.append(Close())
        self._waiting.extend(self._window.commands())
        while self._waiting:
            self.obey(self._waiting.popleft())
        now = time.perf_counter()
        if now >= self._next_check:
            self._next_check = now + _CHECK
            for watch in (*self._watchers, self._videos.completed):
                for message in watch():
                    self._frames.say(message)

    def _show_when_due(self, now: float) -> None:
        """Show a frame if it is time for one, and if something has changed or the last one is long ago."""
        assert self._window is not None
        wanted = self._videos.due or getattr(self._window, "wants_frame", True)
        if now < self._next_frame or not wanted:
            return
        self._next_frame = max(self._next_frame + 1 / self.fps, now)
        changed = self._changed or self._frames.has_messages or self._videos.due
        if self.paused and not changed and now - self._last_frame < _IDLE:
            return
        frame = self.frame()
        self._window.show(frame)
        self._last_frame, self._changed = now, False
        self.frames += 1
        try:
            self._videos.add(frame)
        except (NoVideoError, OSError, ValueError) as error:
            self._videos.give_up()
            self._frames.say(str(error))

    # a plant that keeps its rate

    def _by_the_clock(self) -> bool:
        """Whether a controller of one world controls its plant in real time."""
        return isinstance(self._control, WorldControl) and not self.paused and not self.live.past.ahead

    def _run_plant(self) -> None:
        """Control the plant until its episode ends, or a command needs its state."""
        control, live = self._control, self.live
        assert isinstance(control, WorldControl)
        if live.env.done.item():
            self._begin_episode()
        live.expect_steps()
        self._external = True
        period, run = live.env.timestep / self.speed, control.new_run()
        try:
            trajectory = control_async(
                live.env, run, period=period, steps=_PART, reset=False, on_step=self._stepped,
                on_abort=self._on_trajectory, clock=_SessionClock(self),
            )  # fmt: skip
            if self._on_trajectory is not None:
                self._on_trajectory(trajectory)
        except _InterruptedByCommand:
            pass
        except ValueError as error:  # of actions that do not fit
            raise ControllerError(control.name, error) from error
        finally:
            self._external = False
            control.end_run()
        self._next_step = time.perf_counter()

    def _stepped(self, progress: ControlProgress) -> None:
        """The plant made a step."""
        self.live.stepped()
        self._steps += 1
        if time.perf_counter() - self._last_work > 1 / self.fps:  # the plant is late or fast, and never waits
            self.work(math.inf)

    def work(self, until: float) -> None:
        """Obey commands and show frames up to a moment of ``time.perf_counter``; once if that is infinite."""
        while (now := time.perf_counter()) < until:
            self._last_work = now
            self._poll()
            self._show_when_due(now)
            if until == math.inf:
                return
            left = min(until, now + _POLL) - time.perf_counter()
            if left > 0:
                time.sleep(left)

    def wait_for_plan(self, event: threading.Event) -> None:
        """Work until the first plan of a run is there. The first calls of a controller are waited for."""
        control = self._control
        if not isinstance(control, WorldControl) or control.calls < _WARM_UP:
            event.wait()
        while not event.wait(_POLL):
            self.work(math.inf)

    # steps

    @property
    def live(self) -> Live:
        """The worlds that are stepped: the plant under a controller of one world, the environment otherwise."""
        return self._plant if self._plant is not None and isinstance(self._control, WorldControl) else self._main

    @property
    def _control(self) -> Control | None:
        return self.controllers[self.controller] if self.mode == "controller" and self.controller else None

    def advance(self, steps: int = 1) -> None:
        """Make steps, without waiting for the clock."""
        self._changed = True
        self._steps += steps
        if self.mode == "playback":
            for _ in range(steps):
                self.playback.advance()
                self._frames.add_point(self.playback)
            return
        for _ in range(steps):
            if isinstance(self._control, WorldControl) and not self.live.past.ahead:
                self._step_plant()
            else:
                self.live.step(self._act)
            self._end_old_push()

    def _act(self) -> None:
        """Write the actions of the next step."""
        if isinstance(self._control, PolicyControl):
            self._control.act()
        else:
            self.live.env.action.zero_()

    def _step_plant(self) -> None:
        """One step of a plant that waits for its controller."""
        live = self.live
        if live.env.done.item():
            self._begin_episode()
        live.expect_steps()
        try:
            control(live.env, self._control, steps=1, reset=False)  # type: ignore[arg-type]
        except ValueError as error:  # of actions that do not fit
            raise ControllerError(str(self.controller), error) from error
        live.stepped()

    def _begin_episode(self) -> None:
        """A new episode of the plant, and of its controller."""
        self.live.reset(random=True)
        self._reset_controller()

    def _reset_controller(self) -> None:
        if isinstance(current := self._control, WorldControl):
            current.reset()
        if (thread := self._threads.get(str(self.controller))) is not None:
            thread.forget()

    def back(self, steps: int) -> None:
        """Take steps back."""
        done = self.live.back(steps)
        if done < steps:
            self._frames.say(f"the past ends here: {past_text(self.live)}")

    # commands

    def obey(self, command: Command) -> None:
        """Obey a command. One that cannot be obeyed becomes a message.

        While a plant keeps its rate, a command that needs its state is left for later, and the loop is interrupted.
        """
        if self._external and not isinstance(command, (SetVideo, SetGhosts)) and not _is_push(command):
            self._waiting.appendleft(command)
            raise _InterruptedByCommand
        self._changed = True
        if isinstance(command, SetMode | SetController) and not self._calls_have_ended():
            return
        try:
            self._obey(command)
        except (ValueError, OSError, NoVideoError) as error:
            self._frames.say(str(error))
        except ControllerError as error:
            self._give_up_control(error)
        self._end_old_push()

    def _calls_have_ended(self) -> bool:
        """Show frames until no call of a controller is running; returns whether the window is still open.

        The first calls of another controller may capture graphs, which must not happen beside them.
        """
        while any(isinstance(each, WorldControl) and each.busy for each in self.controllers.values()):
            if (window := self._window) is not None:
                self._waiting.extend(window.commands())
                if not window.is_open() or any(isinstance(each, Close) for each in self._waiting):
                    self._closed = True
                    return False
                self._show_when_due(time.perf_counter())
            time.sleep(_POLL)
        return True

    def _give_up_control(self, error: ControllerError) -> None:
        """Pause, and take the control from a controller that raised an exception."""
        print("".join(traceback.format_exception(error.__cause__)), end="", file=sys.stderr, flush=True)
        self.paused = True
        if self.mode == "controller":
            self._select("passive", self.controller)
        self._frames.say(f"{error}; the viewer is paused, without a controller")
        self._changed = True

    def _obey(self, command: Command) -> None:
        match command:
            case SetMode(mode):
                self.set_mode(mode)
            case SetController(name):
                self.set_controller(name)
            case SetWorld(world):
                self.set_world(world)
            case SetEpisode(episode):
                self.playback.choose(episode)
                self.set_mode("playback")
            case SetPaused(paused):
                self.paused = paused
                self._progress.clear()
            case SetSpeed(speed):
                self.speed = min(max(float(speed), SLOWEST), FASTEST)
                self._progress.clear()
            case StepBy(steps):
                self.paused = True
                self._step_by(steps)
            case Seek(step):
                self.paused = True
                self.seek(step)
            case SetBackwards(backwards):
                self.playback.backwards = backwards
            case Reset(random):
                self.reset(random=random)
            case SetGhosts():
                self._set_ghosts(command)
            case Perturb():
                self.perturb(command)
            case SetVideo(on, camera):
                self.take_video(camera) if on else self._videos.end()
            case Close():
                self._closed = True

    def set_mode(self, mode: Mode) -> None:
        """Change the mode.

        From a playback, the worlds go on from the state that is shown.
        """
        if mode not in self.scene.modes:
            raise ValueError(f"there is no mode {mode!r} here: there are {', '.join(self.scene.modes)}")
        if mode == self.mode:
            return
        state = self.playback.state if self.mode == "playback" else None
        self._select(mode, self.controller or next(iter(self.controllers), None))
        if state is not None:
            self._put(torch.from_numpy(state), self.live, new_episode=True)

    def set_controller(self, name: str) -> None:
        """Give control to a controller."""
        if name not in self.controllers:
            raise ValueError(f"there is no controller {name!r}: there are {', '.join(self.controllers) or 'none'}")
        if self.mode == "playback":
            self.set_mode("controller")
        self._select("controller", name)

    def set_world(self, choice: int | str) -> None:
        """Show another world."""
        world = self._main.choose(choice)
        if world is None and choice == "last_ended":
            raise ValueError("no episode has ended yet")
        if world is None:
            check_world(choice, self.env.nworld)
            return
        before = self.live
        before.end_push()
        self._dragging = False
        if before is not self._main:
            self._carry(before, self._main)
        self._main.world = world
        if before is not self._main:
            self._carry(self._main, before)
            self._reset_controller()
        self._frames.forget_seen(self.live)

    def seek(self, step: int) -> None:
        """Show a step of the episode that is played back, or of the past of the world, as far as it is kept."""
        if self.mode == "playback":
            self.playback.seek(step)
            self._frames.add_point(self.playback)
            return
        live = self.live
        delta = step - int(live.env.episode_step[live.world])
        if delta < 0:
            self.back(-delta)
        else:
            for _ in range(min(delta, live.past.ahead)):
                live.step(self._act)

    def reset(self, *, random: bool) -> None:
        """Begin a new episode of the world, or show the first step of the one that is played back."""
        if self.mode == "playback":
            self.playback.seek(self.playback.episode.steps if self.playback.backwards else 0)
            self._frames.add_point(self.playback)
            return
        self.live.reset(random=random)
        self._reset_controller()

    def perturb(self, command: Perturb) -> None:
        """Push bodies of the shown world, or place them while paused."""
        given = {"mocap_pos": command.mocap_pos, "mocap_quat": command.mocap_quat}
        parts = {name: value for name, value in given.items() if value is not None}
        if command.qpos is not None and self.paused:
            parts["qpos"] = command.qpos
        push = bool(np.any(command.forces))
        if self.mode == "playback":
            if push or parts:
                raise ValueError("a playback cannot be perturbed: change the mode")
            return
        self._dragging = push
        if parts:
            self.live.write(**parts)
        if push:
            self.live.push(command.forces)
        elif self.live.pushed == self.live.world:
            self.live.end_push()
        elif not parts:
            return
        if self._external:
            self.live.expect_steps()

    def _end_old_push(self) -> None:
        """End a push that steps through the past have put back, once the worlds go on from there."""
        live = self.live
        if live.pushed is not None and not self._dragging and not live.past.ahead:
            live.end_push()
        # a planner does not know of the push
        pushed = self.env.state_space.parts["xfrc_applied"] if live.pushed is not None else None
        for each in self.controllers.values():
            if isinstance(each, WorldControl):
                each.hidden = pushed

    def take_video(self, camera: Camera | None = None) -> None:
        """Begin a video of what is shown, from a camera."""
        self._videos.begin(camera)

    def _step_by(self, steps: int) -> None:
        if self.mode == "playback":
            self.playback.seek(self.playback.step + steps)
            self._frames.add_point(self.playback)
        elif steps >= 0:
            self.advance(steps)
        else:
            self.back(-steps)

    def _set_ghosts(self, ghosts: SetGhosts) -> None:
        for kind, count, most in (
            ("worlds", len(ghosts.worlds), MOST_GHOSTS), ("episodes", len(ghosts.episodes), MOST_GHOSTS),
            ("states of the burst", ghosts.burst, MOST_BURST),
        ):  # fmt: skip
            if count > most:
                raise ValueError(f"at most {most} {kind} are drawn as ghosts, not {count}: choose fewer")
        for world in ghosts.worlds:
            check_world(world, self.env.nworld)
        if any(not 0 <= episode < len(self.playback.episodes) for episode in ghosts.episodes):
            raise ValueError(f"there are {len(self.playback.episodes)} episodes, from 0: not {ghosts.episodes}")
        self._frames.ghosts = ghosts

    # which worlds

    def _select(self, mode: Mode, controller: str | None) -> None:
        """Change the mode and the controller; the shown world goes on in the worlds of the new one."""
        before, chosen = self.live, (self.mode, self.controller)
        self.mode, self.controller = mode, controller
        if self.live is not before:
            self._carry(before, self.live)
            before.end_push()
        for thread in self._threads.values():
            if thread is not None:
                thread.forget()
        if chosen != (mode, controller):
            self.live.past.drop_ahead()
            self._reset_controller()
            self._progress.clear()
        self._frames.forget_seen(self.live)
        if isinstance(current := self._control, WorldControl) and current.name not in self._threads:
            self._threads[current.name] = self._trace_thread(current)

    def _make_plant(self) -> None:
        """One world for controllers of one world, on the CPU, where its steps do not wait for a planner's GPU."""
        env = self.env
        if env.nworld == 1 and not env.autoreset and not env.device.is_cuda:
            self._plant = self._main
        else:
            options = options_for_plant(env.options.engine, env.device)
            if options.get("engine", env.engine.name) == "mujoco":
                options["nthread"] = 1
            plant = env.replicate(nworld=1, autoreset=False, **options)
            self._plant = Live(plant, limit=PLANT_HISTORY_BYTES)
            self._main.warm_up()
        self._plant.warm_up()

    def _trace_thread(self, current: WorldControl) -> TraceThread | None:
        """The thread for a planner's traces; None for a controller without plans."""
        if not hasattr(current.controller, "actions"):
            return None
        assert self._plant is not None
        rollouts = rollouts_for(current.controller, self._plant.env, self._trace)
        self._frames.text["trace"] = rollouts.point.name
        return TraceThread(rollouts)

    def _carry(self, before: Live, after: Live) -> None:
        """Let the shown world go on in other worlds."""
        self._put(before.row(), after)
        if before.pushed == before.world:
            after.pushed = after.world
        after.returns[after.world] = before.returns[before.world].item()

    def _put(self, state: torch.Tensor, live: Live, *, new_episode: bool = False) -> None:
        """Put the shown world into a state, as one whose episode goes on."""
        state = state.clone()
        state[self.env.state_space.parts["done_reason"]] = 0.0
        live.set_row(state, new_episode=new_episode)

    # frames

    def frame(self) -> Frame:
        """What is shown now."""
        if self.mode == "playback":
            return self._frames.of_playback(self.playback, self._status)
        current = self._control
        plan_ms = 1000 * current.seconds if current else math.nan
        return self._frames.of_worlds(
            self.live, self._main, self._traces(), self._status, plan_ms=plan_ms, paused=self.paused
        )

    def _traces(self) -> Traces | None:
        """The newest paths of a planner's samples, if they are to be shown; asks for others."""
        thread, current = self._threads.get(str(self.controller)), self._control
        if not self._frames.ghosts.plan or thread is None or not isinstance(current, WorldControl):
            return None
        if thread.error is not None:
            self._frames.say(f"no paths of samples: {thread.error}")
            self._threads[current.name] = None
        if (view := current.look()) is not None:
            thread.give(view)
        seen = thread.newest()
        return seen if seen is not None and (self.paused or time.perf_counter() - seen.made < _OLD) else None

    def _status(self, **rest: Any) -> Status:
        now = time.perf_counter()
        self._progress.append((now, self._steps))
        begun, steps = self._progress[0]
        measured = math.nan
        if not self.paused and now - begun > 0.1:
            measured = (self._steps - steps) * self.env.timestep / (now - begun)
        return Status(
            mode=self.mode, controller=self.controller if self.mode == "controller" else None,
            episode=self.playback.index if self.mode == "playback" else None, paused=self.paused, speed=self.speed,
            measured_speed=measured, backwards=self.playback.backwards, video=self._videos.name, **rest,
        )  # fmt: skip


class _InterruptedByCommand(BaseException):
    """Ends a run of the plant, because a command needs its state."""


class _SessionClock(Clock):
    """The wall clock; while a plant waits for its next step, its session works."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def wait_until(self, moment: float) -> None:
        self._session.work(moment - _RESERVE)
        super().wait_until(moment)

    def wait_for(self, event: threading.Event) -> None:
        self._session.wait_for_plan(event)


def _is_push(command: Command) -> bool:
    return isinstance(command, Perturb) and command.qpos is None


def check_world(world: Any, nworld: int) -> int:
    """Check the number of a world.

    Raises:
        ValueError: There is no such world.
    """
    if not isinstance(world, int) or isinstance(world, bool) or not 0 <= world < nworld:
        raise ValueError(f"there is no world {world!r}: there {_worlds(nworld)}")
    return world


def _worlds(nworld: int) -> str:
    return "is 1 world, number 0" if nworld == 1 else f"are {nworld} worlds, 0 to {nworld - 1}"
