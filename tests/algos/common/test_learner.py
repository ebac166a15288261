import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from torch import nn

import lyceum_warp as lw
from lyceum_warp.algos import Team
from lyceum_warp.cli.display import console, curve_table
from lyceum_warp.cli.progress import Display
from lyceum_warp.training import Run


class Constant(nn.Module):
    nobs, nact = 6, 2

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("action", torch.zeros(2))

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return self.action.expand(*obs.shape[:-1], 2) + 0.0 * obs[..., :2]


@dataclasses.dataclass(frozen=True)
class DriftConfig:
    size: float = 0.1


class Drift(lw.Learner):
    algorithm = "drift"

    def __init__(self, env: lw.Env, *, seed: int = 0) -> None:
        super().__init__(env, seed=seed)
        self.policy, self.config = Constant(), DriftConfig()
        self.generator = torch.Generator().manual_seed(seed)

    def __next__(self) -> lw.Iteration:
        self.policy.action += self.config.size * torch.randn(2, generator=self.generator)
        self.env.step(self.policy.act(self.env.obs))
        self.iteration += 1
        self.samples += self.env.nworld
        number = {"distance": self.policy.action.norm().item()}
        return lw.Iteration(iteration=self.iteration, samples=self.samples, numbers=number)


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env("point_mass", nworld=2)


def test_a_minimal_learner_resumes_bit_for_bit(env: lw.Env) -> None:
    one = Drift(env)
    next(one)
    saved = one.state_dict()
    rest = [next(one).row() for _ in range(3)]
    state = env.get_state()
    other = Drift(env, seed=5)
    other.load_state_dict(saved)
    assert [next(other).row() for _ in range(3)] == rest
    assert torch.equal(env.get_state(), state) and rest[-1].keys() == {"iteration", "samples", "distance"}
    with pytest.raises(ValueError, match="the state has 3 worlds, but the environment has 2"):
        other.load_state_dict(saved | {"env": torch.zeros(3, 1)})
    with pytest.raises(ValueError, match="the state of a world has 1 numbers, and the task needs .* another version"):
        other.load_state_dict(saved | {"env": torch.zeros(2, 1)})
    with pytest.raises(ValueError, match="the state of shared memory has 9 numbers, and the task needs 0"):
        other.load_state_dict(saved | {"shared": torch.zeros(9)})


NETWORKS: dict[str, Any] = dict(hidden=(8,), value_hidden=(8, 8), mean_every=2, mean_episodes=2)
NPG = lw.NPGConfig(samples=80, time_orders=2, **NETWORKS)
PPO = lw.PPOConfig(num_steps=12, **NETWORKS)
SAC = lw.SACConfig(num_steps=12, warmup=60, updates=2, batch=16, replay=78, **NETWORKS)
CHANGES: dict[Any, dict[str, Any]] = {
    NPG: dict(samples=20, rollout="segments", min_restarts=1.5),
    PPO: dict(
        std_type="log", whiten_minibatches=True, schedule="fixed", final_entropy_coef=0.1, entropy_decay=(1, 3),
        minibatches=5, stagger=False, normalize=False,
    ),
    SAC: dict(n_step=3, actor_every=2, normalize=False, layer_norm=False),
}  # fmt: skip


@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize(("learner", "config", "rate"), [
    (lw.NPG, NPG, "value_rate"), (lw.PPO, PPO, "learning_rate"), (lw.SAC, SAC, "learning_rate"),
])  # fmt: skip
def test_run_is_reproducible_and_resumes_bit_for_bit(
    learner: Any, config: Any, rate: str, changed: bool, shared_env: SharedEnv
) -> None:
    env = shared_env(Metered, nworld=4, horizon=10, far=0.3)

    def fresh(seed: int, **others: Any) -> Any:
        env.rand_reset(7)
        changes = CHANGES[config] if changed else {}
        return learner(env, config=dataclasses.replace(config, **changes, **others), seed=seed)

    def numbers(learner: lw.Learner, count: int) -> list[dict[str, Any]]:
        rows = [next(learner).row() for _ in range(count)]
        clocks = [name for name in rows[0] if "time" in name or name == "samples_per_second"]
        return [{name: number for name, number in row.items() if name not in clocks} for row in rows]

    torch.manual_seed(1)
    one = fresh(1)
    first = numbers(one, 3)
    saved, stored = one.state_dict(), one.replay and one.replay.state_dict()
    rest = numbers(one, 3)
    torch.manual_seed(2)  # the run does not depend on torch's global generators
    np.testing.assert_equal(numbers(fresh(1), 6), first + rest)
    resumed = fresh(2, **{rate: 1e-4})
    next(resumed)
    resumed.load_state_dict(saved)
    if stored:
        resumed.replay.load_state_dict(stored)
    np.testing.assert_equal(numbers(resumed, 3), rest)
    for part in ("policy", "value"):
        torch.testing.assert_close(resumed.state_dict()[part], one.state_dict()[part], rtol=0.0, atol=0.0)


def test_policy_that_is_not_gaussian_is_saved_and_exported(env: lw.Env, tmp_path: Path) -> None:
    drift, shown = Drift(env), []
    run = lw.train(drift, tmp_path / "run", 2, callbacks=[shown.append, Display(console)])
    assert len(shown) == 2 and len(list(curve_table(run.rows()).columns)) == 2
    assert run.config["drift"] == {"size": 0.1} and Run.open(run.folder).best_score() is None
    again = lw.train(Drift(env), run, 4)
    assert [row["iteration"] for row in again.rows()] == [1, 2, 3, 4]
    assert lw.evaluate(env, drift.policy, 2).lengths.tolist() == [256.0, 256.0]
    path = lw.export_policy(drift.policy, tmp_path / "policy.pt2")
    exported = torch.export.load(path).module()(torch.zeros(3, 6))
    torch.testing.assert_close(exported, drift.policy.act(torch.zeros(3, 6)))
    with pytest.raises(ValueError, match="policy must be a module with act and nobs, as lw.load"):
        lw.export_policy(nn.Linear(6, 2), tmp_path / "policy.pt2")


def test_unsuitable_environments_raise_errors(shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match="Drift needs an environment that resets automatically: make the"):
        Drift(shared_env("point_mass", nworld=2, autoreset=False))
    with pytest.raises(ValueError, match="process 1 of 2 with 2 worlds needs an environment with first_world=2, not 0"):
        lw.PPO(shared_env("point_mass", nworld=2), team=Team(1, 2))
