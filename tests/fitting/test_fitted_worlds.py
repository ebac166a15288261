import dataclasses
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from hidden_robots import ARM, log_of
from training_runs import QUIET

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos.common.policy_export import deployment_metadata
from lyceum_warp.training import Configuration, Run

TASK = """import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    dof_damping: Row[float]
    offset: Row[float] = lw.lasting_memory(2)


@wp.struct
class Params:
    dt: float
    stiffness: float = lw.from_model(lambda model, p: model.actuator_gainprm[0, 0])


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for i in range(2):
        ctrl[i] = action[i] - 0.5 - s.offset[i]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    lw.put(obs, 0, s.qpos)


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.dof_damping[0] = 2.0 * s.dof_damping[0]
    s.offset[0] = 0.1


class FittedArm(lw.Task):
    model, frame_skip, obs, horizon = "arm.xml", 2, {"position": 2}, 20
"""
SMALL = [
    "--num-steps", "4", "--nworld", "2", "--hidden", "8", "--value-hidden", "8", "--minibatches", "1",
    "--mean-every", "0",
    *QUIET,
]  # fmt: skip
NAMES = ["kp.*", "dof_damping.*", "body_ipos.lower[2]", "delay.ctrl.*"]


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> lw.Fit:
    log = log_of(
        ARM, NAMES, {"kp.*": 0.2, "delay.ctrl.*": 0.012}, lw.excitation([-0.8] * 2, [0.8] * 2, seconds=3.0, rate=100)
    )
    folder = tmp_path_factory.mktemp("fit")
    return lw.fit(mujoco.MjSpec.from_string(ARM), log, NAMES, out=folder, samples=0, nthread=1)


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("task")
    (folder / "arm.xml").write_text(ARM)
    (folder / "fitted_arm.py").write_text(TASK)
    return str(folder / "fitted_arm.py")


def test_fitted_values_and_delays_are_those_of_the_worlds(fit: lw.Fit, task: str) -> None:
    env = lw.make(task, fitted=fit.folder)
    assert env.model.actuator_gainprm[:, 0] == pytest.approx(np.array([30.0, 15.0]) * fit.value[0])
    assert env.model.actuator_delay == pytest.approx([fit.value[3]] * 2)
    assert env.task.params["stiffness"] == 30.0  # an action means the same as without the fit
    plain = lw.make(task)
    for e in (env, plain):
        e.reset()
        e.step(torch.full((1, 2), 0.5))
    assert not torch.equal(env.obs, plain.obs)
    assert torch.equal(env.replicate(nworld=2).field("dof_damping")[0], env.field("dof_damping")[0])


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_worlds_draw_around_the_fit_and_keep_their_draws(fit: lw.Fit, task: str, engine: str) -> None:
    env = lw.make(task, fitted=fit.folder, fitted_draws=True, nworld=64, engine=engine, fields=["body_ipos"], seed=3)
    damping = env.field("dof_damping").clone()
    middle, low, high = 0.6 * np.array([x[1] for x in (fit.value, fit.low, fit.high)])  # startup doubles 0.3
    assert damping[:, 0].mean().item() == pytest.approx(middle, rel=0.05)
    inside = (damping[:, 0] > low) & (damping[:, 0] < high)
    assert 0.8 < inside.float().mean() <= 1.0 and len(damping[:, 0].unique()) > 40
    env.rand_reset(seed=9)
    assert torch.equal(env.field("dof_damping"), damping)
    half = lw.make(task, fitted=fit.folder, fitted_draws=True, nworld=32, engine=engine, seed=3, first_world=32)
    assert torch.equal(half.field("dof_damping"), damping[32:])


def test_both_engines_step_fitted_worlds_alike(fit: lw.Fit, task: str) -> None:
    envs = [
        lw.make(task, fitted=fit.folder, fitted_draws=True, nworld=4, engine=engine) for engine in ("mujoco", "warp")
    ]
    for env in envs:
        env.reset()
        for k in range(10):
            env.step(torch.full((4, 2), 0.3 * (-1) ** k))
    assert torch.allclose(envs[0].obs, envs[1].obs, atol=1e-5)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_delayed_controls_begin_as_after_the_action_0(fit: lw.Fit, task: str, tmp_path: Path, engine: str) -> None:
    envs = [
        lw.make(task, fitted=folder, engine=engine)
        for folder in (fit.folder, changed(fit, tmp_path / "fit", delays={}))
    ]
    for env in envs:
        env.lasting["offset"].zero_()
        env.reset()
        env.step()
    assert envs[0].obs.abs().min() > 1e-3
    assert torch.allclose(envs[0].obs, envs[1].obs, atol=1e-6)


def test_log_of_actions_is_a_log_of_their_controls(task: str) -> None:
    actions = lw.excitation([-0.3] * 2, [1.3] * 2, seconds=3.0, rate=100)
    log = log_of(ARM, ["kp.*"], {"kp.*": 0.2}, actions - 0.5)
    others = {name: column for name, column in log.items() if name != "ctrl"}
    fits = [lw.fit(task, logged, ["kp.*"], samples=0, iterations=1, nthread=1)
            for logged in (log, others | {"action": actions})]  # fmt: skip
    assert fits[1].value == pytest.approx(fits[0].value, rel=1e-6)


def test_run_keeps_a_copy_of_its_fit(fit: lw.Fit, task: str, tmp_path: Path) -> None:
    source = tmp_path / "fit"
    source.mkdir()
    assert fit.folder is not None
    for name in ("fit.json", "draws.npz"):
        (source / name).write_bytes((fit.folder / name).read_bytes())
    env = lw.make(task, fitted=source, fitted_draws=True, nworld=4)
    learner = lw.PPO(env, config=lw.PPOConfig(num_steps=4, hidden=[8], value_hidden=[8], minibatches=1))
    lw.train(learner, tmp_path / "run", 1)
    for file in source.iterdir():
        file.unlink()
    run = Run.open(tmp_path / "run")
    assert run.config["fit"]["parameters"].keys() == set(NAMES)
    options = Configuration.of(run).options
    assert options.fitted_draws and options.fitted is not None and Path(options.fitted).is_relative_to(tmp_path / "run")
    assert lw.make(task, fitted=options.fitted).model.actuator_delay[0] > 0.0
    policy = lw.load(run)
    metadata = deployment_metadata(policy, env)
    assert metadata["fit"]["delays"]["elbow"] == pytest.approx(fit.value[3]) and json.dumps(metadata)
    verdict = lw.transfer(env.replicate(fitted=options.fitted), policy, 4, warp=False)
    assert "fitted by" in verdict.line and dataclasses.asdict(verdict)["fitted"] == options.fitted


def test_training_with_a_fit_keeps_the_time_step_of_its_model(fit: lw.Fit, task: str, tmp_path: Path) -> None:
    coarse = """    physics = {"coarse": lw.PhysicsOptions(frame_skip=1)}
    training = lw.Training(algorithm="ppo", physics="coarse", exact_from=1)
"""
    file = tmp_path / "coarse_arm.py"
    file.write_text(TASK + coarse)
    (tmp_path / "arm.xml").write_text(ARM)
    for name, flags in {"plain": [], "fitted": ["--fitted", str(fit.folder)]}.items():
        command = ["train", str(file), "--out", str(tmp_path / name), "--iterations", "1", *SMALL, *flags]
        assert cli.main(command) == 0
    configs = [Run.open(tmp_path / name).config for name in ("plain", "fitted")]
    assert [config["physics"].get("frame_skip", 2) for config in configs] == [1, 2]
    assert [config["exact_from"] for config in configs] == [1, None]


def changed(fit: lw.Fit, folder: Path, **content: Any) -> Path:
    assert fit.folder is not None
    folder.mkdir()
    (folder / "draws.npz").write_bytes((fit.folder / "draws.npz").read_bytes())
    (folder / "fit.json").write_text(json.dumps(json.loads((fit.folder / "fit.json").read_text()) | content))
    return folder


def test_unfit_folder_is_refused_in_one_sentence(fit: lw.Fit, task: str, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no fit in"):
        lw.make(task, fitted=tmp_path / "none")
    wrong = {
        "newer": ({"format": 99}, "pip install --upgrade"),
        "other": ({"fields": {"dof_damping": {"knee": [1.0]}}}, "has no joint .knee."),
        "unknown": ({"fields": {"nq": {"elbow": [1.0]}}}, "no field that can be fitted"),
        "shape": ({"fields": {"dof_damping": {"elbow": [1.0, 2.0]}}}, "has shape"),
        "delay": ({"delays": {"wrist": 0.1}}, "no actuator here"),
        "broken": ({"fields": 3}, "is damaged"),
    }
    for name, (content, message) in wrong.items():
        with pytest.raises(ValueError, match=message):
            lw.make(task, fitted=changed(fit, tmp_path / name, **content))
    with pytest.raises(ValueError, match="needs a fit"):
        lw.make(task, fitted_draws=True)
