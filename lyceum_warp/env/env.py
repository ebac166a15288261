"""Make, step, reset and observe an environment, which runs one task in many worlds."""

import copy
import functools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.binding.attributes import check_fields
from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.compile_errors import explained
from lyceum_warp.binding.registry import errors_of, find_task, task_name
from lyceum_warp.core.cameras import Camera
from lyceum_warp.core.done import FAULTS
from lyceum_warp.core.fields import describe, elements, has_several_rows, is_data_field
from lyceum_warp.core.model_fields import describe_model_field, is_model_field, put_rows
from lyceum_warp.core.model_files import ModelSource
from lyceum_warp.core.options import OPTIONS, EnvOptions, PhysicsOptions
from lyceum_warp.core.spaces import Space
from lyceum_warp.core.task import Task
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.placement import options_for_few_worlds
from lyceum_warp.env.arrays import own_bytes_per_world
from lyceum_warp.env.probe import Probe
from lyceum_warp.env.worlds import Worlds, open_worlds
from lyceum_warp.graphs.compilation import compile_ahead
from lyceum_warp.kernels import shared_memory, step_types
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.support.collection import without_collection
from lyceum_warp.support.forks import call_once_gone, leave_in_parent
from lyceum_warp.support.suggestions import Named, did_you_mean
from lyceum_warp.support.tensors import check_tensor
from lyceum_warp.support.validate import check_group, check_kind, check_word, whole_number
from lyceum_warp.support.warp_log import start_warp

_BUFFERS = (*step_types.OUTCOMES, "obs", "final_obs", "action")


def make(  # noqa: D417
    task: str | Path | type[Task],
    *,
    nworld: int = 1,
    device: str | None = None,
    engine: str | Callable[..., Engine] = "auto",
    nthread: int | None = None,
    seed: int = 0,
    first_world: int = 0,
    autoreset: bool = True,
    horizon: int | None = None,
    graphs: bool = True,
    model: ModelSource | None = None,
    fields: Collection[str] = (),
    dynamics: Collection[str] = (),
    fitted: str | Path | None = None,
    fitted_draws: bool = False,
    objects: Collection[str] | None = None,
    cameras: Collection[Camera] | None = None,
    final_pictures: bool = False,
    physics: str | PhysicsOptions | None = None,
    frame_skip: int | None = None,
    timestep: float | None = None,
    cone: str | None = None,
    integrator: str | None = None,
    jacobian: str | None = None,
    impratio: float | None = None,
    solver: Mapping[str, int] | None = None,
    discardvisual: bool | None = None,
    nconmax: int | None = None,
    njmax: int | None = None,
    deterministic: bool | None = None,
    **params: Any,
) -> "Env":
    """Make an environment, as in ``make("hopper", nworld=64, ctrl_cost_weight=1e-2)``.

    Each option is a field of ``lw.EnvOptions`` or ``lw.PhysicsOptions``; ``help()`` of these classes describes it. For
    options in one object, call ``lw.Env``.

    Args:
        task: Name of a task, a task file (path/to/file.py, or path/to/file.py:Class), or a task class.
        **params: Parameters of the task, fields of its ``Params``. A scalar may also be given as one value per world,
            (nworld,). A table is an array, a tensor, a nested list, or the path of a ``.npy`` file.

    Raises:
        ValueError: An argument is unknown or not valid; the message names the argument and the fix.
        FileNotFoundError: A model file or a task file is missing.
    """
    options = {name: value for name, value in locals().items() if name in OPTIONS and value is not None}
    return Env(task, EnvOptions().changed(options), params)


class Env:
    """One task in many worlds. Every array is allocated once and shared with torch.

    Write ``action``, call ``step``, and read the other buffers: unlike in Gymnasium, ``step`` and the resets return
    nothing. When an episode ends, the world starts a new random episode in the same step. ``obs`` is then the new
    episode's first observation, and ``final_obs`` is the old episode's last observation.

    A world with a fault (see ``Done``) restarts and leaves all other worlds unchanged. ``fault_counts`` counts the
    faults. After a fault, the reward is 0, and ``final_obs`` is the last valid observation. On the Warp engine, all
    worlds share a pool of contacts. If the pool is full, every world whose contacts do not fit has a fault.

    On a GPU, use the tensors on torch's default stream, which is synchronised with Warp's stream. Synchronise any other
    stream yourself.

    Args:
        task: Name of a task, a task file (path/to/file.py, or path/to/file.py:Class), or a task class.
        options: The options.
        params: Parameters of the task by name, as in ``make``.

    Raises:
        ValueError: An argument is unknown or not valid; the message names the argument and the fix.
        FileNotFoundError: A model file or a task file is missing.
    """

    obs: torch.Tensor
    """Observations, (nworld, nobs), float32."""
    final_obs: torch.Tensor
    """Observations after the last step, before any reset, (nworld, nobs), float32."""
    obs_groups: dict[str, torch.Tensor]
    """Observations by group, each (nworld, group size). The group ``policy`` is ``obs``. A camera's group has its
    pictures, (nworld, height, width, channels); see ``lw.Camera``."""
    final_obs_groups: dict[str, torch.Tensor]
    """``final_obs`` of each group. Cameras have final pictures only if the option ``final_pictures`` is set."""
    reward: torch.Tensor
    """Rewards of the last step, (nworld,), float32."""
    eval: torch.Tensor
    """The task's evaluation metric after the last step, (nworld,), float32."""
    terminated: torch.Tensor
    """Whether the task ended the episode, (nworld,), bool."""
    truncated: torch.Tensor
    """Whether the time limit, the task's ``truncated`` or a fault ended the episode, (nworld,), bool."""
    metrics: dict[str, torch.Tensor]
    """The task's metrics of the last step by name, each (nworld,), float32."""
    episode_metrics: dict[str, torch.Tensor]
    """Sums of the metrics over the episode so far, each (nworld,), float32."""
    episode_metric_sums: torch.Tensor
    """``episode_metrics`` as one tensor, (nworld, number of metrics)."""
    shared: dict[str, torch.Tensor]
    """The memory that all worlds share: a tensor for each field of ``Shared``. Only ``update_shared`` changes it."""
    lasting: dict[str, torch.Tensor]
    """Lasting memory by name, such as a curriculum's level, each (nworld, size). ``rand_reset(seed=...)`` clears it."""
    success: torch.Tensor
    """Whether the goal was met in each of the last ``success_steps`` steps, (nworld,), bool."""
    done: torch.Tensor
    """Whether the episode ended for any reason, (nworld,), bool."""
    done_reason: torch.Tensor
    """Reasons why the episode ended, as bits of ``Done``, (nworld,), int32."""
    action: torch.Tensor
    """Actions of the next step, (nworld, nact), float32. A non-finite action is a fault and becomes zero."""
    episode_step: torch.Tensor
    """Steps since the reset, (nworld,), int32."""
    time: torch.Tensor
    """Simulated seconds since the reset, (nworld,), float32."""
    nworld: int
    """Number of worlds."""
    timestep: float
    """Simulated duration of a step, in seconds."""
    device: wp.Device
    """The Warp device."""
    options: EnvOptions
    """The options of the environment."""
    task: BoundTask
    """The task with its model, its parameters (``task.params``) and its kernels."""
    engine: Engine
    """The physics engine; ``engine.name`` is "mujoco" or "warp"."""
    worlds: Worlds
    """The arrays of the environment, for internal use."""
    obs_space: Space
    """Parts of an observation and their columns."""
    obs_spaces: dict[str, Space]
    """Spaces of all groups of observations."""
    action_space: Space
    """Names, columns and bounds of actions."""
    state_space: Space
    """Parts of a state and their columns."""
    reward_space: Space
    """A scalar."""
    eval_space: Space
    """A scalar."""

    def __init__(
        self,
        task: str | Path | type[Task],
        options: EnvOptions | None = None,
        params: Mapping[str, Any] | None = None,
        *,
        _replica: bool = False,
    ) -> None:
        check_kind("options", options, EnvOptions | None, "as lw.EnvOptions(nworld=64)")
        task, options, params = find_task(task), options or EnvOptions(), dict(params or {})
        self._given_params = params
        self._scratch: Env | None = None
        with errors_of(task), without_collection():
            self.options = options = options.changed({"physics": options.physics.resolved(task.physics)})
            self.worlds = worlds = open_worlds(task, options, params)
            self.task, self.engine, self.device = worlds.task, worlds.engine, worlds.device
            self.nworld, self.timestep = options.nworld, self.task.timestep
            try:
                call_once_gone(self, worlds.drop_programs)
                for name, buffer in worlds.buffers.items():
                    setattr(self, name, buffer)
                self.obs_groups = worlds.obs_groups | worlds.picture_groups
                self.final_obs_groups = worlds.final_obs_groups | worlds.final_picture_groups
                self.obs_space = worlds.obs_spaces["policy"]
                self.obs_spaces = worlds.obs_spaces | worlds.picture_spaces
                self.action_space, self.state_space = worlds.action_space, worlds.state_space
                self.metrics, self.episode_metrics = (
                    Named("metric", zip(self.task.metrics, torch_view(array).unbind(1), strict=True))
                    for array in (worlds.metrics, worlds.episode_metrics)
                )
                self.episode_metric_sums = torch_view(worlds.episode_metrics)
                memory = torch_view(worlds.shared)[0]
                self.shared = {name: memory[part.start : part.start + part.size]
                               for name, part in self.task.layouts.shared.get("Shared", {}).items()}  # fmt: skip
                lasting = torch_view(worlds.lasting_memory)
                self.lasting = {name: lasting[:, part.start : part.start + part.size]
                                for name, part in self.task.layouts.memory["lasting_memory"].items()}  # fmt: skip
                self.reward_space = self.eval_space = Space()
                self._fields = {name: torch_view(array) for name, array in worlds.fields.items()}
                self.time, self.episode_step = self._fields["time"], torch_view(worlds.counters.step)
                compile_ahead(worlds.rehearsal, self.device, self.task.name)
                if self.engine.capturable and options.graphs:
                    self.engine.prepare_capture()
                if self.task.fit is not None:
                    worlds.hold_first_controls()
                self.engine.reset(worlds.everyone)
                Probe(worlds).check_bounds()  # a write out of range would damage the environment's own arrays
                self.rand_reset(options.seed)
                if self.task.dynamics and not _replica:  # after construction, invalid values are faults
                    self._check_dynamics(self._fields)
                Probe(worlds).check_observations()
            except Exception as error:
                if (clear := explained(error, self.task)) is error:
                    raise
                raise clear from None
        leave_in_parent(self, "worlds", "engine")

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__ and name in _BUFFERS:
            raise AttributeError(
                f"env.{name} is a buffer at a fixed address: write into the buffer, as env.{name}.copy_(...)"
            )
        super().__setattr__(name, value)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            hint = did_you_mean(name, [*Env.__annotations__, *vars(self)], "help(lw.Env) lists the attributes")
            if is_data_field(name) or is_model_field(name):
                hint = f"use env.field({name!r})"
            raise AttributeError(f"an environment has no {name!r}: {hint}")

    @functools.cached_property
    def model(self) -> mujoco.MjModel:
        """A copy of the compiled model, whose arrays are read-only, because the engine has a copy of its own.

        To change the physics, pass an edited MjSpec as ``model=``. To change model fields per world, list them in the
        task's ``World`` and write them in ``startup`` or ``randomize``. ``copy.copy(env.model)`` can be edited.
        """
        model = copy.copy(self.task.model)
        for part in (model, model.opt):
            for name in dir(part):
                if isinstance(array := getattr(part, name), np.ndarray):
                    array.flags.writeable = False
        return model

    @property
    def horizon(self) -> int:
        """Number of steps after which an episode is truncated, or 0 for never."""
        return self.worlds.horizon

    @property
    def first_world(self) -> int:
        """Index of the first world among the worlds of all processes."""
        return self.options.first_world

    @property
    def autoreset(self) -> bool:
        """Whether a world starts a new episode in the step that ends the old one."""
        return self.worlds.autoreset

    # the step

    def step(self, action: torch.Tensor | None = None) -> None:
        """Advance every world by one step, and start new episodes in worlds whose episode ended.

        The phases are act, physics, judge, restart, refresh and observe; ``Worlds.step_phases`` lists them.

        Args:
            action: Actions to copy into ``env.action`` before the step, (nworld, nact).

        Raises:
            ValueError: The action has the wrong shape or type.
        """
        if action is not None:
            check_tensor(action, "action", self.action)
            self.action.copy_(action.detach())
        for call in self.worlds.programs.step:
            call()

    # resets

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Reset worlds to the task's fixed initial state, and zero their actions.

        Args:
            mask: Worlds to change, (nworld,) bool; by default all.
        """
        worlds = self.worlds
        worlds.set_mask(mask)
        self.action.masked_fill_(worlds.mask_view[:, None], 0.0)
        for call in worlds.programs.reset:
            call()

    def rand_reset(
        self, seed: int | None = None, mask: torch.Tensor | None = None, *, first_world: int | None = None
    ) -> None:
        """Reset worlds to random initial states, and zero their actions.

        Args:
            seed: Seed of the worlds' random streams. By default, each world continues its stream.
            mask: Worlds to change, (nworld,) bool; by default all.
            first_world: Index of the first world in the random streams; by default the option ``first_world``. World i
                gets the stream of world ``first_world + i``.
        """
        worlds = self.worlds
        worlds.set_mask(mask)
        if seed is not None:
            first = self.first_world if first_world is None else first_world
            worlds.seed_streams(whole_number("seed", seed, low=0), first)
        self.action.masked_fill_(worlds.mask_view[:, None], 0.0)
        for call in worlds.programs.rand_reset:
            call()

    # the state

    def get_state(self, out: torch.Tensor | None = None, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Get the complete state of every world, (nworld, state_space.size), float64.

        A state has everything that determines the future of its world. It includes the engine's integration state, the
        world's own model fields, counters, the random stream and the task's memory. ``state_space.parts`` names the
        columns of a state.

        Args:
            out: Tensor into which the states are written.
            mask: Worlds whose rows of ``out`` are written, (nworld,) bool; by default all.

        Raises:
            ValueError: An argument has the wrong shape or type, or a mask is given without ``out``.
        """
        worlds = self.worlds
        for call in worlds.programs.read_state:
            call()
        if mask is None:
            return _copied(worlds.state_view, out)
        if out is None:
            raise ValueError("get_state(mask=...) needs a tensor to write into: pass the tensor as out=...")
        check_tensor(out, "out", worlds.state_view)
        worlds.set_mask(mask)
        return torch.where(worlds.mask_view[:, None], worlds.state_view, out, out=out)

    def set_state(self, state: torch.Tensor, mask: torch.Tensor | None = None, *, check: bool = True) -> None:
        """Set worlds to states from ``get_state``. All getters then return the values of these states.

        The reward becomes 0, because there was no transition.

        Args:
            state: States, (nworld, state_space.size), float64.
            mask: Worlds to change, (nworld,) bool; by default all.
            check: Whether to refuse states that are not finite. On a GPU, this waits for the device.

        Raises:
            ValueError: The state has the wrong shape or type, or is not finite.
        """
        worlds = self.worlds
        check_tensor(state, "state", worlds.state_view)
        worlds.set_mask(mask)
        if check and (bad := ~torch.isfinite(state) & worlds.mask_view[:, None]).any():
            world, column = bad.nonzero()[0].tolist()
            part, number = self.state_space.part_at(column), state[world, column].item()
            raise ValueError(f"the state of world {world} has {number} in its {part!r}: states must be finite")
        if check and self.task.objects:
            self._check_objects(state)
        worlds.state_view.copy_(state)
        for call in worlds.programs.restore_state:
            call()

    def _check_objects(self, state: torch.Tensor) -> None:
        """Raise a ValueError if a state that will be set has an object that no world of this environment can hold."""
        parts, indices = self.state_space.parts, list(self.task.objects.values())
        held = state[:, parts["object"]].squeeze(1)
        bad = ~torch.isin(held, torch.tensor(indices, dtype=held.dtype, device=held.device))
        if "geom_dataid" in parts:  # in an environment with other objects, meshes may have other indices
            meshes = self.worlds.nominal_rows("geom_dataid", held.clamp(0, max(indices)))
            bad |= (state[:, parts["geom_dataid"]] != meshes).any(1)
        if (bad := bad & self.worlds.mask_view).any():
            world = int(bad.nonzero()[0])
            raise ValueError(
                f"the state of world {world} holds an object of another environment (index {held[world].item():g}): "
                f"this environment was made with objects={list(self.task.objects)}"
            )

    # getters and setters

    def get_obs(
        self, state: torch.Tensor | None = None, out: torch.Tensor | None = None, *, group: str = "policy"
    ) -> torch.Tensor:
        """Get observations of the current states, or of given states, (nworld, nobs).

        Args:
            state: States to observe, (nworld, state_space.size).
            out: Tensor into which the observations are written.
            group: Name of the observation group.

        Raises:
            ValueError: There is no group of this name, or an argument has the wrong shape or type.
        """
        check_group(group, self.obs_groups, self.task.name)
        return _copied((self if state is None else self._scratch_at(state)).obs_groups[group], out)

    def get_eval(self, state: torch.Tensor | None = None, out: torch.Tensor | None = None) -> torch.Tensor:
        """Get the evaluation metric of the last step or of given states, (nworld,)."""
        return _copied(self.eval if state is None else self._scratch_at(state).eval, out)

    def get_terminated(self, state: torch.Tensor | None = None, out: torch.Tensor | None = None) -> torch.Tensor:
        """Get the terminations of the last step, or whether given states are terminal, (nworld,) bool."""
        return _copied(self.terminated if state is None else self._scratch_at(state).worlds.terminated_view, out)

    def get_reward(
        self, before: torch.Tensor | None = None, action: torch.Tensor | None = None,
        after: torch.Tensor | None = None, out: torch.Tensor | None = None,
    ) -> torch.Tensor:  # fmt: skip
        """Get the rewards of the last step or of given transitions, (nworld,).

        The environment does not change. Events run after the reward. The result thus differs from ``env.reward`` if an
        event changed fields that the reward reads.

        Args:
            before: States before the transitions, (nworld, state_space.size).
            action: Actions of the transitions, (nworld, nact).
            after: States after the transitions.
            out: Tensor into which the rewards are written.

        Raises:
            ValueError: Only part of a transition is given, or an argument has the wrong shape or type.
        """
        if before is None and action is None and after is None:
            return _copied(self.reward, out)
        if before is None or action is None or after is None:
            raise ValueError("a reward belongs to a transition: pass before, action and after, or none of the three")
        self._check_action(action)
        scratch = self._scratch_at(before)
        scratch.worlds.keep_before()
        scratch.set_state(after)
        scratch.worlds.judge_transition(action)
        return _copied(scratch.reward, out)

    def get_action(self, out: torch.Tensor | None = None) -> torch.Tensor:
        """Get the actions of the next step, (nworld, nact)."""
        return _copied(self.action, out)

    def set_action(self, action: torch.Tensor) -> None:
        """Check and set the actions of the next step. ``env.action.copy_(...)`` does the same without a check.

        Raises:
            ValueError: The action has the wrong shape or type, or is not finite.
        """
        self._check_action(action)
        self.action.copy_(action.detach())

    def _check_action(self, action: torch.Tensor) -> None:
        check_tensor(action, "action", self.action)
        if not torch.isfinite(action).all():
            world, i = (~torch.isfinite(action)).nonzero()[0].tolist()
            name = self.action_space.part_at(i)
            raise ValueError(f"the action {name!r} of world {world} is {action[world, i].item()}: it must be finite")

    def field(self, name: str, element: str | None = None) -> torch.Tensor:
        """Get a live view of a field of MjData or MjModel, by MuJoCo's name.

        The views of ``time``, ``ctrl`` and the fields that the task reads are always available. Request other fields
        with ``make("hopper", fields=["site_xpos", "body_mass"])``. Do not write to the view: use ``set_state`` or
        ``set_dynamics``.

        Args:
            name: Attribute of MjData or MjModel, for instance "qpos", "site_xpos" or "body_mass".
            element: Name of an element of the model, such as a joint for "qpos", a sensor for "sensordata", a body or a
                site.

        Raises:
            ValueError: The environment has no such field, or the model has no element of this name.
        """
        if name not in self._fields:
            check_fields([name])
            (describe_model_field if is_model_field(name) else describe)(self.task.model, name)
            raise ValueError(
                f"this environment of {self.task.name!r} does not provide the field {name!r}: make the environment "
                f"with fields=[{name!r}] (it provides {', '.join(sorted(self._fields))})"
            )
        view = self._fields[name]
        if element is None:
            return view
        where = elements(self.task.model, name, element)
        one_object = view.ndim > 2 and not has_several_rows(name)
        return view[:, where.start] if one_object else view[:, where]

    def set_dynamics(self, mask: torch.Tensor | None = None, **fields: Any) -> None:
        """Set model fields of some or all worlds, and update constants that MuJoCo derives from them.

        The task must randomize the fields, or the option ``dynamics`` must list them. A reset restores the nominal
        values of fields that the task's ``initialize``, ``randomize`` or ``event`` writes. Other fields keep the new
        values until ``rand_reset(seed=...)``.

        Args:
            mask: Worlds to change, (nworld,) bool; by default all.
            fields: Values by name, as in ``body_mass=masses``, with one row per world or one row for all worlds.
                ``object`` takes the name of an object, or one name per world. The world's model fields that depend on
                the object then become nominal.

        Raises:
            ValueError: A field is not a model field that differs between worlds, or a value is invalid.
        """
        state = self.get_state()
        columns = self.state_space.split(state)
        with errors_of(self.task.definition):
            if (names := fields.pop("object", None)) is not None:
                self._put_objects([names] * self.nworld if isinstance(names, str) else names, columns)
            check_fields(fields)
            put_rows(self.task.model, fields, columns)
            self._check_dynamics({name: columns[name] for name in fields})
        self.set_state(state, mask)

    def _put_objects(self, names: Sequence[str], columns: Mapping[str, torch.Tensor]) -> None:
        objects = self.task.objects
        if len(names) != self.nworld or (unknown := [name for name in names if name not in objects]):
            what = f"{len(names)} names" if len(names) != self.nworld else repr(unknown[0])
            raise ValueError(
                f"object must be a name, or one name for each of the {self.nworld} worlds, not {what}: worlds hold "
                f"{', '.join(objects) or 'no objects'}"
            )
        held = torch.tensor([objects[name] for name in names], device=self.obs.device)
        for field in self.task.dynamics:
            if field.rows is not None:
                columns[field.name].copy_(self.worlds.nominal_rows(field.name, held))

    def _check_dynamics(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Raise a ValueError for the first invalid value of model fields, each (nworld, ...)."""
        for field in self.task.dynamics:
            if field.name in rows:
                values = rows[field.name].reshape(self.nworld, -1).cpu().numpy()
                if problem := field.problem(self.task.model, values):
                    raise ValueError(problem)

    # shared memory

    def update_shared(self, total: Callable[[torch.Tensor], object] | None = None) -> None:
        """Call the task's ``share`` to update ``shared`` from sums over all transitions since the last update.

        Observations that depend on ``shared`` are updated. Learners call this method after each rollout. It does not
        wait for the device.

        Args:
            total: Function that sums an int64 tensor over several processes in place, such as ``Team.sum``. All
                processes must then call ``update_shared``.
        """
        if self.shared and total is not None:
            total(torch_view(self.worlds.sums))
        self.worlds.update_shared()

    def get_shared(self) -> torch.Tensor:
        """Copy the memory that all worlds share, and the sums that the next ``update_shared`` uses.

        Returns:
            One vector, float64; empty if the task has no shared memory.
        """
        parts = (torch_view(self.worlds.shared)[0], torch_view(self.worlds.sums) / shared_memory.UNIT)
        return torch.cat([part.double() for part in parts])

    def set_shared(self, state: torch.Tensor) -> None:
        """Set the memory that all worlds share, and the sums that the next ``update_shared`` uses.

        Args:
            state: A result of ``get_shared`` for the same task.

        Raises:
            ValueError: The state has the wrong size or type.
        """
        check_tensor(state, "the state of shared memory", self.get_shared())
        size = self.worlds.shared.shape[1]
        torch_view(self.worlds.shared)[0].copy_(state[:size])
        torch_view(self.worlds.sums).copy_((state[size:] * shared_memory.UNIT).round())

    def _copy_shared(self, other: "Env") -> None:
        for name, memory in other.shared.items():
            self.shared[name].copy_(memory)

    # parameters and copies

    @property
    def given_params(self) -> dict[str, Any]:
        """The task parameters that were given by the user."""
        return dict(self._given_params)

    def set_params(self, **params: Any) -> None:
        """Change parameters of the task, from the next step on.

        Raises:
            ValueError: A parameter is unknown, or the size of the observation would change.
        """
        with errors_of(self.task.definition):
            self.task.change_params(params)
        self._given_params = self._given_params | params
        self.worlds.update_params()
        if self._scratch is not None:
            self._scratch.follow(self)

    def follow(self, other: "Env") -> None:
        """Copy the parameters and the shared memory of another environment of the same task.

        Raises:
            ValueError: ``other`` is not an environment, or its task has different parameters.
        """
        check_kind("other", other, Env, "an environment of the same task")
        self.set_params(**other._params_for(self.nworld, {**self._given_params, **other._given_params}))
        self._copy_shared(other)

    def replicate(self, *, nworld: int | None = None, **changes: Any) -> "Env":
        """Make another environment with the same task, options and parameters, except for the given changes.

        By default, ``seed`` and ``first_world`` become 0. If the number of worlds differs, parameters with one value
        per world are repeated or cut.
        """
        nworld = self.nworld if nworld is None else nworld
        # use the loaded model, because its file may have changed
        current = {"horizon": self.horizon, "autoreset": self.autoreset, "model": self.task.spec}
        options, params = EnvOptions.split(changes, self.options.changed(current | {"seed": 0, "first_world": 0}))
        options = options.changed({"nworld": nworld})
        params = self._params_for(nworld, self._given_params) | params
        replica = Env(self.task.definition, options, params, _replica=True)
        replica._copy_shared(self)
        return replica

    def replicate_few(self, nworld: int, **changes: Any) -> "Env":
        """Replicate the environment with only a few worlds, with the C engine if ``engine`` is "auto".

        On a GPU, a step of a few worlds takes nearly as long as a step of thousands. An environment with cameras keeps
        its engine.
        """
        # pictures of few worlds are rendered much faster on a GPU, and the C engine would render them on the CPU
        few = {} if self.task.cameras else options_for_few_worlds(self.options.engine, self.device)
        return self.replicate(nworld=nworld, **(few | changes))

    def _params_for(self, nworld: int, names: Iterable[str]) -> dict[str, Any]:
        parameters, worlds = self.task.parameters, np.arange(nworld) % self.nworld
        arguments = {name: value for name, value in self._given_params.items() if name not in parameters.tables}
        values = {name: (parameters.values | arguments)[name] for name in names}
        return values | {name: parameters.values[name][worlds] for name in names if name in parameters.per_world}

    def _scratch_at(self, state: torch.Tensor) -> "Env":
        if self._scratch is None:
            self._scratch = self.replicate()
        self._scratch._copy_shared(self)
        self._scratch.set_state(state)
        return self._scratch

    # diagnostics

    def check_process(self) -> None:
        """Raise RuntimeError if this process was forked after making the environment."""
        _ = self.worlds.programs

    @property
    def bytes_per_world(self) -> float:
        """Estimate the memory per world in bytes, without the model, which all worlds share."""
        return self.engine.estimated_bytes + own_bytes_per_world(self.task, self.engine.name)

    @property
    def fault_counts(self) -> dict[str, int]:
        """Count the faults of each kind since construction. This waits for the device."""
        counts = self.worlds.episodes.fault_count.numpy().sum(axis=0)
        return {bit.name.lower(): int(counts[bit.bit_length() - 1]) for bit in FAULTS}  # type: ignore[union-attr]


def compile_kernels(
    task: str | Path | type[Task],
    options: EnvOptions,
    params: Mapping[str, Any],
    *,
    arch: str,
    kernels: Iterable[wp.Kernel] = (),
) -> None:
    """Compile the kernels that an environment launches on a GPU into Warp's cache, on a machine without that GPU.

    Args:
        task: See ``Env``.
        options: The options of the environment. Its kernels do not depend on the number of worlds.
        params: Parameters of the task by name.
        arch: The CUDA architecture of the GPU, such as "sm_90".
        kernels: More kernels, whose modules are compiled, too.

    Raises:
        ValueError: An argument is not valid, ``deterministic`` is set, or MuJoCo Warp does not support the task's
            model.
    """
    task, _ = find_task(task), start_warp()
    numbers = {f"sm_{number}": number for number in wp.get_cuda_supported_archs()}
    check_word("arch", arch, list(numbers))
    if options.physics.deterministic:
        raise ValueError("deterministic=True needs the GPU to compile its kernels: compile on the GPU's machine")
    with errors_of(task):
        placement = {"physics": options.physics.resolved(task.physics), "engine": "warp", "device": "cpu"}
        options = options.changed(placement)

        def launch() -> None:
            open_worlds(task, options, params).rehearsal()
            for kernel in kernels:
                wp.launch(kernel, 1)

        compile_ahead(launch, None, task_name(task), arch=numbers[arch])


def _copied(values: torch.Tensor, out: torch.Tensor | None) -> torch.Tensor:
    if out is None:
        return values.clone()
    check_tensor(out, "out", values)
    return out.copy_(values)
