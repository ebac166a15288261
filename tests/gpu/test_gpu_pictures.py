from typing import Any

import pytest
import torch
from test_gpu import CUDA, nothing_waits

import lyceum_warp as lw

pytestmark = pytest.mark.gpu

CAMERA = lw.Camera("side", 32, 32)


def learner(**changes: Any) -> lw.PPO:
    config: dict[str, Any] = {"policy_groups": ("camera",), "channels": (4, 8), "hidden": (16,), "num_steps": 6}
    env = lw.make("cartpole", nworld=32, horizon=10, cameras=[CAMERA], device=CUDA)
    return lw.PPO(env, config=lw.PPOConfig(mean_every=0, value_hidden=(8,), schedule="fixed", **config | changes))


@pytest.mark.parametrize("kind", ["rgb", "depth", "segmentation"])
def test_pictures_on_a_gpu_equal_those_on_the_cpu_but_for_edges(kind: Any) -> None:
    cameras = [lw.Camera("near", 64, 48, kind, pos=(0.0, -3.0, 1.0), lookat=(0.0, 0.0, 1.0))]
    envs = [lw.make("cartpole", nworld=4, cameras=cameras, device=device) for device in ("cpu", CUDA)]
    for _ in range(3):
        for env in envs:
            env.step()
    one, other = (env.obs_groups["camera"].float().cpu() for env in envs)
    difference = (one - other).abs().amax(-1)
    assert one.std() > 0 and (difference > 0.03 * one.abs().amax(-1).clamp_min(1.0)).float().mean() < 0.01


def test_steps_with_pictures_do_not_wait_for_the_device() -> None:
    env = lw.make("cartpole", nworld=64, horizon=5, cameras=[CAMERA], final_pictures=True, device=CUDA)
    for _ in range(8):
        env.step()
    with nothing_waits():
        for _ in range(8):
            env.step()
    assert env.obs_groups["camera"].float().std() > 0 and env.final_obs_groups["camera"].float().std() > 0


def test_pictures_do_not_affect_deterministic_steps() -> None:
    options: dict[str, Any] = {"nworld": 64, "horizon": 5, "deterministic": True, "device": CUDA}
    envs = [lw.make("half_cheetah", cameras=cameras, **options) for cameras in ([lw.Camera("track", 32, 32)], [])]
    for _ in range(12):
        for env in envs:
            env.step(torch.ones_like(env.action))
        assert torch.equal(envs[0].get_state(), envs[1].get_state())


@pytest.mark.parametrize("changes", [{}, {"recurrent": 8}, {"spatial_softmax": True, "policy_groups": ()}])
def test_captured_epochs_with_pictures_equal_epochs_without_graphs(changes: dict[str, Any]) -> None:
    captured, direct = learner(tf32=False, **changes), learner(tf32=False, **changes)
    direct.minibatches.epoch.enabled = False
    for _ in range(4):
        one, other = next(captured), next(direct)
        assert one.value_loss == pytest.approx(other.value_loss, rel=5e-2, abs=5e-3)
    for name, part in captured.policy.state_dict().items():
        torch.testing.assert_close(part, direct.policy.state_dict()[name], rtol=5e-2, atol=5e-3, msg=name)


def test_an_iteration_with_pictures_waits_for_the_device_only_at_its_end() -> None:
    ppo = learner(random_shift=2)
    for _ in range(2):
        next(ppo)
    with nothing_waits():
        ppo.sample()
        ppo.update(ppo.evaluated_samples())
        ppo.divergence()
