import pytest
import torch
from torch import nn

from lyceum_warp.algos.common.half import half_layers
from lyceum_warp.algos.common.networks import MLP, Activation, mlp


def network_and_inputs(activation: Activation, device: str) -> tuple[MLP, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    network = mlp([7, 64, 32, 3], activation=activation, generator=generator).to(device)
    x, weight = (torch.randn(40, 5, size, generator=generator).to(device) for size in (7, 3))
    return network, x, weight


@pytest.mark.parametrize("activation", ["elu", "tanh", "relu"])
def test_float32_gradients_equal_autograd(activation: Activation) -> None:
    network, x, weight = network_and_inputs(activation, "cpu")
    x.requires_grad_()  # as after a GRU
    outputs = [network(x), half_layers(network, type(network[1]), x)]
    gradients = [torch.autograd.grad((y * weight).sum(), [x, *network.parameters()]) for y in outputs]
    torch.testing.assert_close(*outputs)
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-4)


@pytest.mark.gpu
@pytest.mark.parametrize("scale", [1.0, 1e-2, 1e2])
def test_half_precision_rounds_gradients_like_tf32(scale: float) -> None:
    network, x, weight = network_and_inputs("elu", "cuda")
    exact = torch.autograd.grad((network(x) * weight * scale).sum(), list(network.parameters()))
    rounded = half_layers(network, nn.ELU, x)
    gradients = torch.autograd.grad((rounded * weight * scale).sum(), list(network.parameters()))
    for a, b in zip(exact, gradients, strict=True):
        assert (a - b).norm() <= 2e-3 * a.norm()
