import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_task
import warp as wp
from conftest import SharedEnv

import lyceum_warp as lw

SCRIPT = """
import warp as wp
from lyceum_warp.graphs.compile_ahead import compile_ahead
from lyceum_warp.support.warp_log import start_warp

start_warp()

@wp.kernel(module="unique", enable_backward=False)
def one(a: wp.array[float]):
    a[wp.tid()] = 1.0

@wp.kernel(module="unique", enable_backward=False)
def two(a: wp.array[float]):
    a[wp.tid()] = 2.0

@wp.kernel(module="unique", enable_backward=False)
def never(a: wp.array[float]):
    a[wp.tid()] = 3.0

def launches():
    a = wp.zeros(4, dtype=float)
    wp.launch(one, 4, [a])
    wp.launch(two, 4, [a])
    wp.launch(two, 4, [a])
    wp.launch(never, 0, [a])

print(len(compile_ahead(launches, wp.get_device("cpu"), "a test")))
"""


@pytest.mark.long
def test_kernels_are_compiled_once_with_progress_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script, cache = tmp_path / "script.py", tmp_path / "cache"
    script.write_text(SCRIPT)
    env = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if "CUDA" not in line]
    assert done.stdout.strip() == "2"
    assert lines[0] == "compiling kernels of a test for cpu: 0 of 2 modules, 0 s"
    (folder,) = {path.parent.parent for path in cache.rglob("*.o")}
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    runpy.run_path(str(script))
    said = capsys.readouterr()
    assert (said.out.strip(), said.err) == ("0", "")


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
