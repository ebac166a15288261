"""Model predictive path integral control (MPPI): planning by weighted averages of random rollouts.

Each call improves a plan, a sequence of actions u_t, from the state that it is given:

1. shift: the plan of the last call moves forward in time, and its end is filled;
2. perturb: sample k adds smoothed noise e_t^k to the plan and is clipped to the actions' bounds; it gets a random
   stream of its own, for what the task draws in it;
3. roll out: each sample earns the return R_k, its discounted rewards and the value of the state where it ends;
4. weigh: w_k = exp((R_k - max R) / temperature), divided by their sum;
5. average: the new plan is u_t = sum_k w_k u_t^k.

The formulation is that of Williams et al. (2017, "Information theoretic MPC for model-based reinforcement learning")
without a cost on the controls, as in Lyceum (Summers et al. 2020) and in trajopt, which also is the source of the
smoothing. Returns are divided by the temperature: the 5 of Summers et al. for their arm, an inverse, is 0.2 here.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.mppi_arguments import plain, planner_arguments
from lyceum_warp.algos.mppi_config import SETTINGS, MPPIConfig
from lyceum_warp.algos.networks import moved
from lyceum_warp.algos.planner_state import checked_state, state_from_parts
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.arrays import flat, torch_view
from lyceum_warp.binding.registry import find_task
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.env import Env
from lyceum_warp.graphs.capture import Calls, Phase
from lyceum_warp.kernels import planning
from lyceum_warp.openloop import OpenLoop
from lyceum_warp.task import Task
from lyceum_warp.validate import described, whole_number

_BLOCK = 256
_BUFFERS = ("actions", "nominal", "standard_noise", "sampled", "returns", "weights")

Value: TypeAlias = ValueFunction | wp.Function | Callable[[torch.Tensor], torch.Tensor]


@document_attributes
class MPPI:
    """A controller that plans again at every step: ``action = plan(state)``.

    The planner simulates in worlds of its own, one for each sample. It controls a plant: an environment, with
    ``plan(env.get_state()[0])``, or a robot, with ``plan(plan.state_of(qpos=..., qvel=..., time=...))``. The plant's
    model, time step and parameters may differ from the planner's. Randomness is counted: a plan depends on the seed,
    on the number of plans before it, and on the plan to start from. A task's functions draw from streams of each
    sample's own, seeded by the planner: a plan cannot know what the plant will draw.

    A task's ``planning`` (see ``lw.Planning``) gives settings of the planner, and options and parameters of its
    worlds. Arguments replace what the task gives.

    Args:
        task: Name of a task, a file with one, or its class.
        config: Settings in place of the task's.
        value: Adds the value of the state where a sample ends to its return: a ``ValueFunction``, or a function from
            (nsample, nobs) observations to (nsample,) values, or a Warp function of one observation,
            ``value(obs: Row[float]) -> float``, which becomes part of the graph on the Warp engine. With a value the
            parameters in ``planning`` do not apply, because the value function was fitted to the task's own rewards.
        seed: Seed of the noise.
        params: Parameters of the task, for names that are also settings.
        words: Single settings, by the names of ``lw.MPPIConfig`` (None leaves one as it is); options of the planner's
            worlds, as for ``lw.make``; and parameters of the task. With a CUDA device and engine="auto", the C engine
            on the CPU rolls out few samples, because it is faster there; plans and actions then lie on the CPU.

    Raises:
        ValueError: An argument is unknown, ambiguous or not valid.
        FileNotFoundError: A model or task file is missing.
    """

    config: MPPIConfig
    """The settings in force."""
    settings: dict[str, Any]
    """The same settings with the options and parameters of the planner's worlds, as JSON can hold them."""
    actions: torch.Tensor
    """The plan, (horizon, nact); the first row is what the last call returned."""
    nominal: torch.Tensor
    """The plan that the last improvement started from, (horizon, nact)."""
    standard_noise: torch.Tensor
    """The last improvement's standard normal numbers, (horizon, samples, nact)."""
    sampled: torch.Tensor
    """The last improvement's actions, (horizon, samples, nact)."""
    returns: torch.Tensor
    """The samples' returns, (samples,); minus infinity for those that failed."""
    weights: torch.Tensor
    """The samples' weights, (samples,)."""

    def __init__(
        self,
        task: str | type[Task],
        config: MPPIConfig | None = None,
        *,
        value: Value | None = None,
        seed: int = 0,
        params: Mapping[str, Any] | None = None,
        **words: Any,
    ) -> None:
        if value is not None and not callable(value):
            raise ValueError(f"value must be a function of observations, or None, not {described(value)}")
        self.seed = whole_number("seed", seed, low=0)
        task = find_task(task)
        self.config, options, own_params = planner_arguments(task, config, words, params, value)
        self.horizon, self.samples, self.iterations = self.config.horizon, self.config.samples, self.config.iterations
        self.temperature, self.discount = self.config.temperature, self.config.discount
        self.termination = self.config.termination

        self.settings = plain(options.given() | own_params | vars(self.config))
        self.env = Env(task, options, nworld=self.samples, autoreset=False, horizon=0, **own_params)
        self.env.reset()
        self.timestep = self.env.timestep
        self._initial = self.env.get_state()[0]
        for (
            name,
            nominal,
        ) in self.env.engine.nominal.items():  # a robot has the nominal model, not one that startup drew
            self._initial[self.env.state_space.parts[name]] = torch_view(flat(nominal))[0].double()
        with wp.ScopedDevice(self.env.device):
            self._keys = wp.zeros(self.samples, dtype=wp.uint32)
        self._loop = OpenLoop(self.env, self.horizon, keys=self._keys, nominal_model=self.config.nominal_model)
        self._allocate()
        self.value = moved(value, self.env) if isinstance(value, ValueFunction) else value
        self._value_kernel = planning.value_kernel(value) if isinstance(value, wp.Function) else None
        self._value_in_torch = value is not None and self._value_kernel is None
        if self._value_in_torch:
            try:
                self._torch_values()
            except RuntimeError as error:  # its weights lie elsewhere, or it takes other observations
                observations = described(self._loop.final_obs)
                raise ValueError(f"value cannot take observations {observations}: {error}") from error
        first, others = self._program(first=True), self._program(first=False)
        self._calls = first + others * (self.iterations - 1)
        self.reset(seed)
        self._made = True

    def __setattr__(self, name: str, value: Any) -> None:
        if "_made" in self.__dict__:
            if name in (*SETTINGS, "config", "value", "seed"):
                raise AttributeError(f"{name} is part of the planner's graphs: make another MPPI with {name}={value!r}")
            if name in _BUFFERS:
                raise AttributeError(
                    f"plan.{name} is a buffer of fixed address: write into it, as plan.{name}.copy_(...)"
                )
        super().__setattr__(name, value)

    def _allocate(self) -> None:
        space, loop = self.env.action_space, self._loop
        factor = self.config.noise_factor(space.size)
        self._diagonal = not np.tril(factor, -1).any()
        self._repeat = self.config.fill == "repeat"
        self._smoothing = wp.vec3(*self.config.smoothing)
        with wp.ScopedDevice(self.env.device):
            self._low: wp.array = wp.array(space.low, dtype=float)
            self._high: wp.array = wp.array(space.high, dtype=float)
            self._fill: wp.array = wp.array(self.config.fill_action(space), dtype=float)
            self._scale: wp.array = wp.array(factor, dtype=float)
            self._plan, self._nominal = (wp.zeros((self.horizon, space.size), dtype=float) for _ in range(2))
            self._noise = wp.zeros((self.horizon, self.samples, space.size), dtype=float)
            self._terminal, self._return, self._weight = (wp.zeros(self.samples, dtype=float) for _ in range(3))
            self._summary = wp.zeros(4, dtype=float)
            self._seed, self._count, self._shift = (wp.zeros(1, dtype=int) for _ in range(3))
        self._samples = wp.from_torch(loop.actions)
        self._earned = [wp.from_torch(buffer) for buffer in (loop.reward, loop.terminated, loop.fault)]
        self.actions, self.nominal = torch_view(self._plan), torch_view(self._nominal)
        self.standard_noise, self.sampled = torch_view(self._noise), loop.actions
        self.returns, self.weights = torch_view(self._return), torch_view(self._weight)
        self._terminal_view, self._shift_view = torch_view(self._terminal), torch_view(self._shift)

    @torch.no_grad()
    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None, *, shift: int = 1) -> torch.Tensor:
        """Improve the plan from a state.

        Args:
            state: (state_space.size,) float64, or one row of states: from ``get_state`` of an environment of the same
                task, on either engine, or from ``state_of``.
            obs: Not used; every controller is called with observations.
            shift: Steps since the last call's state.

        Returns:
            The action to take now, (nu,).

        Raises:
            ValueError: The state has another shape or type, or is not finite.
        """
        self.env.check_process()
        self._loop.state.copy_(checked_state(self.env, state, self._loop.state))
        self._shift_view.fill_(whole_number("shift", shift, low=0))
        for call in self._calls:
            call()
        return self.actions[0].clone()

    def _program(self, *, first: bool) -> Calls:
        """The calls of one improvement, of which ``first`` moves the plan forward in time."""
        sequence = self._loop.sequence
        sample = [Phase("perturb", partial(self._perturb, first)), *self._loop.phases]
        update = [Phase("weigh", self._weigh), Phase("average", self._average)]
        if self._value_in_torch:  # torch computes between two graphs
            return (*sequence(sample), self._evaluate, *sequence(update))
        return sequence([*sample, *update])

    def _perturb(self, first: bool) -> None:
        """The plan to start from, and the samples around it."""
        device, dim = self.env.device, (self.samples, self._plan.shape[1])
        if first:
            shifted = [self._plan, self._shift, self._fill, self._repeat, self._nominal]
            wp.launch(planning.shift_plan, self._plan.shape, shifted, device=device)
        else:
            wp.copy(self._nominal, self._plan)
        wp.launch(planning.draw_noise, dim, [self._seed, self._count, self._noise], device=device)
        wp.launch(planning.draw_keys, self.samples, [self._seed, self._count, self._keys], device=device)
        wp.launch(planning.count_up, 1, [self._count], device=device)
        noise = [self._noise, self._scale, self._diagonal, self._smoothing]
        bounds = [self._low, self._high]
        wp.launch(planning.perturb, dim, [self._nominal, *noise, *bounds, self._samples], device=device)

    def _weigh(self) -> None:
        """Returns of the samples that were rolled out, and their weights."""
        device = self.env.device
        if self._value_kernel is not None:
            values = [wp.from_torch(self._loop.final_obs), self._terminal]
            wp.launch(self._value_kernel, self.samples, values, device=device)
        returns = [*self._earned, self._terminal, self.discount, self.termination == "stop", self._return]
        wp.launch(planning.add_up, self.samples, returns, device=device)
        weights = [self._return, self.temperature, self._weight, self._summary]
        wp.launch_tiled(planning.weigh, dim=[1], inputs=weights, block_dim=_BLOCK, device=device)

    def _average(self) -> None:
        """The new plan, the weighted mean of the samples' actions."""
        plan = [self._weight, self._samples, self._nominal, self._summary, self._plan]
        device = self.env.device
        wp.launch_tiled(planning.average, dim=[self._plan.size], inputs=plan, block_dim=_BLOCK, device=device)

    def _evaluate(self) -> None:
        self._terminal_view.copy_(self._torch_values())

    def _torch_values(self) -> torch.Tensor:
        """Values of the states where the samples end, (samples,)."""
        obs = self._loop.final_obs
        if isinstance(self.value, ValueFunction):
            step = self._loop.state[self.env.state_space.parts["step"]] + self.horizon
            values = self.value(obs, step.float().expand(self.samples))
        else:
            values = self.value(obs)  # type: ignore[misc]
        if not isinstance(values, torch.Tensor) or values.numel() != self.samples:
            raise ValueError(
                f"value must return {self.samples} numbers for {tuple(obs.shape)} observations, not {described(values)}"
            )
        return values.view(self.samples)

    def reset(self, seed: int | None = None) -> None:
        """Forget the plan, and start the noise again.

        Args:
            seed: Another seed.

        Raises:
            ValueError: The seed is not a whole number from 0.
        """
        if seed is not None:
            self.__dict__["seed"] = whole_number("seed", seed, low=0)
            self._seed.fill_(self.seed)
        self._count.zero_()
        self.actions.copy_(torch_view(self._fill).expand_as(self.actions))

    def state_of(self, **parts: Any) -> torch.Tensor:
        """A state from its parts, as a robot knows them; the rest is as the task's fixed reset leaves it.

        Model fields have their nominal values unless they are given, as ``body_mass=...``.

        The rest includes fields that a task reads as the last substep left them: they affect only the first transition
        of a plan. A ``time`` sets the step counter, too, unless ``step`` is given.

        Args:
            parts: Values for parts of ``env.state_space``: qpos, qvel, time, mocap_pos, ...

        Returns:
            (state_space.size,) float64.

        Raises:
            ValueError: A part is unknown, or its value has another size or is not a number.
        """
        return state_from_parts(self.env, self._initial, parts)

    @property
    def summary(self) -> dict[str, float]:
        """Best and mean return, effective number and failures of the last improvement's samples."""
        best, mean, effective, failed = self._summary.numpy().tolist()
        return {"best_return": best, "mean_return": mean, "effective_samples": effective, "failed_samples": failed}
