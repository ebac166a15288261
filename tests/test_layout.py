import ast
import functools
import re
import subprocess
import sys
import textwrap
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import lyceum_warp as lw

ROOT = Path(lw.__file__).parent
TESTS = Path(__file__).parent

LEVELS = {
    "support": -2,
    "mirror": -1, "model_files": -1,
    "done": 0, "options": 0,
    "fields": 1, "kernels": 1, "model_actuators": 1, "model_fields": 1, "task": 1, "walkers": 1,
    "graphs": 2, "spaces": 2, "terms": 2, "terrain": 2,
    "binding": 3, "engines": 3,
    "world_arrays": 4,
    "worlds": 5,
    "env": 6,
    "openloop": 7,
    "curriculum": 7,
    "algos": 8, "controllers": 8, "testing": 8,
    "runs": 9,
    "tuning": 10,
    "viz": 11,
    "training": 12,
    "adapters": 13, "viewer": 13,
    "cli": 14, "gym": 14,
}  # fmt: skip
"""The level of each module or subpackage. A module imports only from lower levels and from itself."""

TESTED_BY = {
    "done": "test_faults.py", "task": "binding", "testing": "conformance",
    "world_arrays": "test_worlds.py",
}  # fmt: skip
"""The tests of modules whose test file or folder has another name."""

ACROSS = {"browser", "conformance", "fuzz", "gpu", "oracles", "stories"}
"""Folders whose tests cover several modules or subpackages."""

NAMEDTUPLE = {"_fields", "_asdict", "_replace", "_make"}
"""Methods of namedtuples, which are public although they begin with an underscore."""


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}


@functools.cache
def trees() -> dict[str, ast.Module]:
    return {name: ast.parse(path.read_text()) for name, path in MODULES.items()}


def room(module: str) -> str:
    return [*module.split("."), "__init__"][1]


def imported_modules(name: str) -> set[str]:
    found = set()
    for node in ast.walk(trees()[name]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in MODULES else str(node.module))
    return {module for module in found if module in MODULES}


@functools.cache
def imports() -> dict[str, set[str]]:
    return {name: imported_modules(name) for name in MODULES}


def test_modules_import_only_from_lower_levels() -> None:
    assert set(LEVELS) == {room(name) for name in MODULES} - {"__init__", "tasks"}
    for name in MODULES:
        if (own := room(name)) in LEVELS:
            upward = {
                other for other in imports()[name] if room(other) != own and LEVELS.get(room(other), 99) >= LEVELS[own]
            }
            assert not upward, f"{name} imports {upward}"
        elif own == "tasks":
            family = {other for other in imports()[name] if other.startswith(f"{name.rpartition('.')[0]}.")}
            public = {"lyceum_warp", "lyceum_warp.terms", "lyceum_warp.models.walkers"}
            assert imports()[name] - family <= public, f"{name} imports more than the public package and its family"


def test_no_module_imports_itself_indirectly() -> None:
    finished: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " imports ".join([*path[path.index(name) :], name])
        if name not in finished:
            # only tasks import the package itself, so it cannot be part of a cycle
            for other in imports()[name] - {"lyceum_warp"}:
                visit(other, (*path, name))
            finished.add(name)

    for name in MODULES:
        visit(name, ())


def test_viewer_window_does_not_import_torch_warp_or_other_subpackages() -> None:
    """The window runs in a subprocess that must start quickly and stay small."""
    window = sorted(name for name in MODULES if name.startswith("lyceum_warp.viewer.window"))
    code = f"import sys, {', '.join(window)}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert not {"torch", "warp"} & set(loaded)
    own = {name for name in loaded if name.partition(".")[0] == "lyceum_warp"}
    assert own == {"lyceum_warp", "lyceum_warp.viewer", "lyceum_warp.viewer.protocol", *window}


def test_viewer_session_imports_nothing_from_the_window() -> None:
    session = [name for name in MODULES if name.startswith("lyceum_warp.viewer.session")]
    imported = {other for name in session for other in imports()[name]}
    assert session and not [name for name in imported if name.startswith("lyceum_warp.viewer.window")]


def test_module_names_are_unique() -> None:
    places = defaultdict(list)
    for name in MODULES:
        places[name.rpartition(".")[2]].append(name)
    assert not {last: names for last, names in places.items() if len(names) > 1 and last != "__main__"}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name not in NAMEDTUPLE


def is_own(node: ast.Attribute) -> bool:
    value = node.value
    if isinstance(value, ast.Call):
        return isinstance(value.func, ast.Name) and value.func.id == "super"
    return isinstance(value, ast.Name) and value.id in ("self", "cls")


def defined_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_own(node):
            yield node.attr


@functools.cache
def private_names() -> dict[str, set[str]]:
    found = defaultdict(set)
    for module, tree in trees().items():
        for defined in filter(is_private, defined_names(tree)):
            found[defined].add(module)
    return found


def test_no_module_uses_private_names_of_another_module() -> None:
    found, private = [], private_names()
    for name, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lyceum_warp"):
                found += [f"{name} imports {alias.name}" for alias in node.names if alias.name.startswith("_")]
            elif isinstance(node, ast.Attribute) and not is_own(node) and (others := private[node.attr] - {name}):
                found.append(f"{name}:{node.lineno}: {ast.unparse(node)}, of {', '.join(sorted(others))}")
    assert not found, "\n".join(found)


UPSTREAM = "lyceum_warp.support.upstream"


def test_private_names_of_other_packages_are_used_only_in_the_upstream_module() -> None:
    own = {name for name, modules in private_names().items() if modules} | NAMEDTUPLE
    pattern = re.compile(r"(?:(?<!\bself)(?<!\bcls)(?<!\bos)\.|import )(_[a-z]\w*)")
    used = {name: set(pattern.findall(ast.unparse(tree))) - own for name, tree in trees().items()}
    assert {name for name, names in used.items() if names} == {UPSTREAM}, used


def test_type_checkers_see_every_public_name() -> None:
    imports = [node for node in ast.parse((ROOT / "__init__.pyi").read_text()).body if isinstance(node, ast.ImportFrom)]
    assert all(alias.asname == alias.name for node in imports for alias in node.names)
    assert {"NPG", "make", "quat_mul"} < set(lw.__all__) == {name for name in lw.__all__ if hasattr(lw, name)}


def in_new_process(program: str) -> str:
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "Warp" not in result.stderr + result.stdout
    return result.stdout


def test_no_submodule_has_the_name_of_a_public_function() -> None:
    """The import of a submodule would hide a function of the same name."""
    assert not {room(name) for name in MODULES} & set(lw.__all__)


def test_importing_the_package_does_not_import_torch_warp_or_mujoco() -> None:
    program = """
        import sys, lyceum_warp
        print([name for name in ("torch", "warp", "mujoco", "numpy") if name in sys.modules])
    """
    assert in_new_process(program) == "[]\n"


@pytest.mark.long
def test_warp_prints_nothing_if_a_task_file_imports_it_first() -> None:
    program = """
        import warp as wp
        import lyceum_warp as lw
        print(lw.make("point_mass", nworld=1).nworld)
    """
    assert in_new_process(program) == "1\n"


def test_every_module_or_subpackage_has_tests_with_the_same_name() -> None:
    for own in {room(name) for name in MODULES} - {"__init__"}:
        places = [TESTS / TESTED_BY[own]] if own in TESTED_BY else [TESTS / own, TESTS / f"test_{own}.py"]
        assert any(place.exists() for place in places), f"no tests of {own}: none of {', '.join(map(str, places))}"


def test_every_folder_of_tests_belongs_to_a_subpackage_or_is_listed() -> None:
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py")} - {"."}
    rooms = {path.parent.relative_to(ROOT).as_posix() for path in MODULES.values()}
    assert folders <= rooms | ACROSS | {"bench"}
    described = (TESTS.parent / "docs" / "architecture.md").read_text()
    assert all(f"`tests/{name}/`" in described for name in ("conformance", "fuzz", "oracles", "stories"))
