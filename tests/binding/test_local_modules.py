import sys
from pathlib import Path

import pytest
import tiny_task

from lyceum_warp.binding import find_task
from lyceum_warp.binding.local_modules import local_modules


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def test_modules_are_found_through_imports_without_running_them(tmp_path: Path) -> None:
    write(tmp_path, {
        "task.py": "import json, numpy.linalg\nfrom aaa_first import one\ndef later():\n    import aaa_pkg.deep.leaf\n",
        "aaa_first.py": "import aaa_second as other, task\n1 / 0\n",
        "aaa_second.py": "from aaa_pkg import tool, name\n",
        "aaa_pkg/__init__.py": "from . import side\nfrom .side import x\n",
        "aaa_pkg/side.py": "from ..above import nothing\n",
        "aaa_pkg/tool.py": "",
        "aaa_pkg/other.py": "",
        "aaa_pkg/deep/leaf.py": "from ..side import x\nthis is not Python\n",
        "aaa_unused.py": "",
    })  # fmt: skip
    found = {name: path.relative_to(tmp_path).as_posix() for name, path in local_modules(tmp_path / "task.py").items()}
    assert found == {
        "aaa_first": "aaa_first.py", "aaa_second": "aaa_second.py", "aaa_pkg": "aaa_pkg/__init__.py",
        "aaa_pkg.tool": "aaa_pkg/tool.py", "aaa_pkg.side": "aaa_pkg/side.py", "aaa_pkg.deep": "aaa_pkg/deep",
        "aaa_pkg.deep.leaf": "aaa_pkg/deep/leaf.py",
    }  # fmt: skip


SHARED = (
    tiny_task.TINY
    + """
from aaa_size import SKIP

Tiny.frame_skip = SKIP
"""
)


def shared(folder: Path, skip: int) -> Path:
    write(folder, {"aaa_size.py": "from aaa_inner.number import SKIP\n", "aaa_inner/number.py": f"SKIP = {skip}\n"})
    return tiny_task.write(folder, SHARED)


def test_modules_with_equal_names_in_two_folders_are_distinct(tmp_path: Path) -> None:
    path, files = list(sys.path), []
    for name, skip in (("a", 4), ("b", 5)):
        (tmp_path / name).mkdir()
        files.append(shared(tmp_path / name, skip))
    assert [find_task(file).frame_skip for file in (*files, *files)] == [4, 5, 4, 5]
    assert sys.path == path and not list(tmp_path.rglob("__pycache__"))


def test_a_changed_module_is_reloaded(tmp_path: Path) -> None:
    file = shared(tmp_path, 6)
    first = find_task(file)
    assert find_task(file) is first
    shared(tmp_path, 17)
    assert (find_task(file).frame_skip, first.frame_skip) == (17, 6)


def test_module_whose_import_fails_does_not_replace_loaded_modules(tmp_path: Path) -> None:
    file = shared(tmp_path, 8)
    first, module = find_task(file), sys.modules["aaa_size"]
    (tmp_path / "aaa_size.py").write_text("from aaa_inner.number import SKIP\n1 / 0\n")
    with pytest.raises(ValueError, match=r"file .*tiny\.py, line \d+: ZeroDivisionError: division by zero"):
        find_task(file)
    assert sys.modules["aaa_size"] is module and vars(sys.modules[first.__module__])["Tiny"] is first
