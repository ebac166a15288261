import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos import Team
from lyceum_warp.algos.common.pictures import Stack, shift_pictures
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.training import Configuration

SIDE = [lw.Camera("side", 16, 16)]
SMALL: dict[str, Any] = {
    "policy_groups": ("camera",), "channels": (4, 8), "hidden": (16,), "mean_every": 0, "num_steps": 6,
}  # fmt: skip


def ppo(env: lw.Env, **changes: Any) -> lw.PPO:
    config: dict[str, Any] = SMALL | {"value_hidden": (8,), "minibatches": 2} | changes
    return lw.PPO(env, config=lw.PPOConfig(**config))


@pytest.fixture
def env(shared_env) -> lw.Env:
    return shared_env("cartpole", nworld=4, cameras=SIDE, horizon=5)


@pytest.mark.parametrize("changes", [
    {}, {"recurrent": 8}, {"policy_groups": (), "spatial_softmax": True, "frames": 2, "normalize": False},
])  # fmt: skip
def test_an_update_sees_what_the_policy_saw_while_it_acted(env: lw.Env, changes: dict[str, Any]) -> None:
    learner = ppo(env, **changes)
    next(learner)
    for _ in range(2):
        learner.sample()
        rollout, policy = learner.rollout, learner.policy
        assert rollout.obs_groups["camera"].dtype == torch.uint8 and "camera" not in rollout.final_obs_groups
        assert rollout.done.any()
        mean, _ = policy.unrolled(policy.inputs(rollout.obs_groups), learner._first, rollout.step == 0.0)
        torch.testing.assert_close(mean, learner._means, rtol=1e-5, atol=1e-6)
        learner.update(learner.evaluated_samples())
        learner.divergence()


def test_a_stack_holds_changes_within_an_episode_only() -> None:
    stack, state = Stack(2, 3), torch.zeros(1, 6)
    x = torch.tensor([[[1.0, 2.0]], [[2.0, 5.0]], [[4.0, 4.0]], [[0.0, 0.0]]])
    outputs = []
    for t, now in enumerate(x):
        output, state = stack(now, state * (t != 3))
        outputs.append((output / torch.tensor([1.0, 1.0, 2.0, 2.0, 2.0, 2.0])).tolist()[0])
    assert outputs == [
        [1, 2, 0, 0, 0, 0], [2, 5, 1, 3, 0, 0], [4, 4, 2, -1, 3, 2], [0, 0, 0, 0, 0, 0],
    ]  # fmt: skip


def test_shifts_move_each_world_by_whole_pixels() -> None:
    pictures = torch.arange(3 * 8 * 8).view(1, 3, 8, 8, 1).float().repeat(2, 1, 1, 1, 1)
    before = pictures.clone()
    shift_pictures(pictures, 2, torch.Generator().manual_seed(1))
    assert torch.equal(pictures[0], pictures[1]) and not torch.equal(pictures, before)
    offsets = (pictures - before)[0, :, 2:6, 2:6, 0].flatten(1)  # away from the edges, a shift is a constant
    assert (offsets == offsets[:, :1]).all() and len(set(offsets[:, 0].tolist())) > 1


def test_a_student_learns_from_pictures_what_its_teacher_reads_from_the_state(shared_env) -> None:
    class Teacher(torch.nn.Module):
        nobs, nact = 5, 1

        def act(self, obs: torch.Tensor) -> torch.Tensor:
            return obs[:, :1].clamp(-1, 1)  # the cart's position

    env = shared_env("cartpole", nworld=16, cameras=SIDE, horizon=40, reset_cart=1.0)
    config = lw.DistillConfig(**SMALL | {"num_steps": 12, "log_std": -0.5, "learning_rate": 2e-3})
    learner = lw.Distill(env, config=config, teacher=Teacher())
    losses = [next(learner).loss for _ in range(30)]
    assert losses[-1] < 0.1 * losses[0]


def test_a_student_learns_from_the_pictures_of_saved_episodes(shared_env) -> None:
    env = shared_env("cartpole", nworld=16, cameras=SIDE, horizon=40, reset_cart=1.0)
    episodes = list(policy_episodes(env.replicate(autoreset=False), lambda obs: obs[:, :1].clamp(-1, 1), 16, seed=1))
    given = lw.Demonstrations(episodes)
    assert torch.equal(given.obs_groups["camera"][40:80], episodes[1].pictures["camera"][:40])
    stored = lw.Demonstrations.like(given.shape)
    stored.load_state_dict(given.state_dict())
    config = lw.DistillConfig(**SMALL | {"num_steps": 12, "learning_rate": 2e-3})
    learner = lw.Distill(env, config=config, teacher=stored)
    losses = [next(learner).loss for _ in range(30)]
    assert losses[-1] < 0.1 * losses[0]
    for unfit in ([dataclasses.replace(each, pictures={}) for each in episodes], [
        dataclasses.replace(each, pictures={"camera": each.pictures["camera"][:, :8]}) for each in episodes
    ]):  # fmt: skip
        with pytest.raises(ValueError, match=r"demonstrations have no pictures 'camera' of the shape \(16, 16, 3\)"):
            lw.Distill(env, config=config, teacher=lw.Demonstrations(unfit))


def test_a_run_with_cameras_resumes_to_the_bit_and_its_policy_acts_elsewhere(env: lw.Env, tmp_path: Path) -> None:
    once = lw.train(ppo(env), tmp_path / "once", iterations=4)
    env.rand_reset(0)
    lw.train(ppo(env), tmp_path / "twice", iterations=2)
    run = lw.Run.open(tmp_path / "twice")
    twice = lw.train(Configuration.of(run).learner(Team(), run=run), run, iterations=4)
    assert once.rows()[-1]["surrogate_loss"] == twice.rows()[-1]["surrogate_loss"]
    policy = lw.load(tmp_path / "twice")
    returns = [lw.evaluate(lw.make("cartpole", nworld=2, horizon=5, engine=engine, cameras=SIDE), policy, 2, seed=1)
               for engine in ("mujoco", "warp")]  # fmt: skip
    torch.testing.assert_close(returns[0].returns, returns[1].returns, rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="no group 'camera'"):
        lw.evaluate(lw.make("cartpole", nworld=2, horizon=5), policy, 2)


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".pt2", ".onnx"])
def test_an_exported_policy_takes_pictures(env: lw.Env, tmp_path: Path, suffix: str) -> None:
    policy = ppo(env, policy_groups=()).policy
    state, obs = torch.rand(4, policy.state_size), policy.inputs(env.obs_groups)
    if suffix == ".onnx":
        runtime = pytest.importorskip("onnxruntime")
        pytest.importorskip("onnxscript")
    path = lw.export_policy(policy, tmp_path / f"policy{suffix}", env=env)
    if suffix == ".pt2":
        results = torch.export.load(path).module()(obs, state)
    else:
        inputs = {"obs": obs[0], "camera": obs[1], "state": state}
        session = runtime.InferenceSession(str(path))
        results = map(torch.from_numpy, session.run(None, {name: part.numpy() for name, part in inputs.items()}))
    for result, wanted in zip(results, policy.act(obs, state), strict=True):
        torch.testing.assert_close(result, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("changes", "message"), [
    ({"policy_groups": ("front",)}, "no group 'front'"), ({"value_group": "camera"}, "no group 'camera'"),
    ({"policy_groups": ("camera", "ids")}, "segmentation"), ({"num_steps": 2}, "frames"),
    ({"symmetry": "exact"}, "without cameras"), ({"policy_groups": "camera"}, "names"),
    ({"policy_groups": ("camera", "camera")}, "'camera' twice"), ({"random_shift": 40}, "less than the 16 pixels"),
    ({"policy_groups": ("policy",), "random_shift": 2}, "0 for a policy without cameras"),
])  # fmt: skip
def test_wrong_settings_are_refused(shared_env, changes: dict[str, Any], message: str) -> None:
    cameras = [*SIDE, lw.Camera("side", 16, 16, "segmentation", "ids")]
    with pytest.raises(ValueError, match=message):
        ppo(shared_env("cartpole", nworld=4, cameras=cameras, horizon=5), **changes)
