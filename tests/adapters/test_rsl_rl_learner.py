"""rsl_rl's PPO as an algorithm of lw.train: what it attains, its state, its networks and its files."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from tensordict import TensorDict
from training_runs import metrics

import lyceum_warp as lw
from lyceum_warp.adapters.rsl_rl_config import Bootstrap, RslRlConfig
from lyceum_warp.adapters.rsl_rl_learner import RslRlLearner
from lyceum_warp.runs.folder import Run

SMALL = RslRlConfig(hidden=(8,), value_hidden=(8, 8), num_steps_per_env=12, mean_every=2, mean_episodes=2)


def learner(env: lw.Env, config: RslRlConfig = SMALL, **words: Any) -> RslRlLearner:
    return RslRlLearner(env, config=config, **words)


def metered(**options: Any) -> lw.Env:
    return lw.make(Metered, nworld=4, horizon=10, **options)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "six"
    lw.train(learner(metered()), folder, iterations=6, keep_every=2)
    return folder


# learning


def test_it_learns_for_a_fixed_seed() -> None:
    """Returns of the mean policy are at most about 250; those of the first policies are negative."""
    config = RslRlConfig(hidden=(32, 32), value_hidden=(32, 32), mean_every=20)
    rows = []
    for iteration in learner(lw.make("point_mass", nworld=32), config):
        rows.append(iteration)
        if iteration.iteration == 40:
            break
    assert rows[-1].mean_return is not None and rows[-1].mean_return > 150.0
    assert rows[-1].return_recent > rows[15].return_recent + 50.0
    assert rows[-1].samples == 40 * 24 * 32


def test_the_mean_policy_is_evaluated_every_twenty_iterations_by_default() -> None:
    made = learner(metered(), RslRlConfig(hidden=(4,), value_hidden=(4,), num_steps_per_env=2, num_learning_epochs=1))
    assert [it for it in range(1, 22) if next(made).mean_return is not None] == [20]


def test_statistics_are_those_of_the_samples(shared_env: SharedEnv) -> None:
    """Every episode has 10 steps; that of a world with a random start does not count."""
    made = learner(shared_env(Metered, nworld=4, horizon=10, far=1e3))
    returns: list[float] = []
    for _ in range(3):
        now = next(made)
        rollout = made.rollout
        ended = rollout.episode_return[rollout.done].tolist()
        returns += [number for number in ended if number == number]
        assert now.return_recent == pytest.approx(sum(returns) / len(returns))
    assert now.samples == 3 * 48 == 3 * made.count and now.length_mean == 10.0
    assert now.reward_mean == pytest.approx(rollout.reward.mean().item())
    effort = rollout.episode_metrics["effort"][rollout.done].mean().item()
    assert now.metrics["effort"] == pytest.approx(effort) and now.row()["metrics/effort"] == now.metrics["effort"]
    assert now.learning_rate == made.ppo.learning_rate and now.faults == 0
    start = learner(metered(), RslRlConfig(**{**vars(SMALL), "random_start": False}))
    assert start.env.episode_step.tolist() == [0, 0, 0, 0]


def test_the_divergence_is_the_one_from_the_policy_that_sampled(shared_env: SharedEnv) -> None:
    made = learner(shared_env(Metered, nworld=4, horizon=10))
    now = next(made)
    old = torch.distributions.Normal(*(part.double() for part in made.ppo.storage.distribution_params))
    new = torch.distributions.Normal(made.policy(made.rollout.obs).double(), made.policy.log_std.double().exp())
    assert now.kl == pytest.approx(torch.distributions.kl_divergence(old, new).sum(-1).mean().item(), rel=1e-4)


def test_it_draws_random_numbers_of_its_own(shared_env: SharedEnv) -> None:
    rows = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        state = torch.get_rng_state()
        made = learner(metered())
        rows.append([next(made).row() for _ in range(2)])
        assert torch.equal(torch.get_rng_state(), state)
    assert rows[0][1]["kl"] == rows[1][1]["kl"] and rows[0][1]["reward_mean"] == rows[1][1]["reward_mean"]
    assert next(learner(metered(), seed=3)).kl != rows[0][0]["kl"]


def test_an_update_that_is_not_finite_ends_learning(shared_env: SharedEnv) -> None:
    config = RslRlConfig(**{**vars(SMALL), "learning_rate": 1e30, "schedule": "fixed"})
    with pytest.raises(FloatingPointError, match="the update of iteration 1 is not finite: make learning_rate, or the"):
        next(learner(shared_env(Metered, nworld=4, horizon=10), config))


@pytest.mark.parametrize("seed", [1.5, -1])
def test_a_seed_that_is_not_valid_is_refused(seed: Any, shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match=f"seed must be a whole number from 0 to 2147483647, not {seed}"):
        learner(shared_env(Metered, nworld=4, horizon=10), seed=seed)


# runs


def test_a_run_has_the_files_of_every_run(six: Path) -> None:
    run = Run.open(six)
    assert run.config["algorithm"] == "rsl-rl" and run.config["rsl-rl"]["hidden"] == [8]
    rows = run.rows()
    assert [row["mean_return"] is not None for row in rows] == [False, True] * 3
    best = run.best_score()
    assert best is not None and best[1] == max(row["mean_return"] or -1e9 for row in rows)
    for which in ("last", "best", 2, 6):
        assert lw.load(run, which=which).nact == 1
    assert lw.load_value(run).group == "critic" and lw.load_value(run).discount == SMALL.gamma


def test_a_resumed_run_has_the_same_numbers(six: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    lw.train(learner(metered()), folder, iterations=3)
    lw.train(learner(metered(seed=5)), folder, iterations=6, resume=True)
    assert metrics(folder) == metrics(six)
    states = [Run.open(path).read()["state"] for path in (folder, six)]
    assert torch.equal(states[0]["env"], states[1]["env"])
    for name, weights in states[0]["ppo"]["critic_state_dict"].items():
        assert torch.equal(weights, states[1]["ppo"]["critic_state_dict"][name])
    with pytest.raises(ValueError, match="has clip_param 0.2, not 0.1, and a run keeps its settings"):
        config = RslRlConfig(**{**vars(SMALL), "clip_param": 0.1})
        lw.train(learner(metered(), config), folder, iterations=9, resume=True)
    with pytest.raises(ValueError, match="has algorithm rsl-rl, not npg, and a run keeps its settings"):
        lw.train(lw.NPG(metered()), folder, iterations=9, resume=True)
    again = learner(metered())
    next(again)
    again.load_state_dict(Run.open(folder).read()["state"])
    assert again.iteration == 6 and torch.equal(again.env.get_state(), states[0]["env"])
    with pytest.raises(ValueError, match="the state has 4 worlds, but the environment has 2"):
        learner(lw.make(Metered, nworld=2)).load_state_dict(states[0])


def test_a_runs_policy_needs_no_rsl_rl(six: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    action = lw.load(six)(torch.ones(1))
    for name in [name for name in sys.modules if name.startswith(("rsl_rl", "tensordict", "lyceum_warp.adapters"))]:
        monkeypatch.setitem(sys.modules, name, None)
    assert torch.equal(lw.load(six)(torch.ones(1)), action) and lw.load_value(six).group == "critic"


# networks


def test_the_policy_and_the_value_function_are_those_of_rsl_rl(shared_env: SharedEnv) -> None:
    for changes in ({}, {"normalize": False}, {"std_type": "log", "activation": "silu", "init_std": 0.3}):
        made = learner(shared_env(Metered, nworld=4, horizon=10), RslRlConfig(**{**vars(SMALL), **changes}))
        next(made)
        obs = TensorDict({"policy": 3 * torch.randn(5, 1), "critic": 30 * torch.randn(5, 2)}, [5])
        made.ppo.eval_mode()
        close = {"rtol": 1e-5, "atol": 1e-5}
        torch.testing.assert_close(made.policy(obs["policy"]), made.ppo.actor(obs), **close)
        value = made.value(obs["critic"], torch.zeros(5))
        torch.testing.assert_close(value, made.ppo.critic(obs).squeeze(-1), **close)
        made.ppo.actor(obs, stochastic_output=True)
        torch.testing.assert_close(made.policy.log_std.exp().expand(5, 1), made.ppo.actor.output_std, **close)


def test_a_learner_begins_with_given_networks(six: Path) -> None:
    policy, value = lw.load(six), lw.load_value(six)
    made = RslRlLearner(metered(), policy, value, RslRlConfig(num_steps_per_env=12))
    assert made.config.hidden == (8,) and made.config.value_hidden == (8, 8)
    obs = torch.randn(5, 2)
    torch.testing.assert_close(made.policy(obs[:, :1]), policy(obs[:, :1]), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(made.value(obs, obs[:, 0]), value(obs, obs[:, 0]), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(made.policy.log_std, policy.log_std)
    assert next(made).kl < 1.0
    assert next(lw.NPG(metered(), policy, value, lw.NPGConfig(samples=40, mean_every=0))).iteration == 1


def test_networks_that_rsl_rl_lacks_are_refused(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=4, horizon=10)
    plain = lw.GaussianPolicy(1, 1, (8,))
    for policy, value, message in [
        (lw.GaussianPolicy(1, 1, normalize=True), None, "the policy clips normalised observations at 10"),
        (lw.GaussianPolicy(1, 1, network=torch.nn.Linear(1, 1)), None, "of a class of its own, torch.nn.modules"),
        (plain, lw.ValueFunction(2, time_orders=2), "time features"),
        (plain, lw.ValueFunction(2, normalize=True), "clips normalised observations"),
        (lw.GaussianPolicy(2, 1), None, "takes 2 observations and gives 1 actions, but the task 'metered' has 1 and 1"),
        (None, lw.ValueFunction(2), "give the policy, too"),
        (plain, lw.ValueFunction(2), "takes the group 'policy' of 2 observations, but the task 'metered' has 'policy'"),
    ]:
        with pytest.raises(ValueError, match=message):
            RslRlLearner(env, policy, value, SMALL)
    scaled = lw.ValueFunction(2, (8, 8), scale=50.0, group="critic")
    scaled.shift.fill_(3.0)
    torch.nn.init.normal_(scaled.network[-1].weight)
    made = RslRlLearner(env, plain, scaled, SMALL)
    obs = torch.randn(5, 2)
    torch.testing.assert_close(made.value(obs, obs[:, 0]), scaled(obs, obs[:, 0]), rtol=1e-4, atol=1e-4)
    assert made.config.value_group is None
    for group in (None, "policy", "critic"):
        config = RslRlConfig(**{**vars(SMALL), "value_group": group})
        assert RslRlLearner(env, plain, lw.ValueFunction(1), config).config.value_group == "policy"


@pytest.mark.gpu
@pytest.mark.parametrize("bootstrap", ["final", "before"])
def test_gpu_sampling_does_not_wait_for_the_device(bootstrap: Bootstrap) -> None:
    env = lw.make(Metered, nworld=64, horizon=10, device="cuda:0")
    changes = {"bootstrap": bootstrap, "batched_values": False, "normalize_when": "after"}
    made = learner(env, RslRlConfig(**vars(SMALL) | changes))
    for _ in range(2):
        next(made)
    torch.cuda.set_sync_debug_mode("error")
    try:
        made._sample()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
def test_gpu_a_run_continues_on_a_gpu(tmp_path: Path) -> None:
    for iterations, resume in ((2, False), (3, True)):
        env = lw.make(Metered, nworld=64, horizon=10, device="cuda:0")
        run = lw.train(learner(env), tmp_path / "run", iterations=iterations, resume=resume)
    assert [row["iteration"] for row in run.rows()] == [1, 2, 3]
