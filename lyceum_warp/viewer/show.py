"""Show worlds, controllers and episodes in a viewer: ``lw.view``."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import Graphics, Scene
from lyceum_warp.viewer.session.clock import Session, Watcher
from lyceum_warp.viewer.session.window_process import NoWindowError, Window


def chosen_graphics(gfx: str | None) -> Graphics:
    """Check the kind of window; None means "web".

    Raises:
        ValueError: ``gfx`` is unknown, or there is no display for a native window.
    """
    if gfx is None or gfx == "web":
        return "web"
    if gfx != "native":
        raise ValueError(f"gfx must be 'web' or 'native', not {gfx!r}")
    displays = map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))
    if not any(displays) if platform.system() == "Linux" else "SSH_CONNECTION" in os.environ:
        raise ValueError("there is no display for a native window: use gfx 'web', which serves a page for browsers")
    return "native"


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

    The viewer steps the worlds of ``env``, and leaves them in their last state. A policy acts in all worlds. A
    controller of one world acts in a copy of the shown world, in real time as with ``lw.control_async``, while the
    other worlds wait; afterwards the shown world takes over the state of the copy. If ``env`` is one world on the CPU
    without automatic resets, no copy is made.

    Args:
        env: The worlds, on any engine and device.
        controllers: Controllers by name. A policy maps observations, (nworld, nobs), to actions, (nworld, nact), as
            ``lw.load`` returns it. A controller of one world is called with a state and an observation; see
            ``lw.Controller``.
        episodes: Episodes to play back: trajectories, files of trajectories, or states, (steps + 1, state_space.size),
            as rows of ``env.get_state()``; one of these, a sequence, or a mapping from names to them.
        world: Index of the world that is shown first.
        seed: Seed of a random reset at the start; by default there is no reset.
        paused: Whether to start paused.
        trace: Name of the site or body whose path is drawn for a planner's samples; by default ``Task.trace``. Without
            either, it is the centre of mass of a robot with an unactuated base, or the end of an arm.
        fps: Maximum number of frames per second.
        title: Title of the window; by default the task's name.
        gfx: "web" (the default) for a page in a browser; "native" for a window, on a machine with a display.
        host: Address to serve the page on. The default is the loopback address, which other machines cannot reach.
        port: Port of the page; by default the first free port from 8080.
        browser: Whether to open the page in a browser on this machine.
        watchers: Functions that are called about twice a second and return new messages, a sequence of strings.
        on_trajectory: Called with a ``Trajectory`` of each real-time run of a controller of one world. A run ends with
            its episode or with a command that interrupts it. Example: ``lambda episode: episode.save("episode.npz")``.

    Raises:
        ValueError: An argument is invalid, or the port is in use.
        FileNotFoundError: An episode's file is missing.
        NoWindowError: The window cannot be opened, or ended with an error.
    """
    graphics = chosen_graphics(gfx)
    session = Session(
        env, controllers=controllers, episodes=episodes, world=world, seed=seed, paused=paused, trace=trace, fps=fps,
        title=title, watchers=watchers, on_trajectory=on_trajectory,
    )  # fmt: skip
    try:
        window = opened(session.stage.scene, graphics, host=host, port=port, browser=browser)
        session.run(window)
    finally:
        session.stage.close()
    if window.error is not None:
        raise NoWindowError(f"the viewer's window ended: {window.error}")


def opened(scene: Scene, graphics: Graphics, **place: Any) -> Window:
    """Open a window, and print where its page is. See ``Window``."""
    window = Window(scene, graphics, **place)
    for line in window.instructions:
        print(line, flush=True)
    return window
