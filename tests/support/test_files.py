import os
from pathlib import Path
from typing import Any

import pytest

from lyceum_warp.support.files import replaced


def test_a_file_is_replaced_only_after_it_is_written_completely(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with replaced(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_an_exception_while_writing_leaves_the_old_file_intact(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), replaced(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("failures", [1, 2])
def test_replacing_a_file_is_tried_again_after_a_failure(
    failures: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first failure may come from a network drive, or from a program that has the file open."""
    path, replace = tmp_path / "file.txt", os.replace
    errors = [PermissionError(13, "Permission denied", str(path)) for _ in range(failures)]

    def moved(*arguments: Any) -> None:
        if errors:
            raise errors.pop()
        replace(*arguments)

    monkeypatch.setattr(os, "replace", moved)
    if failures == 1:
        with replaced(path) as temporary:
            temporary.write_text("new")
        assert path.read_text() == "new"
    else:
        with pytest.raises(PermissionError), replaced(path) as temporary:
            temporary.write_text("new")
        assert not list(tmp_path.iterdir())
