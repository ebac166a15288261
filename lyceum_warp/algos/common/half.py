"""Compute fully connected networks and their gradients in half precision.

The significand of float16 is as long as that of TensorFloat-32, so matrix products are as exact as with
``torch.set_float32_matmul_precision("high")``. On a GPU, they take half the time, and activations half the memory
traffic. Sums and outputs are float32. The range of float16 is shorter, so a loss must be scaled (Micikevicius et al.
2018, "Mixed Precision Training"): multiply a mean over samples by their number.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

_tanh_slope = torch.ops.aten.tanh_backward.grad_input
_relu_slope = torch.ops.aten.threshold_backward.grad_input
_elu_slope = torch.ops.aten.elu_backward.grad_input

SLOPES: dict[type[nn.Module], Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    nn.Tanh: lambda d, y: _tanh_slope(d, y, grad_input=d),
    nn.ReLU: lambda d, y: _relu_slope(d, y, 0.0, grad_input=d),
    nn.ELU: lambda d, y: _elu_slope(d, 1.0, 1.0, 1.0, True, y, grad_input=d),
}
"""Functions of d and an activation's result y that multiply d by the activation's derivative in place."""

_IN_PLACE = {nn.Tanh: torch.tanh_, nn.ReLU: torch.relu_, nn.ELU: nn.functional.elu_}


def activation_of(network: nn.Module) -> type[nn.Module] | None:
    """Return the activation of a network as ``mlp`` makes it, or None for any other network."""
    layers = list(network.children()) if isinstance(network, nn.Sequential) else []
    linear, activations = layers[::2], layers[1::2]
    kind = type(activations[0]) if activations else nn.Tanh
    plain = (
        len(layers) % 2 == 1
        and len(list(network.parameters())) == 2 * len(linear)  # no layers share parameters
        and all(type(layer) is nn.Linear and layer.bias is not None for layer in linear)
        and kind in SLOPES
        and all(type(layer) is kind and getattr(layer, "alpha", 1.0) == 1.0 for layer in activations)
        and not any(map(_hooked, network.modules()))
    )
    return kind if plain else None


def _hooked(module: nn.Module) -> bool:
    return any(getattr(module, f"_forward{kind}_hooks") for kind in ("", "_pre"))


def half_layers(network: nn.Module, activation: type[nn.Module], x: torch.Tensor) -> torch.Tensor:
    """Compute the outputs of a network with the given ``activation_of``, (..., outputs) float32.

    The outputs can be differentiated once, with respect to the parameters.
    """
    rows: torch.Tensor = _HalfLayers.apply(x.reshape(-1, x.shape[-1]), activation, *network.parameters())
    return rows.view(*x.shape[:-1], -1)


class _HalfLayers(torch.autograd.Function):
    """Maps inputs, (rows, inputs), to outputs, (rows, outputs)."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, activation: type[nn.Module], *parameters: torch.Tensor) -> torch.Tensor:
        kind = torch.float16 if x.is_cuda else x.dtype
        weights = [_padded(parameters[0], kind), *(weight.to(kind) for weight in parameters[2::2])]
        results = [_padded(x, kind)]
        for weight, bias in zip(weights[:-1], parameters[1:-1:2], strict=True):
            results.append(_IN_PLACE[activation](torch.addmm(bias.to(kind), results[-1], weight.t())))
        ctx.save_for_backward(*weights, *results)
        ctx.activation, ctx.inputs = activation, x.shape[1]
        return _product(results[-1], weights[-1].t()).add_(parameters[-1])

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,), saved = gradients, ctx.saved_tensors
        weights, results = saved[: len(saved) // 2], saved[len(saved) // 2 :]
        slope = gradient.clamp(-_LARGEST, _LARGEST).to(weights[0].dtype)
        ones = slope.new_ones(_MULTIPLE, len(slope))
        parts: list[torch.Tensor] = []
        for i in reversed(range(len(weights))):
            # the sum over the rows as a product, because torch's reduction takes several times as long
            parts += [_product(ones, slope)[0], _product(slope.t(), results[i])]
            if i:
                slope = SLOPES[ctx.activation](torch.mm(slope, weights[i]), results[i])
        parts[-1] = parts[-1][:, : ctx.inputs]
        inputs = _product(slope, weights[0])[:, : ctx.inputs] if ctx.needs_input_grad[0] else None
        return inputs, None, *reversed(parts)


_LARGEST = 1e4
"""Limit of a sample's gradient with respect to the outputs. float16 leaves room for larger hidden gradients."""

_MULTIPLE = 8
"""Tensor cores need rows whose length is a multiple of this."""


def _padded(rows: torch.Tensor, kind: torch.dtype) -> torch.Tensor:
    """Convert rows, and append zeros up to a multiple of ``_MULTIPLE`` columns."""
    return nn.functional.pad(rows.to(kind), (0, -rows.shape[1] % _MULTIPLE))


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Multiply matrices; the result is float32."""
    return torch.mm(a, b, out_dtype=torch.float32) if a.is_cuda else torch.mm(a, b)
