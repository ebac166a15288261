"""Write model fields that differ between worlds into a batch, and recompute derived constants."""

from collections.abc import Iterable, Mapping

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS, Batch

from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.engines.c.batch_faults import call_batch


class WorldModels:
    """Writes values of model fields into a batch, and recomputes the constants derived from them.

    If a value equals the nominal value of the world's object after rounding to float32, the nominal float64 value is
    written.
    """

    def __init__(self, batch: Batch, fields: Iterable[ModelField]) -> None:
        self.batch = batch
        self.fields = [field for field in fields if field.size and field.in_model]
        self._follows = {field.name for field in self.fields if field.constants}
        self._rows: dict[str, np.ndarray] = {}
        self._nominal: dict[str, np.ndarray] = {}
        self._rounded: dict[str, np.ndarray] = {}
        self._applied: dict[str, np.ndarray] = {}
        for field in self.fields:
            rows = batch.expand(f"opt.{field.name}" if field.option else field.name)
            self._rows[field.name] = rows.reshape(batch.nsim, field.size)
            self._nominal[field.name] = field.nominal(batch.model)
            self._rounded[field.name] = self._nominal[field.name].astype(np.float32)
            self._applied[field.name] = self._rows[field.name].astype(np.float32)
        # the first call recomputes every world's constants, so that worlds with equal values have equal constants
        self._stale = np.full(batch.nsim, bool(self._follows))

    def apply(self, values: Mapping[str, np.ndarray], mask: np.ndarray | None = None) -> None:
        """Write values, and recompute the constants of the worlds in which any value changed."""
        if mask is not None and 1 not in mask.tobytes():  # faster than mask.any()
            return
        worlds = np.arange(self.batch.nsim) if mask is None else np.flatnonzero(mask)
        changed = self._stale[worlds]
        for name, rows in self._rows.items():
            numbers, applied, rounded = values[name][worlds], self._applied[name], self._rounded[name]
            # compare bits, so that NaN equals itself
            different = (numbers.view(np.int32) != applied[worlds].view(np.int32)).any(axis=1)
            if not different.any():
                continue
            applied[worlds], nominal = numbers, self._nominal[name]
            if len(nominal) > 1:
                held = values["object"][worlds, 0].astype(int)
                rounded, nominal = (table.take(held, axis=0, mode="clip") for table in (rounded, nominal))
            numbers = np.where(numbers == rounded, nominal, numbers)
            if name == "geom_dataid":
                numbers = np.nan_to_num(numbers).clip(-1, self.batch.model.nmesh - 1)
            rows[worlds] = numbers
            if name in self._follows:
                changed = changed | different
        if changed.any():
            ids = np.zeros(self.batch.nsim, dtype=bool)
            ids[worlds[changed]] = True
            self._set_const(ids)

    def _set_const(self, worlds: np.ndarray) -> None:
        """Recompute constants. If MuJoCo rejects a world's values, the next call tries again."""
        before = self.batch.warning[:, :, 1].sum(axis=1)
        call_batch(self.batch, self.batch.set_const, worlds)
        self._stale[worlds] = (self.batch.warning[:, :, 1].sum(axis=1) > before)[worlds]


def bytes_per_world(model: mujoco.MjModel, fields: Iterable[ModelField]) -> int:
    """Estimate the bytes per world of a batch's model fields and of ``WorldModels``."""
    fields = list(fields)
    batch = Batch(model, 1, 1)
    models = WorldModels(batch, fields)
    values = {field.name: 1.001 * field.value(model).reshape(1, -1).astype(np.float32) for field in fields}
    models.apply(values)  # constants take memory only if they differ between worlds
    expanded = [rows for name in MODEL_FIELDS if (rows := batch.expanded(name)) is not None]
    return sum(rows.nbytes for rows in expanded) + 4 * sum(field.size for field in fields)
