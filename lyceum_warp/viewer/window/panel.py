"""The panel beside the scene: buttons, keys, curves, and what the mouse does to bodies."""

import dataclasses
import functools
import re
import textwrap
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.link import Opened, Reply
from lyceum_warp.viewer.protocol import MAX_GHOSTS, Frame, Scene, Status
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.curves import Curves
from lyceum_warp.viewer.window.keys import MANY_STEPS, OTHER_KEYS, key_table
from lyceum_warp.viewer.window.model_values import ModelValues
from lyceum_warp.viewer.window.scene import Drawn, ExtraGeoms
from lyceum_warp.viewer.window.studio import imgui, implot, inputs, ux
from lyceum_warp.viewer.window.view_cameras import ViewCameras

SPEEDS = tuple(2.0**power for power in range(-4, 5))
"""Wanted speeds to choose from, simulated seconds per second."""
PLOT_POINTS = 200
"""Points of a plotted curve. All of them are sent to the browser for each frame."""
MAX_BURST = 50
WINDOWS = ("messages", "curves", "view", "keys")
PLAIN_WITHOUT = (
    mujoco.mjtRndFlag.mjRND_SHADOW,
    mujoco.mjtRndFlag.mjRND_REFLECTION,
    mujoco.mjtRndFlag.mjRND_SKYBOX,
    mujoco.mjtRndFlag.mjRND_HAZE,
    mujoco.mjtRndFlag.mjRND_POST_PROCESSING,
)
SWAP_TIME = 0.5
"""Seconds between two models that are sent to the browser."""


class End(Protocol):
    """The window's end of the connection to the session."""

    def send(self, reply: Reply) -> None:
        """Send to the session."""

    def take(self) -> Frame | None:
        """The latest frame that was not taken yet."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a window of the panel lies, in pixels."""

    x: float
    y: float
    width: float
    height: float
    cond: int
    """When it is put there, as ``ImGuiCond``."""


class Panel(studio.Plugin):  # type: ignore[misc]  # studio has no types
    """Draws frames with studio, and turns what a person does into commands.

    Args:
        scene: What is shown.
        model: The scene's model.
        end: Where frames come from and commands go.
        screen: The viewer that runs this plugin.
        opened: What the session is sent when the window runs.
        limit: Geoms that ghosts and traces may take.

    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        end: End,
        screen: studio.Screen,
        opened: Opened,
        limit: int = studio.MAX_GEOMS,
    ) -> None:
        self.scene, self.end, self.screen, self.opened, self.limit = scene, end, screen, opened, limit
        self.values = ModelValues(model)
        self.geoms = ExtraGeoms(model, limit)
        self.drawn = Drawn([], 0, 0)
        self.curves = Curves(len(scene.curves))
        self.messages: deque[str] = deque(maxlen=200)
        self.frame: Frame | None = None
        self.cameras: ViewCameras
        self.ghosts = protocol.SetGhosts()
        self.ghost_worlds = ""
        self.pushed: protocol.Perturb | None = None
        self.left = False
        self.push_lock = threading.Lock()
        self.windows = {"messages", *(["curves"] if scene.curves else [])}
        self.fold: bool | None = None  # what is due
        self.folded = False
        self.scroll_down = False
        self.slow = SPEEDS[0] * 2
        self.swapped = 0.0
        self.model_due = False
        self.placed = (0.0, 0.0)
        self.keys = key_table()

    # messages of studio

    @studio.handler
    def on_start(self, event: studio.Started) -> None:
        """The window runs."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self.cameras = ViewCameras(self.viewer, self.values)
        self.cameras.reset()
        self.end.send(self.opened)

    @studio.handler
    def on_update(self, event: studio.Update) -> None:
        """Before a frame is drawn: take the session's frame, then keys and the mouse."""
        frame = self.end.take()
        if frame is not None:
            self.take(frame)
        self.refuse_dropped_model()
        if self.frame is None:
            return
        inputs.handle_mouse_events(
            self.viewer.model,
            self.viewer.data,
            self.viewer.camera,
            self.viewer.vis_options,
            self.viewer.perturb,
            self.cameras.state,
            move_camera=self.viewer.client_camera is None,
        )
        self.press_keys()
        self.push_body(self.frame.status.paused)

    @studio.handler
    def on_gui(self, event: studio.Gui) -> None:
        """Build the panel."""
        size = imgui.GetIO().DisplaySize
        width, height = size.x, size.y
        # a browser's window changes its size: the panel follows, and may be moved until then
        self.placed, resized = (width, height), (width, height) != self.placed
        cond = int(imgui.Cond.Always if resized else imgui.Cond.FirstUseEver)
        tall = min(len(self.scene.curves) * 128 + 40, height - 50)
        self.window(self.scene.title, Place(10, 10, 320, height - 20, cond), self.session_window)
        self.window("messages", Place(340, height - 110, width - 710, 100, cond), self.messages_window)
        self.window("curves", Place(width - 360, 40, 350, tall, cond), self.curves_window)
        self.window("view", Place(width - 360, 40, 350, height - 50, cond), self.view_window)
        self.window("keys", Place(400, 60, 480, height - 200, cond), self.help_window)
        self.viewer.camera_index = self.cameras.state.camera_index

    # frames

    def take(self, frame: Frame) -> None:
        """Show a frame."""
        self.frame = frame
        self.show_model(frame)
        model, data = self.viewer.model, self.viewer.data
        if frame.samples is not None:
            self.curves.add(frame.samples)
        if frame.messages:
            self.messages.extend(frame.messages)
            self.scroll_down = True
        # the session reports a state that is not finite as a fault; its last good pose stays
        if np.isfinite(frame.state).all():
            mujoco.mj_setState(model, data, frame.state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(model, data)
        groups = np.array(self.viewer.vis_options.geomgroup)
        self.drawn = self.geoms.draw(frame.pose, frame.ghosts, frame.traces, frame.best, groups)
        self.viewer.extra_geoms[:] = self.drawn.geoms

    def show_model(self, frame: Frame) -> None:
        """Set the world's values in the model that is drawn."""
        if self.values.differ(frame.model_fields):
            if self.values.set(frame.model_fields):
                self.model_due = True
            else:
                self.values.copy_to(self.viewer.model)
        if self.model_due and time.monotonic() > self.swapped + SWAP_TIME:
            self.swapped, self.model_due = time.monotonic(), False
            self.geoms = ExtraGeoms(self.values.model, self.limit)
            self.screen.show_model(self.values.model)

    def refuse_dropped_model(self) -> None:
        """Take a file that was dropped on the page or the window from studio, which only keeps it."""
        dropped = self.viewer.get_drop_file()
        if dropped:
            self.say(f"{Path(dropped).name} was not loaded: this viewer shows {self.scene.title} only")

    def say(self, message: str) -> None:
        """Add a line to the messages."""
        self.messages.append(message)
        self.scroll_down = True

    # what a person does

    def do(self, command: protocol.Command) -> None:
        """Send a command to the session."""
        self.end.send(command)

    @property
    def status(self) -> Status:
        """The session's status; there is one from the first frame on."""
        assert self.frame is not None
        return self.frame.status

    def press_keys(self) -> None:
        """Act on the keys that were pressed."""
        io = imgui.GetIO()
        if io.WantCaptureKeyboard:
            return
        for key in self.keys:
            if key.ctrl == io.KeyCtrl and key.shift == io.KeyShift and imgui.IsKeyPressed(key.code, key.repeat):
                key.action(self)
                return
        flying = self.cameras.state.camera_index == ux.FREE_CAMERA_IDX
        if not io.KeyCtrl:
            inputs.handle_vis_options_keyboard_events(self.viewer.vis_options, flying)
        if flying and self.viewer.client_camera is None:
            _, self.viewer.cam_speed = ux.move_camera_with_keys(
                self.viewer.model, self.viewer.camera, self.viewer.cam_speed
            )

    def push_body(self, paused: bool) -> None:
        """Push the selected body while the mouse drags it; while paused, place it."""
        with self.push_lock:
            self.send_push(paused)

    def let_go(self) -> None:
        """End a push: the person who drags has left. Any thread may call it."""
        with self.push_lock:
            self.left = True  # studio draws nothing without a browser, and does not see that the button was let go
            if self.pushed is not None:
                self.end_push()

    def end_push(self) -> None:
        """Take the force away."""
        assert self.pushed is not None
        forces, self.pushed = np.zeros_like(self.pushed.forces), None
        self.do(protocol.Perturb(forces=forces))

    def send_push(self, paused: bool) -> None:
        """Send what the drag does now, unless the session knows it."""
        model, data, perturb = self.viewer.model, self.viewer.data, self.viewer.perturb
        if self.left:
            self.left = False
            perturb.active = 0
        if perturb.active and perturb.select > 0:
            data.xfrc_applied[:] = 0
            mujoco.mjv_applyPerturbPose(model, data, perturb, int(paused))
            if not paused:
                mujoco.mjv_applyPerturbForce(model, data, perturb)
            moved = bool(model.body_mocapid[model.body_rootid[perturb.select]] >= 0)
            push = protocol.Perturb(
                forces=data.xfrc_applied.copy(),
                qpos=data.qpos.copy() if paused else None,
                mocap_pos=data.mocap_pos.copy() if moved else None,
                mocap_quat=data.mocap_quat.copy() if moved else None,
            )
            if self.pushed is None or not same_push(push, self.pushed):
                self.pushed = push
                self.do(push)
        elif self.pushed is not None:
            self.end_push()

    def change_mode(self, by: int) -> None:
        """Go to the next mode, or to one before."""
        modes = self.scene.modes
        self.do(protocol.SetMode(modes[(modes.index(self.status.mode) + by) % len(modes)]))

    def change_controller(self, by: int) -> None:
        """Go to the next controller, or to one before."""
        names = self.scene.controllers
        if names:
            now = names.index(self.status.controller) if self.status.controller in names else -by
            self.do(protocol.SetController(names[(now + by) % len(names)]))

    def change_shown(self, by: int) -> None:
        """Go to the next world or episode, or to one before."""
        if self.status.mode == "playback":
            if self.scene.episodes:
                self.do(protocol.SetEpisode(((self.status.episode or 0) + by) % len(self.scene.episodes)))
        else:
            self.do(protocol.SetWorld("next" if by > 0 else "previous"))

    def change_speed(self, by: int) -> None:
        """Double the speed, or halve it."""
        now = int(np.argmin(np.abs(np.log2(SPEEDS) - np.log2(max(self.status.speed, 1e-3)))))
        self.do(protocol.SetSpeed(SPEEDS[min(max(now + by, 0), len(SPEEDS) - 1)]))

    def toggle_slow(self) -> None:
        """Change between real time and the slower or faster speed before."""
        if self.status.speed == 1:
            self.do(protocol.SetSpeed(self.slow))
        else:
            self.slow = self.status.speed
            self.do(protocol.SetSpeed(1.0))

    def set_ghosts(self, **changes: Any) -> None:
        """Change which ghosts are drawn."""
        ghosts = dataclasses.replace(self.ghosts, **changes)
        if ghosts != self.ghosts:
            self.ghosts = ghosts
            self.do(ghosts)

    def toggle_burst(self) -> None:
        """Draw many states along the trajectory at once, or only the present one."""
        self.set_ghosts(burst=0 if self.ghosts.burst else MAX_BURST // 2)

    def toggle_video(self) -> None:
        """Begin a video from the camera of the view, or end it."""
        on = self.status.video is None
        self.do(protocol.SetVideo(on, self.cameras.view() if on else None))

    # windows of the panel

    def window(self, title: str, place: Place, content: Callable[[], None]) -> None:
        """Draw a window, unless it is closed. The first one only folds when it is closed."""
        first = title == self.scene.title
        if not first and title not in self.windows:
            return
        imgui.SetNextWindowPos(imgui.Vec2(max(place.x, 0), max(place.y, 0)), place.cond)
        imgui.SetNextWindowSize(imgui.Vec2(max(place.width, 200), max(place.height, 80)), place.cond)
        if first and self.fold is not None:
            imgui.SetNextWindowCollapsed(self.fold)
            self.fold = None
        unfolded, still_open = imgui.Begin(title, True)
        if unfolded:
            content()
        imgui.End()
        if first:
            self.folded = not unfolded
            self.fold = None if still_open else True
        elif not still_open:
            self.windows.discard(title)

    def toggle_fold(self) -> None:
        """Fold the first window, or unfold it."""
        self.fold = not self.folded

    def toggle_window(self, title: str) -> None:
        """Open a window of the panel, or close it."""
        self.windows ^= {title}

    def session_window(self) -> None:
        """Modes, worlds, time and ghosts."""
        if self.frame is None:
            imgui.TextDisabled("waiting for the session")
            return
        self.mode_buttons()
        self.world_chooser()
        self.transport()
        self.status_table()
        self.ghost_options()
        self.camera_chooser()
        self.body_chooser()
        self.buttons_below()

    def mode_buttons(self) -> None:
        """Modes, controllers and episodes."""
        status = self.status
        for i, mode in enumerate(self.scene.modes):
            if i:
                imgui.SameLine()
            if highlighted_button(mode, mode == status.mode):
                self.do(protocol.SetMode(mode))
        if status.mode == "controller":
            for name in self.scene.controllers:
                if imgui.Selectable(name, name == status.controller):
                    self.do(protocol.SetController(name))
        if status.mode == "playback":
            chosen = combo("episode", self.scene.episodes, status.episode or 0)
            if chosen is not None:
                self.do(protocol.SetEpisode(chosen))
            changed, backwards = imgui.Checkbox("backwards", status.backwards)
            if changed:
                self.do(protocol.SetBackwards(backwards))

    def world_chooser(self) -> None:
        """The world that is shown."""
        if self.scene.nworld == 1:
            return
        imgui.SeparatorText(f"world, of {self.scene.nworld:,}")
        imgui.PushItemWidth(90)
        entered, world = imgui.InputInt("##world", self.status.world, 0, 0, int(imgui.InputTextFlags.EnterReturnsTrue))
        imgui.PopItemWidth()
        if entered:
            if 0 <= world < self.scene.nworld:
                self.do(protocol.SetWorld(world))
            else:
                self.say(f"there is no world {world}: choose 0 to {self.scene.nworld - 1}")
        choices: tuple[tuple[str, protocol.WorldChoice], ...] = (
            ("\uf053", "previous"), ("\uf054", "next"), ("best", "best"), ("worst", "worst"),
            ("last ended", "last_ended"),
        )  # fmt: skip
        for i, (label, choice) in enumerate(choices):
            if i != 2:
                imgui.SameLine()
            if imgui.Button(label):
                self.do(protocol.SetWorld(choice))

    def transport(self) -> None:
        """Pause, steps, speed, resets and the scrubber."""
        status = self.status
        imgui.SeparatorText("time")
        buttons: tuple[tuple[str, str, protocol.Command], ...] = (
            ("\uf0e2", "reset", protocol.Reset(random=False)),
            ("\uf074", "random reset", protocol.Reset(random=True)),
            ("\uf04a", f"{MANY_STEPS} steps back", protocol.StepBy(-MANY_STEPS)),
            ("\uf048", "a step back", protocol.StepBy(-1)),
            ("\uf04b" if status.paused else "\uf04c", "go on or pause", protocol.SetPaused(not status.paused)),
            ("\uf051", "a step", protocol.StepBy(1)),
            ("\uf04e", f"{MANY_STEPS} steps", protocol.StepBy(MANY_STEPS)),
        )
        for i, (label, tip, command) in enumerate(buttons):
            if i:
                imgui.SameLine()
            if imgui.Button(label):
                self.do(command)
            imgui.SetItemTooltip(tip)
        now = int(np.argmin(np.abs(np.array(SPEEDS) - status.speed)))
        imgui.PushItemWidth(90)
        chosen = combo("speed", [speed_name(speed) for speed in SPEEDS], now)
        imgui.PopItemWidth()
        if chosen is not None:
            self.do(protocol.SetSpeed(SPEEDS[chosen]))
        first, last = status.seekable
        if first == last and status.mode == "playback":
            first, last = 0, max(status.steps - 1, 0)
        if first < last:
            imgui.PushItemWidth(-1)
            changed, step = imgui.SliderInt("##scrub", min(max(status.step, first), last), first, last, "step %d")
            imgui.PopItemWidth()
            if changed:
                self.do(protocol.Seek(step))

    def status_table(self) -> None:
        """The status as a table."""
        status = self.status
        of = f" of {status.steps:,}" if status.steps else ""
        rows = [("step", f"{status.step:,}{of}"), ("time", f"{status.time:.3f} s")]
        if np.isfinite(status.measured_speed):
            rows.append(("speed", f"{status.measured_speed:.2f}, wanted {speed_name(status.speed)}"))
        if np.isfinite(status.plan_ms):
            rows.append(("control", f"{status.plan_ms:.1f} ms"))
        rows += [(name, f"{value:.4g}") for name, value in self.last_values()]
        rows += status.text
        rows += self.dropped()
        if imgui.BeginTable("##status", 2):
            for name, value in rows:
                imgui.TableNextColumn()
                imgui.TextDisabled(name)
                imgui.TableNextColumn()
                imgui.TextWrapped(value)
            imgui.EndTable()
        values = self.values.differences
        if values and imgui.CollapsingHeader(f"model of this world ({len(values)})"):
            for name, value in values:
                imgui.TextUnformatted(f"{name}  {value}")

    def dropped(self) -> list[tuple[str, str]]:
        """How many ghosts and traces are drawn, where some are left out."""
        frame = self.frame
        if frame is None:
            return []
        counts = (
            ("ghosts", len(frame.ghosts), self.drawn.ghosts),
            ("traces", 0 if frame.traces is None else len(frame.traces), self.drawn.traces),
        )
        why = f"{self.limit:,} shapes at most" if self.limit else "only a browser draws them"
        return [(name, f"{drawn} of {given} drawn: {why}") for name, given, drawn in counts if drawn < given]

    def last_values(self) -> list[tuple[str, float]]:
        """The newest value of each curve."""
        rows = self.curves.rows
        return list(zip(self.scene.curves, rows[-1, 1:].tolist(), strict=True)) if len(rows) else []

    def ghost_options(self) -> None:
        """Which ghosts are drawn."""
        if not imgui.CollapsingHeader("ghosts"):
            return
        ghosts = self.ghosts
        imgui.PushItemWidth(150)
        if self.scene.nworld > 1:
            _, self.ghost_worlds = imgui.InputTextWithHint("worlds", "1 2 5-9", self.ghost_worlds)
            if imgui.IsItemDeactivatedAfterEdit():
                try:
                    self.set_ghosts(worlds=numbers(self.ghost_worlds, self.scene.nworld, MAX_GHOSTS))
                except ValueError as error:
                    self.say(str(error))
        if len(self.scene.episodes) > 1 and imgui.BeginCombo("episodes", f"{len(ghosts.episodes)} chosen"):
            for i, name in enumerate(self.scene.episodes):
                changed, on = imgui.Checkbox(f"{name}##{i}", i in ghosts.episodes)
                if changed:
                    others = set(ghosts.episodes) - {i}
                    if on and len(others) == MAX_GHOSTS:
                        self.say(f"{MAX_GHOSTS} episodes can be drawn at once: leave one out first")
                    else:
                        self.set_ghosts(episodes=tuple(sorted(others | {i} if on else others)))
            imgui.EndCombo()
        changed, burst = imgui.SliderInt("burst", ghosts.burst, 0, MAX_BURST)
        if changed:
            self.set_ghosts(burst=burst)
        imgui.SetItemTooltip("states along the trajectory that are drawn at once (Ctrl+B)")
        changed, fade = imgui.SliderFloat("fade", ghosts.fade, 0.5, 1.0)
        if changed:
            self.set_ghosts(fade=fade)
        changed, doppler = imgui.Checkbox("past red, future blue", ghosts.doppler)
        if changed:
            self.set_ghosts(doppler=doppler)
        changed, plan = imgui.Checkbox("plan", ghosts.plan)
        if changed:
            self.set_ghosts(plan=plan)
        imgui.PopItemWidth()

    def camera_chooser(self) -> None:
        """The camera, and the body that it follows."""
        if not imgui.CollapsingHeader("camera"):
            return
        imgui.PushItemWidth(190)
        indices = self.cameras.indices()
        chosen = combo(
            "camera", [self.cameras.name(i) for i in indices], indices.index(self.cameras.state.camera_index)
        )
        if chosen is not None:
            self.cameras.choose(indices[chosen])
        model, camera = self.values.model, self.viewer.camera
        names = [model.body(i).name or f"body {i}" for i in range(1, model.nbody)]
        tracking = camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING
        body = combo("follows", ["-", *names], int(camera.trackbodyid) if tracking else 0)
        if body == 0:
            self.cameras.choose(ux.TUMBLE_CAMERA_IDX)
        elif body is not None:
            self.cameras.track(body)
        imgui.PopItemWidth()
        if imgui.Button("look at everything"):
            self.cameras.reset()

    def body_chooser(self) -> None:
        """The body that the mouse pushes, for those who cannot double-click it."""
        if not imgui.CollapsingHeader("push a body"):
            return
        model, perturb = self.values.model, self.viewer.perturb
        names = [model.body(i).name or f"body {i}" for i in range(1, model.nbody)]
        imgui.PushItemWidth(190)
        body = combo("body", ["-", *names], max(int(perturb.select), 0))
        imgui.PopItemWidth()
        if body is not None:
            perturb.select, perturb.flexselect, perturb.skinselect = body, -1, -1
            perturb.localpos = model.body_ipos[body]
        imgui.TextDisabled("Ctrl + drag right: push, left: twist")

    def buttons_below(self) -> None:
        """Video, help and the end."""
        imgui.Separator()
        making = self.status.video is not None
        if highlighted_button("\uf03d  end the video" if making else "\uf03d  video", making):
            self.toggle_video()
        imgui.SameLine()
        if imgui.Button("quit"):
            self.do(protocol.Close())
        for i, title in enumerate(WINDOWS):
            if i:
                imgui.SameLine()
            if highlighted_button(title, title in self.windows):
                self.toggle_window(title)
        if self.status.video is not None:
            imgui.TextWrapped(self.status.video)

    def messages_window(self) -> None:
        """Ends of episodes, faults and refusals."""
        columns = int(imgui.GetContentRegionAvail().x / imgui.CalcTextSize("n" * 10).x * 10)
        for message in self.messages:
            imgui.TextUnformatted(wrapped(message, max(columns, 10)))
        if self.scroll_down:
            imgui.SetScrollHereY(1.0)
            self.scroll_down = False

    def curves_window(self) -> None:
        """A plot for each curve."""
        rows = self.curves.thinned(PLOT_POINTS)
        flags = int(implot.Flags.NoLegend) | int(implot.Flags.NoMenus) | int(implot.Flags.NoBoxSelect)
        fit = int(implot.AxisFlags.AutoFit)
        for i, name in enumerate(self.scene.curves):
            if implot.BeginPlot(name, imgui.Vec2(-1, 120), flags):
                implot.SetupAxes("", "", fit, fit)
                implot.PlotLine(name, rows[:, 0], rows[:, i + 1], int(implot.LineFlags.SkipNaN))
                implot.EndPlot()

    def view_window(self) -> None:
        """What studio offers for the drawing."""
        viewer = self.viewer
        if imgui.Button("plain drawing, for slow browsers (F4)"):
            self.draw_plainly()
        if imgui.CollapsingHeader("rendering"):
            ux.rendering_gui(viewer.model, viewer.vis_options, viewer.render_flags)
        if imgui.CollapsingHeader("visualization"):
            ux.visualization_gui(viewer.model, viewer.vis_options, viewer.camera)
        if imgui.CollapsingHeader("groups"):
            ux.groups_gui(viewer.model, viewer.vis_options)
        if imgui.CollapsingHeader("sensors"):
            ux.sensor_gui(viewer.model, viewer.data)

    def draw_plainly(self) -> None:
        """Leave out what a browser without a graphics card draws slowly."""
        flags = list(self.viewer.render_flags.flags)
        for flag in PLAIN_WITHOUT:
            flags[int(flag)] = 0
        self.viewer.render_flags.flags = flags

    def help_window(self) -> None:
        """The keys and what the mouse does."""
        if imgui.BeginTable("##keys", 2):
            for keys, what in [*((key.name, key.what) for key in self.keys), *OTHER_KEYS]:
                imgui.TableNextColumn()
                imgui.TextUnformatted(keys)
                imgui.TableNextColumn()
                imgui.TextWrapped(what)
            imgui.EndTable()


# small parts of the panel


def highlighted_button(label: str, on: bool) -> bool:
    """A button that shows whether it is on."""
    if on:
        imgui.PushStyleColor(int(imgui.Col.Button), imgui.Vec4(0.2, 0.55, 0.9, 1.0))
    pressed = imgui.Button(label)
    if on:
        imgui.PopStyleColor()
    return bool(pressed)


def combo(label: str, names: Any, now: int) -> int | None:
    """A choice of several; the index of the newly chosen one."""
    changed, chosen = imgui.Combo(label, now, list(names))
    return int(chosen) if changed and chosen != now else None


@functools.lru_cache(maxsize=1000)
def wrapped(text: str, columns: int) -> str:
    """Break a text between words. ImGui breaks within words, too."""
    return textwrap.fill(text, columns)


def speed_name(speed: float) -> str:
    """A speed as a person writes it, such as 1/4."""
    return f"1/{1 / speed:g}" if 0 < speed < 1 else f"{speed:g}"


def same_push(one: protocol.Perturb, other: protocol.Perturb) -> bool:
    """Whether two pushes do the same, up to rounding errors."""
    pairs = [(getattr(one, field.name), getattr(other, field.name)) for field in dataclasses.fields(protocol.Perturb)]
    return all(
        a is b or (a is not None and b is not None and a.shape == b.shape and np.allclose(a, b, rtol=0, atol=1e-9))
        for a, b in pairs
    )


def numbers(text: str, below: int, most: int) -> tuple[int, ...]:
    """Read numbers and ranges of worlds, such as "1 2 5-9", each once.

    Args:
        text: What a person wrote.
        below: Number of worlds.
        most: Worlds that may be chosen at once.

    Raises:
        ValueError: if the text has another form, or there is no such world, or too many are chosen.
    """
    chosen: dict[int, None] = {}
    for word in text.replace(",", " ").split():
        found = re.fullmatch(r"(\d+)(?:-(\d+))?", word)
        if found is None:
            raise ValueError(f"{word!r} is not a number or a range: write for example 1 2 5-9")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise ValueError(f"the range {word} is empty: write {last}-{first}")
        if last >= below:
            raise ValueError(f"there is no world {max(first, below)}: choose 0 to {below - 1}")
        if last - first >= most or len(chosen := chosen | dict.fromkeys(range(first, last + 1))) > most:
            raise ValueError(f"too many worlds in {text!r}: {most} can be drawn at once")
    return tuple(chosen)
