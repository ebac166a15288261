"""Show worlds, controllers and episodes in a viewer: ``lw.view``."""

import html
import secrets
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import Any

from lyceum_warp.env import Env
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
    block: bool | None = None,
) -> "BackgroundView | None":
    """Show worlds, controllers and episodes on a page in a browser, until the user quits.

    For example, ``lw.view(env, controllers={"policy": policy, "mppi": plan})`` adds two controllers to switch between,
    and ``lw.view(env, episodes=[trajectory, "episode-000.npz"])`` adds episodes to play back. Without a
    controller, all actions are 0. With the panel and its keys, the user chooses the mode, the world, the speed, ghosts
    and the camera.

    The viewer steps the worlds of ``env`` while its page is visible, and leaves them in their last state. A policy acts
    in all worlds. Any other controller acts in a single world, a copy of the displayed world. The copy runs in real
    time, as in ``lw.control_async``, and all other worlds wait. Afterwards, the displayed world gets the copy's state.
    If ``env`` is one world on the CPU without automatic resets, it is not copied.

    Args:
        env: The worlds, on any engine and device.
        controllers: Controllers by name. A policy, such as the result of ``lw.load``, maps observations (nworld, nobs)
            to actions (nworld, nact). A controller of one world is called with a state and an observation; see
            ``lw.Controller``.
        episodes: One episode, a sequence, or a mapping from names to episodes. An episode is a trajectory, the file of
            a trajectory, or a tensor of states (steps + 1, state_space.size) in the format of ``env.get_state()``.
        seed: The seed of a random reset at the start; by default there is no reset.
        paused: Whether to start paused.
        host: The address on which the page is served. Other machines cannot reach the default, the loopback address.
        port: The port of the page; by default the first free port from 8080.
        watchers: Functions that are called about twice a second, and return a sequence of new messages.
        block: Whether the call returns only when the user quits. If False, a thread steps the worlds. The caller must
            not use them until the view is closed. The default is False in a notebook, and True elsewhere. Notebooks
            show the page and a link to it.

    Returns:
        The running view, or None if the call blocks.

    Raises:
        ValueError: An argument is invalid, or the port is in use.
        FileNotFoundError: An episode's file is missing.
        NoWindowError: The window cannot be opened, or ended with an error.
    """
    session = Session(env, controllers, episodes=episodes, seed=seed, paused=paused, watchers=watchers)
    try:
        window = Window(session.stage.scene, host=host, port=port)
        print(*window.instructions, sep="\n", flush=True)
        if block is False or (block is None and in_notebook()):
            return BackgroundView(session, window)
        session.run(window)
    except BaseException:
        session.stage.close()
        raise
    if window.error is not None:
        raise NoWindowError(f"the viewer's window ended: {window.error}")
    return None


FRAME = """<a id="{name}" href="{address}" target="_blank">viewer of {title}</a><script>
if (navigator.userAgentData && ["localhost", "127.0.0.1"].includes(location.hostname)) {{
  const frame = document.createElement("iframe"), link = document.getElementById("{name}"), page = new URL(link.href);
  page.hostname = location.hostname;
  Object.assign(frame, {{src: page.href, style: "display: block; width: 100%; height: 560px; border: 0"}});
  link.before(frame);
}}
</script>"""
"""The HTML of a notebook's output.

Studio shares memory between threads. In an embedded page, only Chromium-based browsers allow this. These browsers let
studio store data only if the page has the notebook's host name.
"""


class BackgroundView:
    """A view that steps its worlds in a thread. ``lw.view`` returns it if ``block`` is False.

    In a notebook, the output of the cell is the page and a link to it. In Firefox, in Safari, and in a notebook served
    by another machine, the output is only the link.
    """

    def __init__(self, session: Session, window: Window) -> None:
        self.address = window.address
        self._session = session
        self._thread = threading.Thread(target=session.run, args=(window,), name="lyceum_warp view", daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """Whether the view runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End the view, and leave the worlds in their last state."""
        self._session.stage.closed = True
        self._thread.join()

    def _repr_html_(self) -> str:
        title = html.escape(self._session.stage.scene.title)
        if not self.is_open:
            return f"viewer of {title} (closed)"
        return FRAME.format(name=f"viewer-{secrets.token_hex(4)}", address=html.escape(self.address), title=title)


def in_notebook() -> bool:
    """Whether this program is the kernel of a notebook."""
    shell = sys.modules.get("IPython")
    return shell is not None and getattr(shell.get_ipython(), "kernel", None) is not None
