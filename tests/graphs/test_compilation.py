from pathlib import Path

import pytest
import tiny_task
import warp as wp
from conftest import SharedEnv

import lyceum_warp as lw


@pytest.mark.long
def test_c_engine_also_reports_compilation_for_a_new_task(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shared_env("point_mass").step()  # this step loads the package's own kernels
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    file = tiny_task.write(tmp_path, tiny_task.changed(("class Tiny", "class Compiled")), "compiled.py")
    env = lw.make(str(file), engine="mujoco")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("compiling kernels of compiled for cpu: 0 of ")
    modules = len(list(tmp_path.rglob("*.o")))
    env.step()
    lw.make(str(file), engine="mujoco")
    assert len(list(tmp_path.rglob("*.o"))) == modules
    assert capsys.readouterr().err == ""
