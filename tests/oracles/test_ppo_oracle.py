from collections.abc import Iterator
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

import lyceum_warp as lw
from lyceum_warp.adapters import RslRlVecEnv, runner_config
from lyceum_warp.algos.common.networks import GRU

STEPS, N = 12, 8


class Mirrored(Metered):
    mirror = lw.Mirror({"x": [-1.0], "v": [-1.0], "action": [-1.0]})


@pytest.fixture(autouse=True)
def double() -> Iterator[None]:
    """Use float64, because Adam would turn float32 rounding errors of tiny gradients into full steps."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def samples(ppo: lw.PPO) -> dict[str, torch.Tensor]:
    """Draw samples. A tenth of the steps begin an episode; the worlds' first steps continue one with a random state."""
    env, generator, memory = ppo.env, torch.Generator().manual_seed(1), torch.Generator().manual_seed(2)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(STEPS, N, *shape, generator=generator)

    step = torch.where(torch.rand(STEPS, N, generator=memory) < 0.1, 0.0, 1.0)
    sizes = (ppo.policy.state_size, ppo.value.state_size)
    state, value_state = (torch.randn(1, N, size, generator=memory) for size in sizes)
    obs, value_obs = drawn(env.obs_space.size), drawn(env.obs_spaces[ppo.value.group].size)
    value_obs = obs if ppo.value.group == "policy" else value_obs
    with torch.no_grad():
        mean = ppo.policy.unrolled(obs, state[0], step == 0)[0] + 0.05 * drawn(env.action_space.size)
        value = ppo.value.unrolled(value_obs, step, value_state[0], step == 0)[0] + 0.3 * drawn()
    action = mean + drawn(env.action_space.size)
    log_prob = torch.distributions.Normal(mean, 1.0).log_prob(action).sum(-1)
    advantage = drawn()
    states = {"state": state, "value_state": value_state} if ppo.policy.state_size else {}
    return {"obs": obs, "value_obs": value_obs, "step": step, "action": action, "mean": mean, "log_prob": log_prob,
            "value": value, "target": value + advantage, "advantage": advantage, **states}  # fmt: skip


def augmented(env: Any, obs: Any, actions: Any) -> tuple[Any, Any]:
    """Append mirror images, as ``Mirrored.mirror`` defines them."""
    images = None if obs is None else torch.cat([obs, obs.apply(torch.neg)])
    return images, torch.cat([actions, -actions])


def weights(network: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Return the parameters of a network of this package by their names in rsl_rl."""
    if not isinstance(network, GRU):
        return {f"mlp.{name}": part for name, part in network.state_dict().items()}
    cell = {f"rnn.rnn.{name}_l0": part for name, part in network.cell.state_dict().items()}
    return cell | weights(network.network)


def theirs(ppo: lw.PPO, given: dict[str, torch.Tensor]) -> Any:
    env = ppo.env
    config = runner_config(env, ppo.config)
    if ppo.config.symmetry == "augment":
        config["algorithm"]["symmetry_cfg"] = {"use_data_augmentation": True, "data_augmentation_func": augmented}
    other = OnPolicyRunner(RslRlVecEnv(env), config, None, "cpu").alg
    for network, ours in ((other.actor, ppo.policy.network), (other.critic, ppo.value.network)):
        network.double().load_state_dict(weights(ours), strict=False)
        assert set(weights(ours)) == {name for name in network.state_dict() if not name.startswith("distribution")}
    storage, parts = other.storage, {name: part.unsqueeze(-1) for name, part in given.items()}
    groups = {"policy": given["obs"], ppo.value.group: given["value_obs"]}
    storage.observations = TensorDict(groups, batch_size=[STEPS, N])
    storage.actions = given["action"]
    storage.distribution_params = (given["mean"], torch.ones_like(given["mean"]))
    storage.actions_log_prob, storage.advantages = parts["log_prob"], parts["advantage"]
    storage.values, storage.returns = parts["value"], parts["target"]
    if "state" in given:  # rsl_rl stores the state before each step; it reads those at the beginning of sequences
        starts = given["step"] == 0.0
        storage.dones[:-1, :, 0] = starts[1:]
        for name, state in (("a", given["state"]), ("c", given["value_state"])):
            before = torch.zeros(STEPS, 1, *state.shape[1:])
            before[0] = state.masked_fill(starts[:1, :, None], 0.0)
            setattr(storage, f"saved_hidden_state_{name}", [before] if state.shape[-1] else None)
    return other


@pytest.mark.parametrize("changes", [
    {}, {"desired_kl": 1e-4}, {"desired_kl": 1e3, "max_grad_norm": 0.01}, {"clip": 0.01, "entropy_coef": 0.3},
    {"whiten_minibatches": True, "clip_value_loss": False, "std_type": "log"},
    {"schedule": "fixed", "minibatches": 5, "epochs": 3, "value_coef": 0.5}, {"symmetry": "augment"},
    {"recurrent": 6}, {"recurrent": 6, "value_group": "policy", "whiten_minibatches": True, "minibatches": 3},
])  # fmt: skip
def test_an_update_gives_the_same_parameters_as_rsl_rl(
    changes: dict[str, Any], shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = lw.PPOConfig(**{"hidden": (16, 8), "value_hidden": (8,), "num_steps": STEPS, "normalize": False} | changes)
    ppo = lw.PPO(shared_env(Mirrored, nworld=N, horizon=10), config=config)
    for module in (ppo.policy, ppo.value):  # layers near zero would have small gradients
        layers = module.network.network if isinstance(module.network, GRU) else module.network
        torch.nn.init.xavier_uniform_(layers[-1].weight, generator=torch.Generator().manual_seed(0))
    given = samples(ppo)
    other = theirs(ppo, given)
    used = config.minibatches * ppo.minibatches.batch  # rsl_rl shuffles only the samples that it uses
    order = torch.randperm(used, generator=torch.Generator().manual_seed(0))
    order = torch.cat([order, torch.arange(used, STEPS * N)])
    if config.recurrent:  # rsl_rl does not shuffle the worlds
        order = torch.arange(N)
    monkeypatch.setattr(torch, "randperm", lambda count, **_: order[:count])
    before = [p.detach().clone() for p in ppo.policy.network.parameters()]
    ppo.update(given)
    losses = other.update()
    spread = other.actor.distribution
    std = spread.std_param if config.std_type == "scalar" else spread.log_std_param.exp()
    for network, same in ((ppo.policy.network, other.actor), (ppo.value.network, other.critic)):
        for name, part in weights(network).items():
            torch.testing.assert_close(part, same.state_dict()[name], rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(ppo.policy.log_std.exp(), std, rtol=1e-5, atol=1e-7)
    assert all((p - p0).abs().max() > 1e-5 for p, p0 in zip(ppo.policy.network.parameters(), before, strict=True))
    assert ppo.rate.item() == pytest.approx(other.learning_rate, rel=1e-6)
    means = ppo._losses / (config.epochs * config.minibatches)
    assert means.tolist() == pytest.approx([losses[name] for name in ("value", "surrogate", "entropy")], rel=1e-6)
