"""lyceum-warp warmup."""

import re

import mujoco
import pytest

import lyceum_warp as lw
from lyceum_warp.cli import main


def test_warmup_prints_compiled_kernels_and_memory(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["warmup", "point_mass", "--engine", "warp", "--nworld", "8"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("point_mass on cpu: ")
    assert re.search(r"memory: about \d+\.\d kB a world; at most some [\d,]+ worlds fit into the free memory", out)
    assert main(["warmup", "point_mass", "--nworld", "8", "--plan", "--npg"]) == 0
    assert " kB a world; " in capsys.readouterr().out
    assert main(["warmup", "nothing"]) == 2


def test_warmup_applies_the_options_of_physics(made_envs: list[lw.Env], capsys: pytest.CaptureFixture[str]) -> None:
    warmup = ["warmup", "point_mass", "--nworld", "8", "--plan"]
    options = ["--integrator", "implicitfast", "--solver", "ls_iterations=9", "--deterministic"]
    assert main([*warmup, *options]) == 0
    assert len(made_envs) == 2  # the environment's and the planner's
    for env in made_envs:
        opt = env.model.opt
        assert (opt.integrator, opt.ls_iterations) == (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 9)
        assert env.options.physics.deterministic
    capsys.readouterr()
    assert main([*warmup, "--integrator", "rk5"]) == 2
    assert "there is no integrator 'rk5'" in capsys.readouterr().err
