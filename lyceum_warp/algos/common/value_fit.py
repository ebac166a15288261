"""Fit a value function to returns by regression."""

import math
from collections.abc import Callable
from typing import Any

import torch

from lyceum_warp.algos.common.adam import BETAS, EPS, GradientStep
from lyceum_warp.algos.common.dense import DensePasses
from lyceum_warp.algos.common.distributed import Captured, Team, flatten, unflatten
from lyceum_warp.algos.common.timing import one_thread
from lyceum_warp.algos.common.value import BOUND, ValueFunction


class ValueFit:
    """Fits a value function with Adam on squared errors in random mini-batches.

    The mini-batches do not depend on the number of processes. Each process uses the samples of its own worlds, and
    gradients are summed over the processes. On a GPU, a mini-batch step is one CUDA graph instead of about 40 launches.
    On the CPU, a network made by ``mlp`` is fitted without autograd.
    """

    def __init__(
        self, value: ValueFunction, samples: int, nworld: int, *, rate: float, epochs: int, batch: int, team: Team
    ) -> None:
        self.value, self.team = value, team
        self.samples, self.nworld = samples, nworld
        self.epochs, self.batch = epochs, batch
        self.parameters = list(value.parameters())
        self.cuda = self.parameters[0].is_cuda
        self.step = GradientStep(self.parameters, rate, team)
        self.optimizer = self.step.optimizer
        self.captured: CapturedStep | None = None
        self._good = flatten(self._numbers()).detach()

    def __call__(
        self, obs: torch.Tensor, step: torch.Tensor, target: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """Fit the value function to returns.

        If the result is not finite, restore the value function and return False. Targets are clipped to the range from
        ``shift - BOUND * scale`` to ``shift + BOUND * scale``. The generator must have the same state in every process.
        """
        with torch.no_grad():
            features = self.value.features(obs, step)
            target = ((target - self.value.shift) / self.value.scale).clamp(-BOUND, BOUND)
            target = target.float().unsqueeze(-1)
        with one_thread():
            self._keep_if_finite()
            passes = DensePasses.of(self.value.network)
            steps = None if passes is None else DenseSteps(self, passes)
            learn = self.learn if steps is None else steps.learn
            for _ in range(self.epochs):
                order = torch.randperm(self.samples, generator=generator, device=features.device)
                if self.cuda and self.team.captures:
                    self.captured = self.captured or CapturedStep(self, features, target)
                    self.captured(features, target, order)
                else:
                    self._run_epoch(features, target, order, learn)
            if steps is not None:
                steps.store()
            self.team.copy_leader(self.parameters)
            finite = self._keep_if_finite()
            self._restore()
        return finite

    def _numbers(self) -> list[torch.Tensor]:
        return [*self.parameters, self.optimizer.first, self.optimizer.second]

    @torch.no_grad()
    def _keep_if_finite(self) -> torch.Tensor:
        """Back up the parameters and moments if all are finite, without waiting for the device."""
        present = flatten(self._numbers())
        finite = self.team.sum((~present.isfinite()).any().float()) == 0
        self._good = torch.where(finite, present, self._good)
        return finite

    @torch.no_grad()
    def _restore(self) -> None:
        numbers = self._numbers()
        for tensor, part in zip(numbers, unflatten(self._good, numbers), strict=True):
            tensor.copy_(part)

    def _run_epoch(
        self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor, learn: Callable[..., None]
    ) -> None:
        """Learn from this process's samples in each mini-batch of a permutation of all processes' samples."""
        places, local = self.team.locate(order, self.nworld)
        sizes = [len(part) for part in order.split(self.batch)]
        counts = [int(part.sum()) for part in local.split(self.batch)]
        features, target = features[places[local]], target[places[local]]
        for x, y, size in zip(features.split(counts), target.split(counts), sizes, strict=True):
            learn(x, y, 1.0 / size)

    def learn(self, features: torch.Tensor, target: torch.Tensor, weight: torch.Tensor | float) -> None:
        """Make one step of Adam on a weighted sum of squared errors."""
        self.step(((self.value.network(features) - target).square() * weight).sum())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the optimizer's state on this device."""
        self.optimizer.load_state_dict(state)
        self.captured = None  # the graph contains the learning rate


class DenseSteps:
    """Makes the mini-batch steps of a ``ValueFit`` on the CPU, without autograd or torch's kernel for Adam.

    The steps change the optimizer's moments and a flat copy of the parameters. ``store`` writes the parameters back.
    """

    def __init__(self, fit: ValueFit, passes: DensePasses) -> None:
        self.fit, self.team = fit, fit.team
        self.count = int(fit.optimizer.count)
        self.parameters = flatten(passes.parameters)
        self.first, self.second = fit.optimizer.first, fit.optimizer.second
        self.gradient, self.root = torch.empty_like(self.parameters), torch.empty_like(self.parameters)
        self.passes = DensePasses(self._shaped(self.parameters), passes.activation)
        self.gradients = self._shaped(self.gradient)

    def _shaped(self, vector: torch.Tensor) -> list[torch.Tensor]:
        return unflatten(vector, self.fit.parameters)

    def learn(self, features: torch.Tensor, target: torch.Tensor, weight: float) -> None:
        """Make one step of Adam on a weighted sum of squared errors."""
        error = self.passes(features).sub_(target)
        self.passes.pull(error.mul_(2.0 * weight), self.gradients)
        self.team.sum(self.gradient)
        decay, slow = BETAS
        self.count += 1
        self.first.lerp_(self.gradient, 1.0 - decay)
        self.second.mul_(slow).addcmul_(self.gradient, self.gradient, value=1.0 - slow)
        # include the bias corrections of both moments in the step's factor
        unbias = math.sqrt(1.0 - slow**self.count)
        torch.sqrt(self.second, out=self.root).add_(EPS * unbias)
        factor = float(self.fit.optimizer.rate) * unbias / (1.0 - decay**self.count)
        self.parameters.addcdiv_(self.first, self.root, value=-factor)

    @torch.no_grad()
    def store(self) -> None:
        """Write the parameters and the number of steps back."""
        for parameter, part in zip(self.fit.parameters, self._shaped(self.parameters), strict=True):
            parameter.copy_(part)
        self.fit.optimizer.count.fill_(self.count)


class CapturedStep:
    """Makes the mini-batch steps of a ``ValueFit`` as a CUDA graph."""

    def __init__(self, fit: ValueFit, features: torch.Tensor, target: torch.Tensor) -> None:
        self.fit = fit
        self.count = -(-fit.samples // fit.batch)
        device = features.device
        self.features, self.target = torch.empty_like(features), torch.empty_like(target)
        self.places = torch.zeros(self.count, fit.batch, dtype=torch.long, device=device)
        self.weight = torch.zeros(self.count, fit.batch, device=device)
        self.at = torch.zeros(1, dtype=torch.long, device=device)
        # pad a smaller last mini-batch with samples of weight 0
        place = torch.arange(self.count * fit.batch, device=device).view(self.count, fit.batch)
        self.inside = (place < fit.samples).float()
        self.inside /= self.inside.sum(1, keepdim=True)
        self.step = Captured(self.learn, fit.team, device)

    def __call__(self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor) -> None:
        """Run an epoch with a permutation of all processes' samples."""
        self.features.copy_(features)
        self.target.copy_(target)
        padded = torch.nn.functional.pad(order, (0, self.places.numel() - len(order))).view_as(self.places)
        places, local = self.fit.team.locate(padded, self.fit.nworld)
        self.places.copy_(places)
        torch.mul(self.inside, local, out=self.weight)
        self.at.zero_()
        for _ in range(self.count):
            self.step()

    def learn(self) -> None:
        """Learn from the next mini-batch."""
        places = self.places.index_select(0, self.at)[0]
        weight = self.weight.index_select(0, self.at)[0]
        features, target = self.features.index_select(0, places), self.target.index_select(0, places)
        self.fit.learn(features, target, weight.unsqueeze(-1))
        self.at += 1
