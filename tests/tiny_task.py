"""Define the source code of the shortest task. Tests change single lines of it."""

from collections.abc import Iterable
from pathlib import Path

import pytest

import lyceum_warp as lw

TINY = """
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row

@wp.struct
class World:
    qpos: Row[float]

@wp.struct
class Params:
    dt: float

@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]

class Tiny(lw.Task):
    model = "hopper.xml"
    obs = {"x": 1}
"""


def changed(*changes: tuple[str, str]) -> str:
    source = TINY
    for old, new in changes:
        assert old in source, f"{old!r} is not in the text"
        source = source.replace(old, new, 1)
    return source


def function(text: str) -> tuple[str, str]:
    return "class Tiny", f"@wp.func\n{text}\n\nclass Tiny"


def field(text: str) -> tuple[str, str]:
    return "    qpos: Row[float]", f"    qpos: Row[float]\n    {text}"


def attribute(text: str) -> tuple[str, str]:
    return '    obs = {"x": 1}', f'    obs = {{"x": 1}}\n    {text}'


def with_function(text: str) -> str:
    return changed(function(text))


def write(folder: Path, source: str, name: str = "tiny.py") -> Path:
    file = folder / name
    file.write_text(source)
    return file


def check_mistake(folder: Path, changes: Iterable[tuple[str, str]], message: str) -> None:
    """Check that the changed task raises an error with one line, which matches ``message``."""
    with pytest.raises((ValueError, ImportError, FileNotFoundError), match=message) as caught:
        lw.make(write(folder, changed(*changes)))
    assert "\n" not in str(caught.value)
