"""Define the interface between an environment and its physics engine."""

import abc
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.fields import Field, Stage, describe
from lyceum_warp.graphs.capture import Phase
from lyceum_warp.kernels.state import narrow, widen
from lyceum_warp.model_fields import ModelField, check_simple
from lyceum_warp.support.arrays import flat, launch_rows
from lyceum_warp.support.docstrings import document_attributes


@document_attributes
class Engine(abc.ABC):
    """Many worlds of one model, stepped together.

    An engine knows nothing of tasks. The fields of an engine are Warp arrays with a leading ``nworld`` axis. The
    addresses of the fields never change, so graphs that read fields are captured once.

    The order of calls in a step is: write ``ctrl`` and other inputs, call ``step`` and ``find_faults``, read fields and
    ``fault``. For worlds that restart, the caller then calls ``reset``, writes state fields and model fields, and calls
    ``commit``, ``apply_model``, optionally ``settle``, and ``refresh``. A new engine holds no state: reset all worlds
    first. Model fields start at the model's values, and resets do not change them.

    Args:
        model: The compiled model; the engine stores it and does not change it.
        nworld: Number of worlds.
        device: Where the arrays live.
        fields: The fields to provide, from ``fields.describe``. Other fields cannot be read later.
        dynamics: The model fields that differ between worlds, from ``model_fields.describe_model_field``.
        initial: The state that ``reset`` puts worlds into, (integration_size,); None for the model's own.

    Raises:
        ValueError: A field is listed both lagged and current, the initial state has the wrong shape, or a model field
            cannot differ between worlds of this model.
    """

    name: str
    """The engine's name, as in ``make(engine=...)``."""
    launch_threads: int = 1
    """Threads that share the worlds in kernel launches around a step.

    An engine with several threads must launch kernels only through ``lyceum_warp.support.arrays``.
    """
    capturable: bool
    """Whether every method consists of Warp launches, so that a whole step can be captured as one graph.

    On other engines, only methods documented as Warp launches are captured.
    """
    model: mujoco.MjModel
    """The compiled model."""
    nworld: int
    """Number of worlds."""
    device: wp.Device
    """Where the arrays live."""
    fields: dict[str, Field]
    """The fields that the engine provides, by name; always includes ``ctrl``."""
    dynamics: dict[str, ModelField]
    """The model fields that differ between worlds, by name."""
    nominal: dict[str, wp.array]
    """The model's own values of these fields, (1, ...), float32."""
    initial: np.ndarray
    """The state that ``reset`` puts worlds into, (integration_size,), float64."""
    arrays: dict[str, wp.array]
    """The live arrays of the fields and model fields, (nworld, ...), by name; filled by each engine's constructor."""
    ctrl: wp.array
    """Controls of the next step, (nworld, nu), float32; ``arrays["ctrl"]``, reset and restored with the state."""
    fault: wp.array
    """Bits of ``Done`` for each world, (nworld,), int32; set by ``find_faults``."""
    stage: Stage
    """The last stage that must run after the substeps, so that fields match the new state."""
    reset_stage: Stage
    """The last stage that must run after a reset."""
    snapshots: list[Field]
    """Fields that are not a function of the integration state, in state-vector order."""
    integration_size: int
    """Number of floats in one world's integration state (mjSTATE_INTEGRATION)."""
    state_size: int
    """Number of floats in one world's state: the integration state, the snapshots, and the model fields."""

    def __init__(
        self, model: mujoco.MjModel, nworld: int, device: wp.Device, fields: Iterable[Field],
        dynamics: Iterable[ModelField] = (), initial: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        self.model, self.nworld, self.device = model, nworld, device
        self.fields = {}
        for field in (describe(model, "ctrl"), *fields):
            if self.fields.setdefault(field.name, field) != field:
                raise ValueError(f"the field {field.name!r} is listed both lagged and current: list it once")
        self.dynamics, self.nominal, self.arrays = {}, {}, {}
        for varied in dynamics:
            check_simple(model, varied.name)
            self.dynamics[varied.name] = varied
            self.nominal[varied.name] = self._nominal_rows(varied, 1)
        self.fault = wp.zeros(nworld, dtype=int, device=device)
        self.stage = max(field.refresh for field in self.fields.values())
        self.reset_stage = max(field.reset for field in self.fields.values())
        self.snapshots = [field for field in self.fields.values() if field.snapshot]
        self.integration_size = _integration_size(model)
        self.state_size = self.integration_size + sum(field.size for field in self._saved())
        self.initial = _initial_state(model) if initial is None else np.array(initial, dtype=np.float64)
        if self.initial.shape != (self.integration_size,):
            raise ValueError(f"an initial state has the shape ({self.integration_size},), not {self.initial.shape}")
        self._everyone = wp.full(nworld, True, dtype=bool, device=device)

    def _nominal_rows(self, field: ModelField, rows: int) -> wp.array:
        """Make an array of a model field, with the model's own value in every row."""
        value = np.tile(field.value(self.model).astype(np.float32).reshape(-1), (rows, 1))
        array: wp.array = wp.zeros((rows, *field.shape), dtype=field.dtype, device=self.device)
        if value.size:
            wp.copy(flat(array), wp.array(value, dtype=wp.float32, device=self.device))
        return array

    @classmethod
    def bytes_per_world(
        cls, model: mujoco.MjModel, fields: Iterable[Field], dynamics: Iterable[ModelField] = (), **options: Any
    ) -> int:
        """Estimated bytes of memory per world; takes the constructor's arguments.

        The default counts a float64 state and one float32 array for each field.
        """
        floats = sum(field.size for field in fields) + sum(field.size for field in dynamics)
        return 8 * _integration_size(model) + 4 * floats + 8

    def prepare_capture(self) -> None:  # noqa: B027
        """Allocate memory for graphs; called once every kernel is compiled, before the first capture.

        Raises:
            ValueError: The memory is too small for this many worlds.
        """

    # physics

    @abc.abstractmethod
    def step(self, nstep: int) -> None:
        """Advance every world by ``nstep`` substeps under ``ctrl`` and the other inputs, and update the fields.

        The engine first reads the arrays of all fields with ``written``.
        """

    def step_phases(self, nstep: int) -> list[Phase]:
        """The phases of ``step``. So an engine that is not ``capturable`` can still capture its copies of fields."""
        return [Phase("physics", partial(self.step, nstep), engine=True)]

    @abc.abstractmethod
    def find_faults(self, mask: wp.array) -> None:
        """Write the masked worlds' ``fault``: non-finite states, and overflows and warnings since the last call.

        Made of Warp launches on every engine.
        """

    def check_room(self) -> None:  # noqa: B027
        """Log a warning if worlds need more contacts or constraints than fit; called once, after the first reset."""

    @abc.abstractmethod
    def reset(self, mask: wp.array) -> None:
        """Put the masked worlds into the model's initial state, state fields included.

        Consists of Warp launches on every engine. ``refresh`` then updates derived fields.
        """

    @abc.abstractmethod
    def commit(self, mask: wp.array, names: Collection[str] | None = None) -> None:
        """Copy the masked worlds' state fields, by default all, into the engine.

        Made of Warp launches.
        """

    def apply_model(self, mask: wp.array) -> None:
        """Apply the masked worlds' model fields, and recompute the constants derived from them.

        Unchanged values cost almost nothing. ``refresh`` or ``refresh_current`` then updates derived fields. An engine
        that accepts ``dynamics`` must implement this method.
        """
        if self.dynamics:
            raise NotImplementedError(f"the {self.name} engine does not let model fields differ between worlds")

    def settle(self, mask: wp.array, nstep: int) -> None:
        """Advance only the masked worlds by ``nstep`` substeps from their committed states, and update state fields.

        Afterwards the time of these worlds is 0; ``refresh`` then updates derived fields. No bit of any other world
        changes.
        """
        raise NotImplementedError(f"the {self.name} engine cannot settle individual worlds")

    def run_for(self, mask: wp.array, run: Callable[[], None]) -> None:
        """Run launches that affect only the masked worlds; a capturable engine may skip them if the mask is empty."""
        run()

    @abc.abstractmethod
    def refresh(self, mask: wp.array) -> None:
        """Compute the masked worlds' derived fields from their states; other worlds do not change."""

    @abc.abstractmethod
    def refresh_current(self, mask: wp.array) -> None:
        """Compute the masked worlds' derived fields and sensors that belong to the current state.

        Fields and sensors of the acceleration stage keep their values from the last substep. Other worlds and all
        sensor histories do not change.
        """

    # rollouts

    def rollout(self, state: wp.array, controls: wp.array, nstep: int, buffers: Mapping[str, wp.array]) -> None:
        """Roll out every world from a given state under given controls, and copy fields into buffers at each step.

        Afterwards the state fields and ``find_faults`` describe the final state; derived fields may be stale.

        Args:
            state: States to start from, (nworld, state_size or more) float64, as from ``get_state``.
            controls: Controls of each step, (steps, nworld, nu) float32.
            nstep: Substeps in a step.
            buffers: Destinations of fields and model fields, by name, (steps + 1, nworld, ...); row 0 is the initial
                state.
        """
        self.reset(self._everyone)  # clears the last rollout's warnings and warm starts
        self.set_state(state, self._everyone)
        self._copy_fields(buffers, 0)
        for t in range(len(controls)):
            if self.ctrl.size:
                wp.copy(self.ctrl, controls[t])
            self.step(nstep)
            self._copy_fields(buffers, t + 1)

    def rollout_bytes_per_world(self, steps: int, nstep: int, fields: Iterable[Field]) -> int:
        """Estimated bytes of memory per world for ``rollout``, without its arguments.

        Args:
            steps: Number of steps in the horizon.
            nstep: Substeps in a step.
            fields: Fields that are copied into buffers.
        """
        return 0

    def _copy_fields(self, buffers: Mapping[str, wp.array], t: int) -> None:
        for name, buffer in buffers.items():
            if buffer.size:
                wp.copy(buffer[t], self.arrays[name])

    # state

    def get_state(self, state: wp.array, mask: wp.array | None = None) -> None:
        """Write the masked worlds' states, by default all, into ``state``, (nworld, state_size) float64, exactly.

        Made of Warp launches.
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
        """Put the masked worlds into the given states, exactly; all fields match them afterwards."""
        self._set_integration(state[:, : self.integration_size], mask)
        if self.dynamics:
            self._read_columns(state, mask, self.dynamics.values(), self.state_size - self._dynamics_size)
            self.apply_model(mask)
        self.refresh_current(mask)
        self._read_columns(state, mask, self.snapshots, self.integration_size)

    def _read_columns(self, state: wp.array, mask: wp.array, fields: Iterable[Field | ModelField], start: int) -> None:
        """Read the masked worlds' fields from consecutive columns of a state, rounded to float32."""
        for field in fields:
            launch_rows(narrow, mask, state[:, start : start + field.size], flat(self.arrays[field.name]))
            start += field.size

    def _saved(self) -> list[Field | ModelField]:
        """The fields after the integration state in a state vector, in order."""
        return [*self.snapshots, *self.dynamics.values()]

    @property
    def _dynamics_size(self) -> int:
        """Number of columns of the model fields, which come last in a state."""
        return sum(field.size for field in self.dynamics.values())

    @abc.abstractmethod
    def _get_integration(self, state: wp.array, mask: wp.array) -> None: ...

    @abc.abstractmethod
    def _set_integration(self, state: wp.array, mask: wp.array) -> None: ...


EngineFactory = Callable[..., Engine]
"""Called with (model, nworld, device, fields, dynamics, initial, **options).

Engine classes are factories. If a factory has ``bytes_per_world``, as engine classes do, memory is checked first.
"""


def _integration_size(model: mujoco.MjModel) -> int:
    return mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value)


def _initial_state(model: mujoco.MjModel) -> np.ndarray:
    """The integration state of a new MjData."""
    state = np.empty(_integration_size(model))
    mujoco.mj_getState(model, mujoco.MjData(model), state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
    return state
