"""Kernels are compiled ahead of the first step, with progress, and by ``lyceum-warp warmup``."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import warp as wp

import lyceum_warp as lw
from lyceum_warp.cli import main

SCRIPT = """
import warp as wp
from lyceum_warp.graphs.compile_ahead import compile_ahead

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

built = compile_ahead(launches, wp.get_device("cpu"), "a test")
print(built.modules, built.known)
"""


def test_compiling_is_reported_and_done_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A process of its own compiles; this one, which does not have these kernels, finds them in its cache."""
    script, cache = tmp_path / "script.py", tmp_path / "cache"
    script.write_text(SCRIPT)
    env = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if "CUDA" not in line]
    assert done.stdout.strip() == "2 0"
    assert lines[0].startswith("compiling kernels of a test for cpu: 2 modules on ")
    assert len(lines) == 3 and all(line.strip().startswith(f"{i}/2 ") for i, line in enumerate(lines[1:], 1))
    assert {line.split()[1].rsplit("_", 1)[0] for line in lines[1:]} == {"one", "two"}
    (folder,) = {path.parent.parent for path in cache.rglob("*.o")}
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    runpy.run_path(str(script))
    said = capsys.readouterr()
    assert (said.out.strip(), said.err) == ("0 2", "")


def test_warmup_reports_modules_and_memory(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["warmup", "point_mass", "--engine", "warp", "--nworld", "8"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("point_mass on cpu: ")
    assert re.search(r"memory: about \d+\.\d kB a world; at most some [\d,]+ worlds fit into the free memory", out)
    assert main(["warmup", "point_mass", "--nworld", "8", "--plan", "--npg"]) == 0
    assert " kB a world; " in capsys.readouterr().out
    assert main(["warmup", "nothing"]) == 2


def test_warmup_takes_options_of_physics(made_envs: list[lw.Env], capsys: pytest.CaptureFixture[str]) -> None:
    warmup = ["warmup", "point_mass", "--nworld", "8", "--plan"]
    options = ["--integrator", "implicitfast", "--solver", "ls_iterations=9", "--deterministic"]
    assert main([*warmup, *options]) == 0
    assert len(made_envs) == 2  # the environment's and the planner's
    for env in made_envs:
        opt = env.model.opt
        assert (opt.integrator, opt.ls_iterations) == (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 9)
        assert env._options["deterministic"]
    capsys.readouterr()
    assert main([*warmup, "--integrator", "rk5"]) == 2
    assert "there is no integrator 'rk5'" in capsys.readouterr().err
