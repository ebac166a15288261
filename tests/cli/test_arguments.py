import pytest

from lyceum_warp.cli.arguments import video_camera
from lyceum_warp.viz import FreeCamera


def test_command_line_arguments_describe_a_camera() -> None:
    assert video_camera([]) is None
    assert video_camera(["side"]) == "side"
    words = ["azimuth=90", "elevation=-20", "lookat=0,0.5,1", "distance=2", "track=torso"]
    expected = FreeCamera(azimuth=90, elevation=-20, lookat=[0, 0.5, 1], distance=2, track="torso")  # type: ignore[arg-type]
    assert video_camera(words) == expected


@pytest.mark.parametrize("words, message", [
    (["side", "top"], "a camera is a name, an index, or a pose of lookat=..., .*, not 'side'"),
    (["roll=3"], "not 'roll=3'"),
    (["azimuth=left"], "the value in 'azimuth=left' must be a number"),
])  # fmt: skip
def test_invalid_camera_arguments_raise_an_error(words: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        video_camera(words)
