"""Random numbers of an algorithm's own, for code that draws from torch's default generators."""

from collections.abc import Mapping

import torch


class OwnRandomNumbers:
    """A block in which torch's default generators continue a stream of their own, because rsl_rl draws from them.

    Args:
        device: The device whose generator is used beside the CPU's.
        seed: Where the stream begins.
    """

    def __init__(self, device: torch.device, seed: int) -> None:
        self._generators = [torch.default_generator]
        if device.type == "cuda":
            torch.cuda.init()
            self._generators.append(torch.cuda.default_generators[device.index or 0])
        self._others: list[torch.Tensor] = []
        self._own = [torch.Generator(generator.device).manual_seed(seed).get_state() for generator in self._generators]

    def __enter__(self) -> None:
        self._others = self._exchanged(self._own)

    def __exit__(self, *exception: object) -> None:
        self._own = self._exchanged(self._others)

    def _exchanged(self, states: list[torch.Tensor]) -> list[torch.Tensor]:
        """Set the generators' states; returns those before."""
        before = [generator.get_state() for generator in self._generators]
        for generator, state in zip(self._generators, states, strict=True):
            generator.set_state(state)
        return before

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The state of each generator, by the type of its device."""
        return {generator.device.type: state for generator, state in zip(self._generators, self._own, strict=True)}

    def load_state_dict(self, states: Mapping[str, torch.Tensor]) -> None:
        """Continue where ``state_dict`` was taken."""
        self._own = [states[generator.device.type].cpu() for generator in self._generators]
