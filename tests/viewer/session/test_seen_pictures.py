import base64
import io

import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.viewer.commands import command, set_mode, set_pictures, set_world, step_by
from lyceum_warp.viewer.session import pictures
from lyceum_warp.viewer.session.clock import Session

CAMERAS = [lw.Camera("side", 16, 12), *(lw.Camera("side", 16, 12, kind, kind) for kind in ("depth", "segmentation"))]


def pixels(address: str) -> np.ndarray:
    image = pytest.importorskip("PIL.Image")
    return np.asarray(image.open(io.BytesIO(base64.b64decode(address.removeprefix("data:image/png;base64,")))))


@pytest.fixture
def session(shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch) -> Session:
    monkeypatch.setattr(pictures, "PERIOD", 0.0)
    env = shared_env("cartpole", nworld=2, cameras=CAMERAS)
    episode = env.get_state()[:1].repeat(3, 1)
    for step in (1, 2):
        env.step(torch.ones_like(env.action))
        episode[step] = env.get_state()[0]
    return Session(env, episodes=[episode], seed=0, paused=True)


def test_pictures_are_sent_only_while_they_are_shown(session: Session) -> None:
    stage = session.stage
    assert stage.scene.sees and stage.frame().pictures is None
    session.obey(command(set_pictures, True))
    assert stage.frame(news=False).pictures is None
    frame = stage.frame()
    assert frame.status.pictures and [caption.split(",")[0] for caption, _ in frame.pictures or ()] == [
        "camera: rgb 16 × 12", "depth: depth 16 × 12", "segmentation: segmentation 16 × 12",
    ]  # fmt: skip
    session.obey(command(set_pictures, False))
    assert [stage.frame().pictures, stage.frame().pictures] == [(), None]


def test_pictures_are_sent_a_few_times_a_second(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "PERIOD", 1e6)
    session.obey(command(set_pictures, True))
    assert session.stage.frame().pictures and session.stage.frame().pictures is None


def test_pictures_show_the_displayed_world_and_the_step_of_a_playback(session: Session) -> None:
    stage, env = session.stage, session.stage.env
    session.obey(command(set_pictures, True))
    session.obey(command(step_by, 1))
    (_, first), *_ = stage.frame().pictures or ()
    states = torch.from_numpy(stage.playback.episode.states[[1, 1]])
    np.testing.assert_array_equal(pixels(first), env.get_obs(states, group="camera")[0].numpy())
    session.obey(command(set_mode, "passive"))
    session.obey(command(set_world, 1))
    session.obey(command(step_by, 80))
    (_, now), *_ = stage.frame().pictures or ()
    np.testing.assert_array_equal(pixels(now), env.obs_groups["camera"][1].numpy())
    assert now != first


def test_distances_are_grey_and_objects_differ_in_colour() -> None:
    depth = np.array([[[0.0], [1.0]], [[2.0], [3.0]]], dtype=np.float32)
    grey, text = pictures.colours("depth", depth)
    assert grey[..., 0].tolist() == [[0, 255], [152, 50]] and text == ", 1 (bright) to 3 m"
    assert pictures.colours("depth", 0 * depth)[1] == ", nothing visible"
    ids = np.array([[[-1, -1], [0, 5]], [[1, 5], [0, 5]]], dtype=np.int32)
    colour, text = pictures.colours("segmentation", ids)
    assert not colour[0, 0].any() and len({tuple(c) for c in colour.reshape(-1, 3).tolist()}) == 3
    assert text == ", 2 objects" and (colour[0, 1] == colour[1, 1]).all()
    assert pictures.colours("rgb", np.zeros((300, 600, 3), np.uint8))[0].shape == (100, 200, 3)
