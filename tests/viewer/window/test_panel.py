from typing import Any

import mujoco
import numpy as np
import pytest
from headless_screen import Bench, frame_of, robot, scene_of, state_of, status_of

from lyceum_warp.viewer.commands import (
    command,
    drive,
    reset,
    set_backwards,
    set_ghosts,
    set_mode,
    set_paused,
    set_pictures,
    set_speed,
    set_video,
    set_watched,
    set_world,
    step_by,
)
from lyceum_warp.viewer.protocol import Arrow, Frame, Ghost, Ghosts, Opened
from lyceum_warp.viewer.window import panel, studio
from lyceum_warp.viewer.window.actions import ACTIONS, HELP, MOUSE
from lyceum_warp.viewer.window.studio import imgui
from lyceum_warp.viewer.window.windows import WINDOWS, legend


@pytest.fixture
def bench() -> Bench:
    model = robot()
    return Bench(model, scene_of(model))


def pressed(bench: Bench, key: str, **status: object) -> list[Any]:
    bench.show(status_of(**status))
    ACTIONS[key].act(bench.panel.actions)
    return list(bench.sent)


# frames and windows


@pytest.mark.parametrize("mode", ["passive", "controller", "playback"])
def test_panel_draws_every_mode_with_all_windows_open(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imgui, "CollapsingHeader", lambda title: True)
    model = robot()
    bench = Bench(model, scene_of(model, speeds=(1.0, 1.0, 0.5)))
    bench.panel.actions.windows |= set(WINDOWS)
    frame = frame_of(
        bench.model, bench.data, status_of(
            mode=mode, episode=1, video="video.mp4", seekable=(0, 20), command=(0.5, 0.0, 0.1), driven=True,
            planner=(("noise", 0.5), ("samples", 8)), params=(("weight", 0.1),), paused=True,
        ),
        points=np.array([[0.0, 0.0, 1.0, np.nan], [0.1, 1.0, 2.0, 3.0]]), messages=("world 3: terminated",),
    )  # fmt: skip
    assert bench.sent == [Opened(("viewer: http://here",)), command(set_watched, False)]
    assert bench.draw() == bench.draw(frame) == []  # draw without a frame, then with the first frame
    bench.panel.actions.cameras.choose(studio.ux.FREE_CAMERA_IDX)
    assert bench.draw() == []
    small = Bench(bench.model, scene_of(bench.model, nworld=1, controllers=(), episodes=(), curves=()))
    small.panel.actions.windows |= set(WINDOWS)
    assert small.draw(frame_of(small.model, small.data, status_of(controller=None, world=0))) == []


def test_panel_draws_only_finite_states(bench: Bench) -> None:
    bench.data.qpos[:3] = 1, 2, 3
    bench.show(status_of())
    bench.data.qpos[0] = np.nan
    bench.show(status_of())
    np.testing.assert_allclose(bench.viewer.data.body("ball").xpos, [1, 2, 3])


def test_panel_draws_ghosts_and_traces(bench: Bench) -> None:
    state = state_of(bench.model, bench.data)
    state[1] += 1.0  # qpos[0]
    bench.draw(frame_of(bench.model, bench.data, ghosts=(Ghost(state, None),), traces=np.zeros((2, 5, 3))))
    assert len(bench.viewer.extra_geoms) == 9


def test_button_asks_for_the_pictures_of_cameras_and_the_page_gets_them(bench: Bench) -> None:
    bench.show(status_of())
    assert "pictures" not in bench.panel.actions.toggles()
    seeing = Bench(bench.model, scene_of(bench.model, sees=True))
    seeing.show(status_of(pictures=False))
    seeing.panel.actions.toggles()["pictures"][1]()
    assert seeing.sent == [command(set_pictures, True)]
    seeing.draw(frame_of(seeing.model, seeing.data, status_of(pictures=True), pictures=(("camera", "data:,1"),)))
    seeing.draw(frame_of(seeing.model, seeing.data, status_of(pictures=True)))
    assert seeing.told == ['pictures=[["camera", "data:,1"]]']


# keys


@pytest.mark.parametrize(
    ("key", "sent"),
    [
        ("Space", command(set_paused, True)), ("Left", command(step_by, -1)), ("Shift+Right", command(step_by, 50)),
        ("Ctrl+Right", command(set_mode, "controller")), ("Ctrl+Left", command(set_mode, "playback")),
        ("Ctrl+Down", command(set_mode, "controller", controller="mppi")), ("Down", command(set_world, "next")),
        ("Shift+Up", command(set_speed, 2.0)), ("Shift+Backspace", command(reset, random=True)),
        ("Ctrl+R", command(set_backwards, True)), ("Ctrl+B", command(set_ghosts, Ghosts(burst=25))),
    ],
)  # fmt: skip
def test_key_sends_its_command(bench: Bench, key: str, sent: object) -> None:
    assert pressed(bench, key) == [sent]


def test_keys_depend_on_the_mode_and_stay_within_limits(bench: Bench) -> None:
    assert pressed(bench, "Down", mode="playback", episode=1) == [command(set_mode, "playback", episode=0)]
    assert pressed(bench, "Shift+Up", speed=16.0) == [command(set_speed, 16.0)]
    assert pressed(bench, "Shift+Down", speed=1 / 16) == [command(set_speed, 1 / 16)]
    assert pressed(bench, "Ctrl+B", ghosts=Ghosts(worlds=1, burst=3)) == [command(set_ghosts, Ghosts(worlds=1))]


@pytest.mark.parametrize("mode", ["passive", "controller", "playback"])
def test_every_key_is_accepted_in_every_mode(bench: Bench, mode: str) -> None:
    for name in ACTIONS:
        pressed(bench, name, mode=mode)
        bench.draw()


def test_table_of_keys_begins_with_the_mouse_and_breaks_lines_between_words(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    cells: list[str] = []

    def write(text: str) -> None:
        assert imgui.CalcTextSize(text).x <= imgui.GetContentRegionAvail().x
        cells.append(text)

    bench.panel.actions.windows = {"keys"}
    bench.show(status_of())
    monkeypatch.setattr(imgui, "TextUnformatted", write)
    bench.draw()
    texts = [" ".join(cell.split("\n")) for cell in cells]
    first = texts.index(MOUSE[0][1])
    assert texts[first : first + len(HELP)] == [what for _, what in HELP]
    assert any("\n" in cell for cell in cells)


# cameras and videos


def test_default_camera_tracks_the_body_of_a_tracking_camera(bench: Bench) -> None:
    ball = bench.model.body("ball").id
    (video,) = pressed(bench, "Ctrl+V")
    assert video.function is set_video
    assert video.arguments[0]["type"] == mujoco.mjtCamera.mjCAMERA_TRACKING
    assert video.arguments[0]["trackbodyid"] == ball
    assert pressed(bench, "Ctrl+V", video="video.mp4") == [command(set_video, None)]


def test_user_can_choose_a_fixed_camera_of_the_model(bench: Bench) -> None:
    bench.show(status_of())
    bench.panel.actions.cameras.choose(0)
    bench.draw()
    assert bench.panel.actions.cameras.view()["fixedcamid"] == 0
    assert bench.viewer.camera_index == 0


def test_world_with_other_geom_sizes_gets_a_separate_model(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lyceum_warp.viewer.window.panel.SWAP_TIME", 0.0)
    for factor in (3.0, 1.0):
        sizes = factor * np.array(bench.model.geom_size).ravel()
        bench.draw(frame_of(bench.model, bench.data, model_fields={"geom_size": sizes}))
        assert bench.models.pop().geom("ball").size[0] == pytest.approx(0.1 * factor)


# the page


@pytest.mark.parametrize("size", [(390, 844), (800, 600), (1440, 900)])
def test_windows_are_inside_the_page(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(model := robot(), scene_of(model))
    bench.panel.actions.windows |= set(WINDOWS)
    imgui.GetIO().DisplaySize = imgui.Vec2(*size)
    left, edges = [0.0], []
    move, resize = imgui.SetNextWindowPos, imgui.SetNextWindowSize
    monkeypatch.setattr(imgui, "SetNextWindowPos", lambda at, *more: (left.append(at.x), move(at, *more)))
    monkeypatch.setattr(
        imgui, "SetNextWindowSize", lambda to, *more: (edges.append(left[-1] + to.x), resize(to, *more))
    )
    bench.show(status_of())
    assert len(edges) >= 4 and min(left) >= 0 and max(edges) <= size[0]


def test_camera_is_farther_away_in_a_page_that_is_higher_than_wide(bench: Bench) -> None:
    distances = []
    for size in ((800, 600), (390, 780), (800, 600)):
        imgui.GetIO().DisplaySize = imgui.Vec2(*size)
        bench.show(status_of())
        distances.append(bench.viewer.camera.distance)
    assert distances == pytest.approx(distances[0] * np.array([1, 2, 1]))


def test_slow_page_turns_shadows_off_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    shadow = mujoco.mjtRndFlag.mjRND_SHADOW
    monkeypatch.setattr(panel, "RATE_TIME", 0.0)
    bench.panel.look(True)
    bench.show(status_of())
    assert bench.viewer.render_flags.flags[shadow]  # nothing has been drawn yet
    monkeypatch.setattr(panel, "SLOW", np.inf)
    bench.inputs = 100
    bench.show(status_of())
    assert not bench.viewer.render_flags.flags[shadow] and "shadows" in bench.panel.actions.messages[-1]
    bench.viewer.render_flags.flags = [1] * 12  # the user turns them on again
    bench.inputs = 200
    bench.show(status_of())
    assert bench.viewer.render_flags.flags[shadow]


def test_worlds_run_only_while_a_page_is_visible(bench: Bench) -> None:
    bench.sent.clear()
    for looks in (True, True, False):
        bench.panel.look(looks)
    assert bench.sent == [command(set_watched, True), command(set_watched, False)]


def test_gamepad_drives_a_robot_that_can_be_driven(bench: Bench) -> None:
    driven = Bench(bench.model, scene_of(bench.model, speeds=(2.0, 1.0, 0.5)))
    driven.sent.clear()
    driven.panel.steer([0.5, -1.0, 1.0])
    assert driven.sent == [command(drive, (1.0, -1.0, 0.5))]
    bench.sent.clear()
    bench.panel.steer([1.0, 0.0, 0.0])
    assert bench.sent == []


def test_changed_numbers_are_copied_as_flags(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.show(status_of(params=(("weight", 0.5),), planner=(("samples", 8),)))
    monkeypatch.setattr(imgui, "Button", lambda label: "flags" in label)
    bench.show(status_of(params=(("weight", 0.5),), planner=(("samples", 8),)))
    assert bench.told == []  # nothing has changed
    bench.show(status_of(params=(("weight", 0.25),), planner=(("samples", 16),), paused=True))
    assert bench.told == ["copy=--samples 16 --param weight=0.25"]


def test_legend_names_ghosts_paths_and_arrows_once() -> None:
    state, red, blue = np.zeros(3), (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
    ghosts = (Ghost(state, red, what="past"), Ghost(state, red, what="past"), Ghost(state, None))
    frame = Frame(state, {}, status_of(), ghosts, np.zeros((2, 2, 3)), (Arrow(state, state, blue, "command"),))
    names = {name: colour for colour, name in legend(frame)}
    assert names["past"] == red and names["command"] == blue and len(names) == 4
