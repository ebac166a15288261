"""Value functions: what a state is worth, fitted by regression on returns."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.policy import Normalizer, mlp
from lyceum_warp.algos.timing import one_thread
from lyceum_warp.validate import layer_sizes


class ValueFunction(nn.Module):
    """A network that predicts discounted returns.

    Args:
        nobs: Numbers in an observation.
        hidden: Widths of the hidden layers.
        scale: What the network's output is multiplied by, so that it stays of order one; 1 / (1 - gamma) for
            rewards of order one.
        time_orders: Highest power of the time feature; 0 for none. A time limit that the observation does not
            show makes the return depend on the step, which the features t, t^2, ... with t = step / 1000 do
            show (mjrl).
        normalize: Whether to normalise observations by their running mean and variance.
        discount: The discount of the returns that it was fitted to, where that is known.
        generator: Draws the initial weights.
    """

    discount: float | None
    """The discount of the returns that it was fitted to, where that is known."""
    orders: torch.Tensor

    def __init__(
        self,
        nobs: int,
        hidden: Sequence[int] = (128, 128),
        *,
        scale: float = 200.0,
        time_orders: int = 0,
        normalize: bool = False,
        discount: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.scale, self.discount = scale, discount
        self._shape = {
            "nobs": nobs, "hidden": layer_sizes(hidden), "scale": scale, "time_orders": time_orders,
            "normalize": normalize,
        }  # fmt: skip
        self.normalizer: nn.Module = Normalizer(nobs) if normalize else nn.Identity()
        self.register_buffer("orders", torch.arange(1.0, time_orders + 1), persistent=False)
        self.network = mlp([nobs + time_orders, *hidden, 1], generator=generator)

    @property
    def shape(self) -> dict[str, Any]:
        """The arguments that make another one for the same weights."""
        return self._shape | {"discount": self.discount}

    def features(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The network's input, (..., nobs + time_orders), for observations made ``step`` steps after a reset."""
        obs = self.normalizer(obs)
        if not len(self.orders):
            return obs
        time = (step.unsqueeze(-1) * 1e-3) ** self.orders
        return torch.cat([obs, time], dim=-1)

    def forward(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Predicted returns, (...,)."""
        return self.network(self.features(obs, step)).squeeze(-1) * self.scale


class ValueFit:
    """Fits a value function by mini-batch Adam on its squared error, in random order.

    The mini-batches are the same for any number of processes: each takes the samples of its own worlds, and the
    gradients are summed. On CUDA a mini-batch is one graph that is recorded once, not some 40 launches.

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
        # one array of all gradients: the processes sum it in one go
        self.gradient = torch.zeros(sum(p.numel() for p in self.parameters), device=self.parameters[0].device)
        for parameter, part in zip(self.parameters, self._split(self.gradient), strict=True):
            parameter.grad = part.view_as(parameter)
        self._step: _CapturedStep | None = None

    def _split(self, flat: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return flat.split([p.numel() for p in self.parameters])

    def __call__(self, obs: torch.Tensor, step: torch.Tensor, target: torch.Tensor, generator: torch.Generator) -> None:
        """Fit to returns.

        Args:
            obs: Observations of this process's worlds, (samples, nobs).
            step: Steps since the reset, (samples,).
            target: Returns, (samples,).
            generator: Draws the order of all processes' samples.
        """
        with torch.no_grad():
            features = self.value.features(obs, step)
            target = (target / self.value.scale).unsqueeze(-1)
        with one_thread():
            for _ in range(self.epochs):
                order = torch.randperm(self.samples, generator=generator, device=features.device)
                if self.cuda and self.team.records:
                    self._step = self._step or _CapturedStep(self, features, target)
                    self._step(features, target, order)
                    continue
                for part in order.split(self.batch):
                    rows, weight = self._own(part)
                    self.learn(features[rows], target[rows], weight)
        self.team.follow(self.parameters)

    def _own(self, index: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | float]:
        """A process's own rows of a mini-batch, and their weights in the mean over all of it."""
        if self.team.size == 1:
            return index, 1.0 / len(index)
        rows, own = self.team.rows(index, self.nworld)
        if self.cuda:  # the host would have to wait to know how many there are: let the others weigh nothing
            return rows, own.unsqueeze(-1) / len(index)
        return rows[own], 1.0 / len(index)

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
        """Go on with the moments of ``state_dict``, on this device."""
        self.optimizer.load_state_dict(state)
        for group in self.optimizer.param_groups:
            group["capturable"] = self.cuda
        self._step = None  # its graph holds the addresses of the old ones


class _CapturedStep:
    """A mini-batch of ``ValueFit`` as one CUDA graph, replayed for each: which one it is, the device counts itself."""

    def __init__(self, fit: ValueFit, features: torch.Tensor, target: torch.Tensor) -> None:
        self.fit = fit
        self.count = -(-fit.samples // fit.batch)
        device = features.device
        self.features, self.target = torch.empty_like(features), torch.empty_like(target)
        self.rows = torch.zeros(self.count, fit.batch, dtype=torch.long, device=device)
        self.weight = torch.zeros(self.count, fit.batch, device=device)
        self.at = torch.zeros(1, dtype=torch.long, device=device)
        # the last mini-batch may be smaller: it is filled up with samples that weigh nothing
        place = torch.arange(self.count * fit.batch, device=device).view(self.count, fit.batch)
        self.inside = (place < fit.samples).float()
        self.inside /= self.inside.sum(1, keepdim=True)
        self.graph: Any = None

    def __call__(self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor) -> None:
        """An epoch."""
        self.load(features, target, order)
        done = 0
        if self.graph is None:
            done = min(3, self.count)
            with torch.cuda.device(features.device):
                self._record(done)
        for _ in range(done, self.count):
            self.graph.replay()

    def load(self, features: torch.Tensor, target: torch.Tensor, order: torch.Tensor) -> None:
        """Begin an epoch: copy the samples, and the rows and weights of its mini-batches."""
        self.features.copy_(features)
        self.target.copy_(target)
        filled = torch.nn.functional.pad(order, (0, self.rows.numel() - len(order))).view_as(self.rows)
        rows, own = self.fit.team.rows(filled, self.fit.nworld)
        self.rows.copy_(rows)
        torch.mul(self.inside, own, out=self.weight)
        self.at.zero_()

    def _record(self, times: int) -> None:
        """Make the graph, after some real steps on another stream than the default one: they make what is made once."""
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(times):
                self.learn()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        # other threads, such as NCCL's, go on calling CUDA meanwhile
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            self.learn()
        self.fit.team.hold(graph)
        self.graph = graph

    def learn(self) -> None:
        """The next mini-batch."""
        rows = self.rows.index_select(0, self.at)[0]
        weight = self.weight.index_select(0, self.at)[0]
        features, target = self.features.index_select(0, rows), self.target.index_select(0, rows)
        self.fit.learn(features, target, weight.unsqueeze(-1))
        self.at += 1
