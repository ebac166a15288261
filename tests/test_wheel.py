from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_wheel_contains_every_file_of_the_package() -> None:
    wheel = pytest.importorskip("hatchling.builders.wheel")
    builder = wheel.WheelBuilder(str(ROOT))
    contents = {file.distribution_path for file in builder.recurse_included_files()}
    files = [path for path in (ROOT / "lyceum_warp").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert {path.relative_to(ROOT).as_posix() for path in files} == contents
    assert {"lyceum_warp/py.typed", "lyceum_warp/pretrained/hopper/policy.pt"} <= contents
    assert sum(name.endswith(".xml") for name in contents) >= 11
