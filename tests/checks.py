"""Make random states, compare results with formulas, and check random samples."""

import numpy as np
import torch

import lyceum_warp as lw


def put_at_random(env: lw.Env, rng: np.random.Generator, position: float, velocity: float) -> torch.Tensor:
    state = env.get_state()
    parts = env.state_space.split(state)
    for name, size in (("qpos", position), ("qvel", velocity)):
        values = rng.uniform(-size, size, parts[name].shape).astype(np.float32)
        parts[name].copy_(torch.from_numpy(values))
    env.set_state(state)
    return state


def positions(env: lw.Env, state: torch.Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
    parts = env.state_space.split(env.get_state() if state is None else state)
    return parts["qpos"].numpy().copy(), parts["qvel"].numpy().copy()


def check_formula(ours: torch.Tensor, formula: np.ndarray) -> None:
    np.testing.assert_allclose(ours.numpy(), formula, rtol=1e-6, atol=2e-6)


def check_uniform(samples: np.ndarray) -> None:
    """Check that each column is U(-1, 1) and independent of the other columns."""
    n, k = samples.shape
    assert np.abs(samples).max() <= 1.0
    assert samples.max(axis=0).min() > 1.0 - 20.0 / n and samples.min(axis=0).max() < 20.0 / n - 1.0
    expected = (np.sort(samples, axis=0) + 1.0) / 2.0
    ranks = (np.arange(n)[:, None] + 0.5) / n
    assert np.abs(expected - ranks).max() < 2.6 / np.sqrt(n)
    assert np.abs(np.corrcoef(samples.T) - np.eye(k)).max() < 5.5 / np.sqrt(n)


def check_normal(samples: np.ndarray) -> None:
    """Check that each column is N(0, 1) and independent of the other columns."""
    n, k = samples.shape
    quantiles = torch.special.ndtr(torch.from_numpy(np.sort(samples, axis=0))).numpy()
    ranks = (np.arange(n)[:, None] + 0.5) / n
    assert np.abs(quantiles - ranks).max() < 2.6 / np.sqrt(n)
    assert np.abs(samples.std(axis=0) - 1.0).max() < 5.0 / np.sqrt(2.0 * n)
    assert np.abs(np.corrcoef(samples.T) - np.eye(k)).max() < 5.5 / np.sqrt(n)


def ks_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the Kolmogorov-Smirnov distance between each column of ``a`` and the same column of ``b``, (columns,)."""
    order = np.argsort(np.concatenate([a, b]), axis=0)
    ranks = np.cumsum(np.where(order < len(a), 1.0 / len(a), -1.0 / len(b)), axis=0)
    return np.abs(ranks).max(axis=0)


def check_same_distribution(a: np.ndarray, b: np.ndarray) -> None:
    """Compare the distributions of two samples (n, k) and (m, k) for each column and each pair of columns.

    If the distributions are equal, fewer than one in 1,000 columns exceeds these thresholds.
    """
    fixed = np.ptp(a, axis=0) < 1e-6
    np.testing.assert_allclose(b[:, fixed], np.tile(a[0, fixed], (len(b), 1)), atol=1e-5)
    a, b, unit = a[:, ~fixed], b[:, ~fixed], np.sqrt(1 / len(a) + 1 / len(b))
    assert (ks_distance(a, b) < 2.2 * unit).all()
    correlations = [np.atleast_2d(np.corrcoef(sample.T)) for sample in (a, b)]
    assert np.abs(correlations[0] - correlations[1]).max(initial=0.0) < 5.5 * unit
