"""The program that draws videos."""

import mujoco
import pytest

import lyceum_warp as lw
from lyceum_warp.viz.render import camera


@pytest.mark.parametrize("task, expected", [("half_cheetah", 0), ("hopper", 0), ("reach", 0), ("point_mass", 0)])
def test_the_models_own_camera_is_chosen(task: str, expected: int) -> None:
    assert camera(mujoco, lw.make(task).model) == expected
