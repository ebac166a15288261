"""Build the windows of the panel with ImGui."""

import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from lyceum_warp.viewer import commands
from lyceum_warp.viewer.protocol import MAX_POINTS, MOST_BURST, MOST_GHOSTS
from lyceum_warp.viewer.window.actions import ACTIONS, OTHER_KEYS, SPEEDS, Actions
from lyceum_warp.viewer.window.studio import imgui, implot, ux

PLOT_POINTS, PLOT_SECONDS = 200, 20.0
"""A plotted curve covers PLOT_SECONDS seconds with at most PLOT_POINTS points."""
PLOT_PERIOD = 0.2
"""Seconds between two updates of the plots. Each update sends all points to the browser."""
NARROW = 1100
"""Below this width in pixels, the initial windows would cover the robot, for example in a notebook."""
FEW_CURVES = 2
"""The reward and the evaluation, which the viewer plots when it starts."""
WINDOWS = ("messages", "curves", "view", "keys")


class Windows:
    """Builds the windows of the panel."""

    def __init__(self, actions: Actions) -> None:
        self.curves = Curves(len(actions.scene.curves))
        self._actions, self._scene = actions, actions.scene
        self._edited: dict[tuple[str, str], float] = {}
        self._plotted = set(self._scene.curves[:FEW_CURVES])
        self._plot = self.curves.thinned(PLOT_POINTS, PLOT_SECONDS)
        self._next_plot = 0.0
        self._size = (0.0, 0.0)

    def build(self) -> None:
        """Build every open window."""
        size = imgui.GetIO().DisplaySize
        width, height = size.x, size.y
        # panels stay where the user moved them until the browser window is resized
        self._size, resized = (width, height), (width, height) != self._size
        cond = int(imgui.Cond.Always if resized else imgui.Cond.FirstUseEver)
        if resized and width < NARROW:
            self._actions.windows -= {"messages", "curves"}
        tall = min(len(self._plotted) * 138 + 60, height - 50)
        self._window(self._scene.title, (10, 10, 320, height - 20), cond, self._session)
        self._window("messages", (340, height - 110, width - 710, 100), cond, self._messages)
        self._window("curves", (width - 360, 40, 350, tall), cond, self._curves)
        self._window("view", (width - 360, 40, 350, height - 50), cond, self._view)
        self._window("keys", (400, 60, 480, height - 200), cond, self._help)

    def _window(
        self, title: str, place: tuple[float, float, float, float], cond: int, content: Callable[[], None]
    ) -> None:
        """Build a window if it is open. ``place`` is its left edge, top edge, width and height in pixels."""
        left, top, width, height = place
        first = title == self._scene.title
        if not first and title not in self._actions.windows:
            return
        imgui.SetNextWindowPos(imgui.Vec2(max(left, 0), max(top, 0)), cond)
        imgui.SetNextWindowSize(imgui.Vec2(max(width, 200), max(height, 80)), cond)
        unfolded, still_open = imgui.Begin(title, True)
        if unfolded:
            content()
        if first and not still_open:  # studio adds a close button in every window
            imgui.SetWindowCollapsed(True)
        imgui.End()
        if not still_open:
            self._actions.windows.discard(title)

    def _session(self) -> None:
        if self._actions.frame is None:
            imgui.TextDisabled("waiting for the session")
            return
        self._modes()
        self._worlds()
        self._time()
        self._status()
        self._drive()
        self._push()
        self._buttons()
        self._metrics()
        self._numbers()
        self._ghosts()
        self._camera()

    def _modes(self) -> None:
        status, do = self._actions.status, self._actions.do
        for i, mode in enumerate(self._scene.modes):
            if i:
                imgui.SameLine()
            if highlighted_button(mode, mode == status.mode):
                do(commands.set_mode, mode)
        if status.mode == "controller":
            for name in self._scene.controllers:
                if imgui.Selectable(name, name == status.controller):
                    do(commands.set_mode, "controller", controller=name)
        if status.mode == "playback":
            episode = combo("episode", self._scene.episodes, status.episode or 0)
            if episode is not None:
                do(commands.set_mode, "playback", episode=episode)
            changed, backwards = imgui.Checkbox("backwards", status.backwards)
            if changed:
                do(commands.set_backwards, backwards)

    def _worlds(self) -> None:
        if self._scene.nworld == 1:
            return
        imgui.SeparatorText(f"world, of {self._scene.nworld:,}")
        imgui.SetNextItemWidth(90)
        only_enter = int(imgui.InputTextFlags.EnterReturnsTrue)
        entered, world = imgui.InputInt("##world", self._actions.status.world, 0, 0, only_enter)
        if entered:
            self._actions.do(commands.set_world, world)
        choices: tuple[commands.WorldChoice, ...] = ("previous", "next", "best", "worst")
        for label, choice in zip(("\uf053", "\uf054", "best", "worst"), choices, strict=True):
            if choice != "best":
                imgui.SameLine()
            if imgui.Button(label):
                self._actions.do(commands.set_world, choice)

    def _time(self) -> None:
        status = self._actions.status
        imgui.SeparatorText("time")
        for key in ("Backspace", "Shift+Backspace", "Shift+Left", "Left", "Space", "Right", "Shift+Right"):
            self._button(key, "\uf04b" if key == "Space" and status.paused else None)
            imgui.SameLine()
        imgui.NewLine()
        imgui.SetNextItemWidth(90)
        speed = combo("speed", [speed_name(speed) for speed in SPEEDS], SPEEDS.index(status.speed))
        if speed is not None:
            self._actions.do(commands.set_speed, SPEEDS[speed])
        first, last = status.seekable
        if first < last:
            imgui.SetNextItemWidth(-1)
            changed, step = imgui.SliderInt("##scrub", min(max(status.step, first), last), first, last, "step %d")
            if changed:
                self._actions.do(commands.seek, step)

    def _button(self, key: str, icon: str | None = None) -> None:
        """Build the button of an action."""
        action = ACTIONS[key]
        if imgui.Button(icon or action.icon):
            action.act(self._actions)
        imgui.SetItemTooltip(f"{action.what} ({key})")

    def _status(self) -> None:
        status = self._actions.status
        of = f" of {status.steps:,}" if status.steps else ""
        rows = [("step", f"{status.step:,}{of}"), ("time", f"{status.time:.3f} s")]
        if np.isfinite(status.measured_speed):
            rows.append(("speed", f"{status.measured_speed:.2f} of {speed_name(status.speed)}"))
        if np.isfinite(status.plan_ms):
            rows.append(("control", f"{status.plan_ms:.1f} ms"))
        two_columns("##status", [*rows, *self._last_values()[:FEW_CURVES], *status.text])

    def _drive(self) -> None:
        status, speeds = self._actions.status, self._scene.speeds
        if speeds is None or status.command is None:
            return
        imgui.SeparatorText("drive")
        if imgui.Checkbox("with the keys W A S D, Q E (Enter)", status.driven)[0]:
            self._actions.toggle_driving()
        names = ("forward", "left", "turn left")
        sliders = [
            imgui.SliderFloat(name, value, -2 * speed, 2 * speed, "%.2f")
            for name, value, speed in zip(names, status.command, speeds, strict=True)
        ]
        if any(changed for changed, _ in sliders):
            forward, left, turn = (value for _, value in sliders)
            self._actions.do(commands.drive, (forward, left, turn))

    def _numbers(self) -> None:
        """Let the user change the planner's settings and the task's parameters.

        A value is sent when the user has finished editing it.
        """
        numbers = {"planner": self._actions.status.planner, "task": self._actions.status.params}
        owners: tuple[Literal["planner", "task"], ...] = ("planner", "task")
        for owner in owners:
            if not numbers[owner] or not imgui.CollapsingHeader(f"{owner} settings"):
                continue
            imgui.PushItemWidth(110)
            for name, number in numbers[owner]:
                value = self._edited.get((owner, name), number)
                if isinstance(number, int):
                    changed, value = imgui.DragInt(name, int(value), max(0.01 * number, 0.1), 1, 100_000)
                else:
                    changed, value = imgui.DragFloat(name, value, max(abs(number) / 100, 1e-3), 0, 0, "%.4g")
                if changed:
                    self._edited[owner, name] = value
                if imgui.IsItemDeactivatedAfterEdit():
                    self._actions.do(commands.set_number, owner, name, self._edited.pop((owner, name), value))
            imgui.PopItemWidth()

    def _push(self) -> None:
        viewer = self._actions.viewer
        body = viewer.perturb.select
        imgui.SeparatorText(f"push {viewer.model.body(body).name if body > 0 else 'a body'}")
        imgui.TextWrapped("double-click it, then Ctrl + drag with the right button")

    def _metrics(self) -> None:
        if (values := self._last_values()[FEW_CURVES:]) and imgui.CollapsingHeader("metrics"):
            two_columns("##metrics", values)

    def _last_values(self) -> list[tuple[str, str]]:
        rows = self.curves.rows
        values = rows[-1, 2:].tolist() if len(rows) else []
        return [(name, f"{value:.4g}") for name, value in zip(self._scene.curves, values, strict=False)]

    def _ghosts(self) -> None:
        if not imgui.CollapsingHeader("ghosts"):
            return
        ghosts = self._actions.status.ghosts
        imgui.PushItemWidth(150)
        for name, most, what in (
            ("worlds", min(self._scene.nworld - 1, MOST_GHOSTS), "number of other worlds"),
            ("burst", MOST_BURST, "number of states along the trajectory (Ctrl+B)"),
        ):
            if most > 0:
                changed, count = imgui.SliderInt(name, getattr(ghosts, name), 0, most)
                if changed:  # a typed number may be outside the slider's range
                    self._actions.set_ghosts(**{name: min(max(count, 0), most)})
                imgui.SetItemTooltip(what)
        if self._scene.nworld > 1:
            changed, grid = imgui.Checkbox("grid: worlds beside each other", ghosts.grid)
            if changed:  # limit the worlds to the number that a browser can render
                self._actions.set_ghosts(grid=grid, worlds=ghosts.worlds or min(self._scene.nworld - 1, MOST_GHOSTS))
        changed, plan = imgui.Checkbox("plan", ghosts.plan)
        if changed:
            self._actions.set_ghosts(plan=plan)
        imgui.PopItemWidth()

    def _camera(self) -> None:
        if not imgui.CollapsingHeader("camera"):
            return
        imgui.PushItemWidth(190)
        viewer = self._actions.viewer
        ux.camera_selection_gui(viewer.model, viewer.data, viewer.camera, self._actions.cameras.state)
        imgui.PopItemWidth()
        self._button("Ctrl+A")

    def _buttons(self) -> None:
        imgui.SeparatorText("more")
        if self._actions.status.video is None:
            self._button("Ctrl+V")
        elif highlighted_button("\uf03d  end the video", True):
            self._actions.toggle_video()
        imgui.SameLine()
        self._button("Ctrl+P")
        imgui.SameLine()
        if imgui.Button("quit"):
            self._actions.do(commands.close)
        for i, title in enumerate(WINDOWS):
            if i:
                imgui.SameLine()
            if highlighted_button(title, title in self._actions.windows):
                self._actions.windows ^= {title}
        if self._actions.status.video is not None:
            imgui.TextWrapped(self._actions.status.video)

    def _messages(self) -> None:
        for message in self._actions.messages:
            imgui.TextWrapped(message)
        if self._actions.scroll_down:
            imgui.SetScrollHereY(1.0)
            self._actions.scroll_down = False

    def _curves(self) -> None:
        names = self._scene.curves
        if len(names) > 2 and imgui.CollapsingHeader("choose"):
            for name in names:
                if imgui.Checkbox(name, name in self._plotted)[0]:
                    self._plotted ^= {name}
        now = time.monotonic()
        if now >= self._next_plot:
            self._next_plot = now + PLOT_PERIOD
            self._plot = self.curves.thinned(PLOT_POINTS, PLOT_SECONDS)
        low, mean, high = self._plot
        times, ends = mean[:, 0], high[high[:, 1] > 0, 0]
        flags = int(implot.Flags.NoLegend) | int(implot.Flags.NoMenus) | int(implot.Flags.NoBoxSelect)
        flags |= int(implot.Flags.NoTitle)
        fit, skip = int(implot.AxisFlags.AutoFit), int(implot.LineFlags.SkipNaN)
        for i, name in enumerate(names, 2):
            if name in self._plotted and implot.BeginPlot(name, imgui.Vec2(-1, 130), flags):
                implot.SetupAxes("simulated seconds", name, fit, fit)
                bounds = np.array([low[:, i], high[:, i]])
                if np.isfinite(bounds).any():  # the order of the curves determines their colours
                    implot.PlotShaded("range", times, *bounds)
                    implot.PlotLine("mean", times, mean[:, i], skip)
                    for end in ends:
                        implot.PlotLine("end", [end, end], [np.nanmin(bounds), np.nanmax(bounds)])
                implot.EndPlot()
        imgui.TextDisabled("vertical lines: ends of episodes")

    def _view(self) -> None:
        viewer = self._actions.viewer
        model, data, options = viewer.model, viewer.data, viewer.vis_options
        sections: dict[str, Callable[[], object]] = {
            "rendering": lambda: ux.rendering_gui(model, options, viewer.render_flags),
            "visualization": lambda: ux.visualization_gui(model, options, viewer.camera),
            "groups": lambda: ux.groups_gui(model, options),
            "sensors": lambda: ux.sensor_gui(model, data),
            "joints": self._joints,
            "controls": self._controls,
            "watch": lambda: ux.watch_gui(model, data, self._actions.cameras.state),
        }
        for title, build in sections.items():
            if imgui.CollapsingHeader(title):
                build()

    def _controls(self) -> None:
        viewer = self._actions.viewer
        imgui.BeginDisabled()  # a controller determines them
        ux.controls_gui(viewer.model, viewer.data, viewer.vis_options)
        imgui.EndDisabled()

    def _joints(self) -> None:
        viewer, frame = self._actions.viewer, self._actions.frame
        paused = frame is not None and frame.status.paused
        imgui.TextDisabled("drag a joint to move it" if paused else "pause to move joints")
        before = viewer.data.qpos.copy()
        ux.joints_gui(viewer.model, viewer.data, viewer.vis_options)
        if paused and (viewer.data.qpos != before).any():
            forces = np.zeros_like(viewer.data.xfrc_applied)
            self._actions.do(commands.perturb, forces, qpos=viewer.data.qpos.copy())

    def _help(self) -> None:
        two_columns("##keys", [*((key, action.what) for key, action in ACTIONS.items()), *OTHER_KEYS])


# helpers


def highlighted_button(label: str, on: bool) -> bool:
    """Build a button, highlighted if ``on`` is true, and return whether it was pressed."""
    if on:
        imgui.PushStyleColor(int(imgui.Col.Button), imgui.Vec4(0.2, 0.55, 0.9, 1.0))
    pressed = imgui.Button(label)
    if on:
        imgui.PopStyleColor()
    return bool(pressed)


def two_columns(label: str, rows: list[tuple[str, str]]) -> None:
    """Show names and values in two columns."""
    if imgui.BeginTable(label, 2):
        for name, value in rows:
            imgui.TableNextColumn()
            imgui.TextDisabled(name)
            imgui.TableNextColumn()
            imgui.TextWrapped(value)
        imgui.EndTable()


def combo(label: str, names: Any, now: int) -> int | None:
    """Build a list of choices, and return the index of a new choice."""
    changed, index = imgui.Combo(label, now, list(names))
    return int(index) if changed and index != now else None


def speed_name(speed: float) -> str:
    """Format a speed, such as 1/4."""
    return f"1/{1 / speed:g}" if 0 < speed < 1 else f"{speed:g}"


class Curves:
    """Holds the newest points of several curves with common times."""

    def __init__(self, number: int) -> None:
        self.rows = np.empty((0, 2 + number))
        """The points, (points, 2 + number): the time in seconds, whether an episode ended, and a value per curve."""

    def add(self, rows: np.ndarray) -> None:
        """Append points. If time decreases, for example after steps back, drop the points of later times."""
        for part in np.split(rows, np.flatnonzero(np.diff(rows[:, 0]) < 0) + 1):
            if len(part):
                earlier = self.rows[: np.searchsorted(self.rows[:, 0], part[0, 0])]
                self.rows = np.concatenate([earlier, part])[-MAX_POINTS:]

    def thinned(self, points: int, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the minima, means and maxima of the curves, each as at most ``points`` rows.

        Only points of the last ``seconds`` seconds count.
        """
        rows = self.rows[np.searchsorted(self.rows[:, 0], self.rows[-1:, 0].sum() - seconds) :]
        if len(rows) <= points:
            return rows, rows, rows
        edges = np.linspace(0, len(rows), points + 1).astype(int)
        count = np.diff(edges)[:, None]
        low, total, high = (each.reduceat(rows, edges[:-1]) for each in (np.minimum, np.add, np.maximum))
        return low, total / count, high
