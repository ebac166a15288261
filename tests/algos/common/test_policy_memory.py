import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from conftest import SharedEnv
from hidden_task import Hidden
from memory_task import Counter, Counting
from metered_task import Metered
from torch import nn

import lyceum_warp as lw
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.env import Player
from lyceum_warp.tuning.trial import SHORT, Trials
from lyceum_warp.viewer.session.drivers import PolicyControl

SMALL = lw.PPOConfig(hidden=(8,), value_hidden=(8,), num_steps=12, epochs=2, recurrent=6, mean_every=0)


def in_viewer(env: lw.Env) -> None:
    env.rand_reset(0)
    control = PolicyControl("counter", Counter(), env)
    for step in range(12):
        control.act()
        env.step()
        if step == 7:
            env.rand_reset(mask=torch.tensor([True, False, False]))


def tuned(env: lw.Env) -> None:
    trials = Trials(env.replicate(autoreset=False), Counter(), effort=SHORT)
    trials._episodes(env.replicate(autoreset=False), "policy", 0)


def controlled(env: lw.Env) -> None:
    plant = env.replicate(nworld=1, autoreset=False)
    for _ in range(2):
        assert lw.control(plant, Counter(), seed=0).actions[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]


DOORS: dict[str, Callable[[lw.Env], object]] = {
    "evaluate": lambda env: lw.evaluate(env, Counter(), 9),
    "transfer": lambda env: lw.transfer(env, Counter(), 4, warp=False),
    "episodes": lambda env: list(policy_episodes(env.replicate(autoreset=False), Counter(), 7)),
    "view": in_viewer, "tune": tuned, "control": controlled,
    "teacher": lambda env: next(lw.Distill(env, config=lw.DistillConfig(hidden=(4,)), teacher=Counter())),
}  # fmt: skip


@pytest.mark.parametrize("door", DOORS)
def test_memory_is_carried_and_cleared_where_episodes_begin(door: str, shared_env: SharedEnv) -> None:
    """The policy raises an error if its memory is not the number of steps since the episode began."""
    DOORS[door](shared_env(Counting, nworld=3))


def test_gate_tests_a_policy_with_memory(shared_env: SharedEnv) -> None:
    verdict = lw.gate(shared_env(Counting, nworld=3), Counter())
    assert verdict.passed and verdict.numbers == {"error": 0.0}


def test_policy_that_returns_no_state_of_its_size_is_refused(shared_env: SharedEnv) -> None:
    class Forgetful(Counter):
        def act(self, obs: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return state[:, :1], state[:, :1]

    with pytest.raises(ValueError, match=r"must return .*\(3, 1\) and .*\(3, 2\), not .*\(3, 1\) and .*\(3, 1\)"):
        lw.evaluate(shared_env(Counting, nworld=3), Forgetful(), 3)


class Filter(nn.Module):
    """A network with memory of a user: exponential means of the observations."""

    def __init__(self, nobs: int, nact: int) -> None:
        super().__init__()
        self.state_size, self.last = nobs, nn.Linear(2 * nobs, nact)
        self.rate = nn.Parameter(torch.zeros(nobs))

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        state = torch.lerp(state, x, self.rate.sigmoid())
        return self.last(torch.cat([x, state], dim=-1)), state


@pytest.mark.parametrize("own", [False, True])
def test_sequences_give_the_actions_and_values_of_single_steps(own: bool, shared_env: SharedEnv) -> None:
    """Episodes of 10 steps begin and end within rollouts of 12 steps."""
    env = shared_env(Metered, nworld=4, horizon=10)
    policy = lw.GaussianPolicy(1, 1, network=Filter(1, 1)) if own else None
    ppo = lw.PPO(env, policy, config=lw.PPOConfig(**vars(SMALL) | {"normalize": False, "value_group": "policy"}))
    assert ppo.value.state_size == (1 if own else 6)
    for module in (ppo.policy, ppo.value):  # a last layer near zero would hide differences
        nn.init.normal_([layer for layer in module.modules() if isinstance(layer, nn.Linear)][-1].weight)
    stepped = [Player(ppo.policy, env), torch.zeros(4, ppo.value.state_size)]
    for _ in range(3):
        ppo.sample()
        rollout, player, state = ppo.rollout, *stepped
        assert rollout.done.any() and not rollout.done.all()
        values, after = [], []
        with torch.no_grad():
            samples = ppo.evaluated_samples()
            for t in range(12):
                began = (rollout.step[t] == 0)[:, None]
                mean, player.state = ppo.policy.act(rollout.obs[t], player.state.masked_fill(began, 0.0))
                torch.testing.assert_close(samples["mean"][t], mean)
                output, state = ppo.value.network(rollout.obs[t], state.masked_fill(began, 0.0))
                values.append(output.squeeze(-1))
                after.append(ppo.value.network(rollout.final_obs[t], state)[0].squeeze(-1))
            torch.testing.assert_close(samples["value"], torch.stack(values))
            advantage, _ = ppo._estimate(rollout.reward, torch.stack(values), torch.stack(after))
            torch.testing.assert_close(samples["target"], torch.stack(values) + advantage)
            torch.testing.assert_close(ppo.divergence(), torch.zeros(()), atol=1e-6, rtol=0.0)
        stepped = [player, state]


@pytest.mark.parametrize("own", [False, True])
def test_ppo_with_memory_resumes_bit_for_bit(own: bool, shared_env: SharedEnv) -> None:
    env = shared_env(Hidden, nworld=4, horizon=10)
    policy = lw.GaussianPolicy(2, 1, network=Filter(2, 1), normalize=True) if own else None
    one, other = (
        lw.PPO(env.replicate(), copy.deepcopy(policy), config=SMALL, seed=seed) for seed in (1, 1 if own else 2)
    )
    for _ in range(2):
        next(one)
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for _ in range(2):
        first, second = next(one), next(other)
        assert (first.value_loss, first.kl, first.reward_mean) == (second.value_loss, second.kl, second.reward_mean)
    assert all(torch.equal(p, q) for p, q in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


def test_value_function_has_memory_only_without_privileged_observations(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=4, horizon=10)
    assert lw.PPO(env, config=SMALL).value.state_size == 0  # the group "critic"
    ppo = lw.PPO(shared_env(Hidden, nworld=4), config=SMALL)
    assert ppo.value.state_size == 6 and ppo.settings()["recurrent"] == 6
    assert lw.PPO(env, lw.GaussianPolicy(1, 1), config=SMALL).settings()["recurrent"] == 0


def test_memory_is_refused_where_it_cannot_be_carried(shared_env: SharedEnv, tmp_path: Path) -> None:
    env = shared_env("point_mass", nworld=4)
    policy, value = lw.GaussianPolicy(6, 2, recurrent=4), lw.PPO(env, config=SMALL).value
    with pytest.raises(ValueError, match="NPG cannot train a policy with memory: use lw.PPO"):
        lw.NPG(env, policy)
    with pytest.raises(ValueError, match="only PPO can use a value function with memory"):
        lw.NPG(env, value=value)
    with pytest.raises(ValueError, match="only PPO can use a value function with memory"):
        lw.MPPI("point_mass", samples=2, horizon=2, value=value)
    with pytest.raises(ValueError, match="symmetry='exact' needs a policy without memory: use symmetry='none'"):
        lw.PPO(env, policy, config=lw.PPOConfig(symmetry="exact"))
    with pytest.raises(ValueError, match="5 mini-batches need at least 5 worlds, not 4"):
        lw.PPO(env, policy, config=lw.PPOConfig(minibatches=5))


@pytest.mark.quick("gru-policy.onnx", "own-policy.pt2")
@pytest.mark.parametrize("name", ["policy.pt2", "policy.onnx"])
@pytest.mark.parametrize("kind", ["gru", "own"])
def test_exported_policy_has_the_state_as_input_and_output(kind: str, name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = Filter(5, 2) if kind == "own" else None
    policy = lw.GaussianPolicy(5, 2, (8,), network=network, recurrent=4, normalize=True)
    policy.observe(torch.randn(100, 5) + 3.0)
    path = lw.export_policy(policy, tmp_path / name)
    state = given = torch.zeros(3, policy.state_size)
    for _ in range(4):
        obs = torch.randn(3, 5)
        with torch.no_grad():
            action, state = policy.act(obs, state)
        if name.endswith(".pt2"):
            found, given = torch.export.load(path).module()(obs, given)
        else:
            runtime = pytest.importorskip("onnxruntime")
            session = runtime.InferenceSession(str(path))
            outputs = session.run(["action", "next_state"], {"obs": obs.numpy(), "state": given.numpy()})
            found, given = map(torch.from_numpy, outputs)
        torch.testing.assert_close(found, action, rtol=1e-5, atol=1e-5)
