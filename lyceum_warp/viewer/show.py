"""``lw.view``: a session and its window."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.env import Env
from lyceum_warp.viewer.link import Graphics
from lyceum_warp.viewer.protocol import Scene
from lyceum_warp.viewer.session import Session, Watcher
from lyceum_warp.viewer.window import Window


def has_display() -> bool:
    """Whether a window can be opened on this machine's own screen."""
    if platform.system() == "Linux":
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return not os.environ.get("SSH_CONNECTION")


def chosen_graphics(gfx: str | None) -> Graphics:
    """The kind of window: a page in a browser, unless a native window is asked for.

    Raises:
        ValueError: The word is not known, or there is no display for a native window.
    """
    if gfx is None:
        return "web"
    if gfx not in ("web", "native"):
        raise ValueError(f"gfx must be 'web' or 'native', not {gfx!r}")
    if gfx == "native" and not has_display():
        raise ValueError("there is no display for a native window: use gfx 'web', which serves a page for browsers")
    return gfx  # type: ignore[return-value]


def view(
    env: Env,
    controllers: Mapping[str, Any] | None = None,
    *,
    episodes: Any = None,
    world: int = 0,
    seed: int | None = None,
    paused: bool = False,
    trace: str | None = None,
    fps: float = 30.0,
    title: str | None = None,
    gfx: str | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    browser: bool = False,
    watchers: Sequence[Watcher] = (),
    on_trajectory: Callable[[Trajectory], object] | None = None,
) -> None:
    """Show worlds, controllers and episodes until the window is closed.

    ``lw.view(env)`` shows passive worlds; ``lw.view(env, controllers={"policy": policy, "mppi": plan})`` adds
    controllers to switch between; ``lw.view(env, episodes=[trajectory, "episode-000.npz"])`` adds episodes to play
    back. The panel and its keys choose the mode, the world, the speed, ghosts and the camera.

    The worlds of ``env`` are stepped, and stay in the state in which the window is closed. A policy acts in all of
    them. A controller of one world controls a copy of the world that is shown, in real time as under
    ``lw.control_async``, while the others wait; the shown world goes on where the copy stopped. Where ``env`` is one
    world on the CPU without automatic resets, it is the plant itself.

    Args:
        env: The worlds, on any engine and device.
        controllers: Controllers by their names. One that is called with observations, (nworld, nobs), and returns
            actions, (nworld, nact), is a policy, as ``lw.load`` returns it. One that is called with a state and an
            observation is a controller of one world; see ``lw.Controller``.
        episodes: Episodes to play back: trajectories, their files, or states, (steps + 1, state_space.size), as rows of
            ``env.get_state()``; one, a sequence, or a mapping from names to them.
        world: Number of the world that is shown first.
        seed: Seed of a random reset at the start; by default the worlds stay as they are.
        paused: Whether to start paused.
        trace: Name of the site or body whose path is drawn for a planner's samples; by default ``Task.trace``, or else
            the centre of mass of a robot whose base moves freely, or the end of an arm.
        fps: The most frames per second.
        title: What the window is called; by default the task's name.
        gfx: "web" for a page in a browser, the default; "native" for a window, on a machine with a display.
        host: Address on which the page is served. Other machines reach it only under another one than the default.
        port: Port of the page; by default the first free one from 8080 on.
        browser: Whether to open the page in this machine's browser.
        watchers: Functions that are called about twice a second and return new messages, a sequence of texts.
        on_trajectory: Called with a ``Trajectory`` of what a controller of one world did in real time, after each
            episode and after each command that interrupts one, as ``lambda episode: episode.save("episode.npz")``.

    Raises:
        ValueError: An argument does not fit, or the port is in use; the message says how to fix it.
        FileNotFoundError: An episode's file is missing.
        NoWindowError: The window cannot be opened, or ended because of an error.
    """
    graphics = chosen_graphics(gfx)
    session = Session(
        env, controllers=controllers, episodes=episodes, world=world, seed=seed, paused=paused, trace=trace, fps=fps,
        title=title, watchers=watchers, on_trajectory=on_trajectory,
    )  # fmt: skip
    try:
        window = opened(session.scene, graphics, host=host, port=port, browser=browser)
        session.run(window)
    finally:
        session.close()
    if window.error is not None:
        raise NoWindowError(f"the viewer's window ended: {window.error}")


class NoWindowError(OSError):
    """The window cannot be opened, or ended because of an error. The message holds the reason."""


def opened(scene: Scene, graphics: Graphics, *, host: str, port: int | None, browser: bool) -> Window:
    """Open a window, and print where its page is.

    Raises:
        ValueError: The port is in use, or the address is not one of this machine.
        NoWindowError: The window cannot be opened.
    """
    try:
        window = Window(scene, gfx=graphics, host=host, port=port, browser=browser)
    except RuntimeError as error:
        raise NoWindowError(str(error)) from error
    for line in window.instructions:
        print(line, flush=True)
    return window
