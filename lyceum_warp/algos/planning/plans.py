"""Store the plans of all plants: shift them in time, add noise to draw samples, and interpolate actions from knots."""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.planning.config import MPPIConfig
from lyceum_warp.core.spaces import Space
from lyceum_warp.kernels import knots, planning, rollouts
from lyceum_warp.support.arrays import torch_view


class Plans:
    """The plans of all plants, the plans around which their samples are drawn, and the samples.

    All buffers have an axis for plants, or for the samples of all plants. The rows of ``plan``, ``nominal``,
    ``samples`` and deviations are knots. Without knots, they are steps, and ``plan`` is the same array as ``actions``.

    Args:
        config: The complete settings.
        space: The action space.
        plants: Number of plants.
        world_actions: The actions of the planner's worlds, (horizon, nworld, nact), which ``perturb`` writes.
        adapts_noise: Whether the plan update adapts the noise.
    """

    def __init__(
        self, config: MPPIConfig, space: Space, plants: int, world_actions: wp.array, *, adapts_noise: bool
    ) -> None:
        factor = config.noise_factor(space.size)
        self._config = config
        self._world_actions = world_actions
        self._diagonal = not np.tril(factor, -1).any()
        with wp.ScopedDevice(world_actions.device):
            self._low: wp.array = wp.array(space.low, dtype=float)
            self._high: wp.array = wp.array(space.high, dtype=float)
            self._fill: wp.array = wp.array(config.fill_action(space), dtype=float)
            # adapted deviations multiply standard normal noise
            self._scale: wp.array = wp.array(np.eye(space.size) if adapts_noise else factor, dtype=float)
            self._first_deviation: wp.array = wp.array(np.diag(factor), dtype=float)
            self.seed = wp.zeros(plants, dtype=int)
            self.count = wp.zeros(plants, dtype=int)
            self.shift = wp.zeros(plants, dtype=int)
            self._phase = wp.zeros(plants, dtype=int)
            self.actions = wp.zeros((config.horizon, plants, space.size), dtype=float)
            self.nominal_actions = wp.zeros_like(self.actions)
            if config.knots:
                self._spline = config.knots, knots.ORDERS[config.spline]
                self._passed = wp.zeros(plants, dtype=int)
                count = knots.knot_count(config.horizon, config.knots, config.spline)
                self.plan: wp.array = wp.zeros((count, plants, space.size), dtype=float)
                self.nominal: wp.array = wp.zeros_like(self.plan)
            else:
                self._spline = config.horizon, 0
                self._passed = self.shift
                self.plan, self.nominal = self.actions, self.nominal_actions
            shape = self.plan.shape[0], plants * config.samples, space.size
            self.noise = wp.zeros(shape, dtype=float)
            separate = config.knots or config.models > 1
            self.samples: wp.array = wp.zeros(shape, dtype=float) if separate else world_actions
            self.deviation: wp.array | None = wp.zeros_like(self.plan) if adapts_noise else None
            self.nominal_deviation: wp.array | None = wp.zeros_like(self.plan) if adapts_noise else None

    def perturb(self, keys: wp.array, *, first: bool) -> None:
        """Draw samples around the plans, and the keys of the worlds' random streams, by Warp launches only.

        If ``first`` is set, the plans are shifted in time before.
        """
        config, device = self._config, self.plan.device
        plants, dim = len(self.count), (self.samples.shape[1], self.samples.shape[2])
        if first and self._passed is not self.shift:
            steps = [self.shift, config.horizon, self._spline[0], self._phase, self._passed]
            wp.launch(knots.pass_knots, plants, steps, device=device)
        self._shift_rows(first, self.plan, self._fill, config.fill == "repeat", self.nominal)
        self._interpolate(self.nominal, self.nominal_actions)
        wp.launch(planning.draw_noise, dim, [self.seed, self.count, self.noise], device=device)
        wp.launch(planning.draw_keys, len(keys), [self.seed, self.count, keys], device=device)
        wp.launch(rollouts.add_to, plants, [1, self.count], device=device)
        if self.deviation is not None and self.nominal_deviation is not None:
            self._shift_rows(first, self.deviation, self._first_deviation, False, self.nominal_deviation)
        noise = [self.nominal, self.noise, self._scale, self._diagonal, self.nominal_deviation]
        options = [wp.vec3(*config.noise_smoothing), bool(config.include_plan), self._low, self._high, self.samples]
        wp.launch(planning.perturb, dim, [*noise, *options], device=device)
        self._interpolate(self.samples, self._world_actions)

    def interpolate(self) -> None:
        """Compute the actions of the plans from their knots, by Warp launches only."""
        self._interpolate(self.plan, self.actions)

    def _shift_rows(self, first: bool, rows: wp.array, fill: wp.array, repeat: bool, target: wp.array) -> None:
        if first:
            wp.launch(planning.shift_plan, rows.shape, [rows, self._passed, fill, repeat, target], device=rows.device)
        else:
            wp.copy(target, rows)

    def _interpolate(self, rows: wp.array, actions: wp.array) -> None:
        if rows is not actions:
            args = [rows, self._phase, *self._spline, self._low, self._high, actions]
            wp.launch(knots.interpolate, actions.shape, args, device=rows.device)

    def reset(self, seeds: Sequence[int] | None, where: torch.Tensor | None) -> None:
        """Reset the plans and the adapted noise, and restart the noise streams; see ``Planner.reset``."""
        rows = None if where is None else where[:, None]
        if seeds is not None:
            _put(self.seed, torch.tensor(seeds, dtype=torch.int32, device=torch_view(self.seed).device), where)
        for counter in (self.count, self._phase):
            _put(counter, torch.zeros_like(torch_view(counter)), where)
        for plan in (self.plan, self.actions):
            _put(plan, torch_view(self._fill), rows)
        if self.deviation is not None:
            _put(self.deviation, torch_view(self._first_deviation), rows)


def _put(target: wp.array, values: torch.Tensor, where: torch.Tensor | None) -> None:
    view = torch_view(target)
    view.copy_(values.expand_as(view) if where is None else torch.where(where, values, view))
