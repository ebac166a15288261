"""Build the networks and observation normalisers of policies and value functions."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeAlias, TypeVar

import torch
import warp as wp
from torch import nn

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.half import activation_of, half_layers
from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.support.machine import free_memory
from lyceum_warp.support.validate import check_flag, check_kind, check_word, described
from lyceum_warp.support.warp_log import start_warp

Module = TypeVar("Module", bound=nn.Module)

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "tanh": nn.Tanh, "relu": nn.ReLU, "leaky_relu": nn.LeakyReLU, "elu": nn.ELU, "selu": nn.SELU, "gelu": nn.GELU,
    "silu": nn.SiLU, "softplus": nn.Softplus,
}  # fmt: skip


def check_memory(sizes: Sequence[int], networks: int = 1) -> None:
    """Check that fully connected networks with layers of the given sizes fit into memory.

    Raises:
        ValueError: The weights do not fit into memory.
    """
    start_warp()
    bytes_each, free = 4 * sum(n * m + m for n, m in itertools.pairwise(sizes)), free_memory(wp.get_device("cpu"))
    if free is not None and (size := networks * bytes_each) > free:
        raise ValueError(
            f"networks with layers of the sizes {list(sizes)} need {size / 1e9:.3g} GB, but only {free / 1e9:.3g} GB "
            "are free: make the layers smaller"
        )


class MLP(nn.Sequential):
    """Fully connected layers with activations between them, as ``mlp`` makes them."""

    in_half: ClassVar[bool] = False
    """Whether networks compute in half precision; their outputs can then be differentiated once."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Compute the outputs, (..., outputs)."""
        if MLP.in_half and (activation := activation_of(self)):
            return half_layers(self, activation, x)
        outputs: torch.Tensor = super().forward(x)
        return outputs


def mlp(
    sizes: Sequence[int],
    *,
    activation: Activation = "tanh",
    last_scale: float = 1.0,
    generator: torch.Generator | None = None,
) -> MLP:
    """Make a fully connected network with Glorot-uniform weights and zero biases.

    ``sizes`` includes the input and the output. ``last_scale`` multiplies the last layer's initial weights.

    Raises:
        ValueError: The activation is unknown.
    """
    check_word("activation", activation, list(ACTIVATIONS))
    check_kind("generator", generator, torch.Generator | None, "as torch.Generator()")
    kind = ACTIVATIONS[activation]
    layers: list[nn.Module] = []
    for i, (n, m) in enumerate(itertools.pairwise(sizes)):
        linear = nn.Linear(n, m)
        nn.init.xavier_uniform_(linear.weight, gain=1.0, generator=generator)
        nn.init.zeros_(linear.bias)
        layers.append(linear)
        if i < len(sizes) - 2:
            layers.append(kind())
    with torch.no_grad():
        linear.weight.mul_(last_scale)
    return MLP(*layers)


class GRU(nn.Module):
    """A network with memory: a gated recurrent unit (Cho et al. 2014) whose state is the input of another network.

    Every network with memory maps (x, state), (n, size) and (n, state_size), to (y, next state).
    """

    def __init__(self, size: int, units: int, network: nn.Module, generator: torch.Generator | None = None) -> None:
        super().__init__()
        check_memory([size + units, 3 * units])
        self.state_size, self.cell, self.network = units, nn.GRUCell(size, units), network
        for parameter in self.cell.parameters():
            nn.init.uniform_(parameter, -1.0 / math.sqrt(units), 1.0 / math.sqrt(units), generator=generator)

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the output and the next state."""
        state = self.cell(x, state)
        return self.network(state), state

    def unrolled(self, x: torch.Tensor, state: torch.Tensor, began: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Run the network over sequences; see ``unrolled``. After the cell, all steps are one batch."""
        states, _ = unrolled(lambda x, state: 2 * (self.cell(x, state),), x, state, began)
        return self.network(states), states


def unrolled(
    network: Callable[..., Any], x: torch.Tensor, state: torch.Tensor, began: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Run a network with memory over sequences.

    Args:
        network: The network.
        x: Inputs, (steps, n, size).
        state: The states before the first step, (n, state_size).
        began: Whether an episode begins at a step, so that the state before it is 0, (steps, n) bool.

    Returns:
        The outputs (steps, n, ...), and the states after each step, (steps, n, state_size).
    """
    if hasattr(network, "unrolled"):
        result: tuple[torch.Tensor, torch.Tensor] = network.unrolled(x, state, began)
        return result
    outputs, after = [], []
    for x_now, starts in zip(x, began, strict=True):
        output, state = network(x_now, state.masked_fill(starts.unsqueeze(-1), 0.0))
        outputs.append(output)
        after.append(state)
    return torch.stack(outputs), torch.stack(after)


@torch.no_grad()
def initialize_as_torch(network: nn.Module, generator: torch.Generator | None) -> None:
    """Initialise all linear layers like ``nn.Linear``, uniformly in +-1 / sqrt(inputs)."""
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            bound = 1.0 / math.sqrt(layer.in_features)
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.uniform_(-bound, bound, generator=generator)


LIMIT = 10.0

OUTLIER = 100.0
"""Limit of observations in updates of a normaliser, in standard deviations from the mean of all earlier observations.
Values rarer than 1 in 10,000 (the square) thus hardly change the standard deviation; more frequent values do."""

_PRIOR = 1000
"""The limit assumes that this many observations with a standard deviation of 1 preceded the first one. Episodes start
with small velocities, for example, and the larger velocities of later steps are no outliers."""

_TRIMMED = 0.01
"""Fraction of the first batch, at each end of a part's values, that may be outliers."""

_Applied: TypeAlias = tuple[torch.Tensor, torch.Tensor]


class Normalizer(nn.Module):
    """Normalises observations by their running mean and variance, and clips them to [-limit, limit].

    Before the first update, observations are not scaled. Outliers, such as the absurd observation of a single world,
    hardly change mean and variance (see ``OUTLIER``).
    """

    count: torch.Tensor
    mean: torch.Tensor
    square: torch.Tensor
    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, size: int, limit: float = LIMIT) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))
        self._first: bool | None = None  # whether ``count`` is 0; reading a GPU's number would wait for the device

    @torch.no_grad()
    def update(self, obs: torch.Tensor, team: Team | None = None, *, eps: float = 0.0) -> None:
        """Update mean and variance with a batch of observations, by the parallel formula of Chan et al. (1983).

        Every process must contribute the same number of observations. ``eps`` is added to the standard deviations.
        """
        team = team or Team()
        obs = obs.reshape(-1, obs.shape[-1]).double()
        n = obs.shape[0] * team.size
        if self._first is None:
            self._first = int(self.count) == 0
        obs = obs.clamp(*self._bounds(obs, team))
        self._first = False
        mean = team.sum(obs.sum(0)) / n
        square = team.sum((obs - mean).square().sum(0))
        total, delta = self.count + n, mean - self.mean
        self.square += square + delta.square() * (self.count * n / total)
        self.mean += delta * (n / total)
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.scale.copy_(((self.square / total).sqrt() + eps).clamp_min(1e-4).reciprocal())

    def _bounds(self, obs: torch.Tensor, team: Team) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the limits of observations in an update from earlier observations, or else from trimmed ranges."""
        mean, square, count = self.mean, self.square, self.count
        if self._first:
            ordered, last = obs.sort(0).values, len(obs) - 1
            trimmed = min(max(1, int(_TRIMMED * len(obs))), last // 2)
            low = team.sum(ordered[trimmed].clone()) / team.size
            high = team.sum(ordered[last - trimmed].clone()) / team.size
            count = torch.full_like(count, len(obs))
            mean, square = (low + high) / 2.0, count * ((high - low) / 4.0).square()
        reach = OUTLIER * ((square + _PRIOR) * (1.0 / (count + _PRIOR))).sqrt()
        return mean - reach, mean + reach

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        self._first = None

    @torch.no_grad()
    def interpolate(self, before: _Applied, after: _Applied, part: torch.Tensor) -> None:
        """Interpolate ``shift`` and ``scale`` between their values before and after an update."""
        self.shift.copy_(torch.lerp(before[0], after[0], part))
        self.scale.copy_(torch.lerp(before[1].log(), after[1].log(), part).exp())

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Normalise observations, (..., size)."""
        normalized = (obs - self.shift) * self.scale
        return normalized if self.limit == math.inf else normalized.clamp(-self.limit, self.limit)


class Normalized(nn.Module):
    """Base class of modules with an optional normaliser of observations."""

    normalizer: nn.Module
    state_size: int = 0
    """Number of floats that the module remembers in each world, from step to step; 0 means no memory."""

    def __init__(self, nobs: int, normalize: bool, limit: float) -> None:
        super().__init__()
        check_flag("normalize", normalize)
        if not isinstance(limit, (int, float)) or not limit > 0:
            raise ValueError(f"limit must be a positive number, or inf for no limit, not {described(limit)}")
        self.normalizer = Normalizer(nobs, limit) if normalize else nn.Identity()

    def observe(self, obs: torch.Tensor, team: Team | None = None, *, eps: float = 0.0) -> None:
        """Update the normaliser, if there is one. This changes the module's outputs.

        Args:
            obs: Observations, (..., nobs).
            team: The processes; each contributes the same number of observations.
            eps: Constant that is added to the standard deviations.
        """
        if isinstance(self.normalizer, Normalizer):
            self.normalizer.update(obs, team, eps=eps)


def trainable(module: Module) -> Module:
    """Return the module; if all its parameters are frozen, as after ``lw.load``, unfreeze them."""
    if isinstance(module, nn.Module) and not any(parameter.requires_grad for parameter in module.parameters()):
        module.requires_grad_(True)
    return module
