"""Env: one task in many worlds."""

from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.arrays import torch_view
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.models import ModelSource
from lyceum_warp.binding.registry import find_task
from lyceum_warp.done import FAULTS
from lyceum_warp.engines.base import EngineFactory
from lyceum_warp.engines.placement import bytes_per_world, few_worlds, find_device, open_engine
from lyceum_warp.fields import Field, describe, elements
from lyceum_warp.graphs.compile_ahead import compile_ahead
from lyceum_warp.graphs.recorder import Recorder
from lyceum_warp.kernels import random, steps
from lyceum_warp.spaces import state_space
from lyceum_warp.task import Task
from lyceum_warp.validate import check_tensor, whole_number
from lyceum_warp.worlds import PHASES, Worlds


def make(task: str | type[Task], **options: Any) -> "Env":
    """Make an environment: ``make("hopper", nworld=64, ctrl_cost_weight=1e-2)``; see ``Env`` for the options."""
    return Env(task, **options)


class Env(Worlds):
    """One task in many worlds, with every array allocated once and shared with torch.

    Write ``action``, call ``step``, read ``obs``, ``reward``, ``eval``, ``terminated``, ``truncated``,
    ``success``, ``done``, ``done_reason`` and ``final_obs``: the tensors stay the same objects at the same
    addresses and change in place. A world whose episode ends begins a new, random one within the same step;
    ``obs`` is then the first observation of the new episode, ``final_obs`` the last one of the old.

    On a GPU, torch's work on these tensors belongs on torch's default stream, which waits for Warp's and is
    waited for; work on other streams has to be synchronised by whoever puts it there.

    Args:
        task: Name of a task, a file with one, or its class.
        nworld: Number of worlds.
        device: "cpu" or a CUDA device.
        engine: "mujoco" (C, on CPU cores), "warp", or "auto": Warp on CUDA and C on the CPU.
        seed: Seed of the worlds' random streams.
        first_world: Number of the first world among those of all processes, where several share a batch: its
            worlds have the random streams of these numbers.
        autoreset: False lets finished worlds keep stepping with their ``done`` set until they are reset. Only
            worlds with a fault still begin again at once.
        horizon: Steps after which an episode is truncated, 0 for never; the task's own by default.
        record: False runs every launch unrecorded, for debugging; the numbers are the same to the bit.
        model: Another model than the task's: a file or an MjSpec.
        frame_skip: Another number of substeps in a step.
        cone: Another friction cone: "pyramidal" or "elliptic".
        integrator: Another integrator: "euler", "rk4", "implicit" or "implicitfast".
        solver: Other limits of the constraint solver, any of {"iterations": 4, "ls_iterations": 10,
            "noslip_iterations": 0}.
        nthread: Threads of the C engine; all cores by default.
        nconmax: Contacts that the Warp engine has room for in each world, on average; probed by default.
        njmax: Constraints that the Warp engine has room for in each world; probed by default.
        deterministic: True makes two runs on a CUDA device equal to the bit, for a price: 5 to 18 times the time and
            5 to 7 times the memory on hopper, half_cheetah and humanoid. On the CPU two runs are equal anyway.
        unroll: True has the Warp engine go through all iterations of the solver, instead of a loop that ends with the
            last world's. The numbers stay the same. With a ``solver`` of at most 20 iterations only; with some four it
            gained 3 to 5 % on half_cheetah and humanoid, and lost 1 to 2 % on hopper. The C engine takes no notice.
        fields: Fields that the task does not read, but ``field`` will be asked for: they are there from the start.
            Needed for those that MuJoCo computes only for a sensor: "sensordata" itself, "cacc", "cfrc_ext" and others.
        nvtx: True marks the phases of a step for NVIDIA's profilers (act, physics, judge, restart, refresh, look), and
            records each by itself.
        params: The task's parameters; a scalar may also be given as one value a world.

    Raises:
        ValueError: Something given does not fit; the message names it and the mend.
        FileNotFoundError: A model or task file is missing.
    """

    obs: torch.Tensor
    """Observations, (nworld, nobs), float32."""
    final_obs: torch.Tensor
    """Observations of the states that the last step led to, before any reset, (nworld, nobs), float32."""
    reward: torch.Tensor
    """Rewards of the last step, (nworld,), float32."""
    eval: torch.Tensor
    """The task's evaluation metric of the states that the last step led to, (nworld,), float32."""
    terminated: torch.Tensor
    """Whether the task, or a fault, ended the episode, (nworld,), bool."""
    truncated: torch.Tensor
    """Whether the time limit was reached, (nworld,), bool."""
    success: torch.Tensor
    """Whether the task's goal is met, (nworld,), bool."""
    done: torch.Tensor
    """Whether the episode ended for any reason, (nworld,), bool."""
    done_reason: torch.Tensor
    """Bits of ``Done``, (nworld,), int32."""
    action: torch.Tensor
    """Actions of the next step, (nworld, nu), float32."""

    def __init__(
        self,
        task: str | type[Task],
        *,
        nworld: int = 1,
        device: str | None = None,
        engine: str | EngineFactory = "auto",
        seed: int = 0,
        first_world: int = 0,
        autoreset: bool = True,
        horizon: int | None = None,
        record: bool = True,
        model: ModelSource | None = None,
        frame_skip: int | None = None,
        cone: str | None = None,
        integrator: str | None = None,
        solver: Mapping[str, int] | None = None,
        nthread: int | None = None,
        nconmax: int | None = None,
        njmax: int | None = None,
        deterministic: bool = False,
        unroll: bool = False,
        fields: Collection[str] = (),
        nvtx: bool = False,
        **params: Any,
    ) -> None:
        self._options: dict[str, Any] = dict(
            device=device, engine=engine, record=record, model=model, frame_skip=frame_skip, cone=cone,
            integrator=integrator, solver=solver, nthread=nthread, nconmax=nconmax, njmax=njmax,
            deterministic=deterministic, unroll=unroll, fields=fields, nvtx=nvtx,
        )  # fmt: skip
        self.nworld = whole_number("nworld", nworld, low=1)
        self._first_world = whole_number("first_world", first_world, low=0)
        self.device = find_device(device)
        self.task = BoundTask(
            find_task(task), self.nworld, model=model, frame_skip=frame_skip, cone=cone, integrator=integrator,
            solver=solver, fields=fields, **params,
        )  # fmt: skip
        self._horizon = self.task.task.horizon if horizon is None else whole_number("horizon", horizon, low=0)
        self._autoreset = autoreset
        self._given_params = dict(params)
        whole_number("seed", seed, low=0)  # before anything large is made
        self.timestep: float = self.task.timestep  # seconds in a step
        # what both engines were made of: changes here reach neither, an MjSpec that was changed is given as model=
        self.model: mujoco.MjModel = self.task.model
        kept = self._fields_to_keep()
        more = dict(nthread=nthread, nconmax=nconmax, njmax=njmax, deterministic=deterministic, unroll=unroll)
        beside = self._own_bytes(kept)
        self.engine = open_engine(engine, self.model, self.nworld, self.device, kept, beside=beside, **more)
        self._bytes_per_world = bytes_per_world(engine, self.model, self.device, kept, **more) + beside
        self.record = record
        if nvtx and not torch.backends.cuda.is_built():
            raise ValueError("nvtx=True marks phases through torch, whose build here is without CUDA: leave it out")
        self._record = Recorder(self.device, record, PHASES if nvtx else None)
        self._scratch: Env | None = None
        self._views: dict[str, torch.Tensor] = {}
        with wp.ScopedDevice(self.device):
            self._allocate()
        try:
            if self.engine.capturable:
                compile_ahead(self._rehearsal, self.device, self.task.name)
                if record:
                    self.engine.prepare_capture()
            self.rand_reset(seed)
        except Exception as error:
            raise self.task.explained(error) from None
        self.task.check_observation(self._after, self._params)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__ and name in (*steps.OUTCOMES, "action"):
            raise AttributeError(f"env.{name} is a buffer of fixed address: write into it, as env.{name}.copy_(...)")
        super().__setattr__(name, value)

    @property
    def horizon(self) -> int:
        """Steps after which an episode is truncated; 0 for never."""
        return self._horizon

    @property
    def first_world(self) -> int:
        """Number of the first world among those of all processes; 0 where there is but one."""
        return self._first_world

    @property
    def autoreset(self) -> bool:
        """Whether finished worlds begin a new episode within the same step."""
        return self._autoreset

    # the step

    def step(self, action: torch.Tensor | None = None) -> None:
        """Advance every world by one step under ``action``, and begin new episodes where one ended.

        Args:
            action: Copied into ``env.action`` first, if given; (nworld, nu).

        Raises:
            ValueError: The action has another shape or type.
        """
        if action is not None:
            check_tensor(action, "action", self.action)
            self.action.copy_(action.detach())
        self._run(self._whole_step)

    # resets

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Put worlds into the task's fixed initial state, with zero actions.

        Args:
            mask: Which worlds, (nworld,) bool; all by default.
        """
        self._set_mask(mask)
        self._begin_episodes(randomly=False)

    def rand_reset(self, seed: int | None = None, mask: torch.Tensor | None = None) -> None:
        """Put worlds into random initial states, with zero actions.

        Args:
            seed: Starts the worlds' random streams anew; by default each world goes on with its own.
            mask: Which worlds, (nworld,) bool; all by default.
        """
        self._set_mask(mask)
        if seed is not None:
            self._seed.fill_(whole_number("seed", seed, low=0))
            args = [self._mask, self._seed, self._first_world, self._key, self._episode]
            wp.launch(random.seed_worlds, self.nworld, args, device=self.device)
        self._begin_episodes(randomly=True)

    # the state

    def get_state(self, out: torch.Tensor | None = None, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Everything that the future depends on, (nworld, state_space.size), float64.

        The engine's integration state, fields that are as the last substep left them, the step counter, the
        random stream and the task's memory; ``state_space.parts`` says where each lies.

        Args:
            out: Where to write the states.
            mask: Which worlds' rows of ``out`` to write, (nworld,) bool; all by default.
        """
        self._record(self._pack)
        if mask is None or out is None:
            return self._given(self._state_view, out)
        check_tensor(out, "out", self._state_view)
        self._set_mask(mask)
        return torch.where(self._mask_view[:, None], self._state_view, out, out=out)

    def set_state(self, state: torch.Tensor, mask: torch.Tensor | None = None, *, check: bool = True) -> None:
        """Put worlds into states from ``get_state``, exactly; every getter reflects them afterwards.

        The reward becomes 0: no action has led there.

        Args:
            state: (nworld, state_space.size), float64.
            mask: Which worlds, (nworld,) bool; all by default.
            check: Whether to refuse states that are not finite, which on a GPU waits for the device.

        Raises:
            ValueError: The state has another shape or type, or is not finite.
        """
        check_tensor(state, "state", self._state_view)
        self._set_mask(mask)
        if check and (bad := ~torch.isfinite(state) & self._mask_view[:, None]).any():
            world, column = bad.nonzero()[0].tolist()
            part = next(name for name, part in self.state_space.parts.items() if part.start <= column < part.stop)
            raise ValueError(
                f"the state of world {world} has {state[world, column].item()} in its {part!r}: it has to be finite"
            )
        self._state_view.copy_(state)
        self._run(self._unpack)

    # getters and setters of the paper's interface

    def get_obs(self, state: torch.Tensor | None = None, out: torch.Tensor | None = None) -> torch.Tensor:
        """Observations of the current states, or of given ones, (nworld, nobs)."""
        return self._given(self.obs if state is None else self._scratch_at(state).obs, out)

    def get_eval(self, state: torch.Tensor | None = None, out: torch.Tensor | None = None) -> torch.Tensor:
        """The evaluation metric after the last step, or of given states, (nworld,)."""
        return self._given(self.eval if state is None else self._scratch_at(state).eval, out)

    def get_terminated(self, state: torch.Tensor | None = None, out: torch.Tensor | None = None) -> torch.Tensor:
        """Whether the last step, or given states, end the episode, (nworld,) bool."""
        return self._given(self.terminated if state is None else self._scratch_at(state).terminated, out)

    def get_reward(
        self,
        before: torch.Tensor | None = None,
        action: torch.Tensor | None = None,
        after: torch.Tensor | None = None,
        out: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Rewards of the last step, or of given transitions, (nworld,).

        Given transitions are judged in scratch worlds; the live ones are untouched.

        Args:
            before: States before, (nworld, state_space.size).
            action: Actions, (nworld, nu).
            after: States after.
            out: Where to write the rewards.

        Raises:
            ValueError: Only a part of a transition is given, or it has the wrong shape or type.
        """
        if before is None and action is None and after is None:
            return self._given(self.reward, out)
        if before is None or action is None or after is None:
            raise ValueError("a reward belongs to a transition: give before, action and after, or none of them")
        check_tensor(action, "action", self.action)
        if not torch.isfinite(action).all():
            raise ValueError("an action is not finite: such a transition is a fault, and has no reward")
        scratch = self._scratch_at(before)
        for copy, live in scratch._pairs:
            wp.copy(copy, live)
        scratch.set_state(after)
        torch_view(scratch._safe_action).copy_(action)
        scratch._judge(scratch._everyone, scratch._no_fault, scratch._no_fault, transition=True)
        return self._given(scratch.reward, out)

    def get_action(self, out: torch.Tensor | None = None) -> torch.Tensor:
        """The actions of the next step, (nworld, nu)."""
        return self._given(self.action, out)

    def set_action(self, action: torch.Tensor) -> None:
        """Set the actions of the next step, with every check; ``env.action.copy_`` is the way without.

        Raises:
            ValueError: The action has another shape or type, or is not finite.
        """
        check_tensor(action, "action", self.action)
        if not torch.isfinite(action).all():
            world, i = (~torch.isfinite(action)).nonzero()[0].tolist()
            name = list(self.action_space.parts)[i]
            raise ValueError(f"the action {name!r} of world {world} is {action[world, i].item()}: it has to be finite")
        self.action.copy_(action.detach())

    @property
    def episode_step(self) -> torch.Tensor:
        """Steps since the reset, (nworld,), int32."""
        return self._step_view

    @property
    def time(self) -> torch.Tensor:
        """Simulated seconds since the reset, (nworld,), float32."""
        return self.field("time")

    def field(self, name: str, element: str | None = None) -> torch.Tensor:
        """A live view of one of the engine's fields, by MuJoCo's name.

        On the C engine it is a copy that every step renews: read it, and write through ``set_state``.

        Args:
            name: Attribute of MjData, for instance "qpos" or "site_xpos".
            element: A name from the model: a joint in "qpos" or "qvel", a sensor in "sensordata", a body,
                site, geom or camera elsewhere.

        Raises:
            ValueError: There is no such field or element, or the environment was made without it: see ``fields``.
        """
        if name not in self._views:
            if name not in self.engine.arrays:
                describe(self.model, name)
                raise ValueError(
                    f"this environment does not keep the field {name!r}: list it in the task's World, or give make() "
                    f"fields=[{name!r}]"
                )
            self._views[name] = torch_view(self.engine.arrays[name])
        view = self._views[name]
        if element is None:
            return view
        where = elements(self.model, name, element)
        one_object = view.ndim > 2 and not name.startswith("cdof")
        return view[:, where.start] if one_object else view[:, where]

    def set_params(self, **params: Any) -> None:
        """Change parameters of the task from the next step on, in place.

        Raises:
            ValueError: There is no such parameter, or the observation would change its size.
        """
        previous = self.task.params
        self.task.params = previous | self.task.checked_params(params)
        try:
            same = self.task.layout() == self.task.obs_layout
        except ValueError:  # one value a world, where the layout wants a single one
            same = False
        if not same:
            self.task.params = previous
            raise ValueError(f"{', '.join(params)} would change the observation's parts: make a new environment")
        self._given_params |= params
        changed = self.task.params_array(self.device)
        if changed.shape == self._params.shape:
            wp.copy(self._params, changed)
        else:
            self._params = changed
            self._record.forget()
        self._scratch = None

    def follow(self, other: "Env") -> None:
        """Take over the parameters of another environment of the same task, as ``replicate`` does."""
        self.set_params(**other._params_for(self.nworld))

    @property
    def bytes_per_world(self) -> float:
        """An estimate of the memory that a world takes, in bytes, without scratch worlds, which judge given states."""
        return self._bytes_per_world

    @property
    def fault_counts(self) -> dict[str, int]:
        """How often each kind of fault has happened since construction; waits for the device."""
        counts = self._fault_count.numpy()
        return {bit.name.lower(): int(counts[bit.bit_length() - 1]) for bit in FAULTS}  # type: ignore[union-attr]

    def replicate(self, *, nworld: int | None = None, **changes: Any) -> "Env":
        """Another environment of the same task with the same options and parameters, but for the given changes.

        Where a parameter has one value a world and the number of worlds differs, the values go round.
        """
        nworld = self.nworld if nworld is None else nworld
        options = self._options | {"horizon": self.horizon, "autoreset": self.autoreset}
        return Env(self.task.task, nworld=nworld, **(options | self._params_for(nworld) | changes))

    def replicate_few(self, nworld: int, **changes: Any) -> "Env":
        """``replicate`` for a few worlds, such as an evaluation's.

        On a GPU a step of a few worlds takes nearly as long as one of thousands. Where the choice was left to
        engine="auto", they step on CPU cores through the C engine, in double precision.
        """
        return self.replicate(nworld=nworld, **(few_worlds(self._options["engine"], self.device) | changes))

    def _params_for(self, nworld: int) -> dict[str, Any]:
        params = {}
        for name, given in self._given_params.items():
            value = self.task.params[name]
            params[name] = value[np.arange(nworld) % self.nworld] if isinstance(value, np.ndarray) else given
        return params

    # helpers

    def _fields_to_keep(self) -> list[Field]:
        task = self.task
        names = dict.fromkeys([*(name for name in task.fields if name != "memory"), *task.further, "time"])
        return [describe(self.model, name, lagged=name in task.task.lagged) for name in names]

    def _own_bytes(self, kept: list[Field]) -> int:
        """An estimate of what this environment itself allocates for each world, in bytes."""
        snapshots = [field for field in kept if field.snapshot]
        state = state_space(self.model, snapshots, self.task.task.memory)
        fields = sum(field.size for field in kept)
        return 8 * fields + 8 * state.size + 8 * sum(self.task.obs_layout.values()) + 200

    def _scratch_at(self, given: torch.Tensor) -> "Env":
        """Worlds of the same task for judging given states; made when first needed."""
        if self._scratch is None:
            self._scratch = self.replicate()
        self._scratch.set_state(given)
        return self._scratch

    def _given(self, values: torch.Tensor, out: torch.Tensor | None) -> torch.Tensor:
        if out is None:
            return values.clone()
        check_tensor(out, "out", values)
        return out.copy_(values)
