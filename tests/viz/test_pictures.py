from collections.abc import Iterator

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.viz import WorldPictures
from lyceum_warp.viz.renderer import NoVideoError

SIZE = (96, 64)


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("hopper", nworld=2, dynamics=["geom_size"])


@pytest.fixture(scope="module")
def pictures(env: lw.Env) -> Iterator[WorldPictures]:
    pictures = WorldPictures(env, size=SIZE)
    try:
        pictures()
    except NoVideoError as error:
        if "cannot render off-screen" not in str(error):
            raise
        pytest.skip(str(error))
    yield pictures
    pictures.close()


def test_picture_shows_the_state_and_the_model_of_its_world(env: lw.Env, pictures: WorldPictures) -> None:
    env.reset()
    first, second = pictures()
    assert first.shape == (64, 96, 3) and first.dtype == np.uint8 and first.std() > 10
    np.testing.assert_array_equal(first, second)
    for _ in range(20):
        env.step(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    first, second = pictures()
    assert (first != second).any()
    env.reset()
    sizes = env.field("geom_size").clone()
    sizes[1, 1:] *= 1.5
    env.set_dynamics(geom_size=sizes)
    first, second = pictures()
    assert (first != second).any()


def test_render_process_is_restarted_after_close(pictures: WorldPictures) -> None:
    before = pictures()
    pictures.close()
    for picture, again in zip(before, pictures(), strict=True):
        np.testing.assert_array_equal(picture, again)
