"""Define the interface between an environment and its physics engine."""

import abc
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.core.fields import Field, Stage, describe
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.graphs.capture import Phase
from lyceum_warp.kernels.state import narrow, widen
from lyceum_warp.support.arrays import flat, launch_rows


class Engine(abc.ABC):
    """Many worlds of one model, stepped together.

    An engine's fields are Warp arrays with a leading ``nworld`` axis. The addresses of these arrays never change. A
    mask, (nworld,) bool, selects the worlds to which a method applies.

    In each step, the caller writes ``ctrl`` and other inputs, calls ``step`` and ``find_faults``, and reads fields and
    ``fault``. To restart worlds, the caller first calls ``reset``. Then it writes state fields and model fields.
    Finally, it calls ``commit``, ``apply_model``, optionally ``settle``, and ``refresh``. A new engine holds no state,
    so reset all worlds first. Model fields start at the model's values, and resets do not change them.

    Args:
        model: The compiled model, which the engine does not change.
        nworld: Number of worlds.
        device: The device of the arrays.
        fields: The fields to provide, from ``fields.describe``.
        dynamics: The model fields that differ between worlds, from ``model_fields.describe_model_field``.
        initial: The initial state for ``reset``, (integration_size,); None for the model's initial state.

    Raises:
        ValueError: A field is listed both as lagged and as current. This error is also raised if a model field cannot
            differ between worlds of this model.
    """

    name: str
    """The engine's name, as in ``make(engine=...)``."""
    launch_threads: int = 1
    """The number of threads that launch kernels before and after a step. Each thread handles a part of the worlds.

    With several threads, an engine must launch kernels only through ``lyceum_warp.support.arrays``.
    """
    capturable: bool
    """Whether every method consists of Warp launches, so that one graph can capture a whole step.

    On other engines, only methods documented as Warp launches are captured.
    """
    model: mujoco.MjModel
    nworld: int
    device: wp.Device
    fields: dict[str, Field]
    """The fields that the engine provides, by name, always including ``ctrl``."""
    dynamics: dict[str, ModelField]
    nominal: dict[str, wp.array]
    """The nominal values of the fields in ``dynamics``, (1, ...) or, if they depend on the object, (objects, ...),
    float32."""
    initial: np.ndarray
    """The initial state of worlds after ``reset``, (integration_size,), float64."""
    arrays: dict[str, wp.array]
    """Maps the name of each field and model field to its array, (nworld, ...). The engine's constructor fills it."""
    ctrl: wp.array
    """The controls of the next step, (nworld, nu), float32. They are ``arrays["ctrl"]`` and part of the state."""
    fault: wp.array
    """The faults of each world as bits of ``Done``, (nworld,), int32; set by ``find_faults``."""
    stage: Stage
    """The stage up to which MuJoCo's forward pass must run after the substeps."""
    reset_stage: Stage
    """The stage up to which MuJoCo's forward pass must run after a reset."""
    snapshots: list[Field]
    """The fields that cannot be computed from the integration state. They have the order of the state vector."""
    integration_size: int
    """The number of floats in one world's integration state (mjSTATE_INTEGRATION)."""
    estimated_bytes: int = 0
    """The estimate of ``bytes_per_world``; 0 if the engine has none."""
    refreshes_all: bool = False
    """Whether ``refresh`` computes all derived fields in every world, and ``refresh_current`` does the same."""
    state_size: int
    """The number of floats in one world's state: the integration state, ``snapshots`` and the model fields."""

    def __init__(
        self, model: mujoco.MjModel, nworld: int, device: wp.Device, fields: Iterable[Field],
        dynamics: Iterable[ModelField] = (), initial: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.model, self.nworld, self.device = model, nworld, device
        self.fields = {}
        for field in (describe(model, "ctrl"), *fields):
            if self.fields.setdefault(field.name, field) != field:
                raise ValueError(f"the field {field.name!r} is listed twice, as lagged and as current: list it once")
        self.dynamics, self.nominal, self.arrays = {}, {}, {}
        for varied in dynamics:
            self.dynamics[varied.name] = varied
            self.nominal[varied.name] = self._array_of(varied, varied.nominal(model))
        self.fault = wp.zeros(nworld, dtype=int, device=device)
        self.stage = max(field.refresh for field in self.fields.values())
        self.reset_stage = max(field.reset for field in self.fields.values())
        self.snapshots = [field for field in self.fields.values() if field.snapshot]
        self.integration_size = _integration_size(model)
        self.state_size = self.integration_size + sum(field.size for field in self._saved())
        self.initial = _initial_state(model) if initial is None else np.array(initial, dtype=np.float64)
        self._everyone = wp.full(nworld, True, dtype=bool, device=device)

    def _array_of(self, field: ModelField, rows: np.ndarray) -> wp.array:
        """Make an array of a model field from rows, (n, size)."""
        array: wp.array = wp.zeros((len(rows), *field.shape), dtype=field.dtype, device=self.device)
        if rows.size:
            wp.copy(flat(array), wp.array(rows, dtype=wp.float32, device=self.device))
        return array

    def _nominal_rows(self, field: ModelField, rows: int) -> wp.array:
        """Make an array of a model field, (rows, ...), with the model's values."""
        return self._array_of(field, np.tile(field.value(self.model).reshape(1, -1), (rows, 1)))

    @classmethod
    def bytes_per_world(
        cls, model: mujoco.MjModel, fields: Iterable[Field], dynamics: Iterable[ModelField] = (), **options: Any
    ) -> int:
        """Estimate the bytes of memory per world, from the constructor's arguments."""
        floats = sum(field.size for field in fields) + sum(field.size for field in dynamics)
        return 8 * _integration_size(model) + 4 * floats + 8

    def start_at(self, initial: np.ndarray) -> None:
        """Change the initial state of all later resets, (integration_size,)."""
        self.initial = initial

    def prepare_capture(self) -> None:  # noqa: B027
        """Allocate memory for graphs, after all kernels have been compiled and before the first capture.

        Raises:
            ValueError: The memory is too small for this many worlds.
        """

    # physics

    @abc.abstractmethod
    def step(self, nstep: int) -> None:
        """Advance every world by ``nstep`` substeps, and update the fields.

        The step reads ``ctrl`` and the other fields whose ``written`` is True.
        """

    def step_phases(self, nstep: int, *, first: bool = True, last: bool = True, rendered: bool = False) -> list[Phase]:
        """Return ``step`` as a list of phases, which ``Graphs`` can capture separately.

        Consecutive parts of a step are ``first``, ``last``, or neither. Until the last part, the fields of the position
        and velocity stages may be outdated. ``rendered`` tells that pictures of the states before the step have been
        rendered, so the step may skip the kinematics.
        """
        return [Phase("physics", partial(self.step, nstep), engine=True)]

    @abc.abstractmethod
    def find_faults(self, mask: wp.array) -> None:
        """Find the masked worlds' faults since the last call, and write them to ``fault``.

        Every engine must implement this method by Warp launches only, so that graphs can capture it.
        """

    @abc.abstractmethod
    def reset(self, mask: wp.array) -> None:
        """Put the masked worlds into the initial state.

        Every engine must implement this method by Warp launches only, so that graphs can capture it. The caller must
        then update derived fields by ``refresh``.
        """

    @abc.abstractmethod
    def commit(self, mask: wp.array, names: Collection[str] | None = None) -> None:
        """Copy state fields of the masked worlds into the engine, by Warp launches. By default, copy all fields."""

    def apply_model(self, mask: wp.array) -> None:
        """Apply the masked worlds' model fields, and recompute the constants derived from them.

        The caller must then update derived fields by ``refresh`` or ``refresh_current``.
        """
        if self.dynamics:
            raise NotImplementedError(f"the {self.name} engine does not let model fields differ between worlds")

    def settle(self, mask: wp.array, nstep: int) -> None:
        """Advance only the masked worlds by ``nstep`` substeps, and update state fields.

        The time of these worlds is then 0. The caller must update derived fields by ``refresh``. Other worlds stay
        exactly the same.
        """
        raise NotImplementedError(
            f"the {self.name} engine does not support settle={nstep}: set the task's settle to 0, or use another engine"
        )

    def run_for(self, mask: wp.array, run: Callable[[], None]) -> None:
        """Run launches that affect only the masked worlds; capturable engines may skip them if the mask is empty."""
        run()

    @abc.abstractmethod
    def refresh(self, mask: wp.array) -> None:
        """Compute the masked worlds' derived fields from their states; other worlds do not change."""

    @abc.abstractmethod
    def refresh_current(self, mask: wp.array) -> None:
        """Compute the derived fields and sensors of the masked worlds, except those of the acceleration stage.

        Fields and sensors of the acceleration stage keep their values from the last substep. Other worlds and the
        histories of sensors do not change.
        """

    # rollouts

    def rollout(self, state: wp.array, controls: wp.array, nstep: int, buffers: Mapping[str, wp.array]) -> None:
        """Roll out every world from a given state, and copy fields into buffers at each step.

        Afterwards, the state fields and ``find_faults`` refer to the final states. Derived fields may be stale.

        Args:
            state: Initial states, (nworld, state_size or more) float64, such as those of ``get_state``.
            controls: Controls of each step, (steps, nworld, nu) float32.
            nstep: Substeps in a step.
            buffers: Destinations of fields and model fields, by name, (steps + 1, nworld, ...); row 0 is the initial
                state.
        """
        self.reset(self._everyone)  # clear warm starts
        self.set_state(state, self._everyone)
        self._copy_fields(buffers, 0)
        for t in range(len(controls)):
            if self.ctrl.size:
                wp.copy(self.ctrl, controls[t])
            self.step(nstep)
            self._copy_fields(buffers, t + 1)

    def rollout_bytes_per_world(self, steps: int, nstep: int, fields: Iterable[Field]) -> int:
        """Estimate the bytes of memory per world that ``rollout`` needs in addition to its arguments."""
        return 0

    def _copy_fields(self, buffers: Mapping[str, wp.array], t: int) -> None:
        for name, buffer in buffers.items():
            if buffer.size:
                wp.copy(buffer[t], self.arrays[name])

    # state

    def get_state(self, state: wp.array, mask: wp.array | None = None) -> None:
        """Copy the exact states of the masked worlds, or of all worlds, into ``state``, by Warp launches.

        The state is (nworld, state_size) float64.
        """
        mask = self._everyone if mask is None else mask
        self._get_integration(state[:, : self.integration_size], mask)
        start = self.integration_size
        for field in self._saved():
            source = flat(self.arrays[field.name])
            target = state[:, start : start + field.size]
            launch_rows(widen, mask, source, target)
            start += field.size

    def set_state(self, state: wp.array, mask: wp.array) -> None:
        """Put the masked worlds exactly into the given states, and update all fields."""
        self._set_integration(state[:, : self.integration_size], mask)
        self._set_dynamics(state, mask)
        self.refresh_current(mask)
        self._read_columns(state, mask, self.snapshots, self.integration_size)

    def _set_dynamics(self, state: wp.array, mask: wp.array) -> None:
        if self.dynamics:
            size = sum(field.size for field in self.dynamics.values())
            self._read_columns(state, mask, self.dynamics.values(), self.state_size - size)
            self.apply_model(mask)

    def _read_columns(self, state: wp.array, mask: wp.array, fields: Iterable[Field | ModelField], start: int) -> None:
        for field in fields:
            launch_rows(narrow, mask, state[:, start : start + field.size], flat(self.arrays[field.name]))
            start += field.size

    def _saved(self) -> list[Field | ModelField]:
        return [*self.snapshots, *self.dynamics.values()]

    @abc.abstractmethod
    def _get_integration(self, state: wp.array, mask: wp.array) -> None: ...

    @abc.abstractmethod
    def _set_integration(self, state: wp.array, mask: wp.array) -> None: ...


EngineFactory = Callable[..., Engine]
"""A function that makes an engine from (model, nworld, device, fields, dynamics, initial, **options).

Engine classes are factories. If a factory has ``bytes_per_world``, the free memory is checked before the call.
"""


def _integration_size(model: mujoco.MjModel) -> int:
    return mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value)


def _initial_state(model: mujoco.MjModel) -> np.ndarray:
    state = np.empty(_integration_size(model))
    mujoco.mj_getState(model, mujoco.MjData(model), state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
    return state
