"""The update of rsl_rl's PPO that can be captured, beside rsl_rl's own."""

from typing import Any

import pytest
import torch
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.adapters.rsl_rl_config import RslRlConfig
from lyceum_warp.adapters.rsl_rl_learner import RslRlLearner


def learner(*, device: str = "cpu", **changes: Any) -> RslRlLearner:
    settings: dict[str, Any] = {"hidden": (16, 8), "value_hidden": (8,), "num_steps_per_env": 12, "mean_every": 0}
    env = lw.make(Metered, nworld=8, horizon=10, device=device)
    return RslRlLearner(env, config=RslRlConfig(**settings | changes))


def check_equal_over_iterations(device: str, close: dict[str, float]) -> None:
    """Compare the update with rsl_rl's own, which draws actions that it does not need: here, it does not."""
    changes = {"device": device, "schedule": "fixed", "learning_rate": 3e-4, "tf32": False}
    own, captured = learner(**changes), learner(captured_update=True, **changes)
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
