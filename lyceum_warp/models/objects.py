"""Put the objects of a task into a model, and compute the model fields of each object."""

from collections import Counter
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from lyceum_warp.core.objects import ObjectGeom, Objects

_BODY = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
_BOUNDS = ("geom_aabb", "geom_rbound")
_GEOM = (
    "geom_dataid", "geom_size", "geom_pos", "geom_quat", "geom_friction", "geom_solref", "geom_solimp", "geom_solmix",
    "geom_margin", "geom_gap", "geom_rgba",
)  # fmt: skip

_UNUSED = {"size": [1e-3] * 3, "mass": 0.0, "margin": -1e9, "rgba": [0.0] * 4}
"""Attributes of a geom that an object does not use. The margin excludes it from collisions on both engines, and MuJoCo
neither renders a transparent geom nor lets rays hit it."""


class ObjectModels:
    """The model fields of objects that replace each other in one body.

    The types of the body's geoms cannot differ between worlds, so the body gets as many geoms of each type as the
    objects need at most. MuJoCo computes mass, inertia, bounds and convex hulls in a model that has a body for every
    object.

    Args:
        spec: The model. It is changed: the body has the geoms of the first object.
        objects: The objects.
        indices: The indices of the objects in use, by name.
        owner: The task, whose folder has the files of meshes.

    Raises:
        ValueError: The model has no such body, or MuJoCo refuses a geom.
        FileNotFoundError: The file of a mesh is missing.
    """

    def __init__(self, spec: mujoco.MjSpec, objects: Objects, indices: Mapping[str, int], owner: type) -> None:
        self._objects, self._indices = objects, indices
        if (body := spec.body(objects.body)) is None:
            bodies = ", ".join(body.name for body in spec.bodies[1:] if body.name)
            raise ValueError(f"the model has no body {objects.body!r}, which lw.Objects names: it has {bodies}")
        self._types = _types([objects.models[name] for name in indices])
        for geom in list(body.geoms):
            spec.delete(geom)
        body.explicitinertial = False
        meshes = _add_meshes(spec, objects, indices, owner)
        copies = {name: spec.worldbody.add_body(name=f"object {name}") for name in indices}
        for name, copy in copies.items():
            self._add_geoms(copy, body, name, meshes)
        self._add_geoms(body, body, next(iter(indices)), meshes)
        fused, spec.compiler.fusestatic = spec.compiler.fusestatic, 0
        try:
            self._union = spec.compile()
        except ValueError as error:
            raise ValueError(f"MuJoCo refuses the objects of {body.name!r}: {' '.join(str(error).split())}") from error
        spec.compiler.fusestatic = fused
        for copy in copies.values():
            spec.delete(copy)

    def rows(self, model: mujoco.MjModel) -> dict[str, np.ndarray]:
        """Compute the fields of a compiled model that differ between the objects in use, and ``object``, the index.

        The rows of each field are (number of objects, size of the field). Objects that are not in use have the model's
        values.
        """
        count, body = len(self._objects.models), model.body(self._objects.body).id
        rows = {"object": np.arange(count, dtype=float)[:, None]}
        for field in (*_BODY, *_GEOM, *_BOUNDS):
            if field in _BOUNDS and "geom_dataid" not in rows:
                continue  # MuJoCo computes the bounds of primitives from their sizes
            value, union = getattr(model, field), getattr(self._union, field)
            table = np.repeat(value[None].astype(float), count, axis=0)
            for name, index in self._indices.items():
                source, target = self._union.body(f"object {name}").id, body
                if field not in _BODY:
                    source, target = (self._geoms(m, b) for m, b in ((self._union, source), (model, body)))
                table[index, target] = union[source]
            used = table[list(self._indices.values())]
            if (used != used[0]).any() or field in _BOUNDS:
                rows[field] = table.reshape(count, -1)
        return rows

    def _geoms(self, model: mujoco.MjModel, body: int) -> slice:
        first = model.body_geomadr[body]
        return slice(first, first + len(self._types))

    def _add_geoms(self, target: mujoco.MjsBody, body: mujoco.MjsBody, name: str, meshes: Mapping[int, str]) -> None:
        """Give a body the geoms of an object, in the order of ``_types``, with the default class of ``body``."""
        geoms = {kind: [geom for geom in self._objects.models[name] if geom.type == kind] for kind in self._types}
        for kind in self._types:
            geom = geoms[kind].pop() if geoms[kind] else None
            attributes = {**self._objects.common, **(_UNUSED if geom is None else geom.attributes)}
            if kind == mujoco.mjtGeom.mjGEOM_MESH:
                attributes["meshname"] = meshes.get(id(geom)) or next(iter(meshes.values()))
            try:
                target.add_geom(body.classname, type=kind, **attributes)
            except (TypeError, ValueError) as error:
                reason = str(error).split(".")[0] if isinstance(error, ValueError) else f"wrong type in {attributes}"
                raise ValueError(f"MuJoCo refuses a geom of the object {name!r}: {reason}") from error


def _types(models: Sequence[Sequence[ObjectGeom]]) -> list[mujoco.mjtGeom]:
    """Return the types of the geoms that a body needs to hold any of the models."""
    most: Counter[mujoco.mjtGeom] = Counter()
    for geoms in models:
        most |= Counter(geom.type for geom in geoms)
    return sorted(most.elements(), key=int)


def _add_meshes(spec: mujoco.MjSpec, objects: Objects, indices: Mapping[str, int], owner: type) -> dict[int, str]:
    """Add the meshes of objects to a spec, and return the name of each geom's mesh, by the id of the geom."""
    names = {}
    for name in indices:
        for i, geom in enumerate(objects.models[name]):
            if (path := objects.path(geom, owner)) is None or id(geom) in names:
                continue
            if not path.is_file():
                raise FileNotFoundError(f"the object {name!r} has no file {path}: check the path in lw.mesh")
            names[id(geom)] = f"object {name} {i}"
            spec.add_mesh(name=names[id(geom)], file=str(path), **geom.asset)
    return names
