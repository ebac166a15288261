"""Hold the state of a session: mode, controller, worlds and episode."""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from lyceum_warp.algos import Planner
from lyceum_warp.controllers import control
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_kind, whole_number
from lyceum_warp.viewer.protocol import Frame, Mode, Scene, Status
from lyceum_warp.viewer.session.drivers import Control, ControllerError, PolicyControl, WorldControl, controls
from lyceum_warp.viewer.session.driving import Driving
from lyceum_warp.viewer.session.frames import FrameMaker, model_bytes
from lyceum_warp.viewer.session.live import Live
from lyceum_warp.viewer.session.live_settings import planner_numbers, rebuilt_planner, task_numbers
from lyceum_warp.viewer.session.plant import make_plant
from lyceum_warp.viewer.session.playback import Playback, episodes_of
from lyceum_warp.viewer.session.traces import TraceRollouts, Traces, TraceThread
from lyceum_warp.viewer.session.videos import VideoTaker

_OLD = 1.0  # seconds after which traces disappear


class Stage:
    """Holds the worlds, controllers and episodes of a session.

    Policies act in all worlds. A controller of one world, such as a planner, acts in the plant, a copy of the displayed
    world. Meanwhile the other worlds wait.
    """

    def __init__(
        self,
        env: Env,
        controllers: Mapping[str, Any] | None = None,
        *,
        episodes: Any = None,
        seed: int | None = None,
        paused: bool = False,
    ) -> None:
        check_kind("env", env, Env, "as lw.make('hopper') returns it")
        self.env = env
        self.controllers = controls(controllers or {}, env)
        self.playback = Playback([] if episodes is None else episodes_of(episodes, env))
        if seed is not None:
            env.rand_reset(whole_number("seed", seed, low=0))
        self.main = Live(env)
        planned = any(isinstance(each, WorldControl) for each in self.controllers.values())
        self._plant = make_plant(self.main) if planned else None
        self._threads: dict[str, TraceThread] = {}
        self.mode: Mode = "passive"
        self.controller: str | None = None
        self.paused, self.speed = bool(paused), 1.0
        self.dragging = self.closed = False
        self.driving = Driving(env)
        modes: list[Mode] = ["playback"] if self.playback.episodes else []
        modes += ["controller"] if self.controllers else []
        modes.append("passive")
        self.scene = Scene(
            title=env.task.name, model=model_bytes(env.task.model), nworld=env.nworld,
            modes=tuple(modes), controllers=tuple(self.controllers),
            episodes=tuple(episode.name for episode in self.playback.episodes),
            curves=("reward", "eval", *env.metrics), speeds=self.driving.limits,
        )  # fmt: skip
        self.videos = VideoTaker(env.task.model, self.scene.title)
        self.frames = FrameMaker(env, len(self.scene.curves), self.driving)
        self.steps = 0
        self.progress: deque[tuple[float, int]] = deque(maxlen=64)
        self.select(modes[0], next(iter(self.controllers), None))

    @property
    def live(self) -> Live:
        """The plant if the selected controller controls one world, otherwise all worlds."""
        return self._plant if self._plant is not None and isinstance(self.control, WorldControl) else self.main

    @property
    def control(self) -> Control | None:
        """The controller in use."""
        return self.controllers[self.controller] if self.mode == "controller" and self.controller else None

    def close(self) -> None:
        """End the threads."""
        while self._threads:
            self._threads.popitem()[1].close()

    # steps

    def advance(self, steps: int = 1) -> None:
        """Step the worlds or the playback without waiting for real time."""
        for _ in range(steps):
            self.steps += 1
            if self.mode == "playback":
                self.seek_episode(self.playback.next_step)
                continue
            if isinstance(self.control, WorldControl) and not self.live.past.ahead:
                self._step_plant(self.control)
            else:
                self.live.step(self.act)
            self.end_old_push()

    def act(self) -> None:
        """Write the actions of all worlds."""
        if isinstance(self.control, PolicyControl):
            self.control.act()
        else:
            self.live.env.action.zero_()

    def _step_plant(self, current: WorldControl) -> None:
        self.begin_due_episode()
        self.live.expect_steps()
        try:
            control(self.live.env, current.new_run(), steps=1, reset=False)
        except ValueError as error:  # from invalid actions
            raise ControllerError(current.name, error) from error
        self.live.stepped()

    def begin_due_episode(self) -> None:
        """Start a new episode of the plant and its controller if the last episode has ended."""
        if self.live.env.done.item():
            self.reset(random=True)

    def reset(self, *, random: bool) -> None:
        """Start a new episode of the displayed world and its controller."""
        self.live.reset(random=random)
        self.reset_controller()

    def reset_controller(self) -> None:
        """Reset the controller, and drop its traces."""
        if isinstance(current := self.control, WorldControl):
            current.reset()
        if (thread := self._threads.get(str(self.controller))) is not None:
            thread.forget()

    def back(self, steps: int) -> None:
        """Undo steps."""
        done = self.live.back(steps)
        if done < steps:
            self.frames.say(f"the history ends here: it has at most {max(self.live.past.length - 1, 0)} steps")

    def seek_episode(self, step: int) -> None:
        """Show a step of the playback."""
        self.playback.seek(step)
        self.frames.add_point(self.playback)

    def end_old_push(self) -> None:
        """End a push that a restored state contains, unless the user still pushes."""
        live = self.live
        if live.pushed is not None and not self.dragging and not live.past.ahead:
            live.end_push()
        pushed = self.env.state_space.parts["xfrc_applied"] if live.pushed is not None else None
        for each in self.controllers.values():
            if isinstance(each, WorldControl):
                each.hidden = pushed

    # which worlds

    def select(self, mode: Mode, controller: str | None) -> None:
        """Change the mode and the controller. The displayed world keeps its state."""
        before, choice = self.live, (self.mode, self.controller)
        self.mode, self.controller = mode, controller
        if self.live is not before:
            self._transfer(before, self.live)
            before.end_push()
        for thread in self._threads.values():
            thread.forget()
        if choice != (mode, controller):
            self.live.past.drop_ahead()
            self.reset_controller()
            self.progress.clear()
        self._trace()

    def _trace(self) -> None:
        current = self.control
        if isinstance(current, WorldControl) and current.plans and current.name not in self._threads:
            self._threads[current.name] = TraceThread(TraceRollouts(current.controller, self.live.env))

    def set_number(self, owner: str, name: str, value: float) -> None:
        """Change a setting of the planner in use, or a task parameter in all worlds."""
        planners = [each for each in self.controllers.values() if isinstance(each, WorldControl)]
        if owner == "planner":
            if not isinstance(self.control, WorldControl):  # the mode may have changed since the command
                raise ValueError(f"{name} was not changed: no planner is in use")
            planners = [self.control]
            self.control.controller = rebuilt_planner(self.control.controller, name, value)
        else:
            plans = [each.controller.env for each in planners if isinstance(each.controller, Planner)]
            for env in {id(env): env for env in (self.env, self.live.env, *plans)}.values():
                env.set_params(**{name: value})
        for planner in planners:
            if (thread := self._threads.pop(planner.name, None)) is not None:
                thread.close()
        self._trace()

    def show_world(self, world: int) -> None:
        """Show another world. First clear the user's push and command in the displayed world."""
        before = self.live
        before.end_push()
        if self.driving.velocity is not None:
            self.driving.velocity = None
            self.driving.apply(before)
        self.dragging = False
        if before is not self.main:
            self._transfer(before, self.main)
        self.main.world = world
        if before is not self.main:
            self._transfer(self.main, before)
            self.reset_controller()

    def go_on_from(self, state: np.ndarray | torch.Tensor, live: Live, *, new_episode: bool = False) -> None:
        """Set the displayed world's state, and continue its episode from there, even if the episode had ended."""
        state = torch.as_tensor(state).clone()
        state[self.env.state_space.parts["done_reason"]] = 0.0
        live.set_row(state, new_episode=new_episode)

    def _transfer(self, before: Live, after: Live) -> None:
        self.go_on_from(before.env.get_state()[before.world], after)
        if before.pushed == before.world:
            after.pushed = after.world
        after.returns[after.world] = before.returns[before.world].item()

    # frames

    def frame(self, *, news: bool = True) -> Frame:
        """Make a frame of the present state, with all new messages, files and points of curves if ``news`` is true."""
        if self.mode == "playback":
            frame = self.frames.of_playback(self.playback, self._status)
        else:
            frame = self.frames.of_worlds(self.live, self.main, self._traces(), self._status)
            velocity, command, live = self.driving.velocity, frame.status.command, self.live
            if velocity and command and not live.past.ahead and not np.allclose(command, velocity, atol=1e-6):
                self.driving.apply(live)  # a reset or a change of world has replaced the user's command
                live.expect_steps()
        if news:
            files = tuple(str(file.absolute()) for file in self.videos.files)
            self.videos.files.clear()
            frame = dataclasses.replace(frame, files=files, **self.frames.news())
        return frame

    def _traces(self) -> Traces | None:
        """Return the newest traces and request new ones, unless traces are off."""
        thread, current = self._threads.get(str(self.controller)), self.control
        if not self.frames.ghosts.plan or thread is None or not isinstance(current, WorldControl):
            return None
        try:
            traces = thread.follow(current)
        except Exception as error:
            self.frames.say(f"the paths of samples cannot be shown: {error}")
            return None
        return traces if traces and (self.paused or time.perf_counter() - traces.time < _OLD) else None

    def _status(self, **fields: Any) -> Status:
        now = time.perf_counter()
        self.progress.append((now, self.steps))
        start, steps = self.progress[0]
        measured = math.nan
        if not self.paused and now - start > 0.1:
            measured = (self.steps - steps) * self.env.timestep / (now - start)
        return Status(
            mode=self.mode, controller=self.controller if self.mode == "controller" else None,
            episode=self.playback.index if self.mode == "playback" else None, paused=self.paused, speed=self.speed,
            measured_speed=measured, backwards=self.playback.backwards, video=self.videos.name,
            ghosts=self.frames.ghosts, driven=self.driving.velocity is not None,
            planner=planner_numbers(getattr(self.control, "controller", None)), params=task_numbers(self.env),
            plan_ms=1000 * self.control.seconds if self.control else math.nan, **fields,
        )  # fmt: skip
