"""Evaluate and differentiate small fully connected networks on the CPU without autograd.

With a hundred units per layer, torch's modules and autograd take longer than the arithmetic itself. For each layer,
this module computes only one matrix product, into a preallocated buffer.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import nn

from lyceum_warp.algos.common.half import SLOPES, activation_of
from lyceum_warp.algos.common.networks import MLP, Normalizer
from lyceum_warp.algos.common.policy import GaussianPolicy
from lyceum_warp.algos.common.value import ValueFunction

_Array: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]


def _elu_(x: _Array) -> None:
    np.copyto(x, np.expm1(x), where=x < 0.0)


# NumPy's tanh is several times as fast as torch's on some processors
_ACTIVATIONS: dict[type[nn.Module], Callable[[_Array], Any]] = {
    nn.Tanh: lambda x: np.tanh(x, out=x), nn.ReLU: lambda x: np.maximum(x, 0.0, out=x), nn.ELU: _elu_,
}  # fmt: skip
"""Functions that apply an activation in place."""

_FEW = 2**18  # up to this number of multiplications, use NumPy, whose calls have less overhead than torch's


class DensePasses:
    """Computes forward passes y = f(x), and products with the Jacobian J = dy / dparameters.

    The next call overwrites the returned tensors. The parameters are the weight and bias of each layer.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], activation: type[nn.Module]) -> None:
        self.parameters = [parameter.detach() for parameter in parameters]
        self.weights, self.biases = self.parameters[::2], self.parameters[1::2]
        self.activation = activation
        self._activate, self._times_slope = _ACTIVATIONS[activation], SLOPES[activation]
        self._parameter_arrays = [(w.numpy().T, b.numpy()) for w, b in zip(self.weights, self.biases, strict=True)]
        self._pulled = [torch.empty_like(parameter) for parameter in self.parameters]
        self._rows = 0
        self._buffers: list[list[torch.Tensor]] = []
        self._allocate(0)

    @staticmethod
    def of(network: nn.Module) -> "DensePasses | None":
        """Wrap a CPU network made by ``mlp``; return None for any other network."""
        parameters = list(network.parameters())
        usual = type(network) in (nn.Sequential, MLP)
        on_cpu = all(p.device.type == "cpu" and p.dtype == torch.float32 for p in parameters)
        kind = activation_of(network) if usual and on_cpu else None
        return None if kind is None else DensePasses(parameters, kind)

    def _allocate(self, rows: int) -> None:
        widths = [len(bias) for bias in self.biases]
        self._buffers = [[torch.empty(rows, n) for n in widths] for _ in range(2)]

    def _resize(self, rows: int) -> None:
        if rows > len(self._buffers[0][0]):
            self._allocate(rows)
        self._rows, self._few = rows, rows * max(weight.numel() for weight in self.weights) <= _FEW
        self.results, self.derivatives = [[b[:rows] for b in kind] for kind in self._buffers]
        self._arrays = [result.numpy() for result in self.results]

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Compute outputs, (rows, outputs), and store the inputs for ``push`` and ``pull``."""
        if len(x) != self._rows:
            self._resize(len(x))
        self._inputs = [x, *self.results[:-1]]
        last = len(self.weights) - 1
        array = x.numpy()
        for i, (result, (weights, biases)) in enumerate(zip(self._arrays, self._parameter_arrays, strict=True)):
            if self._few:
                np.matmul(array, weights, out=result)
                np.add(result, biases, out=result)
            else:
                torch.addmm(self.biases[i], self._inputs[i], self.weights[i].t(), out=self.results[i])
            if i < last:
                self._activate(result)
            array = result
        return self.results[-1]

    def push(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        """Compute J v, (rows, outputs), at the last inputs; v has one tensor for each parameter."""
        last = len(self.weights) - 1
        for i, derivative in enumerate(self.derivatives):
            torch.addmm(parts[2 * i + 1], self._inputs[i], parts[2 * i].t(), out=derivative)
            if i:
                derivative.addmm_(self.derivatives[i - 1], self.weights[i].t())
            if i < last:
                self._times_slope(derivative, self.results[i])
        return self.derivatives[-1]

    def pull(self, u: torch.Tensor, out: Sequence[torch.Tensor] | None = None) -> list[torch.Tensor]:
        """Compute J^T u at the last inputs, in ``out`` or in own buffers; u has the shape (rows, outputs)."""
        out = list(self._pulled if out is None else out)
        for i in reversed(range(len(self.weights))):
            x, weight = self._inputs[i], self.weights[i]
            # compute the product or its transpose, whichever has longer rows, because this is faster
            if x.shape[1] < u.shape[1]:
                out[2 * i].copy_((x.t() @ u).t())
            else:
                torch.mm(u.t(), x, out=out[2 * i])
            torch.sum(u, 0, out=out[2 * i + 1])
            if i:
                u = torch.mm(u, weight, out=self.derivatives[i - 1])
                self._times_slope(u, x)
        return out


class DensePolicy(GaussianPolicy):
    """A policy that is evaluated without autograd, and shares the parameters and the normaliser of another policy.

    The next call overwrites the returned actions.
    """

    def __init__(self, policy: GaussianPolicy, passes: DensePasses) -> None:
        vars(self).update(vars(policy))
        self.passes = passes
        self._normalized = torch.empty(0, policy.nobs)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute mean actions, (rows, nact)."""
        normalizer = self.normalizer
        if not isinstance(normalizer, Normalizer):
            return self.passes(obs)
        if len(obs) > len(self._normalized):
            self._normalized = torch.empty_like(obs)
        rows = self._normalized[: len(obs)]
        torch.sub(obs, normalizer.shift, out=rows).mul_(normalizer.scale)
        return self.passes(rows.clamp_(-normalizer.limit, normalizer.limit))

    def sample(self, obs: torch.Tensor, noise: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Sample actions; see ``GaussianPolicy.sample``."""
        action = out.numpy()
        np.multiply(noise.numpy(), np.exp(self.log_std.detach().numpy()), out=action)
        np.add(action, self(obs).numpy(), out=action)
        return out


def dense_policy(policy: GaussianPolicy) -> GaussianPolicy:
    """Return a ``DensePolicy``, or the policy itself if its class or its network is not supported."""
    trainable = all(parameter.requires_grad for parameter in policy.network.parameters())
    plain = type(policy) is GaussianPolicy and policy.mirror is None and trainable
    passes = DensePasses.of(policy.network) if plain else None
    return policy if passes is None else DensePolicy(policy, passes)


def predict(value: ValueFunction, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Predict returns, (...,), without gradients, and without autograd if the value function's network allows it."""
    passes = DensePasses.of(value.network) if type(value) is ValueFunction else None
    if passes is None:
        return value(obs, step)
    features = value.features(obs, step)
    output = passes(features.reshape(-1, features.shape[-1])).view(features.shape[:-1])
    return output * value.scale.float() + value.shift.float()
