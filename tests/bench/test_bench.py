"""Records of measurements."""

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
def records() -> ModuleType:
    spec = importlib.util.spec_from_file_location("records", BENCH / "records.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written(records: ModuleType, path: Path, rate: float) -> dict:
    records.write(path, [Row("hopper", 4, rate), Row("hopper", 8, 1.0)], nthread=2)
    return json.loads(path.read_text())


def test_a_record_tells_where_it_comes_from(records: ModuleType, tmp_path: Path) -> None:
    record = written(records, tmp_path / "new" / "record.json", 2.0)
    assert record["rows"][0] == {"task": "hopper", "nworld": 4, "steps_per_second": 2.0}
    assert record["nthread"] == 2
    assert {"mujoco", "warp_lang", "torch", "python", "cpu", "cores"} <= record["versions"].keys()


def test_records_of_one_machine_are_compared(records: ModuleType, tmp_path: Path) -> None:
    old, new = (written(records, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    table = records.compare(old, new)
    assert list(table.columns[1].cells) == ["1.500", "1.000"]


@pytest.mark.parametrize("name, value", [("gpu", "NVIDIA H100"), ("cores", 3), ("driver", "580"), ("cpu", "abacus")])
def test_records_of_different_hardware_are_refused(
    name: str, value: object, records: ModuleType, tmp_path: Path
) -> None:
    old, new = (written(records, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    new["versions"][name] = value
    with pytest.raises(ValueError, match=f"different hardware: {name}"):
        records.compare(old, new)


def test_other_measurements_are_refused(records: ModuleType, tmp_path: Path) -> None:
    old, new = (written(records, tmp_path / f"{rate}.json", rate) for rate in (2.0, 3.0))
    for row in new["rows"]:
        row["task"] = "walker2d"
    with pytest.raises(ValueError, match="no case in common"):
        records.compare(old, new)
