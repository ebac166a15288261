"""Regression of a value function on returns."""

from typing import Any

import torch

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.timing import one_thread
from lyceum_warp.algos.value import BOUND, ValueFunction


class ValueFit:
    """Fits a value function by mini-batch Adam on its squared error, in random order.

    The mini-batches are the same for any number of processes: each process takes the samples of its own worlds, and
    the gradients are summed. On CUDA the step of a mini-batch is one graph, captured once and replayed, in place of
    some 40 launches.

    Args:
        value: The value function.
        samples: Samples of all processes.
        nworld: Worlds of this process.
        rate: Learning rate.
        epochs: Passes over the samples.
        batch: Samples in a mini-batch.
        team: The processes that fit together.
    """

    def __init__(
        self, value: ValueFunction, samples: int, nworld: int, *, rate: float, epochs: int, batch: int, team: Team
    ) -> None:
        self.value, self.samples, self.nworld, self.team = value, samples, nworld, team
        self.epochs, self.batch = epochs, batch
        self.parameters = list(value.parameters())
        self.cuda = self.parameters[0].is_cuda
        self.optimizer = torch.optim.Adam(self.parameters, lr=rate, fused=True, capturable=self.cuda)
        # the gradients are views of one tensor, which the processes sum in one call
        self.gradient = torch.zeros(sum(p.numel() for p in self.parameters), device=self.parameters[0].device)
        for parameter, part in zip(self.parameters, self._split(self.gradient), strict=True):
            parameter.grad = part.view_as(parameter)
        self.captured: CapturedStep | None = None
        self._good = torch.nn.utils.parameters_to_vector(self.parameters).detach()

    def _split(self, flat: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return flat.split([p.numel() for p in self.parameters])

    def __call__(
        self, obs: torch.Tensor, step: torch.Tensor, target: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """Fit to returns. If that leaves a parameter or a moment that is not finite, restore all from before.

        Args:
            obs: Observations of this process's worlds, (samples, nobs).
            step: Steps since the reset, (samples,).
            target: Returns, (samples,). One further than ``BOUND`` scales from the value's shift is set to that bound.
            generator: Draws the order of all processes' samples.

        Returns:
            Whether the fit is finite, as a tensor.
        """
        with torch.no_grad():
            features = self.value.features(obs, step)
            target = ((target - self.value.shift) / self.value.scale).clamp(-BOUND, BOUND)
            target = target.float().unsqueeze(-1)
        with one_thread():
            self._keep_if_finite()
            for _ in range(self.epochs):
                order = torch.randperm(self.samples, generator=generator, device=features.device)
                if self.cuda and self.team.captures:
                    self.captured = self.captured or CapturedStep(self, features, target)
                    self.captured(features, target, order)
                    continue
                for part in order.split(self.batch):
                    places, weight = self._own(part)
                    self.learn(features[places], target[places], weight)
            self.team.copy_leader(self.parameters)
            finite = self._keep_if_finite()
            self._restore()
        return finite

    def _numbers(self) -> list[torch.Tensor]:
        """Parameters and Adam's moments, which exist from the first step on."""
        moments = [moment for p in self.parameters for moment in self.optimizer.state.get(p, {}).values()]
        return [*self.parameters, *moments]

    @torch.no_grad()
    def _keep_if_finite(self) -> torch.Tensor:
        """Copy all numbers, unless one is not finite; nothing waits for the device."""
        present = torch.cat([numbers.reshape(-1) for numbers in self._numbers()])
        # the first moments are zeros
        good = torch.nn.functional.pad(self._good, (0, len(present) - len(self._good)))
        finite = self.team.sum((~present.isfinite()).any().float()) == 0
        self._good = torch.where(finite, present, good)
        return finite

    @torch.no_grad()
    def _restore(self) -> None:
        """Copy back the last numbers that were finite."""
        numbers = self._numbers()
        for tensor, part in zip(numbers, self._good.split([tensor.numel() for tensor in numbers]), strict=True):
            tensor.copy_(part.view_as(tensor))

    def _own(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | float]:
        """The process's samples of a mini-batch, and their weights in the mean over the whole mini-batch."""
        if self.team.size == 1:
            return index, 1.0 / len(index)
        places, own = self.team.locate(index, self.nworld)
        if self.cuda:  # counting the own samples would wait for the device, so the others get the weight 0
            return places, own.unsqueeze(-1) / len(index)
        return places[own], 1.0 / len(index)

    def learn(self, features: torch.Tensor, target: torch.Tensor, weight: torch.Tensor | float) -> None:
        """One step of Adam on a weighted sum of squared errors."""
        loss = ((self.value.network(features) - target).square() * weight).sum()
        gradients = torch.autograd.grad(loss, self.parameters)
        torch.cat([gradient.reshape(-1) for gradient in gradients], out=self.gradient)
        self.team.sum(self.gradient)
        self.optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with the moments of ``state_dict``, on this device."""
        self.optimizer.load_state_dict(state)
        for group in self.optimizer.param_groups:
            group["capturable"] = self.cuda
        self.captured = None  # its graph holds the addresses of the old moments


class CapturedStep:
    """The mini-batch step of a ``ValueFit`` as one CUDA graph. A counter on the device selects the mini-batch.

    Args:
        fit: The fit.
        features: The network's inputs, (samples, features); only their shape and device are used here.
        target: Scaled returns, (samples, 1); likewise.
    """

    def __init__(self, fit: ValueFit, features: torch.Tensor, target: torch.Tensor) -> None:
        self.fit = fit
        self.count = -(-fit.samples // fit.batch)
        device = features.device
        self.features, self.target = torch.empty_like(features), torch.empty_like(target)
        self.places = torch.zeros(self.count, fit.batch, dtype=torch.long, device=device)
        self.weight = torch.zeros(self.count, fit.batch, device=device)
        self.at = torch.zeros(1, dtype=torch.long, device=device)
        # the last mini-batch may be smaller: it is filled up with samples of weight 0
        place = torch.arange(self.count * fit.batch, device=device).view(self.count, fit.batch)
        self.inside = (place < fit.samples).float()
        self.inside /= self.inside.sum(1, keepdim=True)
        self.graph: Any = None

    def __call__(self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor) -> None:
        """Run an epoch.

        Args:
            features: The network's inputs, (samples, features).
            target: Scaled returns, (samples, 1).
            order: A permutation of all processes' samples.
        """
        self.load(features, target, order)
        done = 0
        if self.graph is None:
            done = min(3, self.count)
            with torch.cuda.device(features.device):
                self._capture(done)
        for _ in range(done, self.count):
            self.graph.replay()

    def load(self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor) -> None:
        """Begin an epoch: copy the samples, and the places and weights of its mini-batches."""
        self.features.copy_(features)
        self.target.copy_(target)
        filled = torch.nn.functional.pad(order, (0, self.places.numel() - len(order))).view_as(self.places)
        places, own = self.fit.team.locate(filled, self.fit.nworld)
        self.places.copy_(places)
        torch.mul(self.inside, own, out=self.weight)
        self.at.zero_()

    def _capture(self, times: int) -> None:
        """Run some steps directly, on another stream than the default one, then capture the graph.

        The direct steps allocate lasting memory, such as Adam's moments.
        """
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(times):
                self.learn()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # other threads, such as NCCL's, call CUDA during the capture
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self.learn()
        self.fit.team.keep(graph)
        self.graph = graph

    def learn(self) -> None:
        """Learn from the next mini-batch."""
        places = self.places.index_select(0, self.at)[0]
        weight = self.weight.index_select(0, self.at)[0]
        features, target = self.features.index_select(0, places), self.target.index_select(0, places)
        self.fit.learn(features, target, weight.unsqueeze(-1))
        self.at += 1
