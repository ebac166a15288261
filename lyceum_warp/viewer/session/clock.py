"""Run a viewing session: step the worlds at the chosen speed, carry out the window's commands, and send it frames."""

import contextlib
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from lyceum_warp.env import Env
from lyceum_warp.viewer.commands import BETWEEN_CALLS, Command, close
from lyceum_warp.viewer.session.drivers import ControllerError
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
_POLL = 0.005
"""Maximum seconds between two polls of the window's commands."""
_SLEEP = 0.1
"""Seconds between two polls while no page is visible."""
_SWITCH_INTERVAL = 0.0005
"""Seconds until Python lets another thread run. The default of 5 ms would delay the steps while a controller plans."""

Watcher = Callable[[], Sequence[str]]
"""Returns new messages."""


class Session:
    """Show worlds in a window.

    The session steps the worlds at the chosen speed, and handles commands and frames between the steps. A policy acts
    in all worlds. A controller of one world acts in the plant, a single world that does not wait for plans.
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
        self._waiting: deque[Command] = deque()
        self._next_step = self._next_frame = self._next_check = self._last_frame = 0.0

    # the loop

    @torch.no_grad()
    def run(self, window: Window) -> None:
        """Run until the window is closed."""
        now = time.perf_counter()
        self._next_frame = self._next_check = now
        self._next_step = now + self.stage.env.timestep / self.stage.speed
        with contextlib.ExitStack() as ends:  # called in reverse order: the window closes first
            ends.callback(sys.setswitchinterval, sys.getswitchinterval())
            sys.setswitchinterval(_SWITCH_INTERVAL)
            ends.enter_context(self.stage.videos.finishing(print))
            ends.callback(self.stage.close)
            ends.callback(window.close)
            while True:
                self._poll(window)
                if self.stage.closed:
                    return
                try:
                    self._advance()
                    self._show_when_due(window)
                    self._rest()
                except ControllerError as error:
                    self._give_up_control(error)

    def _poll(self, window: Window) -> None:
        stage = self.stage
        self._waiting.extend(window.commands())
        stage.closed |= not window.is_open() or any(each.function is close for each in self._waiting)
        while self._waiting and not (self._waiting[0].function in BETWEEN_CALLS and stage.busy):
            self.obey(self._waiting.popleft())
        now = time.perf_counter()
        if now >= self._next_check:
            self._next_check = now + _CHECK
            for watch in (*self._watchers, stage.videos.completed):
                for message in watch():
                    stage.frames.say(message)

    @property
    def _halted(self) -> bool:
        """Whether no step is due. A waiting command waits for the end of a call, so no further call may begin."""
        return self.stage.paused or self.stage.asleep or bool(self._waiting)

    def _advance(self) -> None:
        """Make the steps that are due, at most until the next frame is due."""
        stage, now = self.stage, time.perf_counter()
        period = stage.env.timestep / stage.speed
        self._next_step = now if self._halted else max(self._next_step, now - max(_LAG, period))
        until = max(now + 0.5 / _FPS, self._next_frame)
        while self._next_step <= now < until and not self._halted:
            if not stage.advance(wait=False):  # the plant waits for its first plan
                self._next_step = now + _POLL
                return
            self._next_step += period
            now = time.perf_counter()

    def _show_when_due(self, window: Window) -> None:
        stage, videos, now = self.stage, self.stage.videos, time.perf_counter()
        if now < self._next_frame or not (videos.due or window.wants_frame):
            return
        self._next_frame = now + _IDLE if stage.paused and not videos.due else max(self._next_frame + 1 / _FPS, now)
        self._last_frame = now
        frame = stage.frame(news=window.wants_frame)
        window.show(frame)
        videos.add(frame)

    def _rest(self) -> None:
        """Wait until the next step, but not longer than until the next poll."""
        until_step = self._next_step - time.perf_counter()
        seconds = _SLEEP if self.stage.asleep else _POLL if self._halted else min(until_step, _POLL)
        if seconds > 0:
            self.stage.rest(seconds)

    # commands

    def obey(self, command: Command) -> None:
        """Carry out a command. If it fails, show the error to the user."""
        self._next_frame = min(self._next_frame, self._last_frame + 1 / _FPS)
        try:
            command.function(self.stage, *command.arguments, **command.options)
        except (ValueError, OSError, NoVideoError) as error:
            self.stage.frames.say(str(error))
        except ControllerError as error:
            self._give_up_control(error)

    def _give_up_control(self, error: ControllerError) -> None:
        stage = self.stage
        print("".join(traceback.format_exception(error.__cause__)), end="", file=sys.stderr, flush=True)
        stage.paused = True
        if stage.mode == "controller":
            stage.select("passive", stage.controller)
        stage.frames.say(f"{error}; the viewer is paused, without a controller")
