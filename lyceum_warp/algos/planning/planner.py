"""Plan by sampling rollouts: MPPI, CEM and predictive sampling.

Each call improves a plan, a sequence of actions u_t, from a given state:

1. shift: move the last call's plan forward in time, and fill the end of the plan;
2. perturb: sample k is the plan plus smoothed noise e_t^k, clipped to the actions' bounds. Each sample has its own
   random stream for the task's functions;
3. roll out: the return R_k of sample k is the sum of its discounted rewards plus the value of its final state. With
   several models, R_k is the mean or the smallest of the returns in all models;
4. weight: w_k = exp((R_k - max R) / temperature), normalised to sum to 1;
5. average: the new plan is u_t = sum_k w_k u_t^k.

The formulation follows Williams et al., 2017 ("Information theoretic MPC for model-based reinforcement learning"),
without a cost on the controls, as in Lyceum (Summers et al. 2020) and in trajopt. The smoothing comes from trajopt.
Returns are divided by the temperature. Summers et al. give inverse temperatures, such as 5 for a temperature of 0.2.

With several plants, each plant has its own plan, and the planner rolls out the samples of all plans together. The
samples of a single plan may leave most of a GPU, or most threads, idle.

``update`` selects how samples are weighted (``updates.py``); the formula of step 4 is MPPI's. CEM weights the best
samples equally and then fits the noise to them. Predictive sampling takes the best sample. A custom update weights the
samples, and may also fit parameters. With knots, the planner shifts, perturbs and
averages the knots of a spline, and interpolates actions from them (``kernels/knots.py``).
"""

import copy
import itertools
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.common.policy_check import check_value
from lyceum_warp.algos.common.value import ValueFunction
from lyceum_warp.algos.planning.arguments import plain, planner_arguments, plant_seeds
from lyceum_warp.algos.planning.config import MPPIConfig
from lyceum_warp.algos.planning.plans import Plans
from lyceum_warp.algos.planning.updates import CrossEntropy, PlanSamples, PlanUpdate, SampleWeights, launch_blocks
from lyceum_warp.binding.registry import find_task
from lyceum_warp.core import Done, EnvOptions, Task
from lyceum_warp.engines.memory import NotEnoughMemoryError
from lyceum_warp.env import Env, OpenLoop, memory_columns, moved
from lyceum_warp.graphs.capture import Calls, Phase
from lyceum_warp.kernels import planning
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.validate import described, whole_number

log = logging.getLogger(__name__)

_MODELS = 0x6D6F64656C73  # seed for drawing models, in addition to the planner's seed ("models" in ASCII)
_DRAWING = ("startup", "initialize", "randomize")
"""Task functions that can randomize a planner's model fields."""

Value: TypeAlias = ValueFunction | wp.Function | Callable[[torch.Tensor], torch.Tensor]


@document_attributes
class Planner:
    """A controller that replans at every step: ``action = plan(state)``.

    The planner simulates in its own worlds, one per sample. The controlled world is called the plant. The plant may be
    an environment: ``plan(env.get_state()[0])``. The plant may also be a robot: ``plan(plan.state_of(qpos=...,
    qvel=..., time=...))``. The plant's model, physics, time step and parameters may differ from the planner's. If the
    planner's time step is a multiple of the plant's, ``lw.control`` and ``lw.control_async`` apply the plan according
    to the setting ``between``. Random streams are counter-based: a plan depends on the seed, on the number of earlier
    plans, and on the plan from which it starts. In each sample, the task's functions draw from a separate stream seeded
    by the planner, so a plan cannot anticipate the plant's random numbers.

    With ``plants=n``, the planner plans for n plants at a time, as in ``env.step(plan(env.get_state()))`` with n
    worlds. Plant i uses the seed ``seed + i`` for its noise. On the same engine, the plan of plant i equals the plan of
    a single-plant planner with this seed. With ``models``, all plants share the same models. The first plant's seed
    determines the random fields of these models. With several plants, all buffers except ``model_fields`` have an axis
    for the plants. This axis follows the axis for steps or knots, if there is one.

    A task's ``planning`` (see ``lw.Planning``) provides default settings of the planner, and options and parameters of
    its worlds. Arguments override them.

    Args:
        task: Name of a task, path of a task file, or a task class.
        config: Settings that replace the task's settings.
        value: Terminal value that is added to each sample's return: a ``ValueFunction``; a function from (nworld, nobs)
            observations to (nworld,) values; or a Warp function of one observation, ``value(obs: Row[float]) ->
            float``. On the Warp engine, a Warp function becomes part of the graph. If a value is given, the parameters
            in ``planning`` do not apply, because the value function was fitted to the task's own rewards.
        seed: Seed of the noise. With several plants, ``seed`` is the seed of the first plant, or a list with one seed
            per plant.
        plants: Number of plants to plan for.
        params: Parameters of the task. A parameter that has the same name as a setting must be given here.
        kwargs: Settings, options of the planner's worlds, and parameters of the task, by name. Settings are the fields
            of ``lw.MPPIConfig``; None keeps the default. The setting ``update`` may be a custom ``lw.PlanUpdate``.
            Options are those of ``lw.make``. Parameters with one value per world are ordered by plant, then by sample,
            then by model. With few samples, engine="auto" selects the C engine even if there is a CUDA device, because
            the C engine is then faster. It keeps the plan in CPU memory.

    Raises:
        ValueError: An argument is unknown, ambiguous or invalid, or the samples do not fit into memory.
        FileNotFoundError: A model or task file is missing.
    """

    config: MPPIConfig
    """The complete settings."""
    plants: int
    """Number of plants."""
    settings: dict[str, Any]
    """The settings, and the options and parameters of the planner's worlds, as JSON values."""
    actions: torch.Tensor
    """The plan, (horizon, nact); the first row is the action returned by the last call. To start from a different plan,
    write into ``actions`` or, with knots, into ``knot_actions``."""
    nominal: torch.Tensor
    """The plan from which the last improvement started, (horizon, nact)."""
    knot_actions: torch.Tensor
    """The plan's knots, (nknot, nact). The last knot may lie beyond the horizon. Without knots, this is ``actions``."""
    standard_noise: torch.Tensor
    """Standard normal numbers from which the last improvement computed its noise. The shape is (horizon, samples,
    nact), or (nknot, samples, nact) with knots."""
    adapted_noise: torch.Tensor | None
    """The adapted standard deviations for the next improvement, before smoothing, (horizon, nact) or (nknot, nact).
    None for updates that do not adapt noise."""
    sampled: torch.Tensor
    """The last improvement's actions, (horizon, samples, nact)."""
    model_fields: dict[str, torch.Tensor]
    """The values of model fields in each model, (models, size) float64; empty with one model. The planner reads these
    values in each call."""
    model_returns: torch.Tensor
    """The samples' returns in each model, (samples, models); minus infinity for failed samples."""
    returns: torch.Tensor
    """The samples' returns, (samples,); minus infinity for failed samples."""
    weights: torch.Tensor
    """The samples' weights, (samples,)."""

    _only_update: str | None = None  # the only value of ``update`` that a subclass accepts

    def __init__(
        self,
        task: str | type[Task],
        config: MPPIConfig | None = None,
        *,
        value: Value | None = None,
        seed: int | Sequence[int] = 0,
        plants: int = 1,
        params: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if value is not None and not callable(value):
            raise ValueError(f"value must be a function of observations, or None, not {described(value)}")
        self.plants = whole_number("plants", plants, low=1)
        seeds = plant_seeds(seed, self.plants)
        task = find_task(task)
        if (only := self._only_update) is not None and kwargs.setdefault("update", only) != only:
            raise ValueError(
                f"update={kwargs['update']!r} is not the update {only!r} of this planner: use lw.MPPI for other updates"
            )
        self.config, options, parameters = planner_arguments(task, config, kwargs, params, value, self.plants)
        self.horizon, self.samples = self.config.horizon, self.config.samples
        settings = options.given() | parameters | vars(self.config)
        self.settings = json.loads(json.dumps(settings, default=plain))
        try:
            self._make_worlds(task, options, parameters)
        except NotEnoughMemoryError as error:
            product = f"{self.plants} * {self.samples} * {self.config.models}"
            raise NotEnoughMemoryError(f"{error}, where nworld is plants * samples * models, {product}") from error
        self._update = _update_of(self.config)
        actions: Any = wp.from_torch(self._loop.actions)
        self._plans = Plans(
            self.config, self.env.action_space, self.plants, actions, adapts_noise=self._update.adapts_noise
        )
        self._allocate()
        self._take_value(value)
        self._calls = self._program(first=True) + self._program(first=False) * (self.config.iterations - 1)
        self.reset(seeds)
        self._warned = False

    def _make_worlds(self, task: type[Task], options: EnvOptions, params: Mapping[str, Any]) -> None:
        nworld = self.plants * self.samples * self.config.models
        changes = {"nworld": nworld, "autoreset": False, "horizon": 0, "cameras": ()}
        self.env = Env(task, options.changed(changes), params)
        names, parts = self._random_fields(), self.env.state_space.parts
        self.env.reset()
        self.timestep, self.between = self.env.timestep, self.config.between
        self._initial = self.env.get_state()[0]
        # `state_of` must return nominal values, not the random values that `startup` wrote
        for name in self.env.engine.nominal:
            self._initial[parts[name]] = self.env.worlds.nominal_rows(name)[0].double()
        if "lasting_memory" in self.env.task.writes["startup"]:
            self._initial[memory_columns(self.env.task, self.env.state_space)["lasting_memory"]] = 0.0
        with wp.ScopedDevice(self.env.device):
            self._keys = wp.zeros(nworld, dtype=wp.uint32)
            sizes = {name: parts[name].stop - parts[name].start for name in names}
            fields = {name: wp.zeros((self.config.models, n), dtype=wp.float64) for name, n in sizes.items()}
        self.model_fields = {name: torch_view(rows) for name, rows in fields.items()}
        self._loop = OpenLoop(
            self.env, self.horizon, keys=self._keys, nominal_model=self.config.nominal_model, models=fields,
            states=self.plants,
        )  # fmt: skip

    def _random_fields(self) -> list[str]:
        """List the model fields that the task's functions randomize; with one model, list none."""
        task = self.env.task
        written = frozenset().union(*(task.writes[name] for name in _DRAWING))
        names = [field.name for field in task.dynamics if field.name in written] if self.config.models > 1 else []
        if self.config.models > 1 and not names:
            raise ValueError(
                f"models={self.config.models} needs a task that draws model fields, but {task.name!r} draws none: "
                "write model fields in its startup or randomize, as s.body_mass[1] = s.body_mass[1] * "
                "lw.uniform(rng, 0.8, 1.2)"
            )
        depends = [field.name for field in task.dynamics if field.name in names and field.rows is not None]
        if depends:
            raise ValueError(
                f"models={self.config.models} would give all plants the {depends[0]} of one object: plan with one "
                "model, or with one object"
            )
        return names

    def _take_value(self, value: Value | None) -> None:
        self.value, group = value, "policy"
        self._value_in_torch = value is not None and not isinstance(value, wp.Function)
        self._value_kernel = planning.value_kernel(value) if isinstance(value, wp.Function) else None
        if isinstance(value, ValueFunction):
            check_value(value, self.env)
            self.value, group = moved(value, self.env), value.group
        self._value_obs = self._loop.final_obs_groups[group]
        if self._value_in_torch:
            try:
                self._torch_values()
            # for example missing weights, another input size, or a critic that also takes actions
            except (RuntimeError, TypeError) as error:
                observations = described(self._value_obs)
                raise ValueError(f"value cannot take observations {observations}: {error}") from error

    def _allocate(self) -> None:
        config, loop, plans = self.config, self._loop, self._plans
        nsample, by_plant = self.plants * self.samples, (self.plants, self.samples)
        with wp.ScopedDevice(self.env.device):
            self._terminal = wp.zeros(self.env.nworld, dtype=float)
            self._world_return = wp.zeros(self.env.nworld, dtype=float)
            self._return: Any = self._world_return if config.models == 1 else wp.zeros(nsample, dtype=float)
            self._weight = wp.zeros(nsample, dtype=float)
            self._summary: Any = wp.zeros((self.plants, 4), dtype=float)
            self._valid = wp.zeros(self.plants, dtype=bool)
            self._problem = wp.zeros(self.plants, dtype=int)
        self._rewards = [wp.from_torch(rows) for rows in (loop.reward, loop.terminated, loop.fault)]
        self._arrays = PlanSamples(
            returns=torch_view(self._return).view(by_plant),
            weights=torch_view(self._weight).view(by_plant),
            actions=torch_view(plans.samples).unflatten(1, by_plant),
            nominal=torch_view(plans.nominal),
            plan=torch_view(plans.plan),
            nominal_deviation=None if plans.nominal_deviation is None else torch_view(plans.nominal_deviation),
            deviation=None if plans.deviation is None else torch_view(plans.deviation),
            summary=torch_view(self._summary),
        )
        self._update.prepare(self._arrays)
        # with one plant, the public buffers have no axis for plants
        self.actions = torch_view(plans.actions).squeeze(1)
        self.nominal = torch_view(plans.nominal_actions).squeeze(1)
        self.knot_actions = self._arrays.plan.squeeze(1)
        self.standard_noise = torch_view(plans.noise).unflatten(1, by_plant).squeeze(1)
        self.adapted_noise = None if plans.deviation is None else torch_view(plans.deviation).squeeze(1)
        self.sampled = loop.actions[:, :: config.models].unflatten(1, by_plant).squeeze(1)
        self.returns = self._arrays.returns.squeeze(0)
        self.weights = self._arrays.weights.squeeze(0)
        self.model_returns = torch_view(self._world_return).view(*by_plant, config.models).squeeze(0)
        self._action, self._shift = self.actions[0], torch_view(plans.shift)
        self._problems = torch_view(self._problem)
        if self._problems.is_cuda:
            self._copied_problems = torch.zeros(self.plants, dtype=torch.int32, pin_memory=True)
            self._copied = torch.cuda.Event()

    @torch.no_grad()
    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None, *, shift: int = 1) -> torch.Tensor:
        """Improve the plan from a state; with several plants, improve each plan from its own state.

        Args:
            state: A state from ``state_of`` or from ``get_state`` of an environment of the same task, on either engine:
                (state_space.size,) or (1, state_space.size) float64; with several plants (plants, state_space.size).
            obs: Not used; present because control loops call controllers with observations.
            shift: Number of the planner's steps since the last call. The last plan is shifted by this number of steps.

        Returns:
            The action to apply now, on the state's device: (nu,), or (plants, nu) with several plants.

        Raises:
            ValueError: The state has the wrong shape or type, or is not finite. Or a custom update wrote invalid
                weights or numbers that are not finite; the plan does not change then. With states on a GPU, a later
                call raises this error, because no call waits for the GPU.
        """
        self.env.check_process()
        self._loop.state.copy_(self._checked(state))
        self._shift.fill_(whole_number("shift", shift, low=0))
        for call in self._calls:
            call()
        action = self._action.to(state.device, copy=True)
        self._report_problems(waited=action.device.type == "cpu")
        return action

    def _checked(self, state: torch.Tensor) -> torch.Tensor:
        """Check the state of each plant; with one plant, return a state without the axis for plants."""
        like = self._loop.state
        if isinstance(state, torch.Tensor) and state.ndim == 2 and len(state) == self.plants == 1:
            state = state[0]
        if not isinstance(state, torch.Tensor) or state.shape != like.shape or state.dtype != like.dtype:
            raise ValueError(
                f"{'a state' if self.plants == 1 else 'the states'} to plan from must be {described(like)}, not "
                f"{described(state)}: call env.get_state() of the same task, or make the state of each plant from its "
                "parts with plan.state_of(qpos=..., qvel=...). (With fields=[...], an environment's states may be "
                "longer.)"
            )
        # a check on a GPU would wait for the device; without it, a non-finite state makes every sample fail
        if state.device.type != "cpu":
            return state
        values = state.numpy().ravel()
        # a plan may take only a millisecond, so check with a fast dot product first
        if not np.isfinite(values.dot(values)) and not (finite := np.isfinite(values)).all():
            index = int(np.flatnonzero(~finite)[0])
            plant, column = divmod(index, self.env.state_space.size)
            raise ValueError(
                f"the state{self._of(plant)} has {values[index]} in its {self.env.state_space.part_at(column)!r}: pass "
                "finite states to the planner"
            )
        return state

    def _of(self, plant: int) -> str:
        return "" if self.plants == 1 else f" of plant {plant}"

    def _report_problems(self, *, waited: bool) -> None:
        """Report the problems of plans; without waiting for a GPU, those of earlier calls."""
        problems = self._problems
        if waited or not problems.is_cuda:
            bits = problems.to("cpu", copy=True)
        elif self._copied.query():
            bits = self._copied_problems.clone()
            self._copied_problems.copy_(problems, non_blocking=True)
            self._copied.record(torch.cuda.current_stream(problems.device))
        else:
            return
        if not bits.any():
            return
        problems.zero_()
        if (bits & (planning.BAD_WEIGHTS | planning.BAD_FIT)).any():
            self._refuse_update(bits)
        if not self._warned:
            self._warned = True
            self._warn_of_failed_samples()

    def _refuse_update(self, bits: torch.Tensor) -> None:
        name, plant = type(self._update).__name__, int(bits.argmax())
        of = self._of(plant)
        if not bits[plant] & planning.BAD_WEIGHTS:
            raise ValueError(f"fit of {name} wrote a plan or a deviation{of} that is not finite")
        weights, returns = self._arrays.weights[plant].cpu(), self._arrays.returns[plant].cpu()
        wrong = torch.where(returns > -torch.inf, ~((weights >= 0.0) & (weights < torch.inf)), weights != 0.0)
        reason = f"their sum{of} is {weights.sum():.6g}"
        if wrong.any():
            sample = int(wrong.nonzero()[0])
            failed = "" if returns[sample] > -torch.inf else ", which failed,"
            reason = f"the weight of sample {sample}{of}{failed} is {weights[sample]:.6g}"
        raise ValueError(
            f"weigh of {name} must write weights that are not negative, sum to 1 and are 0 for failed samples: {reason}"
        )

    def _warn_of_failed_samples(self) -> None:
        faults = Done(int(np.bitwise_or.reduce(self._loop.fault.cpu().numpy())))
        substep, frame_skip = self.env.model.opt.timestep, self.env.task.frame_skip
        if faults:
            reason = f"faults: {faults.name}"
            fix = (
                f"try shorter substeps, such as timestep={0.5 * substep:g}, frame_skip={2 * frame_skip}, or less noise"
            )
        else:
            reason, fix = "returns are not finite", "check the task's reward and the value function"
        log.warning(
            "all %d samples of a plan of %s failed (%s), so the planner keeps its last plan: %s; further failures are "
            "not reported", self.samples, self.env.task.name, reason, fix,
        )  # fmt: skip

    def _program(self, *, first: bool) -> Calls:
        """Return the calls of one iteration. If ``first`` is set, they also shift the plan in time."""
        perturb = Phase("perturb", partial(self._plans.perturb, self._keys, first=first))
        parts: list[Phase | Callable[[], None]] = [perturb, *self._loop.phases]
        if self._value_in_torch:
            parts.append(self._evaluate)
        weigh: Any = self._weigh_in_torch
        fit: Any = self._fit
        if self._update.capturable:
            weigh, fit = Phase("weigh", partial(self._update.weigh, self._arrays)), Phase("fit", self._fit)
        parts += [Phase("returns", self._add_up), weigh, Phase("average", self._average), fit]
        # combine phases into as few graphs as possible; functions that use torch run between the graphs
        calls: list[Any] = []
        for is_phase, group in itertools.groupby(parts, lambda part: isinstance(part, Phase)):
            members: Any = list(group)
            calls += self._loop.sequence(members) if is_phase else members
        return tuple(calls)

    def _add_up(self) -> None:
        config, device = self.config, self.env.device
        if self._value_kernel is not None:
            values = [wp.from_torch(self._value_obs), self._terminal]
            wp.launch(self._value_kernel, self.env.nworld, values, device=device)
        returns = [*self._rewards, self._terminal, config.discount, config.termination == "stop", self._world_return]
        wp.launch(planning.add_up, self.env.nworld, returns, device=device)
        if config.models > 1:
            models = [self._world_return, config.risk == "worst", self._return]
            wp.launch(planning.combine_models, len(self._return), models, device=device)

    def _average(self) -> None:
        launch_blocks(planning.check_weights, self.plants, [self._return, self._weight, self._valid, self._problem])
        plans = self._plans
        args = [self._weight, plans.samples, plans.nominal, self._valid, plans.plan]
        launch_blocks(planning.average, plans.plan.size, args)

    def _fit(self) -> None:
        self._update.fit(self._arrays)
        if isinstance(self.config.update, PlanUpdate):
            plans = self._plans
            for before, after in ((plans.nominal, plans.plan), (plans.nominal_deviation, plans.deviation)):
                if after is not None:
                    args = [self._valid, before, self._problem, after]
                    wp.launch(planning.undo_bad_fit, after.shape, args, device=self.env.device)
        self._plans.interpolate()

    def _weigh_in_torch(self) -> None:
        arrays = self._arrays
        if (result := self._update.weigh(arrays)) is not None:
            raise ValueError(
                f"weigh of {type(self._update).__name__} must write into samples.weights and return None, not "
                f"{described(result)}"
            )
        good = torch.isfinite(arrays.returns)
        mean = torch.where(good, arrays.returns, 0.0).sum(1) / good.sum(1)
        effective = 1 / arrays.weights.square().sum(1)
        torch.stack([arrays.returns.amax(1), mean, effective, (~good).sum(1).float()], 1, out=arrays.summary)

    def _evaluate(self) -> None:
        torch_view(self._terminal).copy_(self._torch_values())

    def _torch_values(self) -> torch.Tensor:
        obs, nworld = self._value_obs, self.env.nworld
        if isinstance(self.value, ValueFunction):
            steps = self._loop.states[:, self.env.state_space.parts["step"]] + self.horizon
            values = self.value(obs, steps.float().expand(-1, nworld // self.plants).reshape(nworld))
        else:
            values = self.value(obs)  # type: ignore[misc]
        if not isinstance(values, torch.Tensor) or values.numel() != nworld:
            raise ValueError(
                f"value must return {nworld} numbers for {tuple(obs.shape)} observations, not {described(values)}"
            )
        return values.view(nworld)

    def reset(self, seed: int | Sequence[int] | None = None, *, where: torch.Tensor | None = None) -> None:
        """Reset the plan and the adapted noise, and restart the noise stream.

        Args:
            seed: A new seed. With several plants, plant i gets the seed ``seed + i``; a list gives one seed per plant.
                The planner randomizes its models again with the first seed.
            where: Mask of the plants to reset, (plants,) bool; by default all plants are reset. With a mask, all plants
                outside the mask keep their seeds, and the planner keeps its models.

        Raises:
            ValueError: A seed is not a non-negative whole number, or ``where`` has the wrong shape or type.
        """
        if where is not None:
            if not isinstance(where, torch.Tensor) or (where.shape, where.dtype) != ((self.plants,), torch.bool):
                raise ValueError(f"where must be a bool tensor of shape ({self.plants},), not {described(where)}")
            where = where.to(self.actions.device)
        seeds = None if seed is None else plant_seeds(seed, self.plants)
        if seeds is not None and where is None and self.model_fields:
            self._draw_models(seeds[0])
        self._plans.reset(seeds, where)

    @property
    def seeds(self) -> list[int]:
        """Return the seed of each plant's noise."""
        return [int(seed) for seed in self._plans.seed.numpy()]

    def _draw_models(self, seed: int) -> None:
        """Randomize the planner's models with the task's functions. Plants use other random streams."""
        self.env.rand_reset(int(np.random.SeedSequence([seed, _MODELS]).generate_state(1)[0]) >> 1)
        states = self.env.get_state()[: self.config.models]
        for name, rows in self.model_fields.items():
            rows.copy_(states[:, self.env.state_space.parts[name]])

    def state_of(self, **parts: Any) -> torch.Tensor:
        """Make a state from some of its parts, such as measurements.

        All other parts have the values of the task's fixed reset. Model fields have nominal values unless they are
        given, for example as ``body_mass=...``.

        Fields that belong to the last substep, such as accelerations, affect only the first transition of a plan.
        ``time`` also sets the step counter, unless ``step`` is given.

        Args:
            parts: Values for parts of ``env.state_space``: qpos, qvel, time, mocap_pos, ...

        Returns:
            The state, (state_space.size,) float64.

        Raises:
            ValueError: A part is unknown, or its value has the wrong size or is not a number.
        """
        space, state = self.env.state_space, self._initial.clone()
        for name, value in parts.items():
            if name not in space.parts:
                raise ValueError(f"a state of {self.env.task.name!r} has no part {name!r}: it has {list(space.parts)}")
            target = state[space.parts[name]]
            try:
                values = torch.as_tensor(value, dtype=torch.float64).ravel()
            except (TypeError, ValueError, RuntimeError) as error:
                raise ValueError(f"the part {name!r} of a state must be numbers, not {value!r}") from error
            if values.shape != target.shape:
                raise ValueError(f"the part {name!r} of a state has {len(target)} numbers, not {len(values)}")
            target.copy_(values)
        if "time" in parts and "step" not in parts:
            state[space.parts["step"]] = torch.round(state[space.parts["time"]] / self.timestep)
        return state

    @property
    def summary(self) -> dict[str, Any]:
        """Return statistics of the last improvement.

        The names are ``best_return``, ``mean_return``, ``effective_samples`` (the effective sample size) and
        ``failed_samples`` (the number of failed samples). The values are numbers or, with several plants, (plants,)
        float32 tensors on the CPU.
        """
        names = ("best_return", "mean_return", "effective_samples", "failed_samples")
        columns = self._summary.numpy().T
        if self.plants == 1:
            return dict(zip(names, columns[:, 0].tolist(), strict=True))
        return {name: torch.tensor(column) for name, column in zip(names, columns, strict=True)}


def _update_of(config: MPPIConfig) -> PlanUpdate:
    if isinstance(config.update, PlanUpdate):
        return copy.copy(config.update)
    if config.update == "cem":
        assert config.elites is not None and config.min_noise is not None
        return CrossEntropy(config.elites, config.min_noise, config.noise_smoothing)
    return SampleWeights(temperature=config.temperature, elites=0 if config.update == "mppi" else 1)


class MPPI(Planner):  # noqa: D101
    __doc__ = f"Model predictive path integral control, or with ``update`` another planner.\n\n{Planner.__doc__}"


class CEM(MPPI):
    """The cross-entropy method: ``lw.CEM(task, ...)`` is ``lw.MPPI(task, update="cem", ...)``.

    The new plan is the mean of the best samples. The standard deviation of the best samples becomes the standard
    deviation of the noise. The adapted noise persists between calls, and ``reset`` restores the initial noise. Names in
    other packages:

    ============= =============== ========================
    here          hydrax          judo
    ============= =============== ========================
    ``samples``   num_samples     num_rollouts
    ``elites``    num_elites      num_elites
    ``noise``     sigma_start     at most sigma_max
    ``min_noise`` sigma_min       sigma_min
    ``knots``     num_knots       num_nodes
    ``spline``    spline_type     spline_order
    ============= =============== ========================

    All arguments of ``lw.MPPI`` except ``update`` are accepted.
    """

    _only_update = "cem"


class PredictiveSampling(MPPI):
    """Predictive sampling: ``lw.MPPI`` with ``update="predictive_sampling"``.

    The new plan is the best sample. Howell et al. 2022, hydrax, judo and MuJoCo MPC plan with knots. To do the same,
    set ``knots`` and ``spline``. All arguments of ``lw.MPPI`` except ``update`` are accepted.
    """

    _only_update = "predictive_sampling"
