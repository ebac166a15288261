"""The contract between an environment and the physics behind it."""

import abc
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import mujoco
import warp as wp

from lyceum_warp.arrays import flat, launch_rows
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.fields import Field, Stage, describe
from lyceum_warp.kernels.state import narrow, widen


@document_attributes
class Engine(abc.ABC):
    """Many worlds of one model, stepped together.

    An engine knows nothing of tasks. Its fields lie in Warp arrays with a leading ``nworld`` axis, whose addresses
    never change, so that graphs of launches that read them can be captured once.

    The order of calls in a step is: write ``ctrl``, ``step``, ``find_faults``, read fields and ``fault``; for worlds
    that restart, ``reset``, then write state fields, then ``commit`` and ``refresh``. After construction the arrays
    hold no state yet: reset all worlds first.

    Args:
        model: The compiled model; the engine keeps it and does not change it.
        nworld: Number of worlds.
        device: Where the arrays live.
        fields: The fields to keep, from ``fields.describe``. No other field can be read later.

    Raises:
        ValueError: A field is listed twice, once lagged and once current.
    """

    name: str
    """The engine's name, as in ``make(engine=...)``."""
    capturable: bool
    """Whether every method is made of Warp launches, so that a whole step can be captured as one graph.

    Otherwise only the launches between two calls of ``step``, ``refresh`` and ``set_state`` are captured: the methods
    whose docstrings say so must be made of launches on every engine, on arrays whose addresses never change.
    """
    model: mujoco.MjModel
    """The compiled model."""
    nworld: int
    """Number of worlds."""
    device: wp.Device
    """Where the arrays live."""
    fields: dict[str, Field]
    """The fields that are kept, by name; ``ctrl`` is always among them."""
    arrays: dict[str, wp.array]
    """The live arrays of the fields, (nworld, ...), by name; filled by each engine's constructor."""
    ctrl: wp.array
    """Controls of the next step, (nworld, nu), float32: the field of that name, reset and restored with the state."""
    fault: wp.array
    """Bits of ``Done`` for each world, (nworld,), int32; set by ``find_faults``."""
    stage: Stage
    """The stage that must be computed after the substeps, for the fields that belong to the new state."""
    reset_stage: Stage
    """The stage that must be computed for worlds that were reset."""
    snapshots: list[Field]
    """Fields that are not a function of the integration state, in the order of the state vector."""
    integration_size: int
    """Floats in one world's integration state (mjSTATE_INTEGRATION)."""
    state_size: int
    """Floats in one world's state: the integration state and the snapshots."""

    def __init__(self, model: mujoco.MjModel, nworld: int, device: wp.Device, fields: Iterable[Field]) -> None:
        self.model = model
        self.nworld = nworld
        self.device = device
        self.fields = {}
        for field in (describe(model, "ctrl"), *fields):
            if self.fields.setdefault(field.name, field) != field:
                raise ValueError(f"the field {field.name!r} is listed both lagged and current: list it once")
        self.arrays = {}
        self.fault = wp.zeros(nworld, dtype=int, device=device)
        self.stage = max(field.refresh for field in self.fields.values())
        self.reset_stage = max(field.reset for field in self.fields.values())
        self.snapshots = [field for field in self.fields.values() if field.snapshot]
        self.integration_size = _integration_size(model)
        self.state_size = self.integration_size + sum(field.size for field in self.snapshots)
        self._everyone = wp.full(nworld, True, dtype=bool, device=device)

    @classmethod
    def bytes_per_world(cls, model: mujoco.MjModel, fields: Iterable[Field], **options: Any) -> int:
        """An estimate of the memory that the engine takes for each world, in bytes.

        The default counts a float64 state and one float32 array for each field.

        Args:
            model: The compiled model.
            fields: The fields that the engine will keep.
            options: The engine's options, as for its constructor.
        """
        return 8 * _integration_size(model) + 4 * sum(field.size for field in fields) + 8

    def prepare_capture(self) -> None:  # noqa: B027
        """Allocate the memory that graphs need; called when every kernel is compiled, before the first capture.

        Raises:
            ValueError: The memory is too small for this many worlds.
        """

    # physics

    @abc.abstractmethod
    def step(self, nstep: int) -> None:
        """Advance every world by ``nstep`` substeps under ``ctrl`` and update the fields."""

    @abc.abstractmethod
    def find_faults(self, mask: wp.array) -> None:
        """Write the masked worlds' ``fault``: a state that is not finite, and overflows and warnings since last time.

        Made of Warp launches on every engine.
        """

    @abc.abstractmethod
    def reset(self, mask: wp.array) -> None:
        """Put the masked worlds into the model's initial state, state fields included.

        Made of Warp launches on every engine. Derived fields follow with ``refresh``.
        """

    @abc.abstractmethod
    def commit(self, mask: wp.array) -> None:
        """Copy the masked worlds' state fields into the engine. Made of Warp launches."""

    @abc.abstractmethod
    def refresh(self, mask: wp.array) -> None:
        """Compute every derived field of the masked worlds as a forward pass at their state does.

        Worlds outside the mask keep their values.
        """

    @abc.abstractmethod
    def refresh_current(self, mask: wp.array) -> None:
        """Compute the masked worlds' fields that belong to the current state, and their sensors.

        Fields and sensors of the acceleration stage stay as the last substep left them. Other worlds, and all
        sensors' histories, stay as they are.
        """

    # rollouts

    def rollout(self, state: wp.array, controls: wp.array, nstep: int, buffers: Mapping[str, wp.array]) -> None:
        """Step every world from a given state under given controls, and copy fields into buffers along the way.

        Afterwards the state fields and ``find_faults`` describe the end; derived fields may belong to another time.

        Args:
            state: States to start from, whose leading columns are those of ``get_state``; (nworld, ...) float64.
            controls: Controls of each step, (steps, nworld, nu) float32.
            nstep: Substeps in a step.
            buffers: Where fields go, by their names, (steps + 1, nworld, ...): the first row is the start.
        """
        self.reset(self._everyone)  # clears warnings and warm starts of the last rollout
        self.set_state(state, self._everyone)
        self._copy_fields(buffers, 0)
        for t in range(len(controls)):
            wp.copy(self.ctrl, controls[t])
            self.step(nstep)
            self._copy_fields(buffers, t + 1)

    def rollout_bytes_per_world(self, steps: int, nstep: int, fields: Iterable[Field]) -> int:
        """An estimate of the memory that ``rollout`` takes for each world beside its arguments, in bytes.

        Args:
            steps: Steps of the horizon.
            nstep: Substeps in a step.
            fields: Fields that are copied into buffers.
        """
        return 0

    def _copy_fields(self, buffers: Mapping[str, wp.array], t: int) -> None:
        for name, buffer in buffers.items():
            wp.copy(buffer[t], self.arrays[name])

    # state

    def get_state(self, state: wp.array, mask: wp.array | None = None) -> None:
        """Write the masked worlds' states, by default all, into (nworld, state_size) float64, exactly.

        Made of Warp launches.
        """
        mask = self._everyone if mask is None else mask
        self._get_integration(state[:, : self.integration_size], mask)
        start = self.integration_size
        for field in self.snapshots:
            source = flat(self.arrays[field.name])
            target = state[:, start : start + field.size]
            launch_rows(widen, mask, source, target)
            start += field.size

    def set_state(self, state: wp.array, mask: wp.array) -> None:
        """Put the masked worlds into the given states, exactly; afterwards every field belongs to them."""
        self._set_integration(state[:, : self.integration_size], mask)
        self.refresh_current(mask)
        start = self.integration_size
        for field in self.snapshots:
            target = flat(self.arrays[field.name])
            source = state[:, start : start + field.size]
            launch_rows(narrow, mask, source, target)
            start += field.size

    @abc.abstractmethod
    def _get_integration(self, state: wp.array, mask: wp.array) -> None: ...

    @abc.abstractmethod
    def _set_integration(self, state: wp.array, mask: wp.array) -> None: ...


EngineFactory = Callable[..., Engine]
"""Called with (model, nworld, device, fields, **options), the options being those that were given; returns an engine.

A factory with an attribute ``bytes_per_world``, as an engine class has, is asked before it is called.
"""


def _integration_size(model: mujoco.MjModel) -> int:
    return mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value)
