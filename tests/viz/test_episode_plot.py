import sys
from pathlib import Path

import pytest
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.controllers import Trajectory, control
from lyceum_warp.viz import control_plot


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


@pytest.fixture(scope="module")
def episode(env: lw.Env) -> Trajectory:
    return control(env, towards, seed=3)


def test_episodes_are_plotted_as_png(episode: Trajectory, env: lw.Env, tmp_path: Path) -> None:
    path = control_plot([episode, control(env, towards, steps=1)], tmp_path / "new" / "control.png")
    assert path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000


def test_error_names_the_extra_if_matplotlib_is_missing(
    episode: Trajectory, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"needs matplotlib: pip install 'lyceum-warp\[viz\]'"):
        control_plot([episode], tmp_path / "none.png")
