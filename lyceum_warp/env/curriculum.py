"""Save how far an environment's curricula have come, and start episodes there."""

import dataclasses
from collections.abc import Mapping

import torch

from lyceum_warp.env.env import Env

_WORLDS = 256
"""Largest number of worlds whose lasting memory is saved."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curriculum:
    """How far curricula have come: the memory that all worlds share, and the lasting memory of some worlds.

    Lasting memory that only the task's ``startup`` writes is not part of a curriculum.

    Raises:
        ValueError: A value is not a tensor of finite floats of the given shape.
    """

    shared: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    """Shared memory by name, each (size,)."""
    lasting: Mapping[str, torch.Tensor] = dataclasses.field(default_factory=dict)
    """Lasting memory by name, each (worlds, size). Every name has the same number of worlds."""

    def __post_init__(self) -> None:
        for memory, ndim in ((self.shared, 1), (self.lasting, 2)):
            for name, rows in memory.items():
                if not (
                    isinstance(rows, torch.Tensor) and rows.ndim == ndim and rows.numel() and rows.isfinite().all()
                ):
                    raise ValueError(f"the memory {name!r} of a curriculum must be {ndim}D and finite, not {rows!r}")
        if len({len(rows) for rows in self.lasting.values()}) > 1:
            raise ValueError(f"lasting memory of a curriculum must have equal numbers of worlds: {self.lasting!r}")

    @classmethod
    def of(cls, env: Env) -> "Curriculum":
        """Copy the memory of an environment to the CPU; lasting memory of at most 256 worlds."""
        count = min(env.nworld, _WORLDS)
        worlds = torch.arange(count) * env.nworld // count
        return cls(
            shared={name: memory.cpu().clone() for name, memory in env.shared.items()},
            lasting={name: env.lasting[name].cpu()[worlds] for name in env.task.curriculum},
        )

    @property
    def text(self) -> str:
        """List the names and the values, such as "level 4.2 (0 to 9)": the mean, the minimum and the maximum."""
        parts = []
        for name, rows in {**self.shared, **self.lasting}.items():
            low, high = (f"{limit.item():.4g}" for limit in rows.aminmax())
            parts.append(f"{name} {low}" if low == high else f"{name} {rows.mean().item():.4g} ({low} to {high})")
        return ", ".join(parts)

    def check(self, env: Env) -> None:
        """Check that the task has this memory.

        Raises:
            ValueError: The task has no memory of this name and size.
        """
        for target, memory in ((env.shared, self.shared), (env.lasting, self.lasting)):
            for name, rows in memory.items():
                if name not in target or rows.shape[-1] != target[name].shape[-1]:
                    parts = ", ".join(f"{part} ({x.shape[-1]})" for part, x in target.items()) or "none"
                    raise ValueError(
                        f"the task {env.task.name!r} has no memory {name!r} of size {rows.shape[-1]}; it has: {parts}"
                    )


def start_episodes(
    env: Env, seed: int | None, curriculum: Curriculum | None = None, *, first: int = 0, total: int | None = None
) -> None:
    """Start a random episode in every world, at a curriculum.

    Args:
        env: The environment.
        seed: Seed of the initial states. It clears lasting memory. Without a seed, the worlds continue their streams.
        curriculum: Memory that replaces the environment's; other memory keeps its values.
        first: Index of the first world among ``total`` worlds, over which the rows of ``curriculum.lasting`` are
            spread.
        total: By default the environment's number of worlds.

    Raises:
        ValueError: The task has no memory of this name and size.
    """
    curriculum = curriculum or Curriculum()
    curriculum.check(env)
    for name, memory in curriculum.shared.items():
        env.shared[name].copy_(memory)
    if seed is not None:
        env.rand_reset(seed, first_world=env.first_world + first)
    for name, rows in curriculum.lasting.items():
        total = total or env.nworld
        middles = (2 * (first + torch.arange(env.nworld)) + 1) * len(rows) // (2 * total)
        env.lasting[name].copy_(rows[middles])
    if seed is None or curriculum.lasting:
        env.rand_reset()
