"""Build the windows of the panel with ImGui."""

import textwrap
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from lyceum_warp.viewer import commands
from lyceum_warp.viewer.protocol import BEST_COLOUR, MAX_POINTS, MOST_BURST, MOST_GHOSTS, TRACE_COLOUR, Frame, Owner
from lyceum_warp.viewer.window.actions import ACTIONS, HELP, SPEEDS, Actions
from lyceum_warp.viewer.window.studio import imgui, implot, ux

PLOT_POINTS = 120
"""Maximum number of points of a plotted curve."""
SPANS = {"20 s": 20.0, "100 s": 100.0, "all": np.inf}
"""How much of the curves can be shown, in simulated seconds."""
UPDATE_PERIOD = 0.2
"""Seconds between two updates of plots and numbers, because each update is sent to the browser."""
FRESH = 0.5
"""For this many seconds after a command, all numbers are up to date."""
TOAST_SECONDS, TOASTS = 6.0, 3
"""The newest messages are shown for TOAST_SECONDS seconds above the legend."""
NARROW = 1100
"""Below this width in pixels, the initial windows would cover the robot, for example in a notebook."""
SIDE = 330
"""Width of the windows on both sides, in pixels. They have one width, so that the scene's free part is centred."""
HINTS = ("drag: turn", "right drag: move", "wheel: zoom", "double-click, then Ctrl + right drag: push", "F1: keys")
HINT = "   ".join(text.replace(" ", "\u00a0") for text in HINTS)  # lines break between these
_LEGEND_PLACE = int(implot.Location.North)
_OVERLAY = (
    int(imgui.WindowFlags.NoDecoration) | int(imgui.WindowFlags.NoInputs) | int(imgui.WindowFlags.AlwaysAutoResize)
)
_OVERLAY |= int(imgui.WindowFlags.NoSavedSettings) | int(imgui.WindowFlags.NoFocusOnAppearing)
FEW_CURVES = 2
"""The reward and the evaluation, which the viewer plots when it starts."""
WINDOWS = ("messages", "curves", "view", "keys")

Line: TypeAlias = tuple[tuple[float, ...] | None, str]
"""A colour (red, green, blue, opacity) with its meaning."""


class Windows:
    """Builds the windows of the panel."""

    def __init__(self, actions: Actions) -> None:
        self.curves = Curves(len(actions.scene.curves))
        self._actions, self._scene = actions, actions.scene
        self._edited: dict[tuple[Owner, str], float] = {}
        self._plotted = set(self._scene.curves[:FEW_CURVES])
        self.page_rate = np.nan
        """Pictures per second that the page draws."""
        self._span = "20 s"
        self._plot = self.curves.thinned(PLOT_POINTS, SPANS[self._span])
        self._next_update = 0.0
        self._last_values: list[tuple[str, str]] = []
        self._frame: Frame | None = None  # the frame whose numbers are shown
        self._hint = True
        self._first: dict[tuple[Owner, str], float] = {}  # the numbers before the user's changes
        self._size = (0.0, 0.0)

    def build(self) -> None:
        """Build every open window."""
        size = imgui.GetIO().DisplaySize
        width, height = size.x, size.y
        # panels stay where the user moved them until the browser window is resized
        self._size, resized = (width, height), (width, height) != self._size
        cond = int(imgui.Cond.Always if resized else imgui.Cond.FirstUseEver)
        if resized:
            self._actions.cameras.fit(height / (max(width, 1.0) if width < NARROW else width - 2 * SIDE))
            if self._scene.curves:
                windows = self._actions.windows
                (windows.discard if width < NARROW else windows.add)("curves")
        self._update()
        tall = min(len(self._plotted) * 168 + 100, height - 50)
        imgui.SetNextWindowCollapsed(width < NARROW, cond)
        self._window(self._scene.title, (10, 10, SIDE, height - 50), cond, self._session)
        self._window("messages", (SIDE + 20, height - 150, width - 2 * SIDE - 40, 110), cond, self._messages)
        self._window("curves", (width - SIDE - 10, 10, SIDE, tall), cond, self._curves)
        self._window("view", (width - SIDE - 10, 10, SIDE, height - 50), cond, self._view)
        self._window("keys", (SIDE + 20, 60, 480, height - 200), cond, self._help)
        self._overlays(width, height)

    def _update(self) -> None:
        """Choose the frame whose numbers are shown, and the points of the plots."""
        frame, now = self._actions.frame, time.monotonic()
        due = now >= self._next_update
        if due:
            self._next_update = now + UPDATE_PERIOD
            self._plot = self.curves.thinned(PLOT_POINTS, SPANS[self._span])
            rows = self.curves.rows[-1:, 2:]
            self._last_values = [
                (name, f"{value:.4g}") for row in rows for name, value in zip(self._scene.curves, row, strict=True)
            ]
        if due or now < self._actions.acted + FRESH or (frame is not None and frame.status.paused):
            self._frame = frame

    def _overlays(self, width: float, height: float) -> None:
        """Show a first hint, and the newest messages with the legend, in the scene."""
        self._hint &= not (imgui.IsMouseDragging(0) or imgui.IsMouseDragging(1) or "keys" in self._actions.windows)
        room = width - 40 if width < NARROW else width - 2 * SIDE - 40
        if self._hint:
            top, text = (50.0, f"{HINT}   ×: the panel") if width < NARROW else (10.0, HINT)
            self._overlay("hint", (width / 2, top), (0.5, 0.0), room, [(None, text)])
        lines: list[Line] = []
        if "messages" not in self._actions.windows and time.monotonic() < self._actions.said + TOAST_SECONDS:
            lines = [(None, text) for text in list(self._actions.messages)[-TOASTS:]]
        if self._frame is not None:
            lines += legend(self._frame)
        if lines:  # at the lower edge, below the robot
            left = 10.0 if width < NARROW else SIDE + 20.0
            self._overlay("legend", (left, height - 40), (0.0, 1.0), room, lines)

    def _overlay(
        self, title: str, place: tuple[float, float], pivot: tuple[float, float], room: float, lines: list[Line]
    ) -> None:
        """Show lines that the mouse does not notice. ``place`` is the position of the point ``pivot`` of the window."""
        imgui.SetNextWindowPos(imgui.Vec2(*place), int(imgui.Cond.Always), imgui.Vec2(*pivot))
        imgui.SetNextWindowBgAlpha(0.6)
        imgui.Begin(title, None, _OVERLAY)
        for colour, text in lines:
            if colour is not None:
                imgui.ColorButton(f"##{text}", imgui.Vec4(*colour[:3], 1.0), 0, imgui.Vec2(14, 14))
                imgui.SameLine()
            imgui.TextUnformatted(wrapped(text, room - 40))
        imgui.End()

    def _window(
        self, title: str, place: tuple[float, float, float, float], cond: int, content: Callable[[], None]
    ) -> None:
        """Build a window if it is open. ``place`` is its left edge, top edge, width and height in pixels."""
        left, top, width, height = place
        first = title == self._scene.title
        if not first and title not in self._actions.windows:
            return
        page = self._size[0] - 20
        width = min(max(width, 200), page)
        imgui.SetNextWindowPos(imgui.Vec2(max(min(left, page + 10 - width), 0), max(top, 0)), cond)
        imgui.SetNextWindowSize(imgui.Vec2(width, max(height, 80)), cond)
        unfolded, still_open = imgui.Begin(title, True)
        if unfolded:
            content()
        if first and not still_open:  # studio adds a close button in every window
            imgui.SetWindowCollapsed(unfolded)
        imgui.End()
        if not still_open:
            self._actions.windows.discard(title)

    def _session(self) -> None:
        if self._frame is None:
            imgui.TextDisabled("waiting for the session")
            return
        self._modes()
        self._worlds()
        self._time()
        self._clip()
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
        assert self._frame is not None
        first, last = self._frame.status.seekable
        if first < last:
            imgui.SetNextItemWidth(-1)
            step = min(max(self._frame.status.step, first), last)
            changed, step = imgui.SliderInt("##scrub", step, first, last, "step %d")
            if changed:
                self._actions.do(commands.seek, step)

    def _clip(self) -> None:
        assert self._frame is not None
        if (now := self._frame.status.clip) is None:
            return
        start, clip, frame = now
        imgui.SeparatorText("clip")
        imgui.SetNextItemWidth(90)
        chosen = combo("of new episodes", ["any", *map(str, range(len(self._scene.clips)))], start + 1)
        if chosen is not None:
            self._actions.do(commands.show_clip, chosen - 1, *((chosen - 1, 0) if chosen else (clip, frame)))
        imgui.SetNextItemWidth(-1)
        changed, frame = imgui.SliderInt("##clip", frame, 0, self._scene.clips[clip] - 1, f"clip {clip}, frame %d")
        if changed:
            self._actions.do(commands.show_clip, start, clip, frame)

    def _button(self, key: str, icon: str | None = None) -> None:
        """Build the button of an action."""
        action = ACTIONS[key]
        if imgui.Button(icon or action.icon):
            action.act(self._actions)
        imgui.SetItemTooltip(f"{action.what} ({key})")

    def _status(self) -> None:
        assert self._frame is not None
        status = self._frame.status
        of = f" of {status.steps:,}" if status.steps else ""
        measured, rate = status.measured_speed, self.page_rate
        rows = [  # always the same rows, so that the buttons below do not move
            ("step", f"{status.step:,}{of}"),
            ("time", f"{status.time:.3f} s"),
            ("speed", f"{measured:.2f} of {speed_name(status.speed)}" if np.isfinite(measured) else "paused"),
            ("pictures", f"{rate:.1f} per s" if np.isfinite(rate) else ""),
        ]
        if np.isfinite(status.plan_ms):
            rows.append(("control", f"{status.plan_ms:.1f} ms"))
        two_columns("##status", [*rows, *self._last_values[:FEW_CURVES], *status.text])

    def _drive(self) -> None:
        assert self._frame is not None
        status, speeds = self._frame.status, self._scene.speeds
        if speeds is None or status.command is None:
            return
        imgui.SeparatorText("drive")
        if imgui.Checkbox("with W A S D, Q E or a gamepad (Enter)", status.driven)[0]:
            self._actions.toggle_driving()
        names = ("forward, m/s", "left, m/s", "turn left, rad/s")
        sliders = [
            imgui.SliderFloat(name, value, -2 * speed, 2 * speed, "%.2f")
            for name, value, speed in zip(names, status.command, speeds, strict=True)
        ]
        if any(changed for changed, _ in sliders):
            forward, left, turn = (value for _, value in sliders)
            self._actions.do(commands.drive, (forward, left, turn))

    def _numbers(self) -> None:
        """Let the user change the planner's settings, the task's parameters and the world's physics.

        A value is sent when the user has finished editing it.
        """
        status = self._actions.status
        flags: list[str] = []
        groups: tuple[tuple[Owner, str, tuple[tuple[str, float], ...]], ...] = (
            ("planner", "planner settings", status.planner), ("task", "task settings", status.params),
            ("physics", "physics, in multiples of the model", status.physics),
        )  # fmt: skip
        for owner, title, numbers in groups:
            if numbers and imgui.CollapsingHeader(title):
                imgui.PushItemWidth(110)
                for name, number in numbers:
                    self._number(owner, name, number)
                imgui.PopItemWidth()
            for name, number in numbers:
                if number != self._first.setdefault((owner, name), number) and owner != "physics":
                    flags.append(f"--param {name}={number:g}" if owner == "task" else f"--{name} {number:g}")
        if flags and imgui.Button("copy changed numbers as flags"):
            self._actions.tell(f"copy={' '.join(flags)}")

    def _number(self, owner: Owner, name: str, number: float, label: str = "") -> None:
        """Build a slider from 0 to four times the first value. Ctrl+click lets the user type any value."""
        far = 4 * self._first.setdefault((owner, name), number) or 1.0
        value = self._edited.get((owner, name), number)
        if isinstance(number, int):
            changed, value = imgui.SliderInt(label or name, int(value), 1, int(far))
        else:
            changed, value = imgui.SliderFloat(label or name, value, min(far, 0.0), max(far, 0.0), "%.4g")
        if changed:
            self._edited[owner, name] = value
        if imgui.IsItemDeactivatedAfterEdit():
            self._actions.do(commands.set_number, owner, name, self._edited.pop((owner, name), value))

    def _push(self) -> None:
        viewer = self._actions.viewer
        if (body := viewer.perturb.select) > 0:
            imgui.TextDisabled(f"Ctrl + right drag pushes {viewer.model.body(body).name or f'body {body}'}")

    def _metrics(self) -> None:
        if (values := self._last_values[FEW_CURVES:]) and imgui.CollapsingHeader("metrics"):
            two_columns("##metrics", values)

    def _ghosts(self) -> None:
        if not imgui.CollapsingHeader("numbers of ghosts"):
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
        imgui.SeparatorText("show")
        for i, (title, (shown, change)) in enumerate(self._actions.toggles().items()):
            if i:
                imgui.SameLine()
            if highlighted_button(title, shown):
                change()
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
        imgui.SetNextItemWidth(90)
        if (span := combo("shown", SPANS, list(SPANS).index(self._span))) is not None:
            self._span = list(SPANS)[span]
        if len(names) > 2 and imgui.CollapsingHeader("choose"):
            for name in names:
                if imgui.Checkbox(name, name in self._plotted)[0]:
                    self._plotted ^= {name}
        params = dict(self._actions.status.params) if self._frame else {}
        for i, name in enumerate(names, 2):
            if name not in self._plotted:
                continue
            self._curve(name, i)
            if name in params:  # the weight of a term has the term's name
                self._number("task", name, params[name], f"weight##{name}")

    def _curve(self, name: str, column: int) -> None:
        low, mean, high = self._plot
        flags = int(implot.Flags.NoMenus) | int(implot.Flags.NoBoxSelect) | int(implot.Flags.NoTitle)
        if not implot.BeginPlot(name, imgui.Vec2(-1, 160), flags):
            return
        times, ends, bounds = mean[:, 0], high[high[:, 1] > 0, 0], np.array([low[:, column], high[:, column]])
        ahead = self._ahead(times) if name == "reward" else np.empty((0, 2))
        implot.SetupAxes("simulated time (s)", f"{name} per step" if name == "reward" else name)
        implot.SetupLegend(_LEGEND_PLACE, int(implot.LegendFlags.Outside) | int(implot.LegendFlags.Horizontal))
        if np.isfinite(bounds).any():  # the order of the curves determines their colours
            values = np.append(bounds, ahead[:, 1])
            least, most = np.nanmin(values), np.nanmax(values)
            until, margin = max(ahead[:, 0], default=times[-1]), 0.05 * (most - least) + 1e-6
            # limits that the plot fits itself would be sent to the browser twice
            implot.SetupAxesLimits(times[0], until + 1e-6, least - margin, most + margin, int(implot.Cond.Always))
            implot.PlotShaded("range", times, *bounds)
            implot.PlotLine("mean", times, mean[:, column], int(implot.LineFlags.SkipNaN))
            for end in ends:
                implot.PlotLine("end of episode", [end, end], [least, most])
            if len(ahead):
                implot.PlotLine("predicted", ahead[:, 0], ahead[:, 1])
        implot.EndPlot()

    def _ahead(self, times: np.ndarray) -> np.ndarray:
        """Return the times and the rewards that the plan predicts, (points, 2)."""
        if self._frame is None or self._frame.predicted is None or not len(times):
            return np.empty((0, 2))
        return np.add(self._frame.predicted, [times[-1], 0.0])

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
            self._actions.do(commands.perturb, {}, qpos=viewer.data.qpos.copy())

    def _help(self) -> None:
        two_columns("##keys", HELP)


# helpers


def legend(frame: Frame) -> list[Line]:
    """Return a line for each kind of ghost, path and arrow in a frame."""
    lines = {each.what: each.colour for each in frame.ghosts} | {each.what: each.colour for each in frame.arrows}
    if frame.traces is not None:
        lines |= {"path of the best sample": BEST_COLOUR, "paths of other samples": TRACE_COLOUR}
    return [(colour, what) for what, colour in lines.items() if what]


def highlighted_button(label: str, on: bool) -> bool:
    """Build a button, highlighted if ``on`` is true, and return whether it was pressed."""
    if on:
        imgui.PushStyleColor(int(imgui.Col.Button), imgui.Vec4(0.2, 0.55, 0.9, 1.0))
    pressed = imgui.Button(label)
    if on:
        imgui.PopStyleColor()
    return bool(pressed)


def wrapped(text: str, room: float) -> str:
    """Wrap a text to a width in pixels. ImGui would break lines within words."""
    columns = int(len(text) * room / max(imgui.CalcTextSize(text).x, 1.0))
    return textwrap.fill(text, max(columns, 20), break_on_hyphens=False)


def two_columns(label: str, rows: Sequence[tuple[str, str]]) -> None:
    """Show names and values in two columns."""
    if imgui.BeginTable(label, 2):
        for name, value in rows:
            imgui.TableNextColumn()
            imgui.TextDisabled(name)
            imgui.TableNextColumn()
            imgui.TextUnformatted(wrapped(value, imgui.GetContentRegionAvail().x - 20))
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
