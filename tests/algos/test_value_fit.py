"""The regression of value functions, with and without a captured step."""

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.value_fit import CapturedStep, ValueFit


def test_the_step_that_is_captured_learns_the_same_as_plain_mini_batches() -> None:
    """Run without a graph: an index on the device selects the mini-batch, and the last one is filled up."""
    fits = []
    obs, step, target = torch.randn(50, 5), torch.zeros(50), torch.randn(50)
    for captured in (False, True):
        value = lw.ValueFunction(5, (8,), scale=1.0, generator=torch.Generator().manual_seed(0))
        fit = ValueFit(value, 50, 5, rate=1e-2, epochs=2, batch=16, team=Team())
        generator = torch.Generator().manual_seed(1)
        if not captured:
            fit(obs, step, target, generator)
        else:
            one_step = CapturedStep(fit, obs, target[:, None])
            for _ in range(2):
                one_step.load(obs, target[:, None], torch.randperm(50, generator=generator))
                for _ in range(one_step.count):
                    one_step.learn()
        fits.append(torch.cat([p.detach().flatten() for p in fit.parameters]))
    torch.testing.assert_close(*fits)


@pytest.mark.gpu
def test_gpu_a_captured_fit_learns_the_same_as_plain_launches() -> None:
    """In two calls: the first captures between two mini-batches, the second only replays, on other samples."""
    samples, batch = 1000, 96  # the last mini-batch is smaller
    generator = torch.Generator("cuda").manual_seed(2)
    data = [torch.randn(samples, 6, generator=generator, device="cuda") for _ in range(2)]
    fits = []
    for captured in (False, True):
        value = lw.ValueFunction(5, (32, 32), scale=1.0, generator=torch.Generator().manual_seed(0)).cuda()
        fit = ValueFit(value, samples, 10, rate=1e-2, epochs=2, batch=batch, team=Team())
        generator = torch.Generator("cuda").manual_seed(1)
        for obs, target in ((part[:, :5], part[:, 5]) for part in data):
            if captured:
                fit(obs, torch.zeros(samples, device="cuda"), target, generator)
                assert fit.captured is not None and fit.captured.graph is not None
                continue
            for _ in range(fit.epochs):
                order = torch.randperm(samples, generator=generator, device="cuda")
                for places in order.split(batch):
                    fit.learn(obs[places], target[places, None], 1.0 / len(places))
        fits.append(torch.nn.utils.parameters_to_vector(fit.parameters))
    torch.testing.assert_close(*fits, rtol=1e-3, atol=1e-3)
