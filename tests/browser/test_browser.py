"""The viewer in a real browser: what a page shows, and what a person does there."""

import contextlib
import http.server
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from block_task import Block
from pages import FLAGS, SECONDS, Tab, Viewer, found_browser, new_context
from PIL import Image
from playwright.sync_api import Browser, BrowserContext, Page, sync_playwright

import lyceum_warp as lw
from lyceum_warp.viewer.protocol import Perturb, Reset, Seek, SetBackwards, SetMode, SetPaused
from lyceum_warp.viewer.session.clock import Session

pytestmark = pytest.mark.browser

STEPS = 60
LEFT = (24, 92)  # the second controller of the panel's list, in pixels
PAUSE = (106, 178)  # its button in the mode "passive"
SCRUBBER = (20, 316, 282)  # left, right and height of its slider
MIDDLE = (500, 300)  # of the block


def push(action: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda obs: torch.full((len(obs), 1), action)


@pytest.fixture(scope="module")
def launch() -> Iterator[Callable[[], Browser]]:
    """Start a browser without a display or a GPU."""
    with sync_playwright() as playwright:  # an event loop runs in this thread until then
        program = found_browser(playwright)
        if program is None:
            pytest.skip("no browser is found: install chromium, or run playwright install chromium")
        yield lambda: playwright.chromium.launch(executable_path=program, args=list(FLAGS))


@pytest.fixture(scope="module")
def browser(launch: Callable[[], Browser]) -> Iterator[Browser]:
    opened = launch()
    yield opened
    opened.close()


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    """A browser without cookies."""
    opened = new_context(browser)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    """Two worlds, two policies and an episode in which the block goes to the right; paused."""
    episode = lw.control(lw.make(Block, autoreset=False), lambda state, obs: torch.ones(1), steps=STEPS, seed=0)
    env = lw.make(Block, nworld=2)
    session = Session(env, controllers={"right": push(1.0), "left": push(-1.0)}, episodes={"right": episode}, seed=0)
    opened = Viewer(session)
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def shared_tab(viewer: Viewer, browser: Browser) -> Iterator[Tab]:
    context = new_context(browser)
    yield Tab(context.new_page(), viewer).loaded()
    context.close()


@pytest.fixture
def tab(shared_tab: Tab) -> Tab:
    """The page, paused in the mode "passive", at the first step of an episode."""
    viewer = shared_tab.viewer
    shared_tab.release()
    viewer.send(SetPaused(True), SetMode("passive"), Reset(random=False))
    shared_tab.wait(lambda: viewer.status.mode == "passive" and viewer.status.paused and viewer.status.step == 0)
    shared_tab.frames(3)
    return shared_tab


def place(silhouette: np.ndarray) -> float:
    """The horizontal middle of what is red, as a part of the page's width."""
    assert silhouette.any()
    return float(np.nonzero(silhouette)[1].mean() / silhouette.shape[1])


# what a page shows


def test_the_page_shows_the_robot(tab: Tab) -> None:
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{43}/", tab.page.url)  # without the token
    assert tab.page.evaluate("document.cookie") == ""
    assert not [line for line in tab.log if line.startswith("error")]
    expected = np.asarray(Image.open(Path(__file__).parent / "block.png")) > 0
    seen = tab.silhouette()
    overlap = (seen & expected).sum() / (seen | expected).sum()
    assert overlap > 0.8


def test_keys_and_buttons_pause_and_go_on(tab: Tab) -> None:
    viewer = tab.viewer
    tab.press("Space", until=lambda: not viewer.status.paused and viewer.status.step > 5)
    tab.press("Space", until=lambda: viewer.status.paused)
    tab.click_near(*PAUSE, lambda: not viewer.status.paused)
    tab.click_near(*PAUSE, lambda: viewer.status.paused)


def test_keys_step_forwards_and_back(tab: Tab) -> None:
    viewer = tab.viewer
    before = viewer.session.stage.env.get_state()
    tab.press("Shift+ArrowRight", until=lambda: viewer.status.step >= 50)
    tab.press("ArrowRight", until=lambda: viewer.status.step >= 51)
    tab.press("ArrowLeft")
    while viewer.status.step:
        step = viewer.status.step
        tab.press("Shift+ArrowLeft", until=lambda: viewer.status.step < step)  # noqa: B023
    assert torch.equal(viewer.session.stage.env.get_state(), before)


def test_controllers_are_switched_and_the_picture_follows(tab: Tab) -> None:
    viewer = tab.viewer
    middle = place(tab.silhouette())
    tab.press(
        "Control+ArrowLeft", until=lambda: viewer.status.mode == "controller" and viewer.status.controller == "right"
    )
    tab.press("Shift+ArrowRight", until=lambda: viewer.status.step >= 50)
    right = place(tab.silhouette())
    assert right > middle + 0.03
    tab.click_near(*LEFT, lambda: viewer.status.controller == "left")
    step = viewer.status.step
    for steps in (50, 100, 150):
        tab.press("Shift+ArrowRight", until=lambda: viewer.status.step >= step + steps)  # noqa: B023
    assert place(tab.silhouette()) < right - 0.03


def test_a_body_is_pushed_by_dragging(tab: Tab) -> None:
    viewer = tab.viewer
    middle = place(tab.silhouette())
    tab.press("Space", until=lambda: not viewer.status.paused)

    def pushed() -> bool:
        return any(isinstance(command, Perturb) and command.forces[1, 0] > 0 for command in viewer.window.given)

    x, y = MIDDLE
    deadline = time.monotonic() + SECONDS
    while not pushed():  # a slow browser may miss one of the clicks
        assert time.monotonic() < deadline
        tab.release()
        tab.click(x, y, times=2)  # choose it
        tab.page.keyboard.down("Control")
        tab.frames(2)
        tab.drag(MIDDLE, (x + 150, y), "right")
    tab.wait(lambda: viewer.session.stage.env.get_obs()[0, 0] > 0.2)
    assert place(tab.silhouette()) > middle + 0.02
    tab.release()
    tab.wait(lambda: not viewer.window.given[-1].forces.any())  # type: ignore[union-attr]


def test_an_episode_is_scrubbed_and_played(tab: Tab) -> None:
    viewer = tab.viewer
    viewer.send(SetMode("playback"), Seek(0), SetBackwards(False))
    tab.wait(lambda: viewer.status.mode == "playback")
    left, right, height = SCRUBBER
    start = place(tab.silhouette())
    tab.click_near((left + right) / 2, height, lambda: STEPS / 3 < viewer.status.step < STEPS * 2 / 3)
    half = place(tab.silhouette())
    tab.click_near(right, height, lambda: viewer.status.step >= STEPS - 2)
    assert start < half < place(tab.silhouette())
    assert any(isinstance(command, Seek) for command in viewer.window.given)
    tab.press("Control+r", until=lambda: viewer.status.backwards)
    tab.press("Space", until=lambda: viewer.status.backwards and viewer.status.step < STEPS / 2)


# tabs and browsers that come and go


def test_two_tabs_show_the_same_and_one_controls(tab: Tab, browser: Browser) -> None:
    viewer = tab.viewer
    context = new_context(browser)
    second = Tab(context.new_page(), viewer)
    second.wait(lambda: second.logged("role=spectator"))
    tab.press("Control+ArrowLeft")
    tab.press("Shift+ArrowRight", until=lambda: viewer.status.step >= 50)
    second.wait(lambda: abs(place(second.silhouette()) - place(tab.silhouette())) < 0.02)
    step = viewer.status.step
    second.press("Shift+ArrowRight")
    second.frames(10)
    assert viewer.status.step == step
    context.close()
    tab.press("Shift+ArrowRight", until=lambda: viewer.status.step > step)


def test_a_closed_tab_leaves_control_to_the_next(viewer: Viewer, browser: Browser, shared_tab: Tab) -> None:
    shared_tab.page.goto("about:blank")
    context = new_context(browser)
    for _ in range(2):
        next_tab = Tab(context.new_page(), viewer).loaded()
        next_tab.wait(lambda tab=next_tab: tab.logged("role=controller"))
        paused = viewer.status.paused
        next_tab.press("Space", until=lambda paused=paused: viewer.status.paused != paused)
        address = next_tab.page.url
        next_tab.page.close()
    again = Tab(context.new_page(), viewer, address)  # the cookie stays
    again.loaded()
    context.close()


def test_a_killed_browser_leaves_the_viewer_running(
    viewer: Viewer, launch: Callable[[], Browser], context: BrowserContext
) -> None:
    victim = launch()
    Tab(victim.new_page(), viewer).loaded()
    session = victim.new_browser_cdp_session()
    processes = [entry["id"] for entry in session.send("SystemInfo.getProcessInfo")["processInfo"]]
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    assert viewer.window.is_open()
    tab = Tab(context.new_page(), viewer).loaded()
    tab.wait(lambda: tab.logged("role=controller"))


# security, as a browser sees it


@contextlib.contextmanager
def other_site(page: str) -> Iterator[str]:
    """Another site's page, at its address."""
    with listening(page) as (address, _):
        yield address


@contextlib.contextmanager
def listening(page: str) -> Iterator[tuple[str, list[str]]]:
    """Another server that serves a page: its address, and the headers of the requests that it gets."""
    received: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            received.append(str(self.headers))
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page.encode())

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_address[1]}/", received
        server.shutdown()


def opens(page: Page, address: str) -> bool:
    """Whether a page may open a WebSocket."""
    script = """address => new Promise(done => {
        const socket = new WebSocket(address);
        socket.onopen = () => { socket.close(); done(true); };
        socket.onerror = () => done(false);
    })"""
    return bool(page.evaluate(script, address))


def test_pages_of_other_sites_cannot_reach_the_viewer(viewer: Viewer, context: BrowserContext) -> None:
    own = context.new_page()
    own.goto(viewer.window.address)
    base = own.url
    sockets = base.replace("http", "ws")
    assert opens(own, f"{sockets}state")
    assert not opens(own, f"{sockets}drop")
    with other_site("<title>other</title>") as address:
        for other in (address, address.replace("localhost", "127.0.0.1")):  # the second one is of the same site
            page = context.new_page()
            page.goto(other)
            assert not opens(page, f"{sockets}state")
            script = "address => fetch(address, {credentials: 'include'}).then(() => true, () => false)"
            assert not page.evaluate(script, f"{base}model")
            script = "address => import(address).then(() => true, () => false)"
            assert not page.evaluate(script, f"{base}web_client.js")


def test_a_server_on_another_port_is_not_sent_the_cookie(viewer: Viewer, context: BrowserContext) -> None:
    """Browsers send cookies to all ports of a host, and other users may listen on this one's."""
    own = context.new_page()
    own.goto(viewer.window.address)
    (cookie,) = context.cookies()
    path = own.url.rpartition("/")[0].rpartition("/")[2]
    secrets = (str(cookie.get("value")), path, viewer.window.address.partition("token=")[2])
    with listening("<title>other</title>") as (address, received):
        page = context.new_page()
        for begin in (address, address.replace("localhost", "127.0.0.1")):
            for end in ("", "model", "ui", "index.html"):
                page.goto(begin + end)
        script = "address => fetch(address, {mode: 'no-cors', credentials: 'include'}).catch(() => 0).then(() => 0)"
        own.evaluate(script, address.replace("localhost", "127.0.0.1") + "model")  # from the viewer's own page
        assert len(received) >= 9
        assert not [secret for secret in secrets if secret in "".join(received)]


def test_a_link_on_another_page_opens_the_viewer(viewer: Viewer, context: BrowserContext) -> None:
    with other_site(f'<a href="{viewer.window.address}">viewer</a>') as address:
        page = context.new_page()
        page.goto(address)
        page.click("a")
        page.wait_for_selector("canvas")
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{43}/", page.url)


def test_a_page_without_the_token_says_what_to_open(viewer: Viewer, context: BrowserContext) -> None:
    page = context.new_page()
    answer = page.goto(viewer.window.address.partition("?")[0])
    assert answer is not None and answer.status == 403
    assert "Open the address that was printed" in page.content()


# the command


def test_ctrl_c_ends_the_command_and_closes_its_port(context: BrowserContext, tmp_path: Path) -> None:
    # a shell's background jobs ignore Ctrl-C
    obey = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{obey}; import lyceum_warp.cli; sys.exit(lyceum_warp.cli.main())"
    command = [sys.executable, "-c", program, "view", "point_mass", "--gfx", "web"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = re.search(r"http://\S+", process.stdout.readline())
        assert address is not None
        assert "ssh -C -N -L" in process.stdout.readline()
        page = context.new_page()
        closed: list[str] = []
        page.on("websocket", lambda opened: opened.on("close", lambda _: closed.append(opened.url)))
        page.goto(address[0])
        with page.expect_event("websocket", lambda opened: "/state" in opened.url, timeout=SECONDS * 1000):
            pass
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=SECONDS)
        assert process.returncode == 130
        assert "Traceback" not in error
        deadline = time.monotonic() + SECONDS
        while not any("/state" in url for url in closed):
            assert time.monotonic() < deadline
            page.wait_for_timeout(50)
        with socket.socket() as client:
            assert client.connect_ex(("127.0.0.1", int(address[0].split(":")[2].partition("/")[0]))) != 0
    finally:
        process.kill()
