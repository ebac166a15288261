import math

import torch

import lyceum_warp as lw


def test_samples_and_log_density_equal_those_of_torch() -> None:
    policy = lw.GaussianPolicy(5, 2, (6, 4), log_std=0.3)
    torch.nn.init.normal_(policy.network[-1].weight)
    obs, noise = torch.randn(20, 5), torch.randn(20, 2)
    normal = torch.distributions.Normal(policy.network(obs), math.exp(0.3))
    action = policy.sample(obs, noise, out=torch.empty(20, 2))
    torch.testing.assert_close(action, normal.mean + normal.stddev * noise)
    torch.testing.assert_close(policy.log_prob(obs, action), normal.log_prob(action).sum(-1))
