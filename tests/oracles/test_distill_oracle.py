from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from rsl_rl.algorithms import Distillation
from tensordict import TensorDict
from test_ppo_oracle import double, weights  # noqa: F401

import lyceum_warp as lw
from lyceum_warp.adapters import RslRlVecEnv

STEPS, N = 12, 8


def theirs(learner: lw.Distill) -> Any:
    config, layers = learner.config, {"activation": "elu", "hidden_dims": [16]}
    memory = {"rnn_type": "gru", "rnn_hidden_dim": config.recurrent} if config.recurrent else {}
    student = {"class_name": f"rsl_rl.models.{'RNN' if memory else 'MLP'}Model", **layers, **memory}
    other = Distillation.construct_algorithm(
        TensorDict(learner.env.obs_groups, batch_size=[N]),
        RslRlVecEnv(learner.env),
        {
            "num_steps_per_env": STEPS, "multi_gpu": None, "student": student,
            "teacher": {"class_name": "rsl_rl.models.MLPModel", **layers},
            "obs_groups": {"student": ["policy"], "teacher": ["critic"]},
            "algorithm": {
                "class_name": "rsl_rl.algorithms.Distillation", "num_learning_epochs": config.epochs,
                "gradient_length": config.gradient_length, "learning_rate": config.learning_rate,
                "max_grad_norm": config.max_grad_norm, "loss_type": config.loss,
            },
        },
        "cpu",
    )  # fmt: skip
    other.student.double().load_state_dict(weights(learner.policy.network))
    return other


@pytest.mark.parametrize("changes", [
    {"recurrent": 6}, {"recurrent": 6, "gradient_length": 12, "loss": "huber", "max_grad_norm": 0.02, "epochs": 3},
    {"gradient_length": 3},
])  # fmt: skip
def test_updates_give_the_same_student_as_rsl_rl(changes: dict[str, Any], shared_env: SharedEnv) -> None:
    """Make two updates; the second one begins with the memory after the first one."""
    env, generator = shared_env(Metered, nworld=N, horizon=10), torch.Generator().manual_seed(1)
    config = lw.DistillConfig(
        **{"hidden": (16,), "num_steps": STEPS, "normalize": False, "gradient_length": 4, "teacher_group": "critic"}
        | changes
    )
    learner = lw.Distill(env, config=config, teacher=lw.GaussianPolicy(2, 1).float())
    other, done = theirs(learner), torch.zeros(N, dtype=torch.bool)
    before = [p.detach().clone() for p in learner.policy.network.parameters()]
    for _ in range(2):
        obs, label = (torch.randn(STEPS, N, 1, generator=generator) for _ in range(2))
        starts = torch.cat([done[None], torch.rand(STEPS, N, generator=generator) < 0.15])
        learner.rollout.obs_groups, learner.label, learner.rollout.step = (
            {"policy": obs}, label, (~starts[:-1]).double()
        )  # fmt: skip
        learner._state.copy_(learner._player.state)
        learner.update()
        groups = {"policy": obs, "critic": torch.zeros(STEPS, N, 2)}
        other.storage.observations = TensorDict(groups, batch_size=[STEPS, N])
        other.storage.privileged_actions, other.storage.dones[..., 0] = label, starts[1:]
        losses, done = other.update(), starts[-1]
        for name, part in weights(learner.policy.network).items():
            torch.testing.assert_close(part, other.student.state_dict()[name], rtol=1e-5, atol=1e-7)
        assert learner._loss.item() * config.gradient_length / (config.epochs * STEPS) == pytest.approx(
            losses["behavior"]
        )
    assert all((p - p0).abs().max() > 1e-5 for p, p0 in zip(learner.policy.network.parameters(), before, strict=True))
    if config.recurrent:
        memory = learner._next_state.masked_fill(done[:, None], 0.0)
        torch.testing.assert_close(memory, other.last_hidden_states[0][0].detach(), rtol=1e-5, atol=1e-7)
