import mujoco
import numpy as np
import pytest
from headless_screen import Bench, frame_of, robot, scene_of, status_of

from lyceum_warp.viewer.commands import Command
from lyceum_warp.viewer.window import studio


@pytest.fixture
def bench() -> Bench:
    model = robot()
    bench = Bench(model, scene_of(model))
    bench.show(status_of())
    return bench


def drag(bench: Bench, body: str, *, paused: bool) -> list[Command]:
    perturb, data = bench.viewer.perturb, bench.viewer.data
    perturb.select = bench.model.body(body).id
    perturb.flexselect = perturb.skinselect = -1
    kind = int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
    studio.ux.InitPerturb(bench.viewer.model, data, bench.viewer.camera, perturb, kind)
    perturb.refpos = data.body(body).xipos + np.array([0.5, 0, 0])
    perturb.refselpos = perturb.refselpos + np.array([0.5, 0, 0])
    return hold(bench, paused=paused)


def hold(bench: Bench, *, paused: bool) -> list[Command]:
    before = len(bench.sent)
    bench.panel.mouse.drag(bench.viewer, paused=paused)
    return bench.sent[before:]  # type: ignore[return-value]


def test_dragged_body_is_pushed_until_the_release(bench: Bench) -> None:
    (push,) = drag(bench, "ball", paused=False)
    (pull,) = push.arguments
    assert pull["select"] == bench.model.body("ball").id and not push.options
    np.testing.assert_array_equal(pull["refselpos"], bench.viewer.perturb.refselpos)
    bench.viewer.perturb.active = 0
    (end,) = hold(bench, paused=False) + hold(bench, paused=False)
    assert end.arguments == ({},)


def test_drag_while_paused_places_the_body_only_when_the_mouse_moves(bench: Bench) -> None:
    (place,) = drag(bench, "ball", paused=True)
    np.testing.assert_allclose(place.options["qpos"][0], 0.5)
    assert place.arguments == ({},)
    for _ in range(5):
        assert hold(bench, paused=True) == []
        bench.data.qpos[:] = bench.viewer.data.qpos
        bench.panel.take(frame_of(bench.model, bench.data, status_of(paused=True)))
    bench.viewer.perturb.refpos = bench.viewer.perturb.refpos + np.array([0.0, 0.1, 0])
    (place,) = hold(bench, paused=True)
    np.testing.assert_allclose(place.options["qpos"][:2], [0.5, 0.1])


@pytest.mark.parametrize("paused", [False, True])
def test_push_ends_when_its_browser_disconnects(bench: Bench, paused: bool) -> None:
    """A browser that closes during a drag never reports that the button was released."""
    drag(bench, "ball", paused=paused)
    bench.sent.clear()
    bench.panel.mouse.let_go()
    bench.panel.mouse.let_go()
    (end,) = bench.sent
    assert end.arguments == ({},) and not end.options
    assert hold(bench, paused=paused) == []  # the next browser
    assert not bench.viewer.perturb.active
    assert len(drag(bench, "ball", paused=paused)) == 1


@pytest.mark.parametrize("paused", [False, True])
def test_dragged_mocap_body_is_placed(bench: Bench, paused: bool) -> None:
    (place,) = drag(bench, "goal", paused=paused)
    np.testing.assert_allclose(place.options["mocap_pos"], [[1.5, 0, 1]])
