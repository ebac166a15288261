"""Open-loop roll-outs: a horizon of given actions in every world, judged by the task."""

from collections.abc import Callable, Hashable

import torch
import warp as wp

from lyceum_warp.arrays import launch_rows, torch_view
from lyceum_warp.env import Env
from lyceum_warp.kernels import planning, state
from lyceum_warp.spaces import COUNTERS
from lyceum_warp.validate import whole_number


class OpenLoop:
    """Rolls out the worlds of an environment from one state under given actions, and keeps what they earn.

    Write ``state`` and ``actions``, call ``run``, read the rest; every tensor stays the same object. Episodes do not
    end along the way: what a task's termination means is for the caller to say. The engine takes the whole horizon at
    once: on the C engine a single native call where its records are exact and the task maps no actions itself, on
    the Warp engine launches that become one recording.

    Args:
        env: Worlds to roll out in; they are the roll-outs' own from then on.
        horizon: Steps.

    Raises:
        ValueError: The environment resets its worlds by itself.
    """

    state: torch.Tensor
    """Where every world starts, (state_space.size,) float64."""
    actions: torch.Tensor
    """Actions of each step, (horizon, nworld, nu); one that is not finite is set to zero."""
    reward: torch.Tensor
    """Reward of each step, (horizon, nworld)."""
    terminated: torch.Tensor
    """Whether the state after each step ends the episode, (horizon, nworld) bool."""
    final_obs: torch.Tensor
    """Observations after the last step, (nworld, nobs)."""
    fault: torch.Tensor
    """Bits of ``Done`` for what went wrong in a world, (nworld,) int32: what it earned then means nothing."""

    def __init__(self, env: Env, horizon: int) -> None:
        if env.autoreset:
            raise ValueError("open-loop roll-outs need worlds that do not reset: make(..., autoreset=False)")
        self.env = env
        self.horizon = whole_number("horizon", horizon, low=1)
        n, nu, task = env.nworld, env.action_space.size, env.task
        rows = self.horizon * n
        with wp.ScopedDevice(env.device):
            self._state = wp.zeros(env.state_space.size, dtype=wp.float64)
            self._actions = wp.zeros((self.horizon, n, nu), dtype=float)
            self._controls = wp.zeros((self.horizon, n, env.model.nu), dtype=float)
            self._reward = wp.zeros(rows, dtype=float)
            self._terminated = wp.zeros(rows, dtype=bool)
            self._fault = wp.zeros(n, dtype=int)
            self._obs = wp.zeros((n, env.obs_space.size), dtype=float)
            self._records: dict[str, wp.array] = {}
            self._before, self._after, self._last = (task.kernels.Batch() for _ in range(3))
            for name in task.fields:
                live = getattr(env._after, name)
                record: wp.array = wp.zeros((rows + n, *live.shape[1:]), dtype=live.dtype)
                self._records[name] = record.reshape((self.horizon + 1, *live.shape))
                for batch, start in ((self._before, 0), (self._after, n), (self._last, rows)):
                    setattr(batch, name, record[start : min(start + rows, rows + n)])
        self._memory = self._records.pop("memory", None)
        self.state, self.actions = torch_view(self._state), torch_view(self._actions)
        self.reward = torch_view(self._reward).view(self.horizon, n)
        self.terminated = torch_view(self._terminated).view(self.horizon, n)
        self.fault, self.final_obs = torch_view(self._fault), torch_view(self._obs)

    def record(self, function: Callable[..., None], *args: Hashable) -> None:
        """Call a function made of launches, recorded once for the same arguments and replayed."""
        self.env._record(function, *args)

    def record_all(self, function: Callable[..., None], *args: Hashable) -> None:
        """Call a function made of launches, ``record`` and ``run``: one recording where the engine can be recorded."""
        self.env._run(function, *args)

    def run(self) -> None:
        """Roll out.

        Raises:
            ValueError: A field was asked for that became part of the state, so that ``state`` no longer fits.
        """
        env = self.env
        if env.state_space.size != self.state.numel():
            raise ValueError(
                f"a field of {env.task.name!r} that was asked for later has made its states longer: ask for it before"
            )
        self.record(self._begin)
        if env.task.functions["control"] is None:
            env.engine.rollout(env._state, self._controls, env.task.frame_skip, self._records)
            self.record(self._judge)
        else:
            self._step_by_step()

    def _begin(self) -> None:
        """The start in every world, and the controls of all steps."""
        env = self.env
        wp.launch(planning.broadcast, env._state.shape, [self._state, env._state], device=env.device)
        rest = env._state[:, env.engine.state_size :]
        counters = [env._everyone, rest, env._step, env._key, env._episode, env._out.done_reason]
        wp.launch(state.unpack_counters, env.nworld, counters, device=env.device)
        if self._memory is not None:
            launch_rows(state.narrow, env._everyone, rest[:, len(COUNTERS) :], env._memory)
            wp.copy(self._memory[0], env._memory)
        self._fault.zero_()
        args = [self._actions, env._ranges, env._scale, self._fault, self._controls]
        wp.launch(planning.controls, self._actions.shape[:2], args, device=env.device)

    def _judge(self) -> None:
        """What the recorded transitions earn."""
        env, kernels = self.env, self.env.task.kernels
        actions = self._actions.reshape((-1, self._actions.shape[2]))
        transition = [self._before, self._after, env._params, actions]
        if self._memory is not None and kernels.recall is None:  # it stays as it was at the reset
            for t in range(self.horizon):
                wp.copy(self._memory[t + 1], self._memory[0])
        elif self._memory is not None:
            counters = [env._step, env._key, env._episode]
            memory = self._memory.reshape((-1, self._memory.shape[2]))
            wp.launch(kernels.recall, env.nworld, [*transition, *counters, memory, env._rng], device=env.device)
        wp.launch(kernels.gains, len(actions), [*transition, self._reward, self._terminated], device=env.device)
        self._end(self._last)

    def _end(self, batch: object) -> None:
        env = self.env
        env.engine.find_faults(env._everyone)
        wp.launch(planning.merge_faults, env.nworld, [env.engine.fault, self._fault], device=env.device)
        args = [env._everyone, batch, env._params, self._obs]
        wp.launch(env.task.kernels.look, env.nworld, args, device=env.device)

    # where the task maps actions to controls itself, it has to see the state that each step starts from

    def _step_by_step(self) -> None:
        env = self.env
        env.engine.reset(env._everyone)
        env.engine.set_state(env._state, env._everyone)
        for t in range(self.horizon):
            env._record(self._act, t)
            env.engine.step(env.task.frame_skip)
            env._record(self._judge_step, t)
        self.record(self._end_of_steps)

    def _act(self, t: int) -> None:
        wp.copy(self.env._action, self._actions[t])
        self.env._begin()

    def _judge_step(self, t: int) -> None:
        env, n = self.env, self.env.nworld
        kernels = env.task.kernels
        transition = [env._before, env._after, env._params, self._actions[t]]
        if kernels.remember is not None:
            counters = [env._step, env._key, env._episode]
            wp.launch(kernels.remember, n, [*transition, *counters, env._rng], device=env.device)
        earned = [self._reward[t * n : (t + 1) * n], self._terminated[t * n : (t + 1) * n]]
        wp.launch(kernels.gains, n, [*transition, *earned], device=env.device)

    def _end_of_steps(self) -> None:
        self._end(self.env._after)
