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
from lyceum_warp.engines import options_for_plant
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_kind, whole_number
from lyceum_warp.viewer.protocol import Frame, Mode, Owner, Scene, Status
from lyceum_warp.viewer.session import live_settings
from lyceum_warp.viewer.session.drivers import Control, WorldControl, controls_by_name
from lyceum_warp.viewer.session.driving import Driving
from lyceum_warp.viewer.session.frames import FrameMaker, model_bytes
from lyceum_warp.viewer.session.live import PLANT_HISTORY_BYTES, Live
from lyceum_warp.viewer.session.pictures import PictureMaker
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
        self.controllers = controls_by_name(controllers or {}, env)
        self.playback = Playback([] if episodes is None else episodes_of(episodes, env))
        if seed is not None:
            env.rand_reset(whole_number("seed", seed, low=0))
        self.main = Live(env)
        self._plant = make_plant(self.main) if self.world_controls else None
        self._threads: dict[str, TraceThread] = {}
        self.mode: Mode = "passive"
        self.controller: str | None = None
        self.paused, self.speed = bool(paused), 1.0
        self.closed, self.watched = False, True
        self.driving = Driving(env)
        modes: list[Mode] = ["playback"] if self.playback.episodes else []
        modes += ["controller"] if self.controllers else []
        modes.append("passive")
        self.scene = Scene(
            title=env.task.name, model=model_bytes(env.task.model), nworld=env.nworld,
            modes=tuple(modes), controllers=tuple(self.controllers),
            episodes=tuple(episode.name for episode in self.playback.episodes),
            curves=("reward", "eval", *env.metrics), speeds=self.driving.limits,
            sees=bool(env.task.cameras),
            clips=tuple(env.task.params["ranges"][:, 1].tolist()) if "start_clip" in env.task.params else (),
        )  # fmt: skip
        self.videos = VideoTaker(env.task.model, self.scene.title)
        self.frames = FrameMaker(env, len(self.scene.curves), self.driving)
        self.pictures = PictureMaker({camera.group: camera for camera in env.task.cameras})
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

    @property
    def world_controls(self) -> list[WorldControl]:
        """The controllers of one world."""
        return [each for each in self.controllers.values() if isinstance(each, WorldControl)]

    @property
    def busy(self) -> bool:
        """Whether a controller is being called."""
        return any(each.busy for each in self.world_controls)

    def rest(self, seconds: float) -> None:
        """Wait, and meanwhile let the controller plan."""
        if isinstance(self.control, WorldControl):
            self.control.rest(seconds)
        else:
            time.sleep(seconds)

    def close(self) -> None:
        """End the threads."""
        for each in self.world_controls:
            each.close()
        while self._threads:
            self._threads.popitem()[1].close()

    # steps

    def advance(self, steps: int = 1, *, wait: bool = True) -> bool:
        """Step the worlds or the playback. Return whether all steps were made.

        With ``wait``, each step of the plant waits for its plan. Otherwise, the plant waits only for the first plan
        after a reset: until then, no step is made.
        """
        for _ in range(steps):
            if self.mode == "playback":
                self.seek_episode(self.playback.next_step)
            elif self.live.past.ahead or self._act(wait=wait):
                self.live.step()
            else:
                return False
            self.steps += 1
        return True

    def _act(self, *, wait: bool) -> bool:
        """Write the actions of all worlds, or return False if the plant has no plan yet."""
        current = self.control
        if isinstance(current, WorldControl):
            env = self.live.env
            if env.done.item():
                self.reset(random=True)
            action = current.action(self.live.steps, env.get_state()[0], env.obs[0].clone(), wait=wait)
            if action is None:
                return False
            env.action[0] = action
        elif current is not None:
            current.act()
        else:
            self.live.env.action.zero_()
        return True

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

    # which worlds

    def select(self, mode: Mode, controller: str | None) -> None:
        """Change the mode and the controller. The displayed world keeps its state."""
        before, choice = self.live, (self.mode, self.controller)
        self.mode, self.controller = mode, controller
        if self.live is not before:
            self._transfer(before, self.live)
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

    @property
    def asleep(self) -> bool:
        """Whether no page is visible and no video is in progress."""
        return not self.watched and self.videos.name is None

    def set_number(self, owner: Owner, name: str, value: float) -> None:
        """Change a number.

        Args:
            owner: The planner in use, the task (in all worlds), or the physics of the displayed world.
            name: A setting, a parameter, or a model field.
            value: The new value. That of a model field is a multiple of the nominal model's.
        """
        planners = self.world_controls
        if owner == "physics":
            self.live.write(**{name: value * live_settings.nominal_fields(self.env)[name]})
            return
        if owner == "planner":
            if not isinstance(current := self.control, WorldControl):  # the mode may have changed since the command
                raise ValueError(f"{name} was not changed: no planner is in use")
            planners = [current]
            rebuilt = live_settings.rebuilt_planner(current.controller, name, value)
            self.controllers[current.name] = WorldControl(current.name, rebuilt, self.env)
            current.close()
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
        before.pull = {}
        if self.driving.velocity is not None:
            self.driving.velocity = None
            self.driving.apply(before)
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
        after.pull, before.pull = before.pull, {}
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
        if news:
            files = tuple(str(file.absolute()) for file in self.videos.files)
            self.videos.files.clear()
            pictures = self.pictures.due(self._picture)
            frame = dataclasses.replace(frame, files=files, pictures=pictures, **self.frames.news())
        return frame

    def _picture(self, group: str) -> torch.Tensor:
        """Return the picture of a group of observations in the displayed state, (height, width, channels)."""
        if self.mode != "playback":
            return self.live.env.obs_groups[group][self.live.world]
        states = torch.as_tensor(self.playback.state).expand(self.env.nworld, -1).to(self.env.obs.device)
        return self.env.get_obs(states.contiguous(), group=group)[0]

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
            pictures=self.pictures.shown,
            planner=live_settings.planner_numbers(getattr(self.control, "controller", None)),
            params=live_settings.task_numbers(self.env),
            plan_ms=1000 * self.control.seconds if self.control else math.nan, **fields,
        )  # fmt: skip


def make_plant(main: Live) -> Live:
    """Make the plant: a single world on the CPU, where steps do not wait for a planner's GPU."""
    env, plant = main.env, main
    if env.nworld > 1 or env.autoreset or env.device.is_cuda:
        options = options_for_plant(env.options.engine, env.device)
        if options.get("engine", env.engine.name) == "mujoco":
            options["nthread"] = 1
        plant = Live(env.replicate(nworld=1, autoreset=False, **options), limit=PLANT_HISTORY_BYTES)
        main.warm_up()
    plant.warm_up()
    return plant
