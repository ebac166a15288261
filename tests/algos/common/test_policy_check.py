from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from torch import nn

import lyceum_warp as lw
from lyceum_warp.algos.common.policy_check import check_policy
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.training import Run
from lyceum_warp.training.runs.checkpoints import policy_content
from lyceum_warp.viewer.session.drivers import PolicyControl


class Net(nn.Module):
    def __init__(self, change: Callable[[torch.Tensor], object] = lambda mean: mean) -> None:
        super().__init__()
        self.first, self.last = nn.Linear(6, 8), nn.Linear(8, 2)
        self.change = change

    def forward(self, obs: torch.Tensor) -> object:
        return self.change(self.last(torch.tanh(self.first(obs))))


class Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return 1.0 * x

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        return gradient


class Unused(Net):
    def __init__(self) -> None:
        super().__init__()
        self.spare = nn.Linear(2, 2)


class Counting(Net):
    """A network whose output depends on the number of previous calls."""

    def forward(self, obs: torch.Tensor) -> object:
        self.calls = getattr(self, "calls", 0.0) + 1.0
        return super().forward(obs) + self.calls


def frozen(module: nn.Module) -> nn.Module:
    return module.requires_grad_(False)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (Net(lambda mean: mean[..., :1]), r"must give a float32 tensor of shape \(4, 2\) .* not .* shape \(4, 1\)"),
        (Net(lambda mean: mean.double()), r"must give a float32 tensor of .* not a float64 tensor of shape \(4, 2\)"),
        (Net(lambda mean: (mean, None)), r"must give a float32 tensor .* not a float32 tensor .* and NoneType"),
        (Net(lambda mean: mean / 0.0), "mean actions are not finite"),
        (Net(lambda mean: mean.detach()), "depend on no parameter: remove detach"),
        (Net(lambda mean: mean + torch.ones(3)), r"fails for observations of shape \(4, 6\) \(RuntimeError: The size"),
        (Net(Once.apply), r"cannot be differentiated twice, which NPG needs .*\): use other layers"),
        (frozen(Net()), r"no trainable parameter: use policy.requires_grad_\(True\)"),
        (Net().double(), r"fails for observations of shape \(4, 6\) \(RuntimeError: .*dtype"),
        (Unused(), "do not depend on its parameter 'network.spare.weight': use the parameter"),
        (Counting(), "two different mean actions for the same observations"),
        (nn.Sequential(nn.Linear(6, 2), nn.Dropout(0.5)), "two different mean actions .*dropout"),
        (
            nn.Sequential(nn.Linear(6, 2), nn.BatchNorm1d(2, track_running_stats=False)),
            r"fails .* \(1, 6\) .*more than 1",
        ),
        (nn.Sequential(nn.Linear(6, 2), nn.Softmax(0)), "depends on other rows of the batch"),
    ],
)
def test_unsuitable_network_raises_a_one_line_error(shared_env: SharedEnv, network: nn.Module, message: str) -> None:
    env = shared_env("point_mass", nworld=2)
    torch.manual_seed(0)
    with pytest.raises(ValueError, match=message) as caught:
        lw.NPG(env, lw.GaussianPolicy(6, 2, network=network))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Net(), r"policy must be a GaussianPolicy, not Net: lw.GaussianPolicy\(nobs, nact, network=net\) makes one"),
        (
            lw.GaussianPolicy(5, 2),
            "is made for 5 observations and 2 actions, but the task 'point_mass' has 6 observations and 2 actions",
        ),
    ],
)
def test_unsuitable_policy_raises_a_one_line_error(shared_env: SharedEnv, policy: object, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        lw.NPG(shared_env("point_mass"), policy)
    assert "\n" not in str(caught.value)


def test_ppo_needs_no_second_derivative(shared_env: SharedEnv) -> None:
    policy = lw.GaussianPolicy(6, 2, network=Net(Once.apply))
    before = policy.network.last.weight.detach().clone()
    next(lw.PPO(shared_env("point_mass", nworld=2), policy, config=lw.PPOConfig(num_steps=4, value_hidden=(4,))))
    assert not torch.equal(policy.network.last.weight, before)


@pytest.mark.parametrize("layer", [nn.LayerNorm(8), nn.GELU(), nn.PReLU(), nn.Softsign()])
def test_policy_check_accepts_usual_layers_and_changes_nothing(shared_env: SharedEnv, layer: nn.Module) -> None:
    env = shared_env("point_mass")
    policy = lw.GaussianPolicy(6, 2, network=nn.Sequential(nn.Linear(6, 8), layer, nn.Linear(8, 2)))
    before, random = env.get_state(), torch.get_rng_state()
    check_policy(policy, env)
    assert torch.equal(env.get_state(), before) and torch.equal(torch.get_rng_state(), random)
    assert all(parameter.grad is None for parameter in policy.parameters())


def test_policy_with_a_user_network_is_saved_and_loaded(tmp_path: Path) -> None:
    torch.manual_seed(0)
    policy, obs = lw.GaussianPolicy(6, 2, network=Net(), normalize=True), torch.randn(5, 6)
    policy.normalizer.update(torch.randn(10, 6) + 3.0)
    run = Run.create(tmp_path / "run", {})
    run.save(policy_content(0, policy), {})
    loaded = lw.load(run, policy=lw.GaussianPolicy(6, 2, network=Net(), normalize=True))
    assert torch.equal(loaded(obs), policy(obs))
    with pytest.raises(
        ValueError,
        match=r"custom class test_policy_check.Net: .*lw.GaussianPolicy\(6, 2, network=..., normalize=True\)\)$",
    ):
        lw.load(run)
    with pytest.raises(ValueError, match="network.weight.*network.first.weight.*: pass a policy with the same"):
        lw.load(run, policy=lw.GaussianPolicy(6, 2, network=nn.Linear(6, 2), normalize=True))


class Recurrent(nn.Module):
    """A policy with a hidden state that no reset clears."""

    nobs, nact = 6, 2

    def __init__(self) -> None:
        super().__init__()
        self.cell, self.last, self.hidden = nn.GRUCell(6, 8), nn.Linear(8, 2), None

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        self.hidden = self.cell(obs, self.hidden)
        return self.last(self.hidden)


class Drawing(nn.Module):
    """A policy with a random generator of its own."""

    nobs, nact = 6, 2

    def __init__(self) -> None:
        super().__init__()
        self.generator = np.random.default_rng(0)

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return obs[:, :2] + self.generator.standard_normal()


def trained_with(policy: nn.Module, env: lw.Env, path: Path) -> object:
    class Wrapped(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.scale = nn.Parameter(torch.ones(2))

        def forward(self, obs: torch.Tensor) -> torch.Tensor:
            return self.scale * policy.act(obs)

    return lw.PPO(env, lw.GaussianPolicy(6, 2, network=Wrapped()))


DOORS: dict[str, Callable[[nn.Module, lw.Env, Path], object]] = {
    "evaluate": lambda policy, env, path: lw.evaluate(env, policy, 2),
    "evaluate a function": lambda policy, env, path: lw.evaluate(env, policy.act, 2),
    "transfer": lambda policy, env, path: lw.transfer(env, policy, 2, warp=False),
    "train": trained_with,
    "episodes": lambda policy, env, path: next(policy_episodes(env.replicate(autoreset=False), policy.act, 2)),
    "view": lambda policy, env, path: PolicyControl("own", policy, env),
    "export": lambda policy, env, path: lw.export_policy(policy, path / "policy.pt2"),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("kind", [Recurrent, Drawing])
def test_policy_with_memory_is_refused_wherever_it_would_leak_over_episodes(
    kind: type[nn.Module], door: str, shared_env: SharedEnv, tmp_path: Path
) -> None:
    env = shared_env("point_mass", nworld=2, horizon=4)
    torch.manual_seed(0)
    with pytest.raises(ValueError, match="different .*actions for the same observations: .*(memory|state)") as caught:
        DOORS[door](kind(), env, tmp_path)
    assert "\n" not in str(caught.value)


def test_policy_may_draw_from_the_global_random_generator(shared_env: SharedEnv) -> None:
    env, draws = shared_env("point_mass", nworld=2, horizon=4), list[torch.Tensor]()

    def random(obs: torch.Tensor) -> torch.Tensor:
        draws.append(torch.rand(2, 2))
        return draws[-1]

    torch.manual_seed(0)
    lw.evaluate(env, random, 2)
    torch.manual_seed(0)
    assert torch.equal(torch.stack(draws[2:]), torch.rand(4, 2, 2))  # checks leave the stream as it is
