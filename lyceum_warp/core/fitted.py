"""Read the folder of a fit (``lw.fit``), and put its values into a model and into single worlds."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.core.fields import elements
from lyceum_warp.core.model_fields import VARYING_FIELDS
from lyceum_warp.support.files import unknown_format
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import first_sentence

FIT_FORMAT = 1
"""Format of the folder of a fit."""


class Fitted:
    """Fitted rows of model fields, and draws of these rows from the posterior.

    Args:
        folder: The folder of a fit.

    Raises:
        FileNotFoundError: The folder has no fit.
        ValueError: A file is damaged or comes from a newer release.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).expanduser()
        path = self.folder / "fit.json"
        if not path.is_file():
            raise FileNotFoundError(f"there is no fit in {str(folder)!r}: lyceum-warp fit writes fit.json")
        content: dict[str, Any] = {}
        with self._damage(path):
            content = json.loads(path.read_text(encoding="utf-8"))
            newer = isinstance(content["format"], int) and content["format"] > FIT_FORMAT
        if newer:
            raise unknown_format(path, content["format"], FIT_FORMAT)
        with self._damage(path):
            self.values: dict[str, dict[str, np.ndarray]] = {
                field: {str(name): _finite(rows) for name, rows in parts.items()}
                for field, parts in content["fields"].items()
            }
            self.delays = {str(name): float(abs(_finite(delay))) for name, delay in content["delays"].items()}
            columns = [content[name] for name in ("names", "value", "low", "high", "determined")]
            self.summary = {name: list(row) for name, *row in zip(*columns, strict=True)}
            """Value, ends of the 95 % interval, and whether it is determined, by the parameter's name."""

    @contextlib.contextmanager
    def _damage(self, path: Path) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a damaged file may have anything in place of a number
            raise ValueError(f"{path} is damaged, or no fit of this model: {first_sentence(error)}") from error

    @property
    def metadata(self) -> dict[str, Any]:
        """The fit as JSON values, for config.json and exported policies."""
        fields = {field: {n: rows.tolist() for n, rows in parts.items()} for field, parts in self.values.items()}
        return {"folder": str(self.folder), "parameters": self.summary, "fields": fields, "delays": self.delays}

    def delay(self, spec: mujoco.MjSpec, timestep: float) -> None:
        """Give the actuators of a spec their delays, as whole and fractional substeps of ``timestep`` seconds."""
        names = [actuator.name for actuator in spec.actuators]
        for name, delay in self.delays.items():
            if name not in names:
                raise ValueError(
                    f"the fit in {self.folder} delays {name!r}, no actuator here: {did_you_mean(name, names)}"
                )
            actuator = spec.actuator(name)
            # linear interpolation between the controls of two substeps is their mean over the delayed substep
            actuator.delay, actuator.nsample, actuator.interp = delay, int(np.ceil(delay / timestep)) + 1, 1

    def put(self, model: mujoco.MjModel) -> None:
        """Write the fitted rows into a compiled model, and recompute its constants."""
        with self._damage(self.folder / "fit.json"):
            for field, parts in self.values.items():
                for name, rows in parts.items():
                    self._rows(model, field, name)[...] = rows
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def draws(self, model: mujoco.MjModel, nworld: int, seed: int, first_world: int) -> dict[str, np.ndarray]:
        """Draw rows of the posterior for each world, as whole fields: (nworld, size of the field).

        World i of all processes gets the same draw for the same seed.
        """
        path, result = self.folder / "draws.npz", {}
        if not path.is_file():
            raise FileNotFoundError(f"there is no {path}: pass the folder of a whole fit")
        with self._damage(path), np.load(path, allow_pickle=False) as file:
            count = min(len(file[name]) for name in file)
            # the seed and the index of a world decide, so that a world keeps its robot in every division of the worlds
            choice = [np.random.default_rng((seed, first_world + w)).integers(count) for w in range(nworld)]
            for field, parts in self.values.items():
                whole = np.repeat(np.array(getattr(model, field), dtype=float)[None], nworld, axis=0)
                for name in parts:
                    whole[:, elements(model, field, name)] = _finite(file[f"{field}.{name}"])[choice]
                result[field] = whole.reshape(nworld, -1)
        return result

    def _rows(self, model: mujoco.MjModel, field: str, name: str) -> np.ndarray:
        if field not in VARYING_FIELDS:
            raise ValueError(f"{field!r} is no field that can be fitted")
        rows: np.ndarray = getattr(model, field)[elements(model, field, name)]
        if rows.shape != (wrong := self.values[field][name].shape):
            raise ValueError(f"{field}.{name} has shape {wrong}, and the model's has {rows.shape}")
        return rows


def _finite(values: Any) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ValueError("a number is not finite")
    return array
