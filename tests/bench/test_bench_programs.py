"""Files of measurements."""

import dataclasses
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

BENCH = Path(__file__).parents[2] / "bench"


@dataclasses.dataclass(frozen=True)
class Row:
    task: str
    nworld: int
    steps_per_second: float


@pytest.fixture(scope="module")
def measurements() -> ModuleType:
    spec = importlib.util.spec_from_file_location("measurements", BENCH / "measurements.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written(measurements: ModuleType, path: Path, rate: float) -> dict:
    measurements.write(path, [Row("hopper", 4, rate), Row("hopper", 8, 1.0)], nthread=2)
    return json.loads(path.read_text())


def test_a_file_holds_its_machine_and_versions(measurements: ModuleType, tmp_path: Path) -> None:
    content = written(measurements, tmp_path / "new" / "new.json", 2.0)
    assert content["rows"][0] == {"task": "hopper", "nworld": 4, "steps_per_second": 2.0}
    assert content["nthread"] == 2
    assert {"mujoco", "warp_lang", "torch", "python", "cpu", "cores"} <= content["versions"].keys()


def test_files_of_one_machine_are_compared(measurements: ModuleType, tmp_path: Path) -> None:
    old, new = (written(measurements, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    table = measurements.compare(old, new)
    assert list(table.columns[1].cells) == ["1.500", "1.000"]


@pytest.mark.parametrize("name, value", [("gpu", "NVIDIA H100"), ("cores", 3), ("driver", "580"), ("cpu", "abacus")])
def test_files_of_different_hardware_are_refused(
    name: str, value: object, measurements: ModuleType, tmp_path: Path
) -> None:
    old, new = (written(measurements, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    new["versions"][name] = value
    with pytest.raises(ValueError, match=f"different hardware: {name}"):
        measurements.compare(old, new)


def test_other_measurements_are_refused(measurements: ModuleType, tmp_path: Path) -> None:
    old, new = (written(measurements, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    for row in new["rows"]:
        row["task"] = "walker2d"
    with pytest.raises(ValueError, match="no case in common"):
        measurements.compare(old, new)
