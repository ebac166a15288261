from collections.abc import Iterator

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.viz.drawing import NoVideoError
from lyceum_warp.viz.pictures import WorldPictures

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
        if "cannot draw off-screen" not in str(error):
            raise
        pytest.skip(str(error))
    yield pictures
    pictures.close()


def test_worlds_in_equal_states_give_equal_pictures_and_others_differ(env: lw.Env, pictures: WorldPictures) -> None:
    env.reset()
    first, second = pictures()
    assert first.shape == (64, 96, 3) and first.dtype == np.uint8 and first.std() > 10
    np.testing.assert_array_equal(first, second)
    for _ in range(20):
        env.step(torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    first, second = pictures()
    assert (first != second).any()


def test_a_picture_shows_the_model_of_its_world(env: lw.Env, pictures: WorldPictures) -> None:
    env.reset()
    sizes = env.field("geom_size").clone()
    sizes[1, 1:] *= 1.5
    env.set_dynamics(geom_size=sizes)
    first, second = pictures()
    assert (first != second).any()
    env.set_dynamics(geom_size=sizes[0])


def test_render_process_is_restarted_after_close(pictures: WorldPictures) -> None:
    before = pictures()
    pictures.close()
    for picture, again in zip(before, pictures(), strict=True):
        np.testing.assert_array_equal(picture, again)


def test_invalid_size_or_camera_raises_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match="size must be two even numbers"):
        WorldPictures(env, size=(3, 4))
    with pytest.raises(ValueError, match="there is no camera 'front'"):
        WorldPictures(env, camera="front")
