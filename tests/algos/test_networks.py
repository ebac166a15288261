"""The normaliser of observations."""

import torch

import lyceum_warp as lw
from lyceum_warp.algos.networks import Normalizer, moved


def test_normalizer_has_mean_and_variance_of_all_portions_together() -> None:
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    normalizer = Normalizer(4)
    torch.testing.assert_close(normalizer(obs[:5, :1].expand(5, 4)), obs[:5, :1].expand(5, 4).clamp(-10, 10))
    for part in obs.split([10, 700, 290]):
        normalizer.update(part)
    normalized = normalizer(obs)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(4), atol=1e-2, rtol=0)


def test_a_module_on_the_right_device_is_not_copied() -> None:
    policy = lw.GaussianPolicy(6, 2)
    assert moved(policy, lw.make("point_mass")) is policy
