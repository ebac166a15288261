import socket

import pytest
from mujoco.studio import launch_web, plugin_registry
from mujoco.studio.web import web_server

from lyceum_warp.viewer.window import studio


def test_viewer_raises_an_error_if_studio_listens_on_every_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a later version of Studio that does not call ``bind_public_socket``."""

    def start(config: object, endpoint: object, plugins: list[object]) -> None:
        plugin_registry.PluginRegistry(plugins).dispatch(studio.Started(viewer=None))

    monkeypatch.setattr(launch_web, "run_web_viewer", start)
    for name in ("bind_public_socket", "bind_loopback_socket"):
        monkeypatch.setattr(web_server, name, getattr(web_server, name))
    with socket.socket() as given, pytest.raises(RuntimeError, match="every address"):
        studio.Screen().run(studio.Plugin(), title="", sock=given)
