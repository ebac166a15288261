"""Store transitions in a ring buffer on the worlds' device, and sample them with n-step returns."""

from typing import Any, NamedTuple, TypeAlias

import torch

from lyceum_warp.engines.memory import check_fit
from lyceum_warp.env.env import Env
from lyceum_warp.support.machine import free_memory
from lyceum_warp.support.validate import check_kind, finite_number, whole_number

Rows: TypeAlias = dict[str, torch.Tensor]

_TRANSITIONS, _STEPS = 1_000_000, 1_024
"""The default capacity is ``_TRANSITIONS`` transitions, but at least ``_STEPS`` steps of every world."""

_SHARE = 0.3


class Transitions(NamedTuple):
    """Sampled transitions. A learner's target is ``reward + discount * value(next_obs)``."""

    obs: dict[str, torch.Tensor]
    """Observations of each group before the first step, (batch, size of the group)."""
    action: torch.Tensor
    """Actions of the first step, (batch, nact)."""
    reward: torch.Tensor
    """Discounted sums of the rewards of up to ``n_step`` steps, (batch,)."""
    discount: torch.Tensor
    """Factors that multiply the value of ``next_obs``, (batch,): gamma^k after k steps, or 0 after a termination."""
    next_obs: dict[str, torch.Tensor]
    """Observations of each group after the last step and before any reset."""


class Replay:
    """Ring buffer of the transitions of every world, on the device of the environment's observations.

    ``step`` steps the environment and stores its transitions; ``sample`` draws some of the stored transitions. A fault
    truncates an episode: the transition has the reward 0 and the last valid observations as ``next_obs``. Non-finite
    actions are stored as 0, so all contents are finite.

    Example:
        >>> replay = Replay(env)
        >>> replay.step(torch.rand_like(env.action))
        >>> batch = replay.sample(256, n_step=3, gamma=0.99)

    Args:
        env: The environment.
        capacity: Number of transitions, rounded up to whole steps of all worlds. The default is 1,024 steps of
            every world, but at least a million transitions. The default buffer takes at most 30 % of the device's free
            memory.

    Raises:
        ValueError: An argument is not valid, or the buffer does not fit into memory.
    """

    env: Env
    """The environment."""
    steps: int
    """Number of steps for which the buffer has room; its capacity is ``steps * env.nworld``."""
    nbytes: int
    """Size of the full buffer in bytes."""
    stored: int
    """Number of steps stored so far, including overwritten steps."""
    obs: dict[str, torch.Tensor]
    """Observations of each group before each step, (steps, nworld, size). Row ``t % steps`` stores step t."""
    action: torch.Tensor
    """Actions, (steps, nworld, nact)."""
    reward: torch.Tensor
    """Rewards, (steps, nworld)."""
    terminated: torch.Tensor
    """Whether the task ended the episode, (steps, nworld) bool."""
    truncated: torch.Tensor
    """Whether the time limit or a fault ended the episode, (steps, nworld) bool."""
    next_obs: dict[str, torch.Tensor]
    """Observations of each group after each step and before any reset."""

    def __init__(self, env: Env, capacity: int | None = None) -> None:
        check_kind("env of Replay", env, Env, "as lw.make(...) makes it")
        self.env, n, device = env, env.nworld, env.obs.device
        sizes = [space.size for space in env.obs_spaces.values()]
        nact = env.action_space.size
        each = _transition_bytes(env)
        if capacity is None:
            capacity = default_capacity(env)
        self.steps = steps = -(-whole_number("capacity", capacity, low=1, high=2**62) // n)
        self.nbytes = each * steps * n
        check_fit(each * steps, n, env.device, model=f"{steps} steps in a replay buffer")
        # only two tensors, so that sampling needs few kernels
        self._before = torch.zeros(steps, n, sum(sizes) + nact, device=device)
        self._after = torch.zeros(steps, n, sum(sizes), device=device)
        self.reward = torch.zeros(steps, n, device=device)
        self.terminated, self.truncated = torch.zeros(2, steps, n, dtype=torch.bool, device=device)
        self._sizes = sizes
        self.obs, self.next_obs = self._groups(self._before), self._groups(self._after)
        self.action = self._before[..., sum(sizes) :]
        # on the device, so that a graph can capture sampling
        self._count, self._oldest = torch.zeros(2, dtype=torch.long, device=device)
        self.stored = 0

    @property
    def count(self) -> int:
        """Number of steps that the buffer holds now."""
        return min(self.stored, self.steps)

    def __len__(self) -> int:
        """Number of transitions that the buffer holds now."""
        return self.count * self.env.nworld

    @torch.no_grad()
    def step(self, action: torch.Tensor | None = None) -> None:
        """Step the environment, and store the transition of every world.

        Args:
            action: Actions, (nworld, nact), by default those in ``env.action``.

        Raises:
            ValueError: The action has the wrong shape or type.
        """
        env, row = self.env, self.stored % self.steps
        if action is not None:
            env.action.copy_(action.detach())
        torch.cat([*env.obs_groups.values(), env.action.nan_to_num(0.0, 0.0, 0.0)], dim=1, out=self._before[row])
        env.step()
        torch.cat(list(env.final_obs_groups.values()), dim=1, out=self._after[row])
        self.reward[row].copy_(env.reward)
        self.terminated[row].copy_(env.terminated)
        self.truncated[row].copy_(env.truncated)
        self._set_stored(self.stored + 1)

    def sample(
        self, batch: int, *, n_step: int = 1, gamma: float = 0.99, generator: torch.Generator | None = None
    ) -> Transitions:
        """Draw transitions, with replacement.

        Args:
            batch: Number of transitions.
            n_step: Maximum number of rewards in a return; see ``at``.
            gamma: Discount factor.
            generator: Random generator on the buffer's device; by default torch's global generator.

        Raises:
            ValueError: The buffer is empty, or an argument is out of range.
        """
        if not self.stored:
            raise ValueError("the replay buffer is empty: call step() before sample()")
        size = (whole_number("batch", batch, low=1),)
        index = torch.randint(len(self), size, generator=generator, device=self.reward.device)
        n_step, gamma = whole_number("n_step", n_step, low=1), finite_number("gamma", gamma, low=0.0, high=1.0)
        return self.at(index, n_step=n_step, gamma=gamma)

    @torch.no_grad()
    def at(self, index: torch.Tensor, *, n_step: int, gamma: float) -> Transitions:
        """Get transitions by index; a CUDA graph can capture this method.

        A return has fewer than ``n_step`` rewards if the episode ends earlier or no further steps are stored. It then
        bootstraps from its last observation, except after a termination.

        Args:
            index: Indices, (batch,) int64: k * nworld + w for world w in the k-th oldest step.
            n_step: Maximum number of rewards in a return.
            gamma: Discount factor.
        """
        n = self.env.nworld
        age, world = index // n, index % n
        first = last = (self._oldest + age) % self.steps * n + world
        reward = self.reward.view(-1)[first]
        discount, going = torch.full_like(reward, gamma), None
        for k in range(1, n_step):
            on = ~(self.terminated.view(-1)[last] | self.truncated.view(-1)[last]) & (age + k < self._count)
            going = on if going is None else going & on
            last = torch.where(going, (self._oldest + age + k) % self.steps * n + world, last)
            reward = reward + torch.where(going, gamma**k * self.reward.view(-1)[last], 0.0)
            discount = torch.where(going, gamma ** (k + 1), discount)
        before = self._before.flatten(0, 1)[first]
        return Transitions(
            obs=self._groups(before), action=before[:, sum(self._sizes) :], reward=reward,
            discount=discount.masked_fill(self.terminated.view(-1)[last], 0.0),
            next_obs=self._groups(self._after.flatten(0, 1)[last]),
        )  # fmt: skip

    def _groups(self, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        parts = rows[..., : sum(self._sizes)].split(self._sizes, dim=-1)
        return dict(zip(self.env.obs_groups, parts, strict=True))

    # the state

    def rows(self, first: int, end: int) -> Rows:
        """Copy the contents of steps ``first`` to ``end - 1``; the first step ever stored is step 0."""
        place = torch.arange(first, end, device=self.reward.device) % self.steps
        return {name: array[place] for name, array in self._arrays().items()}

    def set_rows(self, first: int, rows: Rows) -> None:
        """Write the contents of consecutive steps, beginning with step ``first``. Call ``restore`` afterwards."""
        place = torch.arange(first, first + len(rows["reward"]), device=self.reward.device) % self.steps
        for name, array in self._arrays().items():
            array[place] = rows[name].to(array.device)

    def restore(self, stored: int) -> None:
        """Set the number of steps stored so far; call this after the last ``set_rows``."""
        self._set_stored(whole_number("stored", stored, low=0, high=2**62))

    def state_dict(self) -> dict[str, Any]:
        """Copy the contents, and the number of steps stored so far."""
        return {"stored": self.stored, "rows": self.rows(self.stored - self.count, self.stored)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a result of ``state_dict``.

        With the same random numbers, ``sample`` then returns the same transitions.

        Raises:
            ValueError: The state belongs to a buffer of a different size.
        """
        rows, stored = state["rows"], state["stored"]
        shapes = {name: (min(stored, self.steps), *array.shape[1:]) for name, array in self._arrays().items()}
        if (state_shapes := {name: tuple(part.shape) for name, part in rows.items()}) != shapes:
            raise ValueError(f"the state's rows have the shapes {state_shapes}, but this replay buffer needs {shapes}")
        self.set_rows(stored - len(rows["reward"]), rows)
        self.restore(stored)

    def _arrays(self) -> Rows:
        return {"before": self._before, "after": self._after, "reward": self.reward, "terminated": self.terminated,
                "truncated": self.truncated}  # fmt: skip

    def _set_stored(self, stored: int) -> None:
        self.stored = stored
        self._count.fill_(self.count)
        self._oldest.fill_((stored - self.count) % self.steps)


def default_capacity(env: Env, processes: int = 1) -> int:
    """Compute the default capacity, in transitions, of each process's replay buffer."""
    capacity, free = max(-(-_TRANSITIONS // processes), _STEPS * env.nworld), free_memory(env.device)
    if free is None:
        return capacity
    return max(min(capacity, int(_SHARE * free) // _transition_bytes(env)), env.nworld)


def _transition_bytes(env: Env) -> int:
    nobs = sum(space.size for space in env.obs_spaces.values())
    return 4 * (2 * nobs + env.action_space.size + 1) + 2
