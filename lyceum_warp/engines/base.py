"""The contract between an environment and the physics behind it."""

import abc
from collections.abc import Callable, Mapping

import mujoco
import warp as wp

from lyceum_warp.arrays import flat, launch_rows
from lyceum_warp.fields import Field, Stage, describe
from lyceum_warp.kernels.state import narrow, widen


class Engine(abc.ABC):
    """Many worlds of one model, stepped together.

    An engine knows nothing of tasks. Whatever it shows lies in Warp arrays with a leading ``nworld`` axis and
    an address that never changes, so that launches which read them can be recorded once.

    The order of calls in a step is: write ``ctrl``, ``step``, read fields and ``fault``; for worlds that
    begin again, ``reset``, then write state fields, then ``commit`` and ``refresh``.

    Args:
        model: The compiled model; the engine keeps it and does not change it.
        nworld: Number of worlds.
        device: Where the arrays live.
    """

    name: str
    recordable: bool
    """Whether every call is made of Warp launches, so that a whole step can be recorded as one graph.

    Otherwise the launches between two calls of ``step``, ``refresh`` or ``set_state`` are recorded; so the methods
    that say so have to be made of launches on every engine, and an engine keeps what they touch in Warp arrays.
    """

    ctrl: wp.array
    """Controls of the next step, (nworld, nu), float32: the field of that name, reset and restored with the state."""
    fault: wp.array
    """Bits of ``Done`` for each world, (nworld,), int32; set by ``find_faults``."""

    def __init__(self, model: mujoco.MjModel, nworld: int, device: wp.Device) -> None:
        self.model = model
        self.nworld = nworld
        self.device = device
        self.fields: dict[str, Field] = {}
        self.arrays: dict[str, wp.array] = {}
        self.fault = wp.zeros(nworld, dtype=int, device=device)
        self._everyone = wp.full(nworld, True, dtype=bool, device=device)
        spec = mujoco.mjtState.mjSTATE_INTEGRATION
        self.integration_size = mujoco.mj_stateSize(model, spec.value)

    # fields

    def field(self, name: str, *, lagged: bool = False) -> wp.array:
        """Ask for a field by MuJoCo's name; from now on it is kept up to date.

        Args:
            name: Attribute of MjData.
            lagged: Want it as ``mj_step`` leaves it instead of belonging to the state. Quantities of the
                acceleration stage always are.

        Returns:
            The live array, (nworld, ...).

        Raises:
            ValueError: There is no such field, or it was asked for the other way before.
        """
        if name not in self.fields:
            field = describe(self.model, name, lagged=lagged)
            self.arrays[name] = self._bind(field)
            self.fields[name] = field
        elif lagged and not self.fields[name].snapshot and self.fields[name].reset > Stage.NONE:
            raise ValueError(f"the field {name!r} is already kept current and can't be had lagged, too")
        return self.arrays[name]

    @property
    def stage(self) -> Stage:
        """What has to be computed after the substeps, for the fields that belong to the state."""
        return max((field.refresh for field in self.fields.values()), default=Stage.NONE)

    @property
    def reset_stage(self) -> Stage:
        """What has to be computed for worlds that were reset."""
        return max((field.reset for field in self.fields.values()), default=Stage.NONE)

    @property
    def snapshots(self) -> list[Field]:
        """Fields that are no function of the integration state, in the order of the state vector."""
        return [field for field in self.fields.values() if field.snapshot]

    @property
    def state_size(self) -> int:
        """Floats in one world's state: the integration state (mjSTATE_INTEGRATION) and the snapshots."""
        return self.integration_size + sum(field.size for field in self.snapshots)

    @abc.abstractmethod
    def _bind(self, field: Field) -> wp.array:
        """The array that will hold a field, (nworld, *field.shape) of field.dtype."""

    # memory

    @property
    def shared_bytes(self) -> int:
        """Bytes that any number of worlds share: the model's arrays."""
        return 0

    @property
    def hidden_bytes(self) -> int:
        """Bytes that all worlds together have in memory that no array of this object shows."""
        return 0

    def prepare(self) -> None:  # noqa: B027
        """Set aside what recordings need; called when every kernel is compiled, before the first of them.

        Raises:
            ValueError: So many worlds do not fit into memory.
        """

    # physics

    @abc.abstractmethod
    def step(self, nstep: int) -> None:
        """Advance every world by ``nstep`` substeps under ``ctrl`` and bring the fields up to date."""

    @abc.abstractmethod
    def find_faults(self, mask: wp.array) -> None:
        """Write the masked worlds' ``fault``: a state that is not finite, and what was in their way since last time.

        Made of Warp launches on every engine.
        """

    @abc.abstractmethod
    def reset(self, mask: wp.array) -> None:
        """Put the masked worlds into the model's initial state, state fields included.

        Made of Warp launches on every engine. Derived fields follow with ``refresh``.
        """

    @abc.abstractmethod
    def commit(self, mask: wp.array) -> None:
        """Take over what was written into the masked worlds' state fields. Made of Warp launches."""

    @abc.abstractmethod
    def refresh(self, mask: wp.array) -> None:
        """Make every derived field of the masked worlds that of a forward pass at their state.

        Worlds outside the mask keep the values that they have.
        """

    # roll-outs

    def rollout(self, state: wp.array, controls: wp.array, nstep: int, records: Mapping[str, wp.array]) -> None:
        """Step every world from a given state under given controls, and record fields along the way.

        The state fields and ``find_faults`` then tell of the end; derived fields may be those of another time.

        Args:
            state: States to start from, whose leading columns are those of ``get_state``; (nworld, ...) float64.
            controls: Controls of each step, (steps, nworld, nu) float32.
            nstep: Substeps in a step.
            records: Where to record fields that were asked for, (steps + 1, nworld, ...): the first row is the start.
        """
        self.reset(self._everyone)  # whatever the last roll-out left behind
        self.set_state(state, self._everyone)
        self._keep(records, 0)
        for t in range(len(controls)):
            wp.copy(self.ctrl, controls[t])
            self.step(nstep)
            self._keep(records, t + 1)

    def _keep(self, records: Mapping[str, wp.array], t: int) -> None:
        for name, record in records.items():
            wp.copy(record[t], self.arrays[name])

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
        """Put the masked worlds into the given states, exactly; every field reflects them afterwards."""
        self._set_integration(state[:, : self.integration_size], mask)
        self._refresh_current(mask)
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

    @abc.abstractmethod
    def _refresh_current(self, mask: wp.array) -> None: ...


EngineFactory = Callable[..., Engine]
"""Called with (model, nworld, device, **options), the options being those that were given; returns an engine."""
