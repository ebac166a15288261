"""Who may import whom: downwards only, and no circle."""

import ast
from pathlib import Path

import pytest

import lyceum_warp as lw

ROOT = Path(lw.__file__).parent

LEVELS = {
    "kernels": 0, "quiet": 0, "validate": 0, "versions": 0,
    "fields": 1,
    "engines": 2, "task": 2, "models": 2,
    "registry": 3, "spaces": 3,
    "bound": 4,
    "warmup": 5, "worlds": 5,
    "env": 6,
    "openloop": 7, "testing": 7,
    "algos": 8,
    "runs": 9,
    "viz": 10,
    "report": 11,
    "cli": 12,
}  # fmt: skip
"""Every room's floor; a room imports from lower floors, or from itself."""


def room(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imported(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("lyceum_warp"):
            rest = node.module.split(".")[1:]
            rooms |= {rest[0]} if rest else {alias.name for alias in node.names}
    return rooms


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_downwards(path: Path) -> None:
    own = room(path)
    if own == "__init__":
        return
    if own == "tasks":
        # a task reads like a user's own: it knows the package's name and what a task may use of it
        rooms = {getattr(getattr(lw, name), "__module__", "lyceum_warp.kernels") for name in used_names(path)}
        assert all(module.split(".")[1] in ("task", "kernels", "models", "registry") for module in rooms), rooms
        return
    upwards = {other for other in imported(path) if other != own and LEVELS[other] >= LEVELS[own]}
    assert not upwards, f"{own} imports {upwards}"


def used_names(path: Path) -> set[str]:
    """What a task uses of the package's public names."""
    names = {"Row"}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lw":
            names.add(node.attr)
    return names - {"Row", "vec10"}


def test_no_file_is_too_long_to_read() -> None:
    long = {str(path): n for path in ROOT.rglob("*.py") if (n := len(path.read_text().splitlines())) > 500}
    assert not long


def test_each_public_name_is_there() -> None:
    assert all(hasattr(lw, name) for name in lw.__all__)
