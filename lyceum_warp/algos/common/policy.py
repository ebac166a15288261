"""Define Gaussian policies with a diagonal covariance and a network that computes the mean."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.algos.common.networks import GRU, LIMIT, Normalized, check_memory, mlp, unrolled
from lyceum_warp.algos.common.pictures import PictureNetwork, picture_network
from lyceum_warp.algos.common.symmetry import PolicyMirror
from lyceum_warp.core.mirror import Reflection
from lyceum_warp.support.validate import described, finite_number, layer_sizes, whole_number

_LARGEST = torch.finfo(torch.float32).max


class GaussianPolicy(Normalized):
    """Samples actions from N(mean(obs), exp(log_std)^2), where log_std does not depend on the observation.

    Example:
        >>> policy = GaussianPolicy(nobs, nact, network=MyNetwork())  # any nn.Module, (..., nobs) -> (..., nact)
        >>> npg = NPG(env, policy)

    Args:
        nobs: Length of an observation.
        nact: Length of an action.
        hidden: Widths of the hidden layers.
        network: A module that replaces the default network. It maps float32 observations (..., nobs) to float32 mean
            actions (..., nact), independently for each observation. If ``normalize`` is set, its inputs are normalised.
            For NPG, the network must be twice differentiable. A network with memory has the attribute ``state_size``,
            and maps observations (n, nobs) and states (n, state_size) to mean actions and the next states.
        recurrent: Units of a GRU before the hidden layers, which gives the policy memory; 0 means no memory.
        pictures: Shapes of the pictures that the policy sees, (height, width, channels), by the cameras' groups. An
            observation is then a tuple: the vector, unless ``nobs`` is 0, and each camera's pictures, (..., height,
            width, channels).
        channels: See ``lw.PPOConfig``, like the next two arguments.
        spatial_softmax: See ``lw.PPOConfig``.
        frames: See ``lw.PPOConfig``.
        activation: Activation of the hidden layers.
        log_std: Initial logarithm of the standard deviations.
        normalize: Whether to normalise observations by their running mean and variance.
        limit: Normalised observations are clipped to [-limit, limit]; inf means no limit.
        generator: Draws the initial weights.

    Raises:
        ValueError: ``hidden`` is not a sequence of positive whole numbers, ``activation`` is unknown, or ``network`` is
            not a torch module.
    """

    shape: dict[str, Any]
    """Arguments of ``like``."""
    groups: tuple[str, ...]
    """The groups of observations that the policy reads."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (64, 64),
        *,
        network: nn.Module | None = None,
        recurrent: int = 0,
        pictures: Mapping[str, Sequence[int]] | None = None,
        channels: Sequence[int] = (16, 32, 32),
        spatial_softmax: bool = False,
        frames: int = 3,
        activation: Activation = "tanh",
        log_std: float = -0.5,
        normalize: bool = False,
        limit: float = LIMIT,
        generator: torch.Generator | None = None,
    ) -> None:
        nobs, nact = whole_number("nobs", nobs, low=0 if pictures else 1), whole_number("nact", nact, low=1)
        recurrent = whole_number("recurrent", recurrent, low=0)
        sizes = [recurrent or nobs, *layer_sizes(hidden), nact]
        check_memory(sizes)
        super().__init__(nobs, normalize and nobs > 0, limit)
        self.nobs, self.nact = nobs, nact
        self.shape = {"nobs": nobs, "nact": nact, "normalize": normalize, "limit": limit}
        self.pictures = {group: tuple(shape) for group, shape in (pictures or {}).items()}
        self.groups = (*(("policy",) if nobs else ()), *self.pictures)
        if pictures:
            self.shape["pictures"] = {group: list(shape) for group, shape in pictures.items()}
        if network is None and pictures:
            options: dict[str, Any] = {"channels": list(channels), "spatial_softmax": spatial_softmax, "frames": frames}
            options |= {"activation": activation, "recurrent": recurrent}
            self.shape |= options | {"hidden": layer_sizes(hidden)}
            network = picture_network(nobs, nact, hidden, pictures=pictures, generator=generator, **options)
        elif network is None:
            self.shape |= {"hidden": layer_sizes(hidden), "activation": activation}
            # make initial mean actions near zero (as in mjrl)
            network = mlp(sizes, activation=activation, last_scale=1e-2, generator=generator)
            if recurrent:
                self.shape["recurrent"] = recurrent
                network = GRU(nobs, recurrent, network, generator)
        elif isinstance(network, nn.Module):
            self.shape["own"] = _class_name(network)
        else:
            raise ValueError(f"network must be a module of torch (torch.nn.Module), not {described(network)}")
        if type(self) is not GaussianPolicy:
            self.shape["own"] = _class_name(self)
        self.network = network
        self.state_size = whole_number("state_size of the network", getattr(network, "state_size", 0), low=0)
        log_std = finite_number("log_std", log_std, low=-_LARGEST, high=_LARGEST)
        self.log_std = nn.Parameter(torch.full((nact,), log_std))
        self.mirror: PolicyMirror | None = None

    def use_mirror(self, reflections: Mapping[str, Reflection]) -> None:
        """Make the policy symmetric, by averaging over each observation and its mirror image.

        Args:
            reflections: The reflections of ``obs`` and ``action`` (``algos.symmetry.reflections``).
        """
        self.mirror = PolicyMirror(reflections).to(self.log_std.device)
        self.shape["mirror"] = self.mirror.reflections

    @staticmethod
    def like(shape: Mapping[str, Any], network: nn.Module | None = None) -> "GaussianPolicy":
        """Make a new policy with the given ``shape``, and with a network of a custom class.

        Raises:
            ValueError: The policy or its network has a custom class.
        """
        if "own" in shape and network is None:
            normalize = ", normalize=True" if shape["normalize"] else ""
            raise ValueError(
                f"the policy has the custom class {shape['own']}: pass a policy of this class, as in lw.load(run, "
                f"policy=lw.GaussianPolicy({shape['nobs']}, {shape['nact']}, network=...{normalize}))"
            )
        sizes = {name: value for name, value in shape.items() if name not in ("mirror", "own")}
        policy = GaussianPolicy(**sizes, network=network)
        if "mirror" in shape:
            policy.use_mirror(shape["mirror"])
        return policy

    def inputs(self, groups: Mapping[str, torch.Tensor]) -> Any:
        """Select the argument of ``act`` from groups of observations: a tensor, or a tuple with pictures."""
        return tuple(groups[group] for group in self.groups) if self.pictures else groups["policy"]

    def observe_pictures(self, groups: Mapping[str, torch.Tensor], team: Team) -> None:
        """Update the mean pictures that the default network subtracts. Learners call this before they sample."""
        if isinstance(self.network, PictureNetwork):
            self.network.observe([groups[group] for group in self.pictures], team)

    def _inputs(self, obs: Any) -> Any:
        if not self.pictures:
            return self.normalizer(obs)
        return (self.normalizer(obs[0]), *obs[1:]) if self.nobs else tuple(obs)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute mean actions, (..., nact)."""
        return self._mean(obs) if self.mirror is None else self.mirror.average(self._mean, obs)

    def _mean(self, obs: torch.Tensor) -> torch.Tensor:
        mean: torch.Tensor = self.network(self._inputs(obs))
        return mean

    def act(self, obs: torch.Tensor, state: torch.Tensor | None = None) -> Any:
        """Compute actions without noise, (..., nact): the mean actions.

        A policy with memory also needs its state, (n, state_size), and returns the actions and the next state. The
        state is 0 when an episode begins.
        """
        return self(obs) if state is None else self.network(self._inputs(obs), state)

    def unrolled(
        self, obs: torch.Tensor, state: torch.Tensor, began: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute mean actions along sequences; see ``networks.unrolled``.

        Returns:
            The mean actions (steps, n, nact), and the states after each step, (steps, n, state_size).
        """
        if not self.state_size:
            return self(obs), state.expand(len(obs), *state.shape)
        return unrolled(self.network, self._inputs(obs), state, began)

    def features(self, obs: Any, state: torch.Tensor, began: torch.Tensor) -> torch.Tensor:
        """Compute what the last layers of a policy that sees cameras get, (steps, n, size); see ``unrolled``."""
        assert isinstance(self.network, PictureNetwork)
        return self.network.features(self._inputs(obs), state, began)[0]

    @torch.no_grad()
    def sample(self, obs: torch.Tensor, noise: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Sample actions, without gradients.

        Args:
            obs: Observations, (..., nobs).
            noise: Standard normal numbers, (..., nact).
            out: Buffer for the actions, (..., nact).
        """
        return torch.addcmul(self(obs), noise, self.log_std.exp(), out=out)

    def log_prob(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Compute the log-density of actions, (...,)."""
        return log_density(action, self(obs), self.log_std)


def log_density(action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Compute the log-density of actions under a diagonal Gaussian, (...,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -0.5 * z.square().sum(-1) - log_std.sum() - 0.5 * action.shape[-1] * math.log(2 * math.pi)


def divergence(
    old_mean: torch.Tensor, old_log_std: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """Compute the KL divergence from one diagonal Gaussian to another, (...,)."""
    square = (old_mean - mean).square() + torch.exp(2 * old_log_std)
    return (log_std - old_log_std + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1)


def _class_name(module: nn.Module) -> str:
    return f"{type(module).__module__}.{type(module).__qualname__}"
