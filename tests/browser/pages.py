"""A browser, viewers that tests open, and what a person does on their pages."""

import io
import os
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, Playwright

from lyceum_warp.viewer.protocol import Command, Frame, Scene, Status
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.window_process import Window

SECONDS = 120.0
"""A page must do within this time what a test waits for: without a GPU it draws a few frames a second."""


INPUT_SECONDS = 6.0
"""A click or a key reaches the session within this time, on a busy machine as well, unless it is lost."""


WIDTH, HEIGHT, SCALE = 1000, 640, 0.25
"""Size of a page, and how much smaller its picture is, so that a browser without a GPU draws it fast enough."""


FLAGS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--ignore-gpu-blocklist",
)  # fmt: skip
PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def found_browser(playwright: Playwright) -> str | None:
    """The program: that of LYCEUM_WARP_BROWSER, playwright's own, or the system's."""
    candidates = [os.environ.get("LYCEUM_WARP_BROWSER"), playwright.chromium.executable_path]
    candidates += [shutil.which(name) for name in PROGRAMS]
    return next((found for found in candidates if found and Path(found).exists()), None)


def new_context(browser: Browser) -> BrowserContext:
    """A browser without cookies."""
    return browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, device_scale_factor=SCALE)


class WatchedWindow(Window):
    """A window that keeps what it showed last and what a person asked for."""

    def __init__(self, scene: Scene) -> None:
        self.last: Frame | None = None
        self.given: list[Command] = []
        self.extra: list[Command] = []
        super().__init__(scene)

    def show(self, frame: Frame) -> None:
        self.last = frame
        super().show(frame)

    def commands(self) -> list[Command]:
        commands = super().commands()
        self.given += commands
        while self.extra:
            commands.append(self.extra.pop(0))
        return commands


class Viewer:
    """A session in a thread, with the process of its window."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.window = WatchedWindow(session.stage.scene)
        self.error: BaseException | None = None
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def run(self) -> None:
        try:
            self.session.run(self.window)
        except BaseException as error:
            self.error = error

    @property
    def frame(self) -> Frame:
        if self.error is not None:
            raise self.error
        self.wait(lambda: self.window.last is not None)
        assert self.window.last is not None
        return self.window.last

    @property
    def status(self) -> Status:
        return self.frame.status

    def wait(self, condition: Callable[[], Any], page: Page | None = None) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < deadline, "the page did not do it in time"
            assert self.error is None, self.error
            if page is None:
                time.sleep(0.02)
            else:
                page.wait_for_timeout(20)

    def send(self, *commands: Command) -> None:
        """Give commands to the session as its window does."""
        self.window.extra += commands

    def close(self) -> None:
        self.window.close()
        self.thread.join(30)
        assert not self.thread.is_alive()


class Tab:
    """A page of a viewer."""

    def __init__(self, page: Page, viewer: Viewer, address: str | None = None) -> None:
        self.page, self.viewer = page, viewer
        self.log: list[str] = []
        page.on("console", lambda message: self.log.append(message.text))
        page.on("pageerror", lambda error: self.log.append(f"error: {error}"))
        page.goto(address or viewer.window.address)

    def logged(self, text: str) -> bool:
        return any(text in line for line in self.log)

    def wait(self, condition: Callable[[], Any]) -> None:
        self.viewer.wait(condition, self.page)

    def loaded(self) -> "Tab":
        """Wait until the scene and the panel are drawn."""
        self.wait(lambda: self.logged("First remote draw frame applied"))
        self.wait(lambda: self.logged("State WebSocket connected"))
        self.frames(3)
        return self

    def frames(self, number: int) -> None:
        """Wait for some frames of the browser."""
        self.page.evaluate(
            "n => new Promise(done => { const f = () => n-- > 0 ? requestAnimationFrame(f) : done(); f(); })", number
        )

    def press(self, keys: str, until: Callable[[], Any] | None = None) -> None:
        """Press keys, such as "Control+ArrowRight", for as long as the page needs to see each of them.

        With ``until``, press them again where this does not hold within seconds: a busy machine may lose a key.
        """
        deadline = time.monotonic() + SECONDS
        while True:
            self._press(keys)
            if until is None or self._soon(until):
                return
            assert time.monotonic() < deadline, f"{keys} did not do it in time"

    def _press(self, keys: str) -> None:
        names = keys.split("+")
        for name in names:
            self.page.keyboard.down(name)
            self.frames(2)
        for name in reversed(names):
            self.page.keyboard.up(name)
            self.frames(2)

    def click(self, x: float, y: float, times: int = 1) -> None:
        """Click; each change must be seen by a frame of the browser."""
        self.page.mouse.move(x, y)
        self.frames(2)
        for _ in range(times):
            self.page.mouse.down()
            self.frames(1)
            self.page.mouse.up()
            self.frames(1)

    def click_near(self, x: float, y: float, condition: Callable[[], Any]) -> None:
        """Click at a place of the panel until a condition holds, then a little above or below it.

        Each click gets seconds, because another one might undo it.
        """
        for shift in (0, 0, 20, -20, 0, 40, -40, 0):
            self.click(x, y + shift)
            if self._soon(condition):
                return
        raise AssertionError("nothing near that place of the panel did it")

    def _soon(self, condition: Callable[[], Any]) -> bool:
        """Whether a condition holds within ``INPUT_SECONDS``."""
        end = time.monotonic() + INPUT_SECONDS
        while not condition():
            if time.monotonic() > end:
                return False
            self.page.wait_for_timeout(20)
        return True

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: Literal["left", "right"]) -> None:
        """Move the mouse with a button held down; it stays down."""
        self.page.mouse.move(*start)
        self.frames(2)
        self.page.mouse.down(button=button)
        self.frames(2)
        for i in range(1, 11):
            self.page.mouse.move(*(a + (b - a) * i / 10 for a, b in zip(start, end, strict=True)))
            self.frames(1)

    def release(self) -> None:
        """Let go of the mouse and of Control."""
        self.page.mouse.up(button="left")
        self.page.mouse.up(button="right")
        self.page.keyboard.up("Control")
        self.frames(2)

    def picture(self) -> np.ndarray:
        """What the page shows, (height, width, 3)."""
        self.frames(3)
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))

    def silhouette(self) -> np.ndarray:
        """Where the page shows something red, (height, width)."""
        red, green, blue = self.picture().astype(int).transpose(2, 0, 1)
        found: np.ndarray = (red > 60) & (red > 2 * green) & (red > 2 * blue)
        return found
