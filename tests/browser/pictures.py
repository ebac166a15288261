"""The pictures of docs/viewer.md: ``python tests/browser/pictures.py FOLDER RUN``, with a run of hopper.

Needs a browser, as the tests beside it.
"""

import base64
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from pages import FLAGS, SCALE, Tab, Viewer, found_browser
from playwright.sync_api import sync_playwright

import lyceum_warp as lw
from lyceum_warp.viewer.protocol import Command, SetGhosts, SetPaused, SetWorld, StepBy
from lyceum_warp.viewer.session.clock import Session

WIDTH, HEIGHT, QUALITY = 1200, 720, 82

Shot = tuple[str, Session, Sequence[Command], Callable[[Tab], None] | None]


def zoom(steps: int) -> Callable[[Tab], None]:
    """Go further away, or nearer."""

    def act(tab: Tab) -> None:
        tab.page.mouse.move(WIDTH / 2, HEIGHT / 2)
        for _ in range(abs(steps)):
            tab.page.mouse.wheel(0, -100 if steps > 0 else 100)
            tab.frames(2)

    return act


def stop_early(tab: Tab) -> None:
    """Pause soon after the beginning of an episode, while the planner's samples are shown."""
    zoom(-1)(tab)
    tab.wait(lambda: 6 <= tab.viewer.status.step <= 16 and tab.viewer.frame.traces is not None)
    tab.viewer.send(SetPaused(True))


def shots(run: str) -> Iterator[Shot]:
    """Sessions, what they are asked to do, and what a person does on their pages."""
    env = lw.make("hopper", nworld=12)
    session = Session(env, controllers={"policy": lw.load(run)}, seed=1, paused=True)
    yield "controller", session, (StepBy(160), SetWorld("best"), SetGhosts(burst=10, fade=0.9)), zoom(-2)

    env = lw.make("reach", autoreset=False)
    session = Session(env, controllers={"mppi": lw.MPPI("reach", samples=30)}, seed=2)
    yield "planner", session, (), stop_early

    env = lw.make("half_cheetah", autoreset=False)
    episode = lw.control(env, lw.MPPI("half_cheetah"), seed=0, steps=150)
    session = Session(env, episodes={"mppi": episode}, paused=True)
    yield "playback", session, (*[StepBy(1)] * 75, SetGhosts(burst=36, doppler=True)), zoom(3)

    session = Session(lw.make("humanoid", autoreset=False), seed=3, paused=True)
    yield "passive", session, (StepBy(45),), zoom(-2)


def main(folder: Path, run: str, names: Sequence[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        program = found_browser(playwright)
        assert program is not None, "no browser is found"
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        for name, session, commands, act in shots(run):
            if names and name not in names:
                continue
            viewer = Viewer(session)
            viewer.send(*commands)
            # a browser without a GPU does what a person does on a coarse picture, and draws one fine picture
            context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, device_scale_factor=SCALE)
            tab = Tab(context.new_page(), viewer).loaded()
            tab.frames(20)
            if act is not None:
                act(tab)
            devtools = context.new_cdp_session(tab.page)
            tab.page.set_default_timeout(200_000)
            for width in (WIDTH + 1, WIDTH):  # the page looks at the resolution when its size changes
                size = {"width": width, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
                devtools.send("Emulation.setDeviceMetricsOverride", size)
                tab.frames(3)
            picture = devtools.send("Page.captureScreenshot", {"format": "jpeg", "quality": QUALITY})
            (folder / f"viewer-{name}.jpg").write_bytes(base64.b64decode(picture["data"]))
            print(name, viewer.status)
            context.close()
            viewer.close()
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
