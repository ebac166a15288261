import copy
import importlib
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from world_rules import check_truncation

import lyceum_warp as lw
from lyceum_warp.tasks.cartpole import Cartpole
from lyceum_warp.testing import check_task
from lyceum_warp.testing.fault_rules import check_bad_state

KINDS = [lw.Camera("side", 32, 24), lw.Camera("side", 32, 24, "depth", "depth"),
         lw.Camera("side", 32, 24, "segmentation", "ids")]  # fmt: skip
SIDE = KINDS[:1]


class Seen(Cartpole):
    cameras = (lw.Camera("side", 16, 16),)


def add_follower(spec: mujoco.MjSpec) -> None:
    spec.body("cart").add_camera(
        name="follower", pos=(0.0, -3.0, 1.0), quat=(0.7, 0.7, 0.0, 0.0), mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    )


class Followed(Cartpole):
    edit_model = staticmethod(add_follower)
    cameras = (lw.Camera("follower", 16, 16, "segmentation"),)


def differing(one: torch.Tensor, other: torch.Tensor, tolerance: float) -> float:
    """Compute the share of pixels that differ by more than a tolerance."""
    return ((one.float() - other.float()).abs().amax(-1) > tolerance).float().mean().item()


def test_engines_render_the_same_pictures_of_a_state(shared_env) -> None:
    one, other = (shared_env("cartpole", engine=engine, nworld=3, cameras=KINDS) for engine in ("mujoco", "warp"))
    for _ in range(4):
        for env in (one, other):
            env.step(torch.tensor([[-1.0], [0.0], [1.0]]))
    assert {name: (pictures.shape, pictures.dtype) for name, pictures in one.obs_groups.items()} == {
        "policy": ((3, 5), torch.float32), "camera": ((3, 24, 32, 3), torch.uint8),
        "depth": ((3, 24, 32, 1), torch.float32), "ids": ((3, 24, 32, 2), torch.int32),
    }  # fmt: skip
    for group in ("camera", "depth", "ids"):
        assert one.obs_groups[group][0].float().std() > 0.1
        # rounding can move an edge by a pixel
        assert differing(one.obs_groups[group], other.obs_groups[group], 1e-3) < 0.005
        assert one.obs_spaces[group].shape == one.obs_groups[group].shape[1:]


def test_pictures_agree_with_those_of_mujocos_renderer(shared_env, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [lw.Camera("side", 96, 96, kind, kind) for kind in ("rgb", "depth", "segmentation")]
    env = shared_env("cartpole", nworld=1, cameras=cameras)
    data, model = mujoco.MjData(env.model), copy.copy(env.model)
    model.vis.quality.offsamples = 0  # one ray per pixel knows no antialiasing
    data.qpos[:] = env.field("qpos")[0].numpy()
    mujoco.mj_forward(model, data)
    try:
        context = importlib.import_module("mujoco.egl").GLContext
        monkeypatch.setattr("mujoco.rendering.classic.gl_context.GLContext", context)
        renderer = mujoco.Renderer(model, 96, 96)
    except Exception as error:  # each GL backend raises its own errors
        pytest.skip(f"no OpenGL: {error}")
    renderer.update_scene(data, "side")
    for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
        renderer.scene.flags[flag] = 0
    rgb = torch.tensor(renderer.render().copy())
    renderer.enable_depth_rendering()
    depth = torch.tensor(renderer.render().copy())[..., None]
    renderer.disable_depth_rendering()
    renderer.enable_segmentation_rendering()
    ids = torch.tensor(renderer.render().copy())
    renderer.close()
    groups = {name: pictures[0] for name, pictures in env.obs_groups.items()}
    # texture filters differ, and OpenGL interpolates colours
    assert differing(groups["rgb"], rgb, 24) < 0.05
    seen = groups["depth"] > 0
    assert differing(groups["depth"], torch.where(seen, depth, 0.0), 0.05) < 0.01
    assert differing(groups["segmentation"], ids, 0) < 0.01 and seen.float().mean() > 0.01


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_pictures_belong_to_the_state_and_are_no_part_of_it(shared_env, engine: str) -> None:
    env = shared_env("cartpole", engine=engine, nworld=3, cameras=SIDE)
    assert env.state_space == shared_env("cartpole", engine=engine, nworld=3).state_space
    states, seen = [], []
    for _ in range(3):
        states.append(env.get_state())
        seen.append(env.get_obs(group="camera"))
        for _ in range(15):
            env.step(torch.ones_like(env.action))
    assert not torch.equal(seen[0], seen[2])
    now = env.get_obs(group="camera")
    torch.testing.assert_close(env.get_obs(states[1], group="camera"), seen[1], rtol=0, atol=0)
    torch.testing.assert_close(env.obs_groups["camera"], now, rtol=0, atol=0)
    mask = torch.tensor([False, True, False])
    env.set_state(states[0], mask)
    pictures = env.obs_groups["camera"]
    assert torch.equal(pictures[1], seen[0][1]) and torch.equal(pictures[[0, 2]], now[[0, 2]])
    env.rand_reset(mask=~mask)
    assert torch.equal(pictures[1], seen[0][1]) and not torch.equal(pictures[0], now[0])


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_final_pictures_show_the_last_state_of_an_episode(shared_env, engine: str) -> None:
    env = shared_env("cartpole", engine=engine, nworld=2, cameras=SIDE, final_pictures=True, horizon=6)
    endless = shared_env("cartpole", engine=engine, nworld=2, cameras=SIDE, horizon=6, autoreset=False)
    endless.set_state(env.get_state())
    for _ in range(6):
        env.step(torch.ones_like(env.action))
        endless.step(torch.ones_like(env.action))
    assert env.done.all()
    torch.testing.assert_close(env.final_obs_groups["camera"], endless.obs_groups["camera"], rtol=0, atol=0)
    assert not torch.equal(env.obs_groups["camera"], env.final_obs_groups["camera"])
    assert "camera" not in endless.final_obs_groups


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_worlds_may_differ_in_colours_and_fields_of_view(shared_env, engine: str) -> None:
    env = shared_env("cartpole", engine=engine, nworld=2, cameras=SIDE, dynamics=["geom_rgba", "cam_fovy", "geom_size"])
    env.reset()
    before = env.get_obs(group="camera")
    assert torch.equal(before[0], before[1])
    for name, factor in (("cam_fovy", 0.5), ("geom_rgba", 0.3), ("geom_size", 3.0)):
        values = env.field(name).clone()
        values[1] *= factor
        env.set_dynamics(**{name: values})
        after = env.get_obs(group="camera")
        assert torch.equal(before[0], after[0]) and not torch.equal(before[1], after[1]), name
        env.rand_reset(0)
        env.reset()


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_camera_may_follow_a_centre_of_mass(engine: str) -> None:
    env = lw.make(Followed, nworld=2, engine=engine)
    env.reset()
    state = env.get_state()
    state[1, env.state_space.parts["qpos"].start] += 0.7
    env.set_state(state)
    moving = np.flatnonzero(env.model.geom_bodyid >= env.model.body("cart").id)
    one, other = (np.isin(picture[..., 0].numpy(), moving) for picture in env.obs_groups["camera"])
    assert one.any() and (one == other).all()


def test_a_camera_with_a_pose_is_added_to_the_model() -> None:
    above = lw.Camera("above", 16, 16, "segmentation", pos=(0, 0, 3), lookat=(0, 0, 0), body="cart", group="above")
    beside = lw.Camera("beside", 16, 16, "depth", pos=(0, -2, 1), lookat=(0, 0, 1), fovy=20)
    env = lw.make("cartpole", cameras=[above, beside])
    camera, data = env.model.camera("above"), mujoco.MjData(env.model)
    mujoco.mj_kinematics(env.model, data)
    mujoco.mj_camlight(env.model, data)
    np.testing.assert_allclose(data.camera("above").xmat.reshape(3, 3)[:, 2], [0, 0, 1], atol=1e-9)
    assert env.model.body(camera.bodyid[0]).name == "cart" and env.model.camera("beside").fovy == 20
    ids = env.obs_groups["above"][0, ..., 0]
    assert env.model.geom(int(ids[8, 8])).bodyid[0] != 0  # it follows the cart, which is at its centre
    assert 1.5 < env.obs_groups["camera"][0, 8, 8, 0] < 2.0


def test_a_task_declares_cameras_and_options_replace_them() -> None:
    assert list(lw.make(Seen).obs_groups) == ["policy", "camera"]
    assert list(lw.make(Seen, cameras=[]).obs_groups) == ["policy"]
    assert lw.MPPI(Seen, samples=4, horizon=2).env.task.cameras == ()


@pytest.mark.parametrize(("cameras", "message"), [
    ([lw.Camera("front")], "no camera 'front': it has 'side'"), (["side", "side"], "group 'camera'"), ("side", "list"),
    ([lw.Camera("side"), lw.Camera("side", 32, group="other")], "one size"), ([3], "Camera"),
    ([lw.Camera("new", pos=(0, 0, 1), lookat=(0, 0, 0), body="wheel")], "no body 'wheel'.*are world, cart"),
    ([lw.Camera("new", pos=(0, 0, 1), lookat=(0, 0, 1))], "must differ"),
    ([lw.Camera("side", group="policy")], "another group: the task's group 'policy' has numbers"),
])  # fmt: skip
def test_wrong_cameras_are_refused(cameras: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lw.make("cartpole", cameras=cameras)


@pytest.mark.parametrize(("words", "message"), [
    ({"width": 30}, "multiple of 4"), ({"height": 0}, "height"), ({"kind": "grey"}, "rgb"),
    ({"pos": (0, 0, 1)}, "lookat"),
    ({"pos": (0, 1), "lookat": (0, 0)}, "three"), ({"fovy": 200}, "fovy"),
])  # fmt: skip
def test_wrong_arguments_of_a_camera_are_refused(words: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lw.Camera("side", **words)


def test_pictures_count_as_memory() -> None:
    with pytest.raises(ValueError, match="use nworld="):
        lw.make("cartpole", nworld=10_000_000, cameras=[lw.Camera("side", 4096, 4096)])


def test_learners_and_planners_without_encoders_refuse_cameras(shared_env) -> None:
    env = shared_env("cartpole", nworld=2, cameras=SIDE)
    for kind in (lw.NPG, lw.SAC):
        with pytest.raises(ValueError, match="cameras"):
            kind(env)
    with pytest.raises(ValueError, match="cameras"):
        lw.MPPI("cartpole", cameras=SIDE)


def test_a_task_with_cameras_follows_the_rules() -> None:
    report = check_task("cartpole", nworld=2, cameras=SIDE, checks=(check_truncation, check_bad_state))
    assert "truncation" in str(report)
