"""The update of rsl_rl's PPO that can be captured, beside rsl_rl's own."""

import copy
from typing import Any

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.adapters.rsl_rl_config import RslRlConfig
from lyceum_warp.adapters.rsl_rl_learner import RslRlLearner
from lyceum_warp.adapters.rsl_rl_update import CapturedUpdate


def learner(*, device: str = "cpu", **changes: Any) -> RslRlLearner:
    settings: dict[str, Any] = {"hidden": (16, 8), "value_hidden": (8,), "num_steps_per_env": 12, "mean_every": 0}
    env = lw.make(Metered, nworld=8, horizon=10, device=device)
    return RslRlLearner(env, config=RslRlConfig(**settings | changes))


def check_equal_over_iterations(device: str, close: dict[str, float]) -> None:
    """Compare the update with rsl_rl's own, which draws actions that it does not need: here, it does not."""
    changes = {"device": device, "schedule": "fixed", "learning_rate": 3e-4, "tf32": False, "normalize_when": "after"}
    own, captured = learner(captured_update=False, **changes), learner(captured_update=True, **changes)
    policy = own.ppo.actor.distribution
    sample = policy.sample
    policy.sample = lambda: policy.mean.detach() if torch.is_grad_enabled() else sample()
    for _ in range(5):
        a, b = next(own).row(), next(captured).row()
        for name in ("kl", "std_mean", "surrogate_loss", "entropy", "value_loss"):
            assert b[name] == pytest.approx(a[name], rel=close["rtol"], abs=close["atol"]), name
        for one, other in ((own.ppo.actor, captured.ppo.actor), (own.ppo.critic, captured.ppo.critic)):
            for name, weights in one.state_dict().items():
                torch.testing.assert_close(other.state_dict()[name], weights, **close)
    assert not torch.allclose(own.ppo.actor.obs_normalizer.std, torch.ones(1, device=device), rtol=0.1)


@pytest.mark.parametrize("changes", [
    {}, {"schedule": "fixed"}, {"use_clipped_value_loss": False, "std_type": "log", "optimizer": "adamw"},
    {"num_mini_batches": 5, "num_learning_epochs": 2, "clip_param": 0.05, "entropy_coef": 0.1},
    {"normalize_advantage_per_mini_batch": True},
])  # fmt: skip
def test_the_numbers_are_those_of_rsl_rls_own(changes: dict[str, Any]) -> None:
    """After the first update; later ones draw other random numbers."""
    own, captured = learner(**changes), learner(captured_update=True, **changes)
    a, b = next(own).row(), next(captured).row()
    for name in ("kl", "std_mean", "learning_rate", "surrogate_loss", "entropy", "value_loss"):
        assert b[name] == pytest.approx(a[name], rel=1e-3, abs=1e-6), name
    for one, other in ((own.ppo.actor, captured.ppo.actor), (own.ppo.critic, captured.ppo.critic)):
        for name, weights in one.state_dict().items():
            torch.testing.assert_close(other.state_dict()[name], weights, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("changes", [
    {}, {"desired_kl": 1e-4}, {"desired_kl": 1e3, "max_grad_norm": 0.01}, {"clip_param": 0.01, "entropy_coef": 0.3},
    {"normalize_advantage_per_mini_batch": True, "use_clipped_value_loss": False, "std_type": "log"},
    {"schedule": "fixed", "optimizer": "adamw", "num_mini_batches": 5, "num_learning_epochs": 3},
])  # fmt: skip
def test_the_parameters_are_those_of_rsl_rls_own_to_1e_5(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two updates from the same samples in the same order, in float64 so that rounding hides no difference."""
    made = learner(**changes)
    for _ in range(2):  # the normalisers' statistics are no longer those of new networks
        next(made)
    own = made.ppo
    storage = own.storage
    with torch.inference_mode(False):
        for network in (own.actor, own.critic):
            network.double()
        for name, value in vars(storage).items():
            if isinstance(value, torch.Tensor) and value.is_floating_point():
                setattr(storage, name, value.clone().double())
        storage.observations = storage.observations.double()
        storage.distribution_params = tuple(part.clone().double() for part in storage.distribution_params)
        own.actor.distribution.update(torch.zeros(1, 1, dtype=torch.float64))
        for entry in own.optimizer.state.values():
            for name in ("exp_avg", "exp_avg_sq"):
                entry[name] = entry[name].double()
        own.actor.distribution._distribution = None
        other = copy.deepcopy(own)
    samples = own.num_mini_batches * (96 // own.num_mini_batches)
    order = torch.randperm(samples, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(torch, "randperm", lambda *a, **o: order)
    captured, start = CapturedUpdate(other), [p.detach().clone() for p in own.actor.parameters()]
    for _ in range(2):
        losses = own.update(), captured()
        assert losses[1] == pytest.approx(losses[0], rel=1e-5, abs=1e-6)  # sums are float32
        assert other.learning_rate == pytest.approx(own.learning_rate, rel=1e-5)
    for one, same in ((own.actor, other.actor), (own.critic, other.critic)):
        for weights, found in zip(one.parameters(), same.parameters(), strict=True):
            torch.testing.assert_close(found, weights, rtol=1e-5, atol=1e-6)
    assert all((p - p0).abs().max() > 1e-5 for p, p0 in zip(own.actor.parameters(), start, strict=True))


def test_the_weight_of_the_entropy_may_change_between_updates() -> None:
    """A graph reads it on the device."""
    weights, stds = [], []
    for captured in (False, True):
        for final in (0.0, 5.0):
            made = learner(schedule="fixed", captured_update=captured, entropy_coef=0.0, final_entropy_coef=final,
                           entropy_decay=(1, 3))  # fmt: skip
            for _ in range(3):
                stds.append(next(made).std_mean)
                weights.append(made.ppo.entropy_coef)
    assert weights == [0.0, 0.0, 0.0, 0.0, 2.5, 5.0] * 2
    for without, raised in ((stds[:3], stds[3:6]), (stds[6:9], stds[9:])):
        assert raised[0] == pytest.approx(without[0]) and raised[2] > without[2] + 0.02


def test_the_numbers_are_those_of_rsl_rls_own_over_iterations() -> None:
    check_equal_over_iterations("cpu", {"rtol": 1e-3, "atol": 1e-4})


def test_what_a_graph_reads_and_writes_stays_in_its_place() -> None:
    """rsl_rl's normaliser replaces its standard deviation."""
    made = learner(captured_update=True)
    ppo = made.ppo
    kept: list[dict[str, torch.Tensor]] = []

    def keep(*_: object) -> None:
        if torch.is_grad_enabled():  # in the update
            tensors = {f"{i}/{name}": t for i, net in enumerate((ppo.actor, ppo.critic))
                       for name, t in (*net.named_parameters(), *net.named_buffers())}  # fmt: skip
            for i, entry in enumerate(ppo.optimizer.state.values()):
                tensors |= {f"adam/{i}/{name}": t for name, t in entry.items()}
            kept.append(tensors)

    ppo.actor.mlp.register_forward_pre_hook(keep)
    for _ in range(3):
        next(made)
    for tensors in kept[1:]:  # the first one is before Adam's moments
        assert {name: t.data_ptr() for name, t in tensors.items()} == {n: t.data_ptr() for n, t in kept[1].items()}
    assert len(kept) == 3 * 5 * 4 and any("obs_normalizer._std" in name for name in kept[1])


def test_its_state_is_continued_exactly() -> None:
    one = learner(captured_update=True)
    next(one)
    other = learner(captured_update=True, learning_rate=0.5)
    other.load_state_dict(one.state_dict())
    for _ in range(2):
        first, second = next(one), next(other)
        assert (first.kl, first.learning_rate, first.value_loss) == (second.kl, second.learning_rate, second.value_loss)


def test_what_it_cannot_do_is_refused() -> None:
    with pytest.raises(ValueError, match="captured_update needs the optimizer 'adam' or 'adamw', not 'sgd'"):
        RslRlConfig(captured_update=True, optimizer="sgd")
    with pytest.raises(ValueError, match="captured_update and torch_compile_mode exclude each other"):
        RslRlConfig(captured_update=True, torch_compile_mode="default")


@pytest.mark.gpu
def test_gpu_a_captured_update_has_the_numbers_of_rsl_rls_own_over_iterations() -> None:
    check_equal_over_iterations("cuda:0", {"rtol": 2e-2, "atol": 2e-3})


@pytest.mark.gpu
def test_gpu_a_captured_update_is_continued_and_learns() -> None:
    one = learner(device="cuda:0", captured_update=True)
    for _ in range(3):
        next(one)
    other = learner(device="cuda:0", captured_update=True)
    other.load_state_dict(one.state_dict())
    first, second = next(one), next(other)
    assert second.learning_rate == pytest.approx(first.learning_rate)
    assert second.value_loss == pytest.approx(first.value_loss, rel=1e-2, abs=1e-4)
