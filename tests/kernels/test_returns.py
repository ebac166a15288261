import numpy as np
import warp as wp

from lyceum_warp.kernels import returns


def test_advantages_and_returns_bootstrap_at_time_limits_only() -> None:
    """World 0 has a truncation, and world 1 has a termination."""
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
