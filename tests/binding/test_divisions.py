from pathlib import Path

import pytest
import tiny_task

import lyceum_warp as lw

INTEGERS = (
    "float(1 / 2)",
    "float(-n / 2)",
    "float((s.qpos.shape[0] + 1) / 2)",
    "float(len(s.qpos) / n)",
    "float(int(x) / 2)",
    "float(wp.max(1, n) / 2)",
    "float((1 if x > 0.0 else 2) / n)",
)
OTHERS = (
    "1.0 / 2.0 + float(n) / 2.0 + x / wp.static(1 / 2)",
    "wp.max(x, 1.0) / wp.length(wp.vec3(x)) + (wp.vec3(x) / 2.0)[0] / wp.pi",
    "float(n // 2) / wp.float32(n)",
)


def file(folder: Path, *results: str) -> Path:
    lines = "\n".join(f"    x += {result}" for result in results)
    body = f"def evaluate(s: World, p: Params) -> float:\n    x, n = float(1.0), int(3)\n{lines}\n    return x"
    return tiny_task.write(folder, tiny_task.with_function(body))


@pytest.mark.parametrize("result", INTEGERS)
def test_division_of_integers_is_refused(result: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="evaluate .* drops the fraction"):
        lw.make(file(tmp_path, result))


def test_other_divisions_are_not_refused(tmp_path: Path) -> None:
    assert lw.make(file(tmp_path, *OTHERS)).eval.isfinite().all()
