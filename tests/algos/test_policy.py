import pytest
import torch

import lyceum_warp as lw


@pytest.fixture(scope="module")
def policy() -> lw.GaussianPolicy:
    torch.manual_seed(1)
    policy = lw.GaussianPolicy(5, 2, (6, 4))
    for parameter in policy.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return policy


def test_log_prob_equals_that_of_torch(policy: lw.GaussianPolicy) -> None:
    obs, action = torch.randn(20, 5), torch.randn(20, 2)
    expected = torch.distributions.Normal(policy(obs), policy.log_std.exp()).log_prob(action).sum(-1)
    torch.testing.assert_close(policy.log_prob(obs, action), expected)


def test_samples_have_the_mean_and_the_standard_deviation_of_the_policy(policy: lw.GaussianPolicy) -> None:
    obs = torch.randn(1, 5).expand(20_000, 5)
    generator = torch.Generator().manual_seed(0)
    out = torch.empty(20_000, 2)
    policy.sample(obs, torch.randn(20_000, 2, generator=generator), out=out)
    torch.testing.assert_close(out.mean(0), policy(obs[0]), atol=0.03, rtol=0)
    torch.testing.assert_close(out.std(0), policy.log_std.exp(), atol=0.03, rtol=0)
