import pytest
from mujoco.studio import web_viewer
from mujoco.studio.web import web_server

from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.server import PageServer


def test_viewer_raises_an_error_if_studio_listens_on_every_address(monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulate a later version of studio that does not call ``bind_public_socket``."""
    for name in ("bind_public_socket", "bind_loopback_socket", "serve"):
        monkeypatch.setattr(web_server, name, getattr(web_server, name))
    for name in ("__init__", "close"):
        monkeypatch.setattr(web_viewer.WebViewer, name, lambda *arguments, **options: None)
    with pytest.raises(RuntimeError, match="every address"):
        studio.Screen().run(studio.Plugin(), title="", server=PageServer())
