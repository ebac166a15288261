import copy
import json
import math
import re
import runpy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.cli import main

DOCS = Path(__file__).parents[2] / "docs"

CALM = {
    "linear_velocity_noise": 0.0, "angular_velocity_noise": 0.0, "gravity_noise": 0.0, "joint_position_noise": 0.0,
    "joint_velocity_noise": 0.0, "encoder_bias": 0.0, "push_seconds": (1e6, 1e6), "command_seconds": (1e6, 1e6),
    "heading_share": 0.0, "standing_share": 0.0,
}  # fmt: skip


def program_of(page: str, title: str, folder: Path) -> dict[str, Any]:
    pytest.importorskip("onnxruntime")
    text = (DOCS / page).read_text()
    (program,) = re.findall(rf"^```python title={title}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert "lyceum_warp" not in program
    path = folder / title
    path.write_text(program)
    return runpy.run_path(str(path))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return program_of("deployment.md", "robot_loop.py", tmp_path_factory.mktemp("page"))


def walking_policy(env: lw.Env) -> lw.GaussianPolicy:
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, normalize=True)
    policy.observe(env.obs + 0.3 * torch.randn(200, 1, env.obs_space.size))
    with torch.no_grad():
        policy.network[-1].weight *= 40.0
    return policy.requires_grad_(False)


@pytest.mark.quick("go1_velocity")
@pytest.mark.parametrize(("task", "steps"), [("go1_velocity", 25), ("spot_velocity", 25), ("g1_velocity", 10)])
def test_control_loop_in_the_documentation_reproduces_steps_of_the_environment(
    page: dict[str, Any], task: str, steps: int, tmp_path: Path
) -> None:
    torch.manual_seed(0)
    try:
        env = lw.make(task, **CALM)
    except (FileNotFoundError, ImportError) as error:
        pytest.skip(str(error))
    env.rand_reset(4)
    policy = walking_policy(env)
    file = lw.export_policy(policy, tmp_path / "policy.onnx", env=env)
    model = copy.copy(env.model)
    model.geom_friction[:], model.body_ipos[:] = env.field("geom_friction")[0], env.field("body_ipos")[0]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    parts = env.state_space.split(env.get_state()[0])
    data.qpos[:], data.qvel[:], data.ctrl[:] = parts["qpos"], parts["qvel"], parts["ctrl"]
    if task == "g1_velocity":
        sine, cosine = parts["clock"].tolist()
        data.time = math.atan2(sine, cosine) / (2.0 * math.pi * env.task.params["gait_frequency"])
    robot, command = page["Policy"](str(file), model), parts["drawn_velocity"].numpy()
    moved = 0.0
    for _ in range(steps):
        robot.act(data, command)
        np.testing.assert_allclose(robot.observation(data, command)[-3:], env.obs[0, -3:], atol=1e-6)
        env.step(policy(env.obs))
        mujoco.mj_step(model, data, robot.substeps)
        np.testing.assert_allclose(robot.action, env.action[0], atol=1e-5)
        # contacts amplify the rounding of actions, and the error reaches 2e-5 within ten steps of a G1
        np.testing.assert_allclose(robot.observation(data, command), env.obs[0], atol=1e-4, rtol=1e-4)
        moved = max(moved, np.abs(robot.action).max())
    assert moved > 0.3 and not env.done.any()


@pytest.mark.quick("go1_tracking")
@pytest.mark.parametrize("task", ["go1_tracking", "g1_tracking", "g1_blind_tracking"])
def test_tracking_loop_in_the_documentation_reproduces_steps_of_the_environment(task: str, tmp_path: Path) -> None:
    page = program_of("tracking.md", "tracking_loop.py", tmp_path)
    torch.manual_seed(0)
    env = lw.make(task, randomness=0.0, start_clip=1, start_frame=30, reference_share=0.5)
    policy = walking_policy(env)
    with torch.no_grad():
        policy.network[-1].weight *= 0.5
    file = lw.export_policy(policy, tmp_path / "policy.onnx", env=env)
    first, count = env.task.params["ranges"][1]
    table = env.task.params["clips"][first : first + count]
    clips = lw.Clips(names=("turn",), qpos=(table[:, 2:].astype(float),), rate=50.0, weights=(1.0,))
    model = copy.copy(env.model)
    robot, data = page["Policy"](str(file), model), mujoco.MjData(model)
    clip = page["Clip"](str(clips.save(tmp_path / "turn.npz", model)), robot)
    assert len(clip) == count
    parts = env.state_space.split(env.get_state()[0])
    data.qpos[:], data.qvel[:] = parts["qpos"], parts["qvel"]
    for step in range(31, 51):
        robot.act(model, data, clip.frame(step))
        env.step(policy(env.obs))
        mujoco.mj_step(model, data, robot.substeps)
        np.testing.assert_allclose(robot.action, env.action[0], atol=1e-5)
        seen = robot.observation(model, data, clip.frame(step + 1))
        np.testing.assert_allclose(seen, env.obs[0], atol=1e-4, rtol=1e-4)
    assert np.abs(robot.action).max() > 0.1 and not env.done.any()


def test_export_command_writes_metadata_of_the_task(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runtime = pytest.importorskip("onnxruntime")
    config = lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,), mean_every=0)
    run = lw.train(lw.NPG(lw.make("point_mass", nworld=2, frame_skip=3), config=config), tmp_path / "run", 1)

    def metadata() -> dict[str, str]:
        assert main(["export", str(run.folder)]) == 0
        return runtime.InferenceSession(str(run.folder / "policy.onnx")).get_modelmeta().custom_metadata_map

    found = metadata()
    env = lw.make("point_mass", frame_skip=3)
    assert json.loads(found["timestep"]) == pytest.approx(env.timestep)
    assert [part["name"] for part in json.loads(found["observations"])] == list(env.obs_space.parts)
    assert json.loads(found["actions"]) == [{"name": name, "size": 1} for name in env.action_space.parts]
    capsys.readouterr()
    run.amend(task="nowhere.py")
    assert metadata() == {}
    assert "the file has no metadata on the robot: " in capsys.readouterr().err
