import ast
import functools
import importlib
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

import lyceum_warp as lw

ROOT = Path(lw.__file__).parent

LEVELS = {
    "support": 0,
    "core": 1,
    "graphs": 2, "kernels": 2, "models": 2,
    "engines": 3, "terms": 3, "motions": 3,
    "binding": 4,
    "env": 5,
    "algos": 6, "controllers": 6,
    "viz": 7,
    "training": 8,
    "adapters": 9, "fitting": 9, "testing": 9, "tuning": 9, "viewer": 9,
    "cli": 10, "gym": 10,
}  # fmt: skip
"""The level of each room. A module imports only from lower levels and from its own room."""

APPS = {"adapters", "cli", "fitting", "gym", "testing", "training", "tuning", "viewer", "viz"}
"""Rooms that use the others through the names in their ``__init__.pyi`` only. All rooms may use modules of ``OPEN``."""

OPEN = {"kernels", "support"}


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


@functools.cache
def faces() -> dict[str, dict[str, str]]:
    """The public names of each room, and the modules that define them."""
    names: dict[str, dict[str, str]] = {}
    for path in ROOT.rglob("__init__.pyi"):
        nodes = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom)]
        names[module_name(path)] = {alias.name: str(node.module) for node in nodes for alias in node.names}
    return names


def imported_modules(name: str) -> set[str]:
    modules = set()
    for node in ast.walk(trees()[name]):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} imports relatively"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                source = faces().get(str(node.module), {}).get(alias.name, str(node.module))
                modules.add(whole if whole in MODULES else source)
    return {module for module in modules if module in MODULES}


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
            family = name.rpartition(".")[0]
            nodes = [node for node in ast.walk(trees()[name]) if isinstance(node, ast.Import | ast.ImportFrom)]
            named = {str(getattr(node, "module", node.names[0].name)) for node in nodes}
            ours = {module for module in named if module.startswith("lyceum_warp")}
            foreign = {module for module in ours if not f"{module}.".startswith(f"{family}.")}
            assert foreign <= {"lyceum_warp", "lyceum_warp.terms"}, name


def test_apps_import_only_public_names_of_other_rooms() -> None:
    for name in (name for name in MODULES if room(name) in APPS):
        for node in ast.walk(trees()[name]):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("lyceum_warp."):
                other = room(str(node.module))
                deep = str(node.module).count(".") > 1 and other not in {room(name), "tasks", *OPEN}
                assert not deep, f"{name}:{node.lineno} imports {node.module}: add the name to {other}/__init__.pyi"


def test_every_public_name_exists_and_every_room_has_a_first_sentence() -> None:
    for module, names in faces().items():
        loaded = importlib.import_module(module)
        assert all(hasattr(loaded, name) for name in names), module
    for folder in {path.parent for path in MODULES.values()} - {ROOT / "pretrained"}:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), folder


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
    support = {f"lyceum_warp.support{module}" for module in ("", ".collection", ".docstrings", ".faces")}
    rendering = {"lyceum_warp.viz", "lyceum_warp.viz.render"}
    messages = {"lyceum_warp.viewer.commands", "lyceum_warp.viewer.protocol"}
    assert own == {"lyceum_warp", "lyceum_warp.viewer", *messages, *rendering, *support, *window}


def test_viewer_session_imports_nothing_from_the_window() -> None:
    session = [name for name in MODULES if name.startswith("lyceum_warp.viewer.session")]
    imported = {other for name in session for other in imports()[name]}
    assert session and not [name for name in imported if name.startswith("lyceum_warp.viewer.window")]


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name not in NAMEDTUPLE


def is_own(node: ast.Attribute) -> bool:
    value = node.value
    if isinstance(value, ast.Call):
        return isinstance(value.func, ast.Name) and value.func.id == "super"
    return isinstance(value, ast.Name) and value.id in ("self", "cls", "os")


def defined_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and is_own(node):
            yield node.attr


def used_names(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Attribute) and not is_own(node):
            yield node.attr


UPSTREAM = "lyceum_warp.support.upstream"


def test_private_names_are_used_only_in_the_module_that_defines_them() -> None:
    """Private names of other packages are used only in the upstream module."""
    used = {name: {*filter(is_private, used_names(tree))} - {*defined_names(tree)} for name, tree in trees().items()}
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
    assert {room(name) for name in MODULES} & set(lw.__all__) == {"terms"}


def test_importing_the_package_does_not_import_torch_warp_or_mujoco() -> None:
    program = """
        import sys, lyceum_warp
        print([name for name in ("torch", "warp", "mujoco", "numpy") if name in sys.modules])
    """
    assert in_new_process(program) == "[]\n"


def test_help_lists_and_errors_of_the_command_line_do_not_import_torch_or_warp() -> None:
    program = """
        import contextlib, io, sys
        from lyceum_warp import cli
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            for arguments in (["train", "--help"], ["train", "--help-all"], ["tasks"], ["train", "--itertions", "3"]):
                with contextlib.suppress(SystemExit):
                    cli.main(arguments)
        assert "--learning-rate" in out.getvalue() and "hopper" in out.getvalue() and "--iterations" in err.getvalue()
        print([name for name in ("torch", "warp") if name in sys.modules])
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
