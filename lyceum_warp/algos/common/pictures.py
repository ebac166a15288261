"""Define networks that see cameras."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import torch
from torch import nn

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.hyperparameters import Activation, PictureConfig
from lyceum_warp.algos.common.networks import GRU, MLP, mlp, unrolled
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_group

Parts: TypeAlias = tuple[torch.Tensor, ...]
"""An observation's vector, if the network reads it, and the pictures of each camera, (..., height, width, channels)."""

_GAIN = 2.0
"""Factor on changes of features, which are small between two steps."""

_FEATURES = 64
"""Features of a picture without spatial softmax."""


def policy_inputs(env: Env, config: PictureConfig) -> tuple[int, dict[str, Any]]:
    """Get the size of a policy's vector, and the arguments of ``GaussianPolicy`` for pictures.

    Raises:
        ValueError: There is no group of a name, or a policy cannot read a group.
    """
    cameras = {camera.group: camera for camera in env.task.cameras}
    groups = config.policy_groups or ("policy", *cameras)
    if twice := next((group for group in groups if groups.count(group) > 1), ""):
        raise ValueError(f"policy_groups={groups} names {twice!r} twice: omit one of them")
    for group in groups:
        check_group(group, env.obs_groups, env.task.name)
        if group != "policy" and group not in cameras:
            raise ValueError(f"policy_groups may hold 'policy' and the groups of cameras, not {group!r}")
        if group in cameras and cameras[group].kind == "segmentation":
            raise ValueError(f"the policy cannot read the ids of the segmentation {group!r}: use kind 'rgb' or 'depth'")
    pictures = {group: env.obs_spaces[group].shape for group in groups if group in cameras}
    if config.random_shift >= (size := min((min(shape[:2]) for shape in pictures.values()), default=1)):
        needed = f"less than the {size} pixels of a picture" if pictures else "0 for a policy without cameras"
        raise ValueError(f"random_shift={config.random_shift} must be {needed}")
    arguments = {name: getattr(config, name) for name in ("channels", "spatial_softmax", "frames")}
    return env.obs_space.size if "policy" in groups else 0, {"pictures": pictures, **arguments}


def policy_settings(policy: Any) -> dict[str, Any]:
    """Get the hyperparameters that a policy determines."""
    names = ("hidden", "activation", "normalize", "recurrent", "channels", "spatial_softmax", "frames")
    settings = {name: policy.shape[name] for name in names if name in policy.shape}
    if policy.pictures:
        settings["policy_groups"] = policy.groups
    return settings if "own" in policy.shape else {"recurrent": 0, **settings}


def shift_pictures(pictures: torch.Tensor, limit: int, generator: torch.Generator) -> None:
    """Shift pictures, (steps, nworld, height, width, channels), in place, each world by up to ``limit`` pixels."""
    nworld, height, width = pictures.shape[1:4]
    shift = torch.randint(-limit, limit + 1, (2, nworld, 1), generator=generator, device=pictures.device)
    rows = (torch.arange(height, device=pictures.device) + shift[0]).clamp(0, height - 1)[:, :, None]
    columns = (torch.arange(width, device=pictures.device) + shift[1]).clamp(0, width - 1)[:, None, :]
    worlds = torch.arange(nworld, device=pictures.device)[:, None, None]
    for picture in pictures:
        picture.copy_(picture[worlds, rows, columns])


class Encoder(nn.Module):
    """Convolutional layers that map pictures of a camera, (..., height, width, channels), to features, (..., size).

    The mean picture is subtracted first. With a static background, a change of a weight then changes the features of
    all pictures less, and an update of the same KL divergence can be larger.
    """

    size: int
    count: torch.Tensor
    mean: torch.Tensor

    def __init__(
        self, shape: Sequence[int], channels: Sequence[int], spatial_softmax: bool, generator: torch.Generator | None
    ) -> None:
        super().__init__()
        height, width, depth = shape
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(*shape))
        layers: list[nn.Module] = []
        for i, (before, after) in enumerate(itertools.pairwise((depth, *channels))):
            layers += [nn.Conv2d(before, after, 5 if i == 0 else 3, stride=2, padding=2 if i == 0 else 1), nn.ReLU()]
            nn.init.kaiming_uniform_(layers[-2].weight, nonlinearity="relu", generator=generator)  # type: ignore[arg-type]
            nn.init.zeros_(layers[-2].bias)  # type: ignore[arg-type]
            height, width = (height + 1) // 2, (width + 1) // 2
        self.layers = nn.Sequential(*layers)
        if spatial_softmax:
            self.size = 2 * channels[-1]
            x, y = torch.linspace(-4.0, 4.0, width), torch.linspace(-4.0, 4.0, height)
            self.register_buffer("places", torch.cartesian_prod(y, x), persistent=False)
            self.head: nn.Module = nn.Identity()
        else:
            self.size = _FEATURES
            linear = nn.Linear(channels[-1] * height * width, self.size)
            nn.init.xavier_uniform_(linear.weight, generator=generator)
            nn.init.zeros_(linear.bias)
            self.head = nn.Sequential(linear, nn.LayerNorm(self.size))
        self.spatial_softmax = spatial_softmax

    @torch.no_grad()
    def observe(self, picture: torch.Tensor, team: Team) -> None:
        """Update the mean picture; every call has the same weight."""
        self.count += 1.0
        self.mean += (team.sum(_scaled(picture).mean(0)) / team.size - self.mean) / self.count

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Compute the features."""
        x = (_scaled(picture) - self.mean).flatten(0, -4).permute(0, 3, 1, 2)
        x = x if x.is_cuda else x.contiguous()  # the memory format channels_last is slow on the CPU
        # the range of bfloat16 is that of float32, so that gradients cannot overflow
        half = MLP.in_half and x.is_cuda
        with torch.autocast(x.device.type, torch.bfloat16, enabled=half, cache_enabled=False):
            x = self.layers(x)
        x = x.float().flatten(2)
        features = x.softmax(-1) @ self.places if self.spatial_softmax else self.head(x.flatten(1))
        return features.reshape(*picture.shape[:-3], self.size)


def _scaled(picture: torch.Tensor) -> torch.Tensor:
    """Scale colours to the range from 0 to 4, and distances to closeness from 0 (nothing visible) to 4."""
    return picture.float() / 64.0 if picture.dtype == torch.uint8 else 4.0 * (picture > 0) / (1.0 + picture)


class Stack(nn.Module):
    """A memory of the last features: maps features and a state to the features with their changes, and the next state.

    The state holds earlier features, and for each of them whether it belongs to this episode.
    """

    def __init__(self, size: int, frames: int) -> None:
        super().__init__()
        self.size, self.past = size, frames - 1
        self.state_size = self.past * (size + 1)

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the output, (n, frames * size), and the next state."""
        earlier, mask = state.split([self.past * self.size, self.past], dim=-1)
        changes = (x.unsqueeze(-2) - earlier.unflatten(-1, (self.past, self.size))) * (_GAIN * mask.unsqueeze(-1))
        history = earlier[..., : (self.past - 1) * self.size], torch.ones_like(mask[..., :1]), mask[..., :-1]
        return torch.cat([x, changes.flatten(-2)], dim=-1), torch.cat([x, *history], dim=-1)


class PictureNetwork(nn.Module):
    """A network with memory that sees cameras: encoders, then a ``Stack`` or a ``GRU``, then another network."""

    def __init__(self, vector: int, encoders: Sequence[nn.Module], memory: nn.Module, network: nn.Module) -> None:
        super().__init__()
        self.vector, self.encoders = vector, nn.ModuleList(encoders)
        self.memory, self.network = memory, network
        self.size = next(network.parameters()).shape[1]  # of the memory's outputs
        self.state_size: int = memory.state_size  # type: ignore[assignment]
        self.burn_in: int = getattr(memory, "past", 0)
        """Steps of a sequence whose outputs depend on features in the state, which older encoders computed."""

    def observe(self, pictures: Sequence[torch.Tensor], team: Team) -> None:
        """Update the encoders' mean pictures with the pictures of all worlds."""
        for encoder, picture in zip(self.encoders, pictures, strict=True):
            encoder.observe(picture, team)  # type: ignore[operator]

    def encode(self, x: Parts) -> torch.Tensor:
        """Compute the vector and the features of all pictures, (..., size)."""
        pictures = x[1:] if self.vector else x
        features = [encoder(picture) for encoder, picture in zip(self.encoders, pictures, strict=True)]
        return torch.cat([*x[: len(x) - len(pictures)], *features], dim=-1)

    def forward(self, x: Parts, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the output and the next state."""
        output, state = self.memory(self.encode(x), state)
        return self.network(output), state

    def features(self, x: Parts, state: torch.Tensor, began: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the memory's outputs and states along sequences. All pictures are encoded in one batch."""
        return unrolled(self.memory, self.encode(x), state, began)

    def unrolled(self, x: Parts, state: torch.Tensor, began: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Run the network over sequences; see ``networks.unrolled``."""
        outputs, states = self.features(x, state, began)
        return self.network(outputs), states


def picture_network(
    nobs: int,
    nact: int,
    hidden: Sequence[int],
    *,
    pictures: Mapping[str, Sequence[int]],
    channels: Sequence[int],
    spatial_softmax: bool,
    frames: int,
    recurrent: int,
    activation: Activation,
    generator: torch.Generator | None,
) -> PictureNetwork:
    """Make the default network of a policy that sees cameras; for the arguments, see ``PictureConfig``."""
    encoders = [Encoder(shape, channels, spatial_softmax, generator) for shape in pictures.values()]
    size = nobs + sum(encoder.size for encoder in encoders)
    memory = GRU(size, recurrent, nn.Identity(), generator) if recurrent else Stack(size, frames)
    sizes = [recurrent or frames * size, *hidden, nact]
    network = mlp(sizes, activation=activation, last_scale=1e-2, generator=generator)
    return PictureNetwork(nobs, encoders, memory, network)
