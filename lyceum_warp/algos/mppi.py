"""Model predictive path integral control (MPPI): planning by weighted averages of random roll-outs.

Each call improves a plan, a sequence of actions, from the state that it is given:

1. the plan of the last call moves forward in time, and its end is filled;
2. every sample adds noise of its own to it, smoothed over time, and is kept within the actions' bounds;
3. every sample is rolled out, and its discounted rewards and the value of where it ends are added up;
4. the new plan is the mean of the samples' actions, weighted by exp((return - best return) / temperature).

The formulation is that of Williams et al. (2017) without a cost on the controls, as in Lyceum (Summers et al. 2020)
and in trajopt, whose smoothing of the noise it takes over. A temperature here is a true one: the paper's 5 for its
arm is an inverse temperature, and stands for 0.2.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.evaluation import moved
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.arrays import torch_view
from lyceum_warp.binding.bound_task import task_spec
from lyceum_warp.binding.registry import find_task
from lyceum_warp.engines.placement import place_samples
from lyceum_warp.env import Env
from lyceum_warp.kernels import planning
from lyceum_warp.openloop import OpenLoop
from lyceum_warp.options import OPTIONS
from lyceum_warp.spaces import Space
from lyceum_warp.task import Task
from lyceum_warp.validate import described, whole_number

_BLOCK = 256

Value = ValueFunction | wp.Function | Callable[[torch.Tensor], torch.Tensor]


class MPPI:
    """A controller that plans anew at every step: ``action = plan(state)``.

    The planner simulates in worlds of its own, one a sample. What it controls, the plant, may be an environment, with
    ``plan(env.get_state()[0])``, or a robot, with ``plan(plan.state_of(qpos=..., qvel=..., time=...))``; its model,
    time step and parameters may differ from the planner's. Randomness is counted: a plan depends on the seed, on how
    many plans came before it, and on what those left as the plan to start from.

    Everything that is left at None comes from the task's ``planning``, if it names it, and else from the default in
    brackets. ``planning`` may also hold options and parameters for the planner's worlds, which those given override;
    with a ``value`` its parameters don't count, because values are of what the task itself pays.

    Args:
        task: Name of a task, a file with one, or its class.
        horizon: Steps of a plan (32).
        samples: Roll-outs for each improvement of the plan (64).
        temperature: In units of reward; low ones follow the best sample, high ones average all (0.1).
        noise: Standard deviation of the noise in units of the action, one number, or one for each action; or its
            covariance, (nu, nu) (0.5).
        smoothing: Weights (b0, b1, b2) of the noise, of the last step's and of the one before it, from the third step
            on; (1, 0, 0) is white noise ((0.25, 0.8, 0)).
        discount: Of rewards and of the terminal value, a step (1, or what ``value`` was fitted for).
        iterations: Improvements of the plan in a call (1).
        fill: What fills the end of a plan that moves forward: "zero" (the action nearest to it), "repeat" the last
            action, or an action, (nu,) ("zero").
        termination: Whether a sample that reaches the end of its episode earns nothing from there on ("stop"), or
            goes on ("ignore", as Lyceum and trajopt do). Either way a sample whose physics fails anywhere within the
            horizon has no weight.
        value: What is added for where a sample ends: a ``ValueFunction``, or anything that makes (nsample,) values of
            (nsample, nobs) observations, or a Warp function of one observation, ``value(obs: Row[float]) -> float``,
            which on the Warp engine becomes part of the recording.
        seed: Of the noise.
        options: Options and parameters of the planner's environment, as for ``lw.make``. With a CUDA device and
            engine="auto", few samples are rolled out by the C engine on the CPU all the same, because it is faster
            there; then plans and actions lie on the CPU, too.

    Raises:
        ValueError: An argument makes no sense; the message says which and why.
    """

    settings: dict[str, Any]
    """The settings above as they are, from horizon to termination, and the options of the planner's worlds."""
    actions: torch.Tensor
    """The plan, (horizon, nu); the first row is what the last call returned."""
    nominal: torch.Tensor
    """The plan that the last improvement started from, (horizon, nu)."""
    standard_noise: torch.Tensor
    """The last improvement's standard normal numbers, (horizon, samples, nu)."""
    sampled: torch.Tensor
    """The last improvement's actions, (horizon, samples, nu)."""
    returns: torch.Tensor
    """The samples' returns, (samples,); minus infinity for those that failed."""
    weights: torch.Tensor
    """The samples' weights, (samples,)."""

    def __init__(
        self,
        task: str | type[Task],
        *,
        horizon: int | None = None,
        samples: int | None = None,
        temperature: float | None = None,
        noise: float | Sequence[float] | np.ndarray | torch.Tensor | None = None,
        smoothing: Sequence[float] | None = None,
        discount: float | None = None,
        iterations: int | None = None,
        fill: str | Sequence[float] | np.ndarray | torch.Tensor | None = None,
        termination: str | None = None,
        value: Value | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        task = find_task(task)
        for name, instead in (("nworld", "samples is the number of worlds"), ("autoreset", "samples never reset")):
            if name in options:
                raise ValueError(f"a planner takes no {name}: {instead}")
        discount = getattr(value, "discount", None) if discount is None else discount
        given = dict(
            horizon=horizon, samples=samples, temperature=temperature, noise=noise, smoothing=smoothing,
            discount=discount, iterations=iterations, fill=fill, termination=termination,
        )  # fmt: skip
        own = dict(task.planning)
        if value is not None:  # it was fitted to what the task itself pays, not to what its planning pays
            own = {name: own[name] for name in own if name in _DEFAULTS or name in _WORLDS}
        options = {name: own[name] for name in own if name not in _DEFAULTS} | options
        own = {name: own[name] for name in own if name in _DEFAULTS}
        settings = _DEFAULTS | own | {name: v for name, v in given.items() if v is not None}
        self.horizon = whole_number("horizon", settings["horizon"], low=1)
        self.samples = whole_number("samples", settings["samples"], low=1)
        self.iterations = whole_number("iterations", settings["iterations"], low=1)
        self.temperature = _number("temperature", settings["temperature"], _SMALLEST)
        self.discount = _number("discount", settings["discount"], 0.0, 1.0)
        self.termination = settings["termination"]
        if self.termination not in ("stop", "ignore"):
            raise ValueError(f"termination has to be 'stop' or 'ignore', not {self.termination!r}")
        self._smoothing = wp.vec3(*_numbers("smoothing", settings["smoothing"], 3))
        whole_number("seed", seed, low=0)
        if value is not None and not callable(value):
            raise ValueError(f"value has to be a function of observations, or None, not {described(value)}")

        options = _placed(task, options, self.samples)
        self.env = Env(task, nworld=self.samples, autoreset=False, **({"horizon": 0} | options))
        self.env.reset()
        self._initial = self.env.get_state()[0]
        self.timestep = self.env.timestep
        self._loop = OpenLoop(self.env, self.horizon)
        self.value = moved(value, self.env) if isinstance(value, ValueFunction) else value
        self.seed = seed
        self._value_kernel = planning.value_kernel(value) if isinstance(value, wp.Function) else None
        space = self.env.action_space
        factor = _factor(settings["noise"], space.size)
        self._diagonal = not np.tril(factor, -1).any()
        self._repeat = isinstance(settings["fill"], str) and settings["fill"] == "repeat"
        with wp.ScopedDevice(self.env.device):
            self._low: wp.array = wp.array(space.low, dtype=float)
            self._high: wp.array = wp.array(space.high, dtype=float)
            self._fill: wp.array = wp.array(_filling(settings["fill"], space), dtype=float)
            self._scale: wp.array = wp.array(factor, dtype=float)
            self._plan, self._nominal = (wp.zeros((self.horizon, space.size), dtype=float) for _ in range(2))
            self._noise = wp.zeros((self.horizon, self.samples, space.size), dtype=float)
            self._terminal, self._return, self._weight = (wp.zeros(self.samples, dtype=float) for _ in range(3))
            self._summary = wp.zeros(4, dtype=float)
            self._seed, self._count, self._shift = (wp.zeros(1, dtype=int) for _ in range(3))
        self.settings = {name: _plain(value) for name, value in (settings | options).items()}
        loop = self._loop
        self._samples = wp.from_torch(loop.actions)
        self._earned = [wp.from_torch(buffer) for buffer in (loop.reward, loop.terminated, loop.fault)]
        self.actions, self.nominal = torch_view(self._plan), torch_view(self._nominal)
        self.standard_noise, self.sampled = torch_view(self._noise), loop.actions
        self.returns, self.weights = torch_view(self._return), torch_view(self._weight)
        self._terminal_view, self._shift_view = torch_view(self._terminal), torch_view(self._shift)
        if value is not None and self._value_kernel is None:
            try:
                self._torch_values()
            except RuntimeError as error:  # its weights lie elsewhere, or it takes other observations
                raise ValueError(f"value can't take observations {described(loop.final_obs)}: {error}") from error
        self.reset(seed)
        self._made = True

    def __setattr__(self, name: str, value: Any) -> None:
        if name in (*_DEFAULTS, "value", "seed") and "_made" in self.__dict__:
            raise AttributeError(f"{name} is part of what was recorded: make another MPPI with {name}={value!r}")
        super().__setattr__(name, value)

    def reset(self, seed: int | None = None) -> None:
        """Forget the plan, and begin the noise anew.

        Args:
            seed: Another seed.
        """
        if seed is not None:
            self._seed.fill_(whole_number("seed", seed, low=0))
        self._count.zero_()
        self.actions.copy_(torch_view(self._fill).expand_as(self.actions))

    @torch.no_grad()
    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None, *, shift: int = 1) -> torch.Tensor:
        """Improve the plan from a state.

        Args:
            state: (state_space.size,) float64, or one row of it: from ``get_state`` of an environment of the same
                task, on either engine, or from ``state_of``.
            obs: Not used: controllers are called with it.
            shift: How many steps have passed since the last call's state.

        Returns:
            The action to take now, (nu,).

        Raises:
            ValueError: The state has another shape or type, or is not finite.
        """
        self._loop.state.copy_(self._checked(state))
        self._shift_view.fill_(whole_number("shift", shift, low=0))
        if self.value is None or self._value_kernel is not None:
            self._improve()
        else:  # torch has its turn between two recordings
            for i in range(self.iterations):
                self._sample(i == 0)
                self._terminal_view.copy_(self._torch_values())
                self._update()
        return self.actions[0].clone()

    @property
    def summary(self) -> dict[str, float]:
        """Of the last improvement's samples: best and mean return, their effective number, and how many failed."""
        best, mean, effective, failed = self._summary.numpy().tolist()
        return {"best_return": best, "mean_return": mean, "effective_samples": effective, "failed_samples": failed}

    def state_of(self, **parts: Any) -> torch.Tensor:
        """A state by its parts, as a robot knows it; the rest is as the task's fixed reset leaves it.

        That is true also of fields which a task wants as the last substep left them: they matter for what the first
        step of a plan came from. A ``time`` sets the step counter, too, if ``step`` does not.

        Args:
            parts: Values for parts of ``env.state_space``: qpos, qvel, time, mocap_pos, ...

        Returns:
            (state_space.size,) float64.

        Raises:
            ValueError: There is no such part, or its value has another size, or is no number.
        """
        space = self.env.state_space
        state = self._initial.clone()
        if "time" in parts and "step" not in parts:
            parts["step"] = np.round(np.asarray(parts["time"], dtype=np.float64) / self.timestep)
        for name, value in parts.items():
            if name not in space.parts:
                raise ValueError(f"a state of {self.env.task.name!r} has no part {name!r}: it has {list(space.parts)}")
            target = state[space.parts[name]]
            try:
                values = torch.as_tensor(value, dtype=torch.float64).ravel()
            except (TypeError, ValueError, RuntimeError) as error:
                raise ValueError(f"the part {name!r} of a state has to be numbers, not {value!r}") from error
            if values.shape != target.shape:
                raise ValueError(f"the part {name!r} of a state has {len(target)} numbers, not {len(values)}")
            target.copy_(values)
        return state

    # one plan

    def _improve(self) -> None:
        for i in range(self.iterations):
            self._sample(i == 0)
            self._update()

    def _sample(self, first: bool) -> None:
        self._perturb(first)
        self._loop.run()

    def _perturb(self, first: bool) -> None:
        """The plan to start from, and the samples around it."""
        device, dim = self.env.device, (self.samples, self._plan.shape[1])
        if first:
            args = [self._plan, self._shift, self._fill, self._repeat, self._nominal]
            wp.launch(planning.shift_plan, self._plan.shape, args, device=device)
        else:
            wp.copy(self._nominal, self._plan)
        wp.launch(planning.draw_noise, dim, [self._seed, self._count, self._noise], device=device)
        wp.launch(planning.count_up, 1, [self._count], device=device)
        wp.launch(planning.perturb, dim, [
            self._nominal, self._noise, self._scale, self._diagonal, self._smoothing, self._low, self._high,
            self._samples,
        ], device=device)  # fmt: skip

    def _update(self) -> None:
        """Returns, weights, and the plan that they make."""
        device = self.env.device
        if self._value_kernel is not None:
            args = [wp.from_torch(self._loop.final_obs), self._terminal]
            wp.launch(self._value_kernel, self.samples, args, device=device)
        wp.launch(planning.add_up, self.samples, [
            *self._earned, self._terminal, self.discount, self.termination == "stop", self._return,
        ], device=device)  # fmt: skip
        weights = [self._return, self.temperature, self._weight, self._summary]
        wp.launch_tiled(planning.weigh, dim=[1], inputs=weights, block_dim=_BLOCK, device=device)
        plan = [self._weight, self._samples, self._nominal, self._summary, self._plan]
        wp.launch_tiled(planning.average, dim=[self._plan.size], inputs=plan, block_dim=_BLOCK, device=device)

    def _torch_values(self) -> torch.Tensor:
        obs = self._loop.final_obs
        if isinstance(self.value, ValueFunction):
            step = self._loop.state[self.env.state_space.parts["step"]] + self.horizon
            values = self.value(obs, step.float().expand(self.samples))
        else:
            values = self.value(obs)  # type: ignore[misc]
        if not isinstance(values, torch.Tensor) or values.numel() != self.samples:
            raise ValueError(f"value has to make {self.samples} numbers of {tuple(obs.shape)} observations, "
                             f"not {described(values)}")  # fmt: skip
        return values.view(self.samples)

    def _checked(self, state: torch.Tensor) -> torch.Tensor:
        if isinstance(state, torch.Tensor) and state.ndim == 2 and len(state) == 1:
            state = state[0]
        expected = self._loop.state
        if not isinstance(state, torch.Tensor) or state.shape != expected.shape or state.dtype != expected.dtype:
            raise ValueError(
                f"a state to plan from has to be {described(expected)}, not {described(state)}: take it from "
                "env.get_state() of the same task, or make it by its parts with plan.state_of(qpos=..., qvel=...). "
                "(env.field() of an acceleration or of its like makes an environment's states longer.)"
            )
        # on a GPU this would wait for the device: there every sample fails, and the plan stays
        if state.device.type == "cpu" and not (finite := np.isfinite(state.numpy())).all():
            column = int(np.flatnonzero(~finite)[0])
            part = next(n for n, part in self.env.state_space.parts.items() if part.start <= column < part.stop)
            raise ValueError(f"the state to plan from has {state[column].item()} in its {part!r}: it has to be finite")
        return state


def _placed(task: str | type[Task], options: Mapping[str, Any], samples: int) -> dict[str, Any]:
    """Where to roll out: engine="auto" on a GPU chooses by the number of samples and by the solver."""
    return dict(options) | place_samples(
        options.get("engine", "auto"), options.get("device"), nthread=options.get("nthread"), samples=samples,
        has_noslip=lambda: _has_noslip(task, options),
    )  # fmt: skip


def _has_noslip(task: str | type[Task], options: Mapping[str, Any]) -> bool:
    solver, found = options.get("solver"), find_task(task)
    if isinstance(solver, Mapping) and "noslip_iterations" in solver:
        return bool(solver["noslip_iterations"])
    if options.get("model") is None and not hasattr(found, "model"):
        return False  # the environment will tell what is missing
    return task_spec(found, options.get("model")).option.noslip_iterations > 0


_DEFAULTS: dict[str, Any] = dict(
    horizon=32, samples=64, temperature=0.1, noise=0.5, smoothing=(0.25, 0.8, 0.0), discount=1.0, iterations=1,
    fill="zero", termination="stop",
)  # fmt: skip


# the kernels' float32 holds no smaller one at full precision
_SMALLEST = float(np.finfo(np.float32).tiny)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):  # limits of the solver
        return dict(value)
    if value is None or isinstance(value, (int, float, str)):
        return value
    if isinstance(value, Path):  # of another model
        return str(value)
    names = isinstance(value, (list, tuple)) and all(isinstance(part, str) for part in value)
    return list(value) if names else _array(value).tolist()


def _array(value: Any) -> np.ndarray:
    """Numbers as float64; one that is not finite for what are none."""
    try:
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu()
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.array(math.nan)


_WORLDS = frozenset(OPTIONS)
"""Options of environments, as opposed to parameters of tasks."""


def _number(name: str, value: Any, low: float, high: float = math.inf) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not low <= number <= high:
        bounds = f"from {low:g} to {high:g}" if math.isfinite(high) else "above 0"
        raise ValueError(f"{name} has to be a number {bounds}, not {value!r}")
    return number


def _numbers(name: str, value: Any, size: int) -> np.ndarray:
    array = _array(value)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(f"{name} has to be {size} finite numbers, not {value!r}")
    return array


def _factor(noise: Any, nu: int) -> np.ndarray:
    """The lower Cholesky factor of the noise's covariance, (nu, nu)."""
    array = _array(noise)
    if array.ndim < 2 and array.shape in ((), (nu,)) and np.isfinite(array).all() and (array >= 0).all():
        return np.diag(np.broadcast_to(array, nu))
    if array.shape == (nu, nu) and np.isfinite(array).all() and np.allclose(array, array.T):
        try:
            return np.linalg.cholesky(array)
        except np.linalg.LinAlgError:
            pass
    raise ValueError(
        f"noise has to be a standard deviation, {nu} of them, or a positive definite covariance ({nu}, {nu}), "
        f"not {noise!r}"
    )


def _filling(fill: Any, space: Space) -> np.ndarray:
    """The action that fills the end of a plan, and the whole plan at first, (nu,)."""
    if isinstance(fill, str):
        if fill not in ("zero", "repeat"):
            raise ValueError(f"fill has to be 'zero', 'repeat' or an action, not {fill!r}")
        fill = np.zeros(space.size)
    return np.clip(_numbers("fill", fill, space.size), space.low, space.high)
