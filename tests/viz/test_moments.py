from pathlib import Path

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.viz import draw_moments
from lyceum_warp.viz.renderer import NoVideoError


def test_picture_shows_the_reference_far_from_the_robot(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    env = lw.make("go1_tracking", randomness=0.0, start_clip=0, start_frame=0)
    states = env.get_state()
    states[0, env.state_space.parts["qpos"].start] += 6.0
    one = torch.ones(1)
    results = lw.ClipResults(
        seconds=one, failed=one > 0.0, tracked=one, returns=one, scores=one, errors={}, worst=one, worst_states=states
    )
    try:
        file = draw_moments(env, ["walk"], results, tmp_path / "clips.png")
    except NoVideoError as error:
        pytest.skip(str(error))
    red, green, blue = np.asarray(image.open(file).convert("RGB"), int).reshape(-1, 3).T
    assert ((green > red + 40) & (green > blue + 20)).sum() > 50  # the colour of the reference
