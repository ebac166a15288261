"""TEMPORARY"""

import dataclasses
import mujoco, numpy as np, warp as wp


@dataclasses.dataclass(frozen=True)
class ModelField:
    name: str
    shape: tuple
    dtype: type

    @property
    def size(self):
        return int(np.prod(self.shape, dtype=int)) * wp.types.type_size_in_bytes(self.dtype) // 4

    def nominal(self, model):
        return getattr(model, self.name).astype(np.float32)


def is_model_field(name):
    return name in ("body_mass", "geom_friction")


def describe_model_field(model, name):
    a = getattr(model, name)
    return ModelField(name, a.shape[:1], wp.float32 if a.ndim == 1 else wp.vec3)
