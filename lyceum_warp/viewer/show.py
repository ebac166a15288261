"""Show worlds, controllers and episodes in a viewer: ``lw.view``."""

from collections.abc import Mapping, Sequence
from typing import Any

from lyceum_warp.env import Env
from lyceum_warp.viewer.protocol import Scene
from lyceum_warp.viewer.session.clock import Session, Watcher
from lyceum_warp.viewer.session.window_process import NoWindowError, Window


def view(
    env: Env,
    controllers: Mapping[str, Any] | None = None,
    *,
    episodes: Any = None,
    seed: int | None = None,
    paused: bool = False,
    host: str = "127.0.0.1",
    port: int | None = None,
    watchers: Sequence[Watcher] = (),
) -> None:
    """Show worlds, controllers and episodes on a page in a browser, until the user quits.

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
        seed: Seed of a random reset at the start; by default there is no reset.
        paused: Whether to start paused.
        host: Address to serve the page on. The default is the loopback address, which other machines cannot reach.
        port: Port of the page; by default the first free port from 8080.
        watchers: Functions that are called about twice a second and return new messages, a sequence of strings.

    Raises:
        ValueError: An argument is invalid, or the port is in use.
        FileNotFoundError: An episode's file is missing.
        NoWindowError: The window cannot be opened, or ended with an error.
    """
    session = Session(env, controllers, episodes=episodes, seed=seed, paused=paused, watchers=watchers)
    try:
        window = opened(session.stage.scene, host=host, port=port)
        session.run(window)
    finally:
        session.stage.close()
    if window.error is not None:
        raise NoWindowError(f"the viewer's window ended: {window.error}")


def opened(scene: Scene, **place: Any) -> Window:
    """Open a window, and print where its page is. See ``Window``."""
    window = Window(scene, **place)
    for line in window.instructions:
        print(line, flush=True)
    return window
