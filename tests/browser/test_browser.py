import io
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.viewer.commands import Command, command, perturb, reset, seek, set_backwards, set_mode, set_paused
from lyceum_warp.viewer.protocol import Frame, Status
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.window_process import Window
from lyceum_warp.viz import FreeCamera
from lyceum_warp.viz.page import write_page

pytestmark = pytest.mark.browser

SECONDS = 120.0
"""Time limit for a page, in seconds. Without a GPU, a browser draws only a few frames per second."""
INPUT_SECONDS = 6.0
"""Seconds before a test repeats an input that a busy browser may have lost."""
VIEW = {"width": 1200, "height": 640}  # wide enough for the unfolded panel
FLAGS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--ignore-gpu-blocklist",
)  # fmt: skip

STEPS = 60
LEFT = (24, 92)  # position of the second controller in the panel's list, in pixels
PAUSE = (106, 178)  # position of the pause button in the mode "passive"
SCRUBBER = (20, 316, 282)  # left end, right end and height of the slider
MIDDLE = (600, 300)  # position of the block's centre
CLIPS, SECOND = (58, 178), (24, 240)  # positions of the list of clips before the first step, and of its third entry
CLIP_SLIDER = (20, 330, 205)  # left end, right end and height of the slider below the list

MODEL = """
<mujoco>
  <option timestep="0.02"/>
  <statistic center="0 0 .4" extent="3"/>
  <visual><quality shadowsize="256" offsamples="1"/></visual>
  <worldbody>
    <light pos="0 0 5" dir="0 0 -1" castshadow="false"/>
    <geom type="plane" size="3 3 .1" rgba=".3 .35 .4 1"/>
    <body name="block" pos="0 0 .4">
      <joint name="x" type="slide" axis="1 0 0" damping="4" limited="true" range="-.6 .6"/>
      <geom type="box" size=".4 .4 .4" rgba=".9 .05 .05 1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="4" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@wp.struct
class BlockWorld:
    qpos: Row[float]


@wp.struct
class BlockParams:
    dt: float  # a further parameter would move the buttons that the tests click


@wp.func
def observe_block(s: BlockWorld, p: BlockParams, obs: Row[float]):
    obs[0] = s.qpos[0]


class Block(lw.Task):
    """A red block on a rail, which a browser without a GPU renders quickly."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(MODEL))
    obs = {"x": 1}
    horizon = 100_000
    World, Params, observe = BlockWorld, BlockParams, observe_block


class WatchedWindow(Window):
    """A viewer window that stores the last frame and the commands. Tests can also send commands."""

    def __init__(self, *given: Any) -> None:
        self.last: Frame | None = None
        self.given: list[Command] = []
        self.extra: list[Command] = []
        super().__init__(*given)

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
    def __init__(self, session: Session) -> None:
        self.session, self.window = session, WatchedWindow(session.stage.scene)
        self.thread = threading.Thread(target=session.run, args=(self.window,), daemon=True)
        self.thread.start()
        self.wait(lambda: self.window.last is not None)

    @property
    def status(self) -> Status:
        assert self.window.last is not None
        return self.window.last.status

    def wait(self, condition: Callable[[], Any], page: Page | None = None) -> None:
        deadline = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < deadline and self.thread.is_alive()
            time.sleep(0.02) if page is None else page.wait_for_timeout(20)


class Tab:
    def __init__(self, page: Page, viewer: Viewer, address: str | None = None) -> None:
        self.page, self.viewer = page, viewer
        self.log: list[str] = []
        page.on("console", lambda message: self.log.append(message.text))
        page.on("pageerror", lambda error: self.log.append(f"error: {error}"))
        page.goto(address or viewer.window.address)

    def logs(self, text: str) -> None:
        self.wait(lambda: any(text in line for line in self.log))

    def wait(self, condition: Callable[[], Any]) -> None:
        self.viewer.wait(condition, self.page)

    def loaded(self) -> "Tab":
        self.logs("First remote draw frame applied")
        self.logs("State WebSocket connected")
        self.frames(3)
        return self

    def frames(self, number: int) -> None:
        self.page.evaluate(
            "n => new Promise(done => { const f = () => n-- > 0 ? requestAnimationFrame(f) : done(); f(); })", number
        )

    def repeat(self, act: Callable[[int], None], until: Callable[[], Any]) -> None:
        """Repeat an action until a condition holds.

        Wait after each action, because a second click may undo the first.
        """
        for attempt in range(20):
            act(attempt)
            end = time.monotonic() + INPUT_SECONDS
            while not (done := until()) and time.monotonic() < end:
                self.page.wait_for_timeout(20)
            if done:
                return
        raise AssertionError("the page did not reach the expected state")

    def press(self, keys: str, until: Callable[[], Any]) -> None:
        """Press keys such as "Control+ArrowRight" long enough for the page to notice them."""

        def act(attempt: int) -> None:
            names = keys.split("+")
            for move, each in [*((self.page.keyboard.down, n) for n in names),
                               *((self.page.keyboard.up, n) for n in reversed(names))]:  # fmt: skip
                move(each)
                self.frames(2)

        self.repeat(act, until)

    def click(self, x: float, y: float, times: int = 1) -> None:
        self.page.mouse.move(x, y)
        self.frames(2)
        for _ in range(times):
            self.page.mouse.down()
            self.frames(1)
            self.page.mouse.up()
            self.frames(1)

    def click_near(self, x: float, y: float, until: Callable[[], Any]) -> None:
        """Click near a point of the panel."""
        self.repeat(lambda attempt: self.click(x, y + (0, 0, 20, -20, 0, 40, -40)[attempt % 7]), until)

    def release(self) -> None:
        self.page.mouse.up(button="left")
        self.page.mouse.up(button="right")
        self.page.keyboard.up("Control")
        self.frames(2)

    def place(self) -> float:
        """Return the horizontal position of the red block, from 0 to 1."""
        self.frames(3)
        return red_place(self.page)


def red_place(page: Page) -> float:
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    red, green, blue = picture.transpose(2, 0, 1)
    seen = (red > 60) & (red > 2 * green) & (red > 2 * blue)
    assert 0.01 < seen.mean() < 0.2
    return float(np.nonzero(seen)[1].mean() / seen.shape[1])


def ghost_size(page: Page) -> float:
    """Return the share of the scene that a green ghost covers."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    height, width = picture.shape[:2]
    red, green, blue = picture[height // 8 : height * 3 // 4, width // 3 : width * 2 // 3].transpose(2, 0, 1)
    return float(((green > red + 25) & (green > blue + 25)).mean())


def push(action: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda obs: torch.full((len(obs), 1), action)


@pytest.fixture(scope="module")
def launch() -> Iterator[Callable[[], Browser]]:
    """Start a headless browser."""
    with sync_playwright() as playwright:  # playwright runs an event loop in this thread until it is closed
        candidates = [os.environ.get("LYCEUM_WARP_BROWSER"), playwright.chromium.executable_path]
        candidates += map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable"))
        program = next((found for found in candidates if found and Path(found).exists()), None)
        if program is None:
            pytest.skip("no browser is found: install chromium, or run playwright install chromium")
        yield lambda: playwright.chromium.launch(executable_path=program, args=list(FLAGS))


@pytest.fixture(scope="module")
def browser(launch: Callable[[], Browser]) -> Iterator[Browser]:
    opened = launch()
    yield opened
    opened.close()


def new_context(browser: Browser) -> BrowserContext:
    """Open a browser context without cookies. Its window is small, so that machines without a GPU draw it quickly."""
    return browser.new_context(viewport=VIEW, device_scale_factor=0.25)  # type: ignore[arg-type]


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    opened = new_context(browser)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    """Start a viewer with two worlds, two policies, and an episode in which the block moves to the right."""
    episode = lw.control(lw.make(Block, autoreset=False), lambda state, obs: torch.ones(1), steps=STEPS, seed=0)
    env = lw.make(Block, nworld=2)
    session = Session(env, controllers={"right": push(1.0), "left": push(-1.0)}, episodes={"right": episode}, seed=0)
    opened = Viewer(session)
    yield opened
    opened.window.close()
    opened.thread.join(30)


@pytest.fixture(scope="module")
def shared_tab(viewer: Viewer, browser: Browser) -> Iterator[Tab]:
    context = new_context(browser)
    yield Tab(context.new_page(), viewer).loaded()
    context.close()


@pytest.fixture
def tab(shared_tab: Tab) -> Tab:
    """Return a page that is paused in the mode "passive" at the first step of an episode."""
    viewer = shared_tab.viewer
    shared_tab.release()
    viewer.window.extra += [command(set_paused, True), command(set_mode, "passive"), command(reset, random=False)]
    shared_tab.wait(lambda: viewer.status.mode == "passive" and viewer.status.paused and viewer.status.step == 0)
    return shared_tab


@pytest.mark.long
def test_keys_and_buttons_pause_step_and_choose_a_controller(tab: Tab) -> None:
    viewer = tab.viewer
    before = viewer.session.stage.env.get_state()
    tab.press("Shift+ArrowRight", lambda: viewer.status.step >= 50)
    tab.press("ArrowRight", lambda: viewer.status.step >= 51)
    while step := viewer.status.step:
        tab.press("Shift+ArrowLeft", lambda: viewer.status.step < step)
    assert torch.equal(viewer.session.stage.env.get_state(), before)
    tab.press("Space", lambda: not viewer.status.paused and viewer.status.step > 5)
    tab.press("Space", lambda: viewer.status.paused)
    tab.click_near(*PAUSE, lambda: not viewer.status.paused)
    tab.press("Control+ArrowLeft", lambda: viewer.status.controller == "right")
    tab.click_near(*LEFT, lambda: viewer.status.controller == "left")


@pytest.mark.long
def test_dragging_a_body_pushes_it(tab: Tab) -> None:
    viewer = tab.viewer
    middle = tab.place()
    tab.press("Space", lambda: not viewer.status.paused)

    def drag(attempt: int) -> None:
        tab.release()
        tab.click(*MIDDLE, times=2)  # selects the block
        tab.page.keyboard.down("Control")
        tab.frames(2)
        tab.page.mouse.down(button="right")
        for i in range(1, 11):
            tab.frames(1)
            tab.page.mouse.move(MIDDLE[0] + 15 * i, MIDDLE[1])

    pulls = lambda: [c.arguments[0] for c in viewer.window.given if c.function is perturb]  # noqa: E731
    tab.repeat(drag, lambda: any(pull and pull["refselpos"][0] > 0.3 for pull in pulls()))
    tab.wait(lambda: viewer.session.stage.env.get_obs()[0, 0] > 0.2)
    assert tab.place() > middle + 0.02
    tab.release()
    tab.wait(lambda: not pulls()[-1])


@pytest.mark.long
def test_slider_and_play_button_show_a_saved_episode(tab: Tab) -> None:
    viewer = tab.viewer
    viewer.window.extra += [command(set_mode, "playback"), command(seek, 0), command(set_backwards, False)]
    tab.wait(lambda: viewer.status.mode == "playback")
    left, right, height = SCRUBBER
    start = tab.place()
    tab.click_near((left + right) / 2, height, lambda: STEPS / 3 < viewer.status.step < STEPS * 2 / 3)
    half = tab.place()
    tab.click_near(right, height, lambda: viewer.status.step >= STEPS - 2)
    assert start < half < tab.place()
    tab.press("Control+r", lambda: viewer.status.backwards)
    tab.press("Space", lambda: viewer.status.step < STEPS / 2)


def test_a_saved_page_plays_without_a_server(browser: Browser, tmp_path: Path) -> None:
    env = lw.make(Block, autoreset=False)
    episode = lw.control(env, lambda state, obs: torch.ones(1), steps=STEPS, seed=0)
    file = write_page(env, episode.states, tmp_path / "block.html", camera=FreeCamera(azimuth=90, elevation=-20))
    page = browser.new_page(viewport=VIEW, device_scale_factor=0.25)  # type: ignore[arg-type]
    errors: list[Any] = []
    page.on("pageerror", lambda error: errors.append(error))
    page.goto(f"file://{file}")
    page.get_by_text("pause").click()
    assert page.get_by_text("play").is_visible()
    page.get_by_text("follow").click()
    places = []
    for frame in (0, STEPS):
        page.get_by_label("frame").fill(str(frame))
        page.wait_for_timeout(200)
        places.append(red_place(page))
    assert places[0] < places[1] - 0.02 and not errors
    page.close()


@pytest.mark.long
def test_keys_and_a_gamepad_set_the_command_of_a_walking_robot(context: BrowserContext) -> None:
    context.add_init_script("pad = {axes: [0, 0, 0]}; navigator.getGamepads = () => [null, pad]")
    viewer = Viewer(Session(lw.make("go1_velocity"), seed=0))
    tab = Tab(context.new_page(), viewer).loaded()
    tab.press("Enter", lambda: viewer.status.driven)
    tab.page.keyboard.down("w")
    tab.wait(lambda: viewer.status.command == (1.0, 0.0, 0.0))
    tab.page.keyboard.down("q")
    tab.wait(lambda: viewer.status.command == (1.0, 0.0, 0.5))
    tab.page.keyboard.up("w")
    tab.page.keyboard.up("q")
    tab.wait(lambda: viewer.status.command == (0.0, 0.0, 0.0))
    tab.page.evaluate("dispatchEvent(new Event('gamepadconnected'))")
    for axes, velocity in (([0.0, -1.0, 0.0], (1.0, 0.0, 0.0)), ([1.0, 0.1, 0.5], (0.0, -1.0, -0.25))):
        tab.page.evaluate("axes => pad.axes = axes", axes)
        tab.wait(lambda velocity=velocity: viewer.status.command == velocity)
    tab.press("Enter", lambda: not viewer.status.driven)
    viewer.window.close()
    viewer.thread.join(30)


@pytest.mark.long
def test_clips_are_chosen_and_scrubbed_beside_a_ghost(context: BrowserContext) -> None:
    viewer = Viewer(Session(lw.make("go1_tracking", autoreset=False), seed=0, paused=True))
    tab = Tab(context.new_page(), viewer).loaded()

    def choose(attempt: int) -> None:
        tab.click(*CLIPS)
        tab.click(*SECOND)

    tab.repeat(choose, lambda: viewer.status.clip == (1, 1, 0))
    left, right, height = CLIP_SLIDER
    half = lambda: viewer.status.clip is not None and 80 < viewer.status.clip[2] < 120  # noqa: E731
    tab.click_near((left + right) / 2, height, half)
    tab.frames(3)
    assert ghost_size(tab.page) == 0.0  # the robot is where the reference is
    tab.press("Shift+ArrowRight", lambda: viewer.status.step >= 50)
    tab.frames(3)
    assert ghost_size(tab.page) > 0.005
    viewer.window.close()
    viewer.thread.join(30)
