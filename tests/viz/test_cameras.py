import mujoco
import numpy as np
import pytest

from lyceum_warp.viz import FreeCamera, find_camera
from lyceum_warp.viz.cameras import camera_values

MODEL = """
<mujoco>
  <worldbody>
    <camera name="corner" pos="0 -3 1"/>
    <camera pos="0 -3 1"/>
    <camera name="1" pos="0 -3 1"/>
    <body name="torso" pos="0 0 1"><freejoint/><geom size=".1"/><body name="head"><geom size=".1"/></body></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.mark.parametrize("cameras, fixed, tracked", [
    ("<camera/><camera mode='trackcom'/>", 1, -1), ("<camera/>", -1, 1), ("", -1, 1),
])  # fmt: skip
def test_default_camera_is_a_tracking_or_fixed_camera_or_follows_the_first_body(
    model: mujoco.MjModel, cameras: str, fixed: int, tracked: int
) -> None:
    text = f"<mujoco><worldbody><body><freejoint/><geom size='1'/>{cameras}</body></worldbody></mujoco>"
    found = find_camera(mujoco.MjModel.from_xml_string(text))
    kind = mujoco.mjtCamera.mjCAMERA_FIXED if fixed >= 0 else mujoco.mjtCamera.mjCAMERA_TRACKING
    assert (found.type, found.fixedcamid, found.trackbodyid) == (kind, fixed, tracked)
    assert find_camera(model).fixedcamid == 0
    assert find_camera(mujoco.MjModel.from_xml_string("<mujoco/>")).type == mujoco.mjtCamera.mjCAMERA_FREE


@pytest.mark.parametrize("camera, index", [("corner", 0), (1, 1), (np.int64(2), 2), ("0", 0), ("1", 2)])
def test_a_camera_is_found_by_name_and_by_index(model: mujoco.MjModel, camera: object, index: int) -> None:
    found = find_camera(model, camera)  # type: ignore[arg-type]
    assert (found.type, found.fixedcamid) == (mujoco.mjtCamera.mjCAMERA_FIXED, index)


@pytest.mark.parametrize("camera", ["side", "", 3, -2, True, 0.0, "7"])
def test_error_of_an_unknown_camera_lists_the_cameras_of_the_model(model: mujoco.MjModel, camera: object) -> None:
    with pytest.raises(ValueError, match=r"no camera .*: the model has 'corner' \(0\), 1, '1' \(2\), or 'free'"):
        find_camera(model, camera)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the model has none, or 'free'"):
        find_camera(mujoco.MjModel.from_xml_string("<mujoco/>"), 0)


def test_free_camera_has_the_given_pose_or_the_default_of_mujoco(model: mujoco.MjModel) -> None:
    default = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, default)
    for choice in ("free", FreeCamera()):
        assert camera_values(model, choice) == camera_values(model, default)
    found = find_camera(model, FreeCamera(lookat=(1, 2, 3), azimuth=45))
    assert (*found.lookat, found.azimuth) == (1, 2, 3, 45)
    assert (found.distance, found.elevation) == (default.distance, default.elevation)
    for body in ("head", 2, "2"):
        found = find_camera(model, FreeCamera(track=body, distance=4))
        assert (found.type, found.trackbodyid, found.distance) == (mujoco.mjtCamera.mjCAMERA_TRACKING, 2, 4)
    assert find_camera(model, default) is default


@pytest.mark.parametrize("pose, message", [
    (dict(track="tors"), "cannot track the body 'tors', .*: did you mean torso?"),
    (dict(track=7), "cannot track the body 7, .*: its bodies are world, torso, head"),
    (dict(distance=0), "distance must be a positive number of metres, not 0"),
    (dict(azimuth=float("nan")), "azimuth in degrees must be a finite number, not nan"),
    (dict(lookat=(1, 2)), r"lookat must be three finite numbers, not \(1, 2\)"),
])  # fmt: skip
def test_invalid_camera_pose_raises_an_error(model: mujoco.MjModel, pose: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_camera(model, FreeCamera(**pose))  # type: ignore[arg-type]
