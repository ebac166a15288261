"""Roll out given actions in every world, with rewards and terminations."""

from collections.abc import Iterable, Mapping
from functools import partial

import torch
import warp as wp

from lyceum_warp.core.task import MEMORIES
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.env.arrays import memory_columns, own_parts
from lyceum_warp.env.env import Env
from lyceum_warp.graphs.capture import Calls, Phase
from lyceum_warp.kernels import rollouts, state
from lyceum_warp.support.arrays import (
    flat,
    launch_parts,
    launch_rows,
    launch_worlds,
    shared_rows,
    torch_view,
    with_memory,
    zeros_of,
)
from lyceum_warp.support.validate import check_kind, whole_number


class OpenLoop:
    """Rolls out an environment's worlds from one or more states under given actions.

    Write ``state`` and ``actions``, call ``run``, and read the other tensors. ``run`` updates them in place. Episodes
    continue after a termination, up to the horizon. The C engine simulates the whole horizon in one native call if this
    does not change the results. Tasks with ``control`` or ``substep`` are simulated step by step.

    Args:
        env: An environment that nothing else uses.
        horizon: Number of steps.
        keys: Keys of the worlds' random streams, (nworld,) uint32 on the environment's device. By default, each world
            uses the random stream of its state, as ``env.step`` does.
        nominal_model: Whether to use nominal values of model fields, instead of each world's own values in ``state``.
        models: Values, by name, of model fields that differ between worlds. They replace the values in ``state``. Each
            is (n, size) float64 on the environment's device. World w uses row w % n. Every run reads ``keys`` and these
            values.
        states: Number of initial states. Each is the initial state of ``nworld / states`` consecutive worlds.

    Raises:
        ValueError: The environment has automatic resets, ``keys`` or ``states`` does not fit the worlds, or the memory
            is too small.
    """

    state: torch.Tensor
    """The initial state of every world, (state_space.size,) float64. With several initial states, it is the same tensor
    as ``states``."""
    states: torch.Tensor
    """The initial states, (states, state_space.size) float64."""
    actions: torch.Tensor
    """Actions of each step, (horizon, nworld, nact). Non-finite actions become zero."""
    reward: torch.Tensor
    """Reward of each step, (horizon, nworld)."""
    terminated: torch.Tensor
    """Whether the state after each step ends the episode, (horizon, nworld) bool."""
    final_obs: torch.Tensor
    """Observations after the last step, (nworld, nobs)."""
    final_obs_groups: dict[str, torch.Tensor]
    """Observations of each group after the last step. The group ``policy`` is ``final_obs``."""
    fault: torch.Tensor
    """Faults of each world, (nworld,) int32. Each fault is a bit of ``Done``. Ignore the rewards of worlds with faults.
    """
    phases: tuple[Phase, ...]
    """The phases of ``run``, for callers that add their own phases to its graph."""

    def __init__(
        self, env: Env, horizon: int, *, keys: wp.array | None = None, nominal_model: bool = False,
        models: Mapping[str, wp.array] | None = None, states: int = 1,
    ) -> None:  # fmt: skip
        check_kind("env of OpenLoop", env, Env, "as lw.make(..., autoreset=False) makes it")
        if env.autoreset:
            raise ValueError("open-loop rollouts need worlds that do not reset: make(..., autoreset=False)")
        self.env, self.worlds = env, env.worlds
        self.horizon = whole_number("horizon", horizon, low=1)
        n, nact, task = env.nworld, env.action_space.size, env.task
        if n % (states := whole_number("states", states, low=1)):
            raise ValueError(f"nworld={n} must be a multiple of states={states}")
        if keys is not None and (keys.shape, keys.dtype, keys.device) != ((n,), wp.uint32, env.device):
            raise ValueError(
                f"keys must be a wp.array of shape ({n},) and type uint32 on {env.device}, not of shape {keys.shape} "
                f"and type {wp.types.type_repr(keys.dtype)} on {keys.device}"
            )
        self._keys, self._models = keys, dict(models or {})
        self._nominal: dict[str, wp.array] = {}
        for name, row in (env.engine.nominal if nominal_model else {}).items():
            if name not in self._models and name != "object":
                self._nominal[name] = wp.array(flat(row).numpy(), dtype=wp.float64, device=env.device)
        stepwise = task.functions["control"] is not None or task.functions["substep"] is not None
        length = f"horizon {self.horizon} with frame_skip {task.frame_skip}"
        check_fit(self._bytes_per_world(env, self.horizon), n, env.device, model=length)
        with wp.ScopedDevice(env.device):
            self._state = wp.zeros((states, env.state_space.size), dtype=wp.float64)
            self._actions = wp.zeros((self.horizon, n, nact), dtype=float)
            self._controls = wp.zeros((self.horizon, n, 0 if stepwise else task.model.nu), dtype=float)
            self._reward = wp.zeros(self.horizon * n, dtype=float)
            self._terminated = wp.zeros(self.horizon * n, dtype=bool)
            self._fault = wp.zeros(n, dtype=int)
            shapes = {group: (n, space.size) for group, space in env.worlds.obs_spaces.items()}
            self._obs = zeros_of(task.kernels.Observations, **shapes)
            self._finite = wp.zeros((len(env.worlds.obs_spaces), n), dtype=bool)
            self._no_memory = wp.zeros(((self.horizon + 1) * n, 0), dtype=float)
            self._make_rows()
        self.states, self.actions = torch_view(self._state), torch_view(self._actions)
        self.state = self.states[0] if states == 1 else self.states
        self.reward = torch_view(self._reward).view(self.horizon, n)
        self.terminated = torch_view(self._terminated).view(self.horizon, n)
        self.fault = torch_view(self._fault)
        self.final_obs_groups = {group: torch_view(getattr(self._obs, group)) for group in env.worlds.obs_spaces}
        self.final_obs = self.final_obs_groups["policy"]
        self.phases = self._step_by_step() if stepwise else self._whole_horizon()
        self._calls = self.sequence(self.phases)

    def _make_rows(self) -> None:
        """Make the arrays of the states and their fields at all steps."""
        task, n, rows = self.env.task, self.env.nworld, self.horizon * self.env.nworld
        # for each field, the rows before and after the steps, and the last rows, are views of one buffer
        self._fields: dict[str, wp.array] = {}
        self._rows, self._last = task.kernels.Transition(), task.kernels.Transition()
        self._rows.action = self._actions.reshape((-1, self.env.action_space.size))
        self._rows.counters = self._last.counters = self.worlds.counters
        batches = (self._rows.before, self._rows.after, self._last.after)
        if task.layouts.shared:
            for batch in batches:
                batch.shared = self.worlds.shared
        constants = {field.name: field for field in task.constants}
        for name in task.types:
            live = getattr(self.worlds.after, name)
            if field := constants.get(name):
                buffer = shared_rows(field.value(task.model), field.dtype, rows + n, self.env.device)
            else:
                buffer = wp.zeros((rows + n, *live.shape[1:]), dtype=live.dtype)
                self._fields[name] = buffer.reshape((self.horizon + 1, *live.shape))
            for batch, start in zip(batches, (0, n, rows), strict=True):
                # Warp cannot slice an array without elements
                part = buffer[start : min(start + rows, rows + n)] if buffer.size else with_memory(buffer)
                setattr(batch, name, part)
        self._memories = {name: self._fields.pop(name) for name in MEMORIES if name in self._fields}
        self._dynamics = {f.name: self._fields.pop(f.name) for f in task.dynamics if f.name in self._fields}

    def run(self) -> None:
        """Roll out."""
        self.env.check_process()
        for call in self._calls:
            call()

    def sequence(self, phases: Iterable[Phase]) -> Calls:
        """Capture phases in as few graphs as possible, and return the calls that run them."""
        return self.worlds.programs.graphs.sequence(phases)

    @staticmethod
    def _bytes_per_world(env: Env, horizon: int) -> int:
        fields = [field for field in env.task.fields if field.name in env.task.types]
        numbers = sum(field.size for field in fields) + sum(field.size for field in env.task.dynamics)
        numbers += sum(own_parts(env.task).values())
        step_bytes = 4 * (numbers + env.task.model.nu + env.action_space.size)
        return horizon * (step_bytes + 8) + env.engine.rollout_bytes_per_world(horizon, env.task.frame_skip, fields)

    def _whole_horizon(self) -> tuple[Phase, ...]:
        physics = partial(
            self.env.engine.rollout, self.worlds.state, self._controls, self.env.task.frame_skip, self._fields
        )
        return (
            Phase("start", self._start),
            Phase("physics", physics, engine=True),
            Phase("advance", self._advance_memory),
            Phase("judge", self._judge_rows, by_world=True),
            Phase("end", self._end_of_horizon),
        )

    def _step_by_step(self) -> tuple[Phase, ...]:
        """List the phases for tasks with ``control`` or ``substep``. These functions read the state in every step."""
        engine, worlds = self.env.engine, self.worlds
        phases = [
            Phase("start", self._start),
            Phase("reset", partial(engine.reset, worlds.everyone)),
            Phase("restore", partial(engine.set_state, worlds.state, worlds.everyone), engine=True),
        ]
        for t in range(self.horizon):
            phases += [
                Phase("act", partial(self._act, t)),
                *worlds.physics_phases(),
                Phase("judge", partial(self._judge_step, t)),
            ]
        return (*phases, Phase("end", partial(self._end, worlds.transition)))

    def _start(self) -> None:
        worlds, device = self.worlds, self.env.device
        wp.launch(rollouts.broadcast, worlds.state.shape, [self._state, worlds.state], device=device)
        parts = self.env.state_space.parts
        for name, rows in {**self._nominal, **self._models}.items():
            # nominal rows belong to objects
            column = parts["object"].start if name in self._nominal and self.env.task.objects else -1
            args = [rows, column, parts[name].start, worlds.state]
            wp.launch(rollouts.overwrite_rows, (self.env.nworld, rows.shape[1]), args, device=device)
        rest = worlds.state[:, self.env.engine.state_size :]
        worlds.restore_counters(worlds.everyone, rest)
        if self._keys is not None:
            wp.copy(worlds.counters.key, self._keys)
        for name, buffer in self._memories.items():
            columns = worlds.state[:, memory_columns(self.env.task, self.env.state_space)[name]]
            launch_rows(state.narrow, worlds.everyone, columns, getattr(worlds, name))
            wp.copy(buffer[0], getattr(worlds, name))
        for name, buffer in self._dynamics.items():
            columns = worlds.state[:, self.env.state_space.parts[name]]
            rows = flat(buffer).reshape((*buffer.shape[:2], -1))
            wp.launch(rollouts.repeat_columns, rows.shape, [columns, rows], device=device)
        for transition in (self._rows, self._last):  # env.set_params may have replaced the arrays
            transition.params, transition.weights = worlds.params, worlds.weights
        self._fault.zero_()
        args = [self._actions, worlds.ranges, worlds.scale, self._fault, self._controls]
        wp.launch(rollouts.controls, self._actions.shape[:2], args, device=device)

    def _advance_memory(self) -> None:
        n, kernels = self.env.nworld, self.env.task.kernels
        if kernels.advance_rows is not None:
            rows = (self.horizon + 1) * n
            memories = [
                self._memories[name].reshape((rows, -1)) if name in self._memories else self._no_memory
                for name in MEMORIES
            ]
            launch_worlds(kernels.advance_rows, n, [self._rows, *memories], self.env.device)
        else:
            for buffer in self._memories.values():
                for t in range(self.horizon):
                    wp.copy(buffer[t + 1], buffer[0])

    def _judge_rows(self) -> None:
        args = [self._rows, self._reward, self._terminated]
        launch_worlds(self.env.task.kernels.judge_rows, self.horizon * self.env.nworld, args, self.env.device)

    def _end_of_horizon(self) -> None:
        wp.launch(rollouts.add_to, self.env.nworld, [self.horizon, self.worlds.counters.step], device=self.env.device)
        self._end(self._last)

    def _act(self, t: int) -> None:
        wp.copy(self.worlds.action, self._actions[t])
        self.worlds.act()

    def _judge_step(self, t: int) -> None:
        worlds, n = self.worlds, self.env.nworld
        worlds.advance_memory()
        rows = slice(t * n, (t + 1) * n)
        args = [worlds.transition, self._reward[rows], self._terminated[rows]]
        launch_worlds(self.env.task.kernels.judge_rows, n, args, self.env.device)

    def _end(self, transition: object) -> None:
        worlds, n, device = self.worlds, self.env.nworld, self.env.device
        self.env.engine.find_faults(worlds.everyone)
        wp.launch(rollouts.merge_faults, n, [self.env.engine.fault, self._fault], device=device)
        args = [worlds.everyone, transition, self._obs, self._finite, self._obs, 1]
        launch_parts(self.env.task.kernels.observe_worlds, 1, n, args, device)
