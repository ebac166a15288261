"""Run a viewing session: step the worlds at the chosen speed, carry out the window's commands, and send it frames."""

import contextlib
import math
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from lyceum_warp.controllers import ControlProgress, control_async
from lyceum_warp.env import Env
from lyceum_warp.viewer.commands import BETWEEN_CALLS, DURING_STEPS, Command, close
from lyceum_warp.viewer.session.drivers import ControllerError, WorldControl
from lyceum_warp.viewer.session.plant import POLL, InterruptedByCommand, WorkingClock
from lyceum_warp.viewer.session.stage import Stage
from lyceum_warp.viewer.session.window_process import Window
from lyceum_warp.viz import NoVideoError

_FPS = 30.0
"""Maximum frames per second."""
_LAG = 0.25
"""If the worlds fall behind, they catch up on at most this many seconds."""
_IDLE = 0.5
"""Seconds between two frames while the viewer is paused and receives no commands."""
_CHECK = 0.5
"""Seconds between two calls of the watchers."""
_PART = 10_000
"""Maximum number of steps of one control loop, which stores all its states."""

Watcher = Callable[[], Sequence[str]]
"""Returns new messages."""


class Session:
    """Show worlds in a window.

    A policy acts in all worlds, which the session steps at the chosen speed. A controller of one world acts in the
    plant, a single world that runs in real time. The session handles commands and frames between the plant's steps.
    """

    def __init__(
        self,
        env: Env,
        controllers: Mapping[str, Any] | None = None,
        *,
        watchers: Sequence[Watcher] = (),
        **options: Any,
    ) -> None:
        self.stage = Stage(env, controllers, **options)
        self._watchers = watchers
        self._window: Window | None = None
        self._in_run = False
        self._waiting: deque[Command] = deque()
        self._next_step = self._next_frame = self._next_check = self._last_frame = self._last_work = 0.0

    # the loop

    @torch.no_grad()
    def run(self, window: Window) -> None:
        """Run until the window is closed."""
        self._window = window
        now = time.perf_counter()
        self._next_frame = self._next_check = now
        self._next_step = now + self.stage.env.timestep / self.stage.speed
        with contextlib.ExitStack() as ends:  # called in reverse order: the window closes first
            ends.enter_context(self.stage.videos.finishing(print))
            ends.callback(self.stage.close)
            ends.callback(window.close)
            while True:
                self._poll()
                if self.stage.closed:
                    return
                try:
                    if self._by_the_clock():
                        self._run_plant()
                    else:
                        self._tick()
                except ControllerError as error:
                    self._give_up_control(error)

    def _tick(self) -> None:
        stage, now = self.stage, time.perf_counter()
        if stage.paused:
            self._next_step = now
        else:
            period = stage.env.timestep / stage.speed
            self._next_step = max(self._next_step, now - max(_LAG, period))
            until = max(now + 0.5 / _FPS, self._next_frame)
            while self._next_step <= now and not self._by_the_clock():
                stage.advance()
                self._next_step += period
                if (now := time.perf_counter()) >= until:
                    break
        self._show_when_due(now)
        due = math.inf if stage.paused else self._next_step - time.perf_counter()
        if due > 0:
            time.sleep(min(due, POLL))

    def _poll(self) -> None:
        assert self._window is not None
        self.stage.closed |= not self._window.is_open()
        if self.stage.closed and self._in_run:
            raise InterruptedByCommand
        self._waiting.extend(self._window.commands())
        while self._waiting:
            self.obey(self._waiting.popleft())
        now = time.perf_counter()
        if now >= self._next_check:
            self._next_check = now + _CHECK
            for watch in (*self._watchers, self.stage.videos.completed):
                for message in watch():
                    self.stage.frames.say(message)

    def _show_when_due(self, now: float) -> None:
        assert self._window is not None
        stage, videos = self.stage, self.stage.videos
        if now < self._next_frame or not (videos.due or self._window.wants_frame):
            return
        self._next_frame = now + _IDLE if stage.paused and not videos.due else max(self._next_frame + 1 / _FPS, now)
        self._last_frame = now
        frame = stage.frame(news=self._window.wants_frame)
        self._window.show(frame)
        videos.add(frame)

    # real time

    def _by_the_clock(self) -> bool:
        stage = self.stage
        return isinstance(stage.control, WorldControl) and not stage.paused and not stage.live.past.ahead

    def _run_plant(self) -> None:
        stage, control = self.stage, self.stage.control
        assert isinstance(control, WorldControl)
        stage.begin_due_episode()
        live = stage.live
        live.expect_steps()
        self._in_run = True
        try:
            control_async(
                live.env, control.new_run(), period=live.env.timestep / stage.speed, steps=_PART, reset=False,
                on_step=self._stepped, clock=WorkingClock(self._work, control),
            )  # fmt: skip
        except InterruptedByCommand:
            pass
        except ValueError as error:  # from invalid actions
            raise ControllerError(control.name, error) from error
        finally:
            self._in_run = False
            control.new_run()  # further calls from this control loop fail
        self._next_step = time.perf_counter()

    def _stepped(self, progress: ControlProgress) -> None:
        self.stage.live.stepped()
        self.stage.steps += 1
        # a plant that is late or has short steps never waits, so `_work` must run here
        if time.perf_counter() - self._last_work > 1 / _FPS:
            self._work()

    def _work(self) -> None:
        self._last_work = time.perf_counter()
        self._poll()
        self._show_when_due(self._last_work)

    # commands

    def obey(self, command: Command) -> None:
        """Carry out a command. If it fails, show the error to the user.

        Most commands first stop a plant that runs in real time, because they need its state.
        """
        function, arguments, options = command
        if self._in_run and function not in DURING_STEPS:
            self._waiting.appendleft(command)
            raise InterruptedByCommand
        stage = self.stage
        self._next_frame = min(self._next_frame, self._last_frame + 1 / _FPS)
        if function in BETWEEN_CALLS and not self._calls_have_ended():
            return
        try:
            function(stage, *arguments, **options)
        except (ValueError, OSError, NoVideoError) as error:
            stage.frames.say(str(error))
        except ControllerError as error:
            self._give_up_control(error)
        stage.end_old_push()
        if self._in_run:
            stage.live.expect_steps()

    def _calls_have_ended(self) -> bool:
        """Show frames until no controller is being called, and return whether the window is still open.

        The first calls of a new controller may capture CUDA graphs. No other controller may run during a capture.
        """
        window = self._window
        while any(isinstance(each, WorldControl) and each.busy for each in self.stage.controllers.values()):
            if window is not None:
                self._waiting.extend(window.commands())
                self.stage.closed |= not window.is_open() or any(each.function is close for each in self._waiting)
                self._show_when_due(time.perf_counter())
            if self.stage.closed:
                return False
            time.sleep(POLL)
        return True

    def _give_up_control(self, error: ControllerError) -> None:
        stage = self.stage
        print("".join(traceback.format_exception(error.__cause__)), end="", file=sys.stderr, flush=True)
        stage.paused = True
        if stage.mode == "controller":
            stage.select("passive", stage.controller)
        stage.frames.say(f"{error}; the viewer is paused, without a controller")
