"""Who may import whom: downwards only, no circle, no two modules of one name."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest

import lyceum_warp as lw

ROOT = Path(lw.__file__).parent
PATHS = sorted(ROOT.rglob("*.py"))

LEVELS = {
    "docstrings": -1, "arrays": 0, "done": 0, "files": 0, "machine": 0, "mujoco_log": 0, "validate": 0, "versions": 0,
    "fields": 1, "kernels": 1, "options": 1, "task": 1,
    "graphs": 2, "spaces": 2,
    "binding": 3, "engines": 3,
    "worlds": 4,
    "env": 5,
    "openloop": 6,
    "algos": 7, "control": 7, "testing": 7,
    "runs": 8,
    "viz": 9,
    "cli": 10,
}  # fmt: skip
"""Every room's floor: a room imports from lower floors, or from itself."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in PATHS}


def room(module: str) -> str:
    return [*module.split("."), "__init__"][1]


def imported_modules(path: Path) -> set[str]:
    """Modules of the package that a file imports anywhere, under TYPE_CHECKING and within functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in MODULES else str(node.module))
    return {name for name in found if name in MODULES}


IMPORTS = {name: imported_modules(path) for name, path in MODULES.items()}


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) not in ("__init__", "tasks")])
def test_imports_point_to_lower_rooms(name: str) -> None:
    own = room(name)
    for other in IMPORTS[name]:
        assert room(other) == own or LEVELS.get(room(other), 99) < LEVELS[own], f"{name} imports {other}"


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) == "tasks"])
def test_a_task_file_imports_only_the_public_package(name: str) -> None:
    assert IMPORTS[name] <= {"lyceum_warp"}


def test_no_module_imports_itself_through_others() -> None:
    finished: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " imports ".join([*path[path.index(name) :], name])
        if name not in finished:
            for other in IMPORTS[name]:
                visit(other, (*path, name))
            finished.add(name)

    for name in MODULES:
        if name != "lyceum_warp":  # the public names: tasks import them, and are imported by name alone
            visit(name, ("lyceum_warp",))


def test_module_names_are_unique() -> None:
    places = defaultdict(list)
    for name in MODULES:
        places[name.rpartition(".")[2]].append(name)
    assert not {last: names for last, names in places.items() if len(names) > 1 and last != "__main__"}


def test_no_room_uses_private_names_of_another_module() -> None:
    for name, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lyceum_warp"):
                private = [alias.name for alias in node.names if alias.name.startswith("_")]
                assert not private, f"{name} imports {private} of {node.module}"


def test_each_public_name_is_there() -> None:
    assert all(hasattr(lw, name) for name in lw.__all__)
