import dataclasses
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from headless_screen import Bench, frame_of, pose_of, robot, scene_of, status_of

from lyceum_warp.viewer.protocol import (
    Camera,
    Ghost,
    Opened,
    Perturb,
    Reset,
    SetBackwards,
    SetController,
    SetEpisode,
    SetGhosts,
    SetMode,
    SetPaused,
    SetSpeed,
    SetVideo,
    SetWorld,
    StepBy,
)
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.actions import SPEEDS, Key, key_table
from lyceum_warp.viewer.window.windows import WINDOWS, numbers, speed_name

KEYS = {key.name: key for key in key_table()}


@pytest.fixture
def bench() -> Iterator[Bench]:
    model = robot()
    yield Bench(model, scene_of(model))


def shown(bench: Bench, **status: object) -> Bench:
    """The bench after a frame with this status."""
    bench.draw(frame_of(bench.model, bench.data, status_of(**status)))
    bench.sent.clear()
    return bench


def test_address_is_reported_when_the_window_runs(bench: Bench) -> None:
    assert bench.sent == [Opened("http://here")]


def test_panel_draws_before_the_first_frame(bench: Bench) -> None:
    assert bench.draw() == []


@pytest.mark.parametrize("mode", ["passive", "controller", "playback"])
def test_panel_draws_every_mode_with_all_windows_open(bench: Bench, mode: str) -> None:
    bench.panel.actions.windows |= set(WINDOWS)
    frame = frame_of(
        bench.model, bench.data, status_of(mode=mode, episode=1, video="video.mp4", seekable=(0, 20)),
        samples=np.array([[0.0, 1.0, np.nan], [0.1, 2.0, 3.0]]), messages=("world 3: terminated",),
    )  # fmt: skip
    assert bench.draw(frame) == []
    assert bench.draw() == []


def test_scene_with_one_world_and_no_curves_draws() -> None:
    model = robot()
    scene = scene_of(model, nworld=1, modes=("passive",), controllers=(), episodes=(), curves=())
    bench = Bench(model, scene)
    bench.panel.actions.windows |= set(WINDOWS)
    bench.draw(frame_of(model, bench.data, status_of(controller=None, world=0)))


def test_state_of_the_frame_is_drawn(bench: Bench) -> None:
    bench.data.qpos[:3] = 1, 2, 3
    shown(bench)
    np.testing.assert_array_equal(bench.viewer.data.qpos, bench.data.qpos)
    np.testing.assert_allclose(bench.viewer.data.body("ball").xpos, [1, 2, 3])


def test_state_that_is_not_finite_leaves_the_pose_before(bench: Bench) -> None:
    shown(bench)
    bench.data.qpos[0] = np.nan
    shown(bench)
    assert np.isfinite(bench.viewer.data.qpos).all()


def test_messages_of_frames_are_kept_in_order(bench: Bench) -> None:
    bench.draw(frame_of(bench.model, bench.data, messages=("one", "two")))
    bench.draw(frame_of(bench.model, bench.data, messages=("three",)))
    assert list(bench.panel.actions.messages) == ["one", "two", "three"]


def ghost_beside(data: mujoco.MjData) -> Ghost:
    pose = pose_of(data)
    qpos = pose.qpos.copy()
    qpos[0] += 1.0
    return Ghost(dataclasses.replace(pose, qpos=qpos), (1, 0, 0, 0.3))


def test_ghosts_and_traces_are_extra_geoms(bench: Bench) -> None:
    traces = np.cumsum(np.full((3, 5, 3), 0.1), axis=1)
    bench.draw(frame_of(bench.model, bench.data, ghosts=(ghost_beside(bench.data),), traces=traces, best=1))
    kinds = [geom.type for geom in bench.viewer.extra_geoms]
    assert kinds.count(int(mujoco.mjtGeom.mjGEOM_LINE)) == 12
    assert kinds.count(int(mujoco.mjtGeom.mjGEOM_SPHERE)) == 1


def test_ghosts_that_are_not_drawn_are_reported() -> None:
    """The row of the panel is made while it is drawn."""
    model = robot()
    bench = Bench(model, scene_of(model), limit=3)
    bench.draw(frame_of(model, bench.data, ghosts=(ghost_beside(bench.data),) * 2))
    assert len(bench.viewer.extra_geoms) == 1  # the goal stands still
    assert bench.panel.windows.dropped() == [("ghosts", "1 of 2 drawn: 3 shapes at most")]


def test_window_without_extra_geoms_draws_the_world_alone() -> None:
    model = robot()
    bench = Bench(model, scene_of(model), limit=0)
    bench.draw(
        frame_of(model, bench.data, ghosts=(Ghost(pose_of(bench.data), (1, 0, 0, 0.3)),), traces=np.zeros((2, 5, 3)))
    )
    assert bench.viewer.extra_geoms == []
    assert bench.panel.windows.dropped() == [
        ("ghosts", "0 of 1 drawn: only a browser draws them"), ("traces", "0 of 2 drawn: only a browser draws them"),
    ]  # fmt: skip


def test_dropped_model_is_refused_with_a_message(bench: Bench) -> None:
    shown(bench)
    bench.viewer.dropped = "/tmp/mujoco_drop_1/other.xml"
    assert bench.draw() == []
    assert bench.panel.actions.messages[-1].startswith("other.xml was not loaded")


# keys


@pytest.mark.parametrize(
    ("key", "command"),
    [
        ("Space", SetPaused(True)),
        ("Right", StepBy(1)),
        ("Left", StepBy(-1)),
        ("Shift+Right", StepBy(50)),
        ("Shift+Left", StepBy(-50)),
        ("Ctrl+Right", SetMode("controller")),
        ("Ctrl+Left", SetMode("playback")),
        ("Ctrl+Down", SetController("mppi")),
        ("Ctrl+Up", SetController("mppi")),
        ("Down", SetWorld("next")),
        ("Up", SetWorld("previous")),
        ("Shift+Up", SetSpeed(2.0)),
        ("Shift+Down", SetSpeed(0.5)),
        ("Enter", SetSpeed(0.125)),
        ("Backspace", Reset(random=False)),
        ("Shift+Backspace", Reset(random=True)),
        ("Ctrl+R", SetBackwards(True)),
        ("Ctrl+B", SetGhosts(burst=25)),
        ("Ctrl+D", SetGhosts(doppler=True)),
    ],
)
def test_key_sends_its_command(bench: Bench, key: str, command: object) -> None:
    KEYS[key].action(shown(bench).panel.actions)
    assert bench.sent == [command]


def test_up_and_down_choose_episodes_in_a_playback(bench: Bench) -> None:
    KEYS["Down"].action(shown(bench, mode="playback", episode=1).panel.actions)
    assert bench.sent == [SetEpisode(0)]


@pytest.mark.parametrize("name", [name for name in KEYS if name not in ("Ctrl+V",)])
def test_every_key_acts_in_every_mode(bench: Bench, name: str) -> None:
    for mode in ("passive", "controller", "playback"):
        KEYS[name].action(shown(bench, mode=mode).panel.actions)
        bench.draw()


def test_keys_are_unique_and_known_to_studio() -> None:
    chords = [(int(key.code), key.ctrl, key.shift) for key in KEYS.values()]
    assert len(set(chords)) == len(chords)


def test_key_with_two_modifiers_is_read() -> None:
    key = Key("Ctrl+Shift+A", "", lambda panel: None)
    assert key.ctrl
    assert key.shift
    assert key.code == studio.imgui.Key.A


def test_speed_stays_within_its_limits(bench: Bench) -> None:
    shown(bench, speed=16.0).panel.actions.change_speed(1)
    shown_at = bench.sent[-1]
    shown(bench, speed=1 / 16).panel.actions.change_speed(-1)
    assert [shown_at, bench.sent[-1]] == [SetSpeed(16.0), SetSpeed(1 / 16)]


# video and cameras


def test_video_begins_from_the_camera_of_the_view_and_ends(bench: Bench) -> None:
    shown(bench).panel.actions.toggle_video()
    (command,) = bench.sent
    assert command.on
    assert isinstance(command.camera, Camera)
    assert command.camera.tracked_body == bench.model.body("ball").id
    shown(bench, video="video.mp4").panel.actions.toggle_video()
    assert bench.sent == [SetVideo(False)]


def test_camera_that_tracks_a_body_is_the_first_one(bench: Bench) -> None:
    assert bench.viewer.camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING
    assert bench.viewer.camera.trackbodyid == bench.model.body("ball").id


def test_fixed_camera_of_the_model_can_be_chosen(bench: Bench) -> None:
    actions = shown(bench).panel.actions
    names = [actions.cameras.name(index) for index in actions.cameras.indices()]
    assert names == ["free", "flying", "tracking", "side", "track"]
    actions.cameras.choose(0)
    bench.draw()
    assert actions.cameras.view().fixed == 0
    assert bench.viewer.camera_index == 0


# the mouse


def drag(bench: Bench, body: str, kind: mujoco.mjtPertBit) -> None:
    """What studio sets while a person drags a body by half a metre."""
    perturb, data = bench.viewer.perturb, bench.viewer.data
    perturb.select = bench.model.body(body).id
    perturb.flexselect = perturb.skinselect = -1
    studio.ux.InitPerturb(bench.viewer.model, data, bench.viewer.camera, perturb, int(kind))
    perturb.refpos = data.body(body).xipos + np.array([0.5, 0, 0])
    perturb.refselpos = perturb.refselpos + np.array([0.5, 0, 0])


def test_dragged_body_is_pushed_until_it_is_left(bench: Bench) -> None:
    shown(bench)
    drag(bench, "ball", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    bench.panel.mouse.drag(bench.viewer, paused=False)
    (command,) = bench.sent
    assert isinstance(command, Perturb)
    assert command.forces[bench.model.body("ball").id, 0] > 0
    assert command.qpos is None
    assert command.mocap_pos is None
    bench.viewer.perturb.active = 0
    bench.panel.mouse.drag(bench.viewer, paused=False)
    bench.panel.mouse.drag(bench.viewer, paused=False)
    assert len(bench.sent) == 2
    assert not bench.sent[1].forces.any()


def test_dragged_body_is_placed_while_paused(bench: Bench) -> None:
    shown(bench, paused=True)
    drag(bench, "ball", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    bench.panel.mouse.drag(bench.viewer, paused=True)
    (command,) = bench.sent
    assert isinstance(command, Perturb)
    np.testing.assert_allclose(command.qpos[0], 0.5)
    assert not command.forces.any()


@pytest.mark.parametrize("paused", [False, True])
def test_push_ends_when_its_person_has_left(bench: Bench, paused: bool) -> None:
    """A browser that is closed in the middle of a drag never lets go of the button."""
    shown(bench)
    drag(bench, "ball", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    bench.panel.mouse.drag(bench.viewer, paused=paused)
    bench.panel.mouse.let_go()  # of another thread; nothing is drawn from here on
    bench.panel.mouse.let_go()
    assert len(bench.sent) == 2
    assert isinstance(bench.sent[1], Perturb)
    assert not bench.sent[1].forces.any()
    assert bench.sent[1].qpos is None
    bench.panel.mouse.drag(bench.viewer, paused=paused)  # the next browser
    assert len(bench.sent) == 2
    assert not bench.viewer.perturb.active
    drag(bench, "ball", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    bench.panel.mouse.drag(bench.viewer, paused=paused)
    assert len(bench.sent) == 3


def test_body_that_is_held_still_while_paused_is_placed_once(bench: Bench) -> None:
    shown(bench, paused=True)
    drag(bench, "ball", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    for _ in range(5):
        bench.panel.mouse.drag(bench.viewer, paused=True)
        bench.data.qpos[:] = bench.viewer.data.qpos
        bench.panel.take(frame_of(bench.model, bench.data, status_of(paused=True)))
    assert len(bench.sent) == 1
    bench.viewer.perturb.refpos = bench.viewer.perturb.refpos + np.array([0.0, 0.1, 0])
    bench.panel.mouse.drag(bench.viewer, paused=True)
    assert len(bench.sent) == 2
    assert isinstance(bench.sent[1], Perturb)
    np.testing.assert_allclose(bench.sent[1].qpos[:2], [0.5, 0.1])


@pytest.mark.parametrize("paused", [False, True])
def test_dragged_mocap_body_is_placed(bench: Bench, paused: bool) -> None:
    shown(bench)
    drag(bench, "goal", mujoco.mjtPertBit.mjPERT_TRANSLATE)
    bench.panel.mouse.drag(bench.viewer, paused=paused)
    (command,) = bench.sent
    np.testing.assert_allclose(command.mocap_pos, [[1.5, 0, 1]])


# models that differ between worlds


def test_world_of_another_size_gets_a_model_of_its_own(bench: Bench) -> None:
    sizes = np.array(bench.model.geom_size)
    sizes[1, 0] = 0.3
    bench.draw(frame_of(bench.model, bench.data, model_fields={"geom_size": sizes}))
    (model,) = bench.models
    assert model.geom("ball").size[0] == pytest.approx(0.3)
    assert bench.model.geom("ball").size[0] == pytest.approx(0.1)
    assert bench.panel.values.differences == [("geom_size ball", "0.3 0 0 (0.1 0 0)")]
    bench.panel._swapped = 0.0
    bench.draw(frame_of(bench.model, bench.data))
    assert bench.models[1].geom("ball").size[0] == pytest.approx(0.1)


def test_world_of_another_mass_keeps_the_picture(bench: Bench) -> None:
    masses = np.array(bench.model.body_mass) * 2
    bench.draw(frame_of(bench.model, bench.data, model_fields={"body_mass": masses}))
    assert bench.models == []
    np.testing.assert_array_equal(bench.viewer.model.body_mass, masses)
    assert bench.panel.values.differences[0][0] == "body_mass ball"


# small parts


def test_speeds_are_named_as_fractions() -> None:
    assert [speed_name(speed) for speed in SPEEDS] == ["1/16", "1/8", "1/4", "1/2", "1", "2", "4", "8", "16"]


def test_numbers_and_ranges_are_read_once_each() -> None:
    assert numbers("1 2, 5-7 6", 8, 5) == (1, 2, 5, 6, 7)
    assert numbers("", 8, 5) == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 x", "'x' is not"),
        ("1-", "'1-' is not"),
        ("7-9", "no world 8"),
        ("-1", "'-1'"),
        ("9", "no world 9"),
        ("1 20-30", "no world 20"),
        ("5-2", "write 2-5"),
        ("0-5", "too many worlds in '0-5': 5 can"),
        ("0-3 6 7", "too many"),
        ("0-99999999999", "no world 8"),
    ],
)
def test_numbers_of_another_form_are_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        numbers(text, 8, 5)
