from typing import Any

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos import Team
from lyceum_warp.algos.common.dense import DensePasses
from lyceum_warp.algos.common.value_fit import ValueFit


@pytest.mark.parametrize("activation", ["tanh", "relu", "elu"])
def test_value_fit_with_hand_written_gradients_equals_a_fit_with_autograd(activation: Any) -> None:
    generator = torch.Generator().manual_seed(2)
    data = [torch.randn(50, 6, generator=generator) for _ in range(2)]  # the last mini-batch is smaller than the others
    fits = []
    for written_out in (False, True):
        init = torch.Generator().manual_seed(0)
        value = lw.ValueFunction(5, (16, 8), activation=activation, scale=1.0, generator=init)
        fit = ValueFit(value, 50, 5, rate=1e-2, epochs=2, batch=16, team=Team())
        generator = torch.Generator().manual_seed(1)
        for obs, target in ((part[:, :5], part[:, 5]) for part in data):
            if written_out:
                assert fit(obs, torch.zeros(50), target, generator)
                continue
            for _ in range(fit.epochs):
                for places in torch.randperm(50, generator=generator).split(16):
                    fit.learn(obs[places], target[places, None], 1.0 / len(places))
        fits.append(fit)
    plain, dense = fits
    for parameter, other in zip(plain.parameters, dense.parameters, strict=True):
        torch.testing.assert_close(parameter, other)
    for name in ("first", "second", "count"):
        moments, others = getattr(plain.optimizer, name), getattr(dense.optimizer, name)
        torch.testing.assert_close(moments, others, rtol=1e-4, atol=1e-6)


def test_user_value_network_is_fitted_by_autograd() -> None:
    value = lw.ValueFunction(5, (8,), activation="gelu", scale=1.0)
    assert DensePasses.of(value.network) is None
    fit = ValueFit(value, 50, 5, rate=1e-2, epochs=20, batch=16, team=Team())
    obs, target = torch.randn(50, 5), torch.ones(50)
    assert fit(obs, torch.zeros(50), target, torch.Generator().manual_seed(0))
    assert (value(obs, torch.zeros(50)) - 1.0).abs().mean() < 0.5


@pytest.mark.gpu
def test_value_fit_in_a_gpu_graph_equals_plain_launches() -> None:
    samples, batch = 1000, 96
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
                assert fit.captured is not None and fit.captured.step.graph is not None
                continue
            for _ in range(fit.epochs):
                order = torch.randperm(samples, generator=generator, device="cuda")
                for places in order.split(batch):
                    fit.learn(obs[places], target[places, None], 1.0 / len(places))
        fits.append(torch.nn.utils.parameters_to_vector(fit.parameters))
    torch.testing.assert_close(*fits, rtol=1e-3, atol=1e-3)
