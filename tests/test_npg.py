"""NPG: each piece of the mathematics against a plain version of it, and the whole on a task that it can learn."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from conftest import TaskFile

import lyceum_warp as lw
from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.npg import FisherProduct, conjugate_gradient
from lyceum_warp.algos.policy import Normalizer
from lyceum_warp.algos.rollout_buffer import finished, summary
from lyceum_warp.algos.value import ValueFit, _CapturedStep
from lyceum_warp.kernels import returns
from lyceum_warp.runs import Run

SMALL = lw.NPGConfig(samples=320, hidden=(8, 8), value_hidden=(16,), mean_every=2, mean_episodes=2)


@pytest.fixture(scope="module")
def policy() -> lw.GaussianPolicy:
    torch.manual_seed(1)
    policy = lw.GaussianPolicy(5, 2, (6, 4))
    for parameter in policy.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return policy


def test_log_prob_is_torchs(policy: lw.GaussianPolicy) -> None:
    obs, action = torch.randn(20, 5), torch.randn(20, 2)
    expected = torch.distributions.Normal(policy(obs), policy.log_std.exp()).log_prob(action).sum(-1)
    torch.testing.assert_close(policy.log_prob(obs, action), expected)


def test_samples_have_the_mean_and_the_spread_of_the_policy(policy: lw.GaussianPolicy) -> None:
    obs = torch.randn(1, 5).expand(20_000, 5)
    generator = torch.Generator().manual_seed(0)
    out = torch.empty(20_000, 2)
    policy.sample(obs, torch.randn(20_000, 2, generator=generator), out=out)
    torch.testing.assert_close(out.mean(0), policy(obs[0]), atol=0.03, rtol=0)
    torch.testing.assert_close(out.std(0), policy.log_std.exp(), atol=0.03, rtol=0)


def test_fisher_product_is_the_covariance_of_the_score(policy: lw.GaussianPolicy) -> None:
    """F = E[score score^T], whose expectation over actions is taken exactly by a quadrature of each action."""
    obs = torch.randn(7, 5)
    size = sum(p.numel() for p in policy.parameters())
    nodes, weights = np.polynomial.hermite_e.hermegauss(6)
    fisher = torch.zeros(size, size)
    for o in obs:
        mean, std = policy(o).detach(), policy.log_std.exp().detach()
        for i, x in enumerate(nodes):
            for j, y in enumerate(nodes):
                action = mean + std * torch.tensor([x, y], dtype=torch.float32)
                grads = torch.autograd.grad(policy.log_prob(o, action), list(policy.parameters()))
                score = torch.cat([g.flatten() for g in grads])
                fisher += weights[i] * weights[j] / (2 * math.pi) / len(obs) * score.outer(score)
    vector = torch.randn(size)
    product = FisherProduct(policy, obs, damping=0.1)
    torch.testing.assert_close(product(vector), fisher @ vector + 0.1 * vector, atol=2e-4, rtol=2e-4)


def test_conjugate_gradient_solves_and_stays_put_once_it_has() -> None:
    generator = torch.Generator().manual_seed(3)
    root = torch.randn(12, 12, generator=generator, dtype=torch.float64)
    matrix, target = root @ root.T + torch.eye(12), torch.randn(12, generator=generator, dtype=torch.float64)
    expected = torch.linalg.solve(matrix, target)
    torch.testing.assert_close(conjugate_gradient(lambda v: matrix @ v, target, 12), expected, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(conjugate_gradient(lambda v: matrix @ v, target, 40), expected, rtol=1e-6, atol=1e-8)
    zero = torch.zeros_like(target)
    assert torch.equal(conjugate_gradient(lambda v: matrix @ v, zero, 5), zero)


def test_advantages_and_returns_bootstrap_at_time_limits_only() -> None:
    """Against the definition, world by world, with ends of both kinds at known places."""
    steps, worlds, gamma, lam = 9, 3, 0.9, 0.8
    rng = np.random.default_rng(0)
    reward, value, next_value = rng.normal(size=(3, steps, worlds)).astype(np.float32)
    terminated, done = np.zeros((steps, worlds), bool), np.zeros((steps, worlds), bool)
    done[3, 0] = done[5, 1] = True
    terminated[5, 1] = True
    expected, total = np.zeros((steps, worlds)), np.zeros((steps, worlds))
    for w in range(worlds):
        for t in range(steps):
            factor, discount = 1.0, 1.0
            for k in range(t, steps):
                after = 0.0 if terminated[k, w] else next_value[k, w]
                expected[t, w] += factor * (reward[k, w] + gamma * after - value[k, w])
                total[t, w] += discount * reward[k, w]
                factor, discount = factor * gamma * lam, discount * gamma
                if done[k, w] or k == steps - 1:
                    total[t, w] += discount * after
                    break
    arrays = [wp.array(a, device="cpu") for a in (reward, value, next_value, terminated, done)]
    advantage, rest = wp.zeros((steps, worlds), device="cpu"), wp.zeros((steps, worlds), device="cpu")
    wp.launch(returns.advantages, worlds, [*arrays, gamma, lam, advantage, rest], device="cpu")
    np.testing.assert_allclose(advantage.numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(rest.numpy(), total, atol=1e-5)


def test_normalizer_gathers_mean_and_variance_in_any_portions() -> None:
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    normalizer = Normalizer(4)
    torch.testing.assert_close(normalizer(obs[:5, :1].expand(5, 4)), obs[:5, :1].expand(5, 4).clamp(-10, 10))
    for part in obs.split([10, 700, 290]):
        normalizer.update(part)
    normalized = normalizer(obs)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(4), atol=1e-2, rtol=0)


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", nworld=16, horizon=12, nthread=1)


def test_a_step_has_the_length_that_was_asked_for(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, samples=3200, delta=1e-3), seed=0)
    before = torch.cat([p.detach().flatten() for p in npg.policy.parameters()])
    it = next(npg)
    after = torch.cat([p.detach().flatten() for p in npg.policy.parameters()])
    # KL = step.F.step / 2 to second order
    assert it.kl == pytest.approx(0.0005, rel=0.1)
    assert (after - before).norm().item() == pytest.approx(it.step_norm, rel=1e-4)


@pytest.mark.parametrize("rollout", ["episodes", "segments"])
def test_a_run_is_reproducible_and_resumes_to_the_bit(env: lw.Env, rollout: str) -> None:
    config = dataclasses.replace(SMALL, rollout=rollout, time_orders=2, normalize=True)

    def numbers(it: lw.Iteration) -> dict[str, object]:
        skipped = {"samples_per_second", "faults"}
        values = dataclasses.asdict(it).items()
        return {k: v for k, v in values if not k.startswith("time_") and k not in skipped}

    def fresh(seed: int) -> lw.NPG:
        env.rand_reset(7)
        return lw.NPG(env, config=config, seed=seed)

    npg = fresh(1)
    first = [numbers(next(npg)) for _ in range(2)]
    saved = npg.state_dict()
    rest = [numbers(next(npg)) for _ in range(2)]
    again = fresh(1)
    np.testing.assert_equal([numbers(next(again)) for _ in range(4)], first + rest)
    resumed = fresh(2)
    resumed.load_state_dict(saved)
    np.testing.assert_equal([numbers(next(resumed)) for _ in range(2)], rest)


def test_statistics_are_of_the_episodes_that_ended() -> None:
    """Against plain ones, in one record and pooled from the records of two halves of the worlds."""
    env = lw.make("hopper", nworld=6)
    rollout = lw.Rollout(env, 60)
    rollout.running_return[0] = math.nan  # an episode that was begun in its middle is not counted
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size, log_std=0.0)
    rollout.collect(policy, torch.randn(rollout.action.shape, generator=torch.Generator().manual_seed(0)))
    ended = rollout.done & ~rollout.episode_return.isnan()
    assert 6 < ended.sum() < rollout.done.sum()
    returns = rollout.episode_return[ended].double()
    expected = {
        "return_mean": returns.mean(), "return_std": returns.std(correction=0), "return_min": returns.min(),
        "return_max": returns.max(), "length_mean": rollout.episode_length[ended].mean(),
        "terminal_reward": rollout.reward[ended].mean(), "eval_mean": rollout.eval[ended].mean(),
        "success": rollout.success[ended].float().mean(),
    }  # fmt: skip
    assert summary([finished(rollout).tolist()]) == pytest.approx({k: v.item() for k, v in expected.items()}, rel=1e-5)
    names = ("done", "episode_return", "episode_length", "reward", "eval", "success")
    halves = [
        finished(SimpleNamespace(**{name: getattr(rollout, name)[:, part] for name in names})).tolist()
        for part in (slice(0, 1), slice(1, None))
    ]
    assert halves[0][0] < halves[1][0]
    assert summary(halves) == pytest.approx({k: v.item() for k, v in expected.items()}, rel=1e-5)
    assert all(math.isnan(number) for number in summary([[0.0] * 9]).values())


def test_faults_of_a_record_are_counted() -> None:
    env = lw.make("hopper", nworld=3)
    rollout = lw.Rollout(env, 4)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    noise = torch.zeros(rollout.action.shape)
    noise[1:3, 2] = math.nan
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 2]
    assert env.fault_counts["action"] == 2
    noise.zero_()
    rollout.collect(policy, noise)
    assert rollout.faults.tolist() == [0, 0, 0]


def test_mini_batches_grow_with_the_samples(env: lw.Env) -> None:
    def batch(samples: int, given: int | None = None) -> int:
        return lw.NPG(env, config=dataclasses.replace(SMALL, samples=samples, value_batch=given)).fit.batch

    assert [batch(320), batch(16 * 2048)] == [64, 128]
    assert batch(320, 10) == 10


def test_a_mini_batch_of_its_own_counting_learns_as_one_that_is_given() -> None:
    """The step that CUDA records, run without a recording: an index on the device, a last mini-batch filled up."""
    fits = []
    obs, step, target = torch.randn(50, 5), torch.zeros(50), torch.randn(50)
    for counting in (False, True):
        value = lw.ValueFunction(5, (8,), scale=1.0, generator=torch.Generator().manual_seed(0))
        fit = ValueFit(value, 50, 5, rate=1e-2, epochs=2, batch=16, team=Team())
        generator = torch.Generator().manual_seed(1)
        if not counting:
            fit(obs, step, target, generator)
        else:
            captured = _CapturedStep(fit, obs, target[:, None])
            for _ in range(2):
                captured.load(obs, target[:, None], torch.randperm(50, generator=generator))
                for _ in range(captured.count):
                    captured.learn()
        fits.append(torch.cat([p.detach().flatten() for p in fit.parameters]))
    torch.testing.assert_close(*fits)


def test_a_value_function_knows_the_discount_of_the_returns_that_it_was_fitted_to(env: lw.Env, tmp_path: Path) -> None:
    env.rand_reset(0)
    config = dataclasses.replace(SMALL, gamma=0.9)
    value = lw.ValueFunction(env.obs_space.size, (4,))
    assert value.discount is None
    npg = lw.NPG(env, value=value, config=config)
    assert value.discount == lw.NPG(env, config=config).value.discount == 0.9
    run = Run.create(tmp_path, {}, device="cpu")
    run.save(0, npg.policy, {}, value)
    assert lw.load_value(run).discount == 0.9
    content = torch.load(run.checkpoint)
    del content["value"]["shape"]["discount"]  # as older releases saved it
    torch.save(content, run.checkpoint)
    assert lw.load_value(run).discount is None


def test_segments_go_on_where_the_last_ones_ended(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, samples=16 * 5, mean_every=0))
    assert npg.segments  # chosen by itself: 5 steps hold no episode of 12
    lengths, steps = [], []
    for _ in range(6):
        lengths.append(next(npg).length_mean)
        steps.append(npg.rollout.step.clone())
    joined = torch.cat(steps)
    assert torch.equal(joined, (joined[0] + torch.arange(30.0)[:, None]) % 12)
    assert len(joined[0].unique()) > 5  # the worlds do not march in step
    # an episode that was begun in its middle is not counted, whole ones are
    assert math.isnan(lengths[0])
    assert lengths[-1] == 12.0


def test_gradient_that_is_not_finite_leaves_the_policy_alone(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=SMALL)
    with torch.no_grad():
        npg.policy.log_std.fill_(-4.0)  # below its limit, which is only kept to by a step
        npg.value.network[0].weight[0, 0] = math.nan
    before = [p.clone() for p in (*npg.policy.parameters(), *npg.value.parameters())]
    with pytest.raises(FloatingPointError, match="gradient of iteration 1 is not finite; .* finite: make the step"):
        next(npg)
    after = (*npg.policy.parameters(), *npg.value.parameters())
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize(
    ("name", "value"), [("gamma", 1.5), ("samples", 0), ("delta", -1.0), ("value_batch", 0), ("gamma", math.nan)]
)
def test_bad_hyperparameters_are_named(env: lw.Env, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{name} has to be .*, not {value}"):
        lw.NPG(env, config=dataclasses.replace(SMALL, **{name: value}))


def test_samples_by_default() -> None:
    """The paper's 10,000, and at least 16 steps of every world."""
    counts = [lw.NPG(lw.make("point_mass", nworld=n)).count for n in (10, 64, 1000)]
    assert counts == [10_000, 10_048, 16_000]


def test_an_evaluation_leaves_no_gradients() -> None:
    env = lw.make("point_mass", nworld=2)
    lw.evaluate(env, lw.GaussianPolicy(env.obs_space.size, env.action_space.size), 2)
    assert not env.action.requires_grad


def test_evaluation_counts_the_same_number_of_episodes_of_every_world() -> None:
    """Short episodes do not crowd out long ones, and the numbers are those of a plain loop."""
    env = lw.make("hopper", nworld=4, horizon=60)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    got = lw.evaluate(env, policy, 8, seed=3)
    env.rand_reset(3)
    total, lengths, expected = torch.zeros(4), [0] * 4, [[] for _ in range(4)]
    while min(map(len, expected)) < 2:
        with torch.no_grad():
            env.step(policy(env.obs))
        total += env.reward
        for w in range(4):
            lengths[w] += 1
            if env.done[w]:
                expected[w].append((total[w].item(), lengths[w], env.eval[w].item()))
                total[w], lengths[w] = 0.0, 0
    flat = [episodes[i] for i in range(2) for episodes in expected]
    np.testing.assert_allclose(got.returns, [e[0] for e in flat], rtol=1e-5)
    np.testing.assert_array_equal(got.lengths, [e[1] for e in flat])
    np.testing.assert_allclose(got.evals, [e[2] for e in flat], rtol=1e-5)


def test_point_mass_learns_to_reach_the_target() -> None:
    """A short run with the original's own settings for this task; its full run is in the README's figures."""
    env = lw.make("point_mass", nworld=16)
    config = lw.NPGConfig(
        samples=16 * 256, gamma=0.97, lam=0.95, delta=0.02, hidden=(16, 16), value_hidden=(32, 32), mean_every=0
    )
    npg = lw.NPG(env, config=config, seed=0)
    rewards = [next(npg).terminal_reward for _ in range(25)]
    assert np.mean(rewards[:3]) < 0.4
    assert np.mean(rewards[-3:]) > 0.7, rewards


def test_parameters_of_each_world_reach_the_mean_policys_worlds() -> None:
    """And so do those that are changed later."""
    env = lw.make("point_mass", nworld=4, horizon=12, success_distance=[0.0, 9.0, 0.0, 9.0])
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, mean_every=1, mean_episodes=6))
    assert next(npg).mean_success == 0.5
    env.set_params(success_distance=9.0)
    it = next(npg)
    assert it.mean_success == it.success == 1.0


def test_weights_and_noise_are_drawn_apart(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=SMALL, seed=5)
    same_seed = torch.Generator().manual_seed(5)
    assert not torch.equal(npg.generator.get_state(), same_seed.get_state())


def test_npg_wants_automatic_resets() -> None:
    env = lw.make("point_mass", autoreset=False)
    with pytest.raises(ValueError, match="autoreset=True"):
        lw.NPG(env)
    with pytest.raises(ValueError, match="autoreset=True"):
        lw.evaluate(env, lw.GaussianPolicy(6, 2), 1)


def on_gpu(**changes: object) -> lw.NPG:
    """NPG on Hopper on a GPU, 2 iterations old: everything is compiled and recorded."""
    env = lw.make("hopper", nworld=64, device="cuda")
    config = lw.NPGConfig(samples=64 * 16, rollout="segments", mean_every=0, value_batch=100, **changes)
    npg = lw.NPG(env, config=config, seed=1)
    for _ in range(2):
        next(npg)
    return npg


@pytest.mark.gpu
def test_gpu_an_iteration_waits_for_one_copy_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that torch would have to wait for raises, but for the copy of the statistics."""
    npg = on_gpu(normalize=True)
    copies = []

    def tolist(tensor: torch.Tensor) -> list[list[float]]:
        torch.cuda.set_sync_debug_mode("default")
        copies.append(tensor.shape)
        numbers = tensor.cpu().numpy().tolist()
        torch.cuda.set_sync_debug_mode("error")
        return numbers

    monkeypatch.setattr(torch.Tensor, "tolist", tolist)
    torch.cuda.set_sync_debug_mode("error")
    try:
        it = next(npg)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(copies) == 1 and math.isfinite(it.kl)


@pytest.mark.gpu
def test_gpu_a_recorded_fit_learns_as_plain_launches() -> None:
    """In two calls: the first records between two mini-batches, the second only replays, on other samples."""
    samples, batch = 1000, 96  # a last mini-batch that is smaller
    generator = torch.Generator("cuda").manual_seed(2)
    data = [torch.randn(samples, 6, generator=generator, device="cuda") for _ in range(2)]
    fits = []
    for recorded in (False, True):
        value = lw.ValueFunction(5, (32, 32), scale=1.0, generator=torch.Generator().manual_seed(0)).cuda()
        fit = ValueFit(value, samples, 10, rate=1e-2, epochs=2, batch=batch, team=Team())
        generator = torch.Generator("cuda").manual_seed(1)
        for obs, target in ((part[:, :5], part[:, 5]) for part in data):
            if recorded:
                fit(obs, torch.zeros(samples, device="cuda"), target, generator)
                assert fit._step is not None and fit._step.graph is not None
                continue
            for _ in range(fit.epochs):
                order = torch.randperm(samples, generator=generator, device="cuda")
                for rows in order.split(batch):
                    fit.learn(obs[rows], target[rows, None], 1.0 / len(rows))
        fits.append(torch.nn.utils.parameters_to_vector(fit.parameters))
    torch.testing.assert_close(*fits, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_gpu_resumes() -> None:
    """A recorded fit has the addresses of its optimizer's moments: other ones want another recording."""
    npg = on_gpu()
    saved = npg.state_dict()
    first = next(npg)
    npg.load_state_dict(saved)
    again = next(npg)
    assert again.kl == pytest.approx(first.kl, rel=1e-2)
    assert again.value_error == pytest.approx(first.value_error, rel=1e-2)
    assert again.gradient_norm == pytest.approx(first.gradient_norm, rel=1e-2)


def test_what_is_no_environment_or_no_configuration_is_refused() -> None:
    env = lw.make("point_mass", nworld=2)
    with pytest.raises(ValueError, match=r"env of NPG must be of type Env, as lw.make\(...\) .*, not str 'hopper'"):
        lw.NPG("hopper")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"config of NPG must be of type NPGConfig .* not dict"):
        lw.NPG(env, config={"samples": 3})  # type: ignore[arg-type]
    for hidden in (8, (8, 0), "wide"):
        with pytest.raises(ValueError, match=r"hidden must be the widths of the hidden layers, as in \(64, 64\), not "):
            lw.NPG(env, config=lw.NPGConfig(hidden=hidden))  # type: ignore[arg-type]


NAN = """
import warp as wp
import lyceum_warp as lw
from lyceum_warp import Row

@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]

@wp.struct
class Params:
    dt: float
    where: int = 0

@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qpos[1]
    if p.where == 1:
        obs[2] = wp.sqrt(s.qpos[1] - 1.2)
    else:
        obs[2] = 0.0

@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.where == 0 and s1.qpos[1] < 1.2:
        return wp.sqrt(s1.qpos[1] - 1.2)
    return 0.0

class Fragile(lw.Task):
    model = "hopper.xml"
    obs = {"place": 2, "root": 1}
"""


@pytest.mark.parametrize("where, what", [
    (0, r"The reward of the task 'fragile' is -?nan, \d+ steps after a reset of world \d, and not finite in \d+ of 32"),
    (1, r"The observation of the task 'fragile' is -?nan in 'root', \d+ steps after a reset of world \d, and not"),
])  # fmt: skip
def test_what_is_not_finite_is_named(where: int, what: str, task_file: TaskFile) -> None:
    env = lw.make(str(task_file("fragile.py", NAN)), nworld=4, where=where, horizon=80)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, mean_every=0))
    with pytest.raises(FloatingPointError, match=what):
        for _ in range(5):
            next(npg)
