import ast
import socket
from pathlib import Path

import mujoco
import pytest
from mujoco.studio import launch_web, plugin_registry
from mujoco.studio.web import web_server

import lyceum_warp
from lyceum_warp.viewer.window import studio

ROOT = Path(lyceum_warp.__file__).parent
NAMES = {"imgui": studio.imgui, "implot": studio.implot, "ux": studio.ux, "inputs": studio.inputs}


def used_names(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node).replace("GetIO()", "IO").partition("(")[0]
            if text.partition(".")[0] in NAMES:
                found.add(text)
    return found


@pytest.mark.parametrize("name", sorted(set().union(*map(used_names, (ROOT / "viewer" / "window").glob("*.py")))))
def test_studio_has_every_name_that_the_window_uses(name: str) -> None:
    module, *attributes = name.split(".")
    thing = NAMES[module]
    for attribute in attributes:
        assert hasattr(thing, attribute), f"mujoco.studio {mujoco.__version__} has no {name} any more"
        thing = getattr(thing, attribute)


def test_screen_does_not_listen_on_a_public_socket_of_studio(monkeypatch: pytest.MonkeyPatch) -> None:
    """The test simulates a later version of Studio that does not call bind_public_socket."""

    def start(config: object, endpoint: object, plugins: list[object]) -> None:
        plugin_registry.PluginRegistry(plugins).dispatch(studio.Started(viewer=None))

    monkeypatch.setattr(launch_web, "run_web_viewer", start)
    for name in ("bind_public_socket", "bind_loopback_socket"):
        monkeypatch.setattr(web_server, name, getattr(web_server, name))
    with socket.socket() as given, pytest.raises(RuntimeError, match="every address"):
        studio.Screen().run(studio.Plugin(), title="", sock=given)
