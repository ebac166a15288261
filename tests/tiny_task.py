"""Define the source code of the shortest task. Tests change single lines of it."""

from pathlib import Path

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


def with_function(function: str) -> str:
    return changed(("class Tiny", f"@wp.func\n{function}\n\nclass Tiny"))


def write(folder: Path, source: str, name: str = "tiny.py") -> Path:
    file = folder / name
    file.write_text(source)
    return file
