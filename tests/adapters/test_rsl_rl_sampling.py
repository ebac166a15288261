"""Samples of rsl_rl's PPO, computed for all steps at once, and when its normalisers take them in."""

import copy
from typing import Any

import pytest
import torch
from metered_task import Metered
from rsl_rl.modules import EmpiricalNormalization

import lyceum_warp as lw
from lyceum_warp.adapters.rsl_rl_config import RslRlConfig
from lyceum_warp.adapters.rsl_rl_learner import RslRlLearner
from lyceum_warp.adapters.rsl_rl_normalizer import take_in


def learner(*, device: str = "cpu", nworld: int = 8, **changes: Any) -> RslRlLearner:
    settings: dict[str, Any] = {"hidden": (16, 8), "value_hidden": (8,), "num_steps_per_env": 12, "mean_every": 0}
    env = lw.make(Metered, nworld=nworld, horizon=10, far=0.1, device=device)
    return RslRlLearner(env, config=RslRlConfig(**settings | {"tf32": False} | changes))


def check_equal(device: str, rtol: float, **changes: Any) -> None:
    """Compare what is stored, and the networks, over iterations with ends of all kinds."""
    own, batched = (learner(device=device, batched_values=b, **changes) for b in (False, True))
    ends = torch.zeros(3)
    for iteration in range(3):
        for made in (own, batched) if iteration == 1 else ():
            state = made.env.get_state()
            state[2, made.env.state_space.parts["qvel"].start] = 1e12  # a fault
            made.env.set_state(state)
        a, b = next(own).row(), next(batched).row()
        one, other = own.ppo.storage, batched.ppo.storage
        for name in ("actions", "rewards", "dones", "values", "actions_log_prob", "returns", "advantages"):
            torch.testing.assert_close(getattr(other, name), getattr(one, name), rtol=rtol, atol=rtol, msg=name)
        for group in ("policy", "critic"):
            torch.testing.assert_close(other.observations[group], one.observations[group], rtol=rtol, atol=rtol)
        for part, same in zip(one.distribution_params, other.distribution_params, strict=True):
            torch.testing.assert_close(same, part, rtol=rtol, atol=rtol)
        for name in ("kl", "learning_rate", "value_loss", "return_recent"):
            assert b[name] == pytest.approx(a[name], rel=10 * rtol, abs=rtol, nan_ok=True), name
        rollout = batched.rollout
        kinds = rollout.terminated, rollout.done & ~rollout.terminated
        ends += torch.stack([*(kind.sum() for kind in kinds), rollout.faults.sum()]).cpu()
    assert (ends > 0).all()  # terminated, cut off, faults


@pytest.mark.parametrize("bootstrap", ["final", "before"])
@pytest.mark.parametrize("normalize_when", ["after", "before"])
def test_what_is_stored_is_the_same(bootstrap: str, normalize_when: str) -> None:
    """With "before", values of the samples are those of the statistics with which the update begins."""
    if normalize_when == "before":
        made = learner(bootstrap=bootstrap, normalize_when="before", batched_values=True)
        next(made)
        made._sample()
        critic = made.ppo.critic
        values = critic.mlp(critic.get_latent(made.ppo.storage.observations))
        torch.testing.assert_close(made.ppo.storage.values, values)
    else:
        check_equal("cpu", 1e-4, bootstrap=bootstrap, normalize_when="after")


def test_a_saved_state_is_continued_exactly() -> None:
    one, other = (learner(batched_values=True, normalize_when="step") for _ in range(2))
    next(one)
    other.load_state_dict(one.state_dict())
    for _ in range(2):
        first, second = next(one), next(other)
        assert (first.kl, first.learning_rate, first.value_loss) == (second.kl, second.learning_rate, second.value_loss)


def test_observations_are_taken_in_as_rsl_rl_does() -> None:
    made = learner()
    for network, size in ((made.ppo.actor, 1), (made.ppo.critic, 2)):
        known = EmpiricalNormalization(size)
        address = network.obs_normalizer._std.data_ptr()
        for _ in range(3):
            rows = {"policy": 3.0 + 2.0 * torch.randn(40, 1), "critic": 5.0 * torch.randn(40, 2)}
            known.update(rows[network.obs_groups[0]])
            take_in(network, {group: part.view(5, 8, -1) for group, part in rows.items()})
        for name, buffer in known.state_dict().items():
            torch.testing.assert_close(network.obs_normalizer.state_dict()[name], buffer, rtol=1e-5, atol=1e-6)
        assert network.obs_normalizer._std.data_ptr() == address
    plain = learner(normalize=False)
    take_in(plain.ppo.actor, rows)
    assert next(plain).iteration == 1


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("when", ["step", "before", "after"])
@pytest.mark.parametrize("captured", [False, True])
def test_the_statistics_take_in_each_sample_once(when: Any, batched: bool, captured: bool) -> None:
    made = learner(normalize_when=when, batched_values=batched, captured_update=captured)
    normalizer, counts = made.ppo.critic.obs_normalizer, []
    update = made._update

    def noted() -> Any:
        counts.append(normalizer.count.item())
        return update()

    made._update = noted
    for _ in range(2):
        next(made)
    assert counts == ([96, 192] if when != "after" else [0, 96]) and normalizer.count == 192
    seen = copy.deepcopy(normalizer._mean)
    rows = made.ppo.storage.observations["critic"]
    next(made)
    if when != "step":  # there, observations after a step count, not those before it
        torch.testing.assert_close(normalizer._mean[0], (2 * seen[0] + rows.mean((0, 1))) / 3)


def test_statistics_of_a_step_serve_the_next_one() -> None:
    """As in rsl_rl 5.4: the mean action of the second step is that of statistics with the first one's results."""
    made = learner(normalize_when="step", batched_values=True)
    made._sample()
    storage, actor = made.ppo.storage, made.ppo.actor
    known = EmpiricalNormalization(1)
    for t in range(3):
        mean = actor.mlp(known(storage.observations["policy"][t]))
        torch.testing.assert_close(storage.distribution_params[0][t], mean.detach())
        known.update(storage.observations["policy"][t + 1])


@pytest.mark.gpu
@pytest.mark.parametrize("bootstrap", ["final", "before"])
def test_gpu_what_is_stored_is_the_same(bootstrap: str) -> None:
    made = learner(device="cuda:0", batched_values=True, bootstrap=bootstrap, normalize_when="after")
    for _ in range(3):
        next(made)
    ppo, storage = made.ppo, made.ppo.storage
    made._sample()
    ppo.actor(storage.observations.flatten(0, 1), stochastic_output=True)
    log_prob = ppo.actor.get_output_log_prob(storage.actions.flatten(0, 1))
    torch.testing.assert_close(storage.actions_log_prob.flatten(), log_prob, rtol=1e-3, atol=1e-3)
    values = ppo.critic(storage.observations.flatten(0, 1))
    torch.testing.assert_close(storage.values.flatten(0, 1), values, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
@pytest.mark.parametrize("when", ["step", "before", "after"])
def test_gpu_sampling_for_all_steps_does_not_wait_for_the_device(when: Any) -> None:
    made = learner(device="cuda:0", nworld=64, batched_values=True, captured_update=True, normalize_when=when)
    for _ in range(3):
        next(made)
    torch.cuda.set_sync_debug_mode("error")
    try:
        made._sample()
    finally:
        torch.cuda.set_sync_debug_mode("default")
