"""Define the options of an environment and of its physics.

A field of ``EnvOptions`` or ``PhysicsOptions`` is an argument of ``make``, ``replicate`` and MPPI, and a flag of the
command line. To add an option, add a field to one of these classes.
"""

import dataclasses
from collections.abc import Callable, Collection, Iterable, Mapping, Set
from pathlib import Path
from typing import Any

import mujoco

from lyceum_warp.core.cameras import Camera, cameras_of
from lyceum_warp.core.model_files import ModelSource
from lyceum_warp.support.suggestions import did_you_mean, suggest_arguments
from lyceum_warp.support.validate import Rule, check_fields, check_kind, described, positive_number, whole_number


def _members(kind: Any, prefix: str, *names: str) -> dict[str, Any]:
    """Look up members of MuJoCo's enumeration, by their names in lower case and without the prefix."""
    return {name: getattr(kind, f"{prefix}_{name.upper()}") for name in names}


CONES = _members(mujoco.mjtCone, "mjCONE", "pyramidal", "elliptic")
INTEGRATORS = _members(mujoco.mjtIntegrator, "mjINT", "euler", "rk4", "implicit", "implicitfast", "discrete")
JACOBIANS = _members(mujoco.mjtJacobian, "mjJAC", "dense", "sparse", "auto")
SOLVER_LIMITS = {"iterations": 1, "ls_iterations": 1, "noslip_iterations": 0}
"""Limits that the option ``solver`` may set, each with its smallest value."""


def _for_engine(default: Any) -> Any:
    """Make a dataclass field for an option of the engine's constructor."""
    return dataclasses.field(default=default, metadata={"engine": True})


def given_values(options: Any) -> dict[str, Any]:
    """Get the fields of a dataclass that differ from their defaults, by name."""
    values = {field.name: (getattr(options, field.name), field.default) for field in dataclasses.fields(options)}
    return {name: value for name, (value, default) in values.items() if value is not default and value != default}


_PHYSICS_RULES: dict[str, Rule] = {
    "base": "the name of one of the task's physics, as 'exact'", "frame_skip": 1, "nconmax": 1, "njmax": 1,
    "impratio": 1e-15, "cone": list(CONES), "integrator": list(INTEGRATORS), "jacobian": list(JACOBIANS),
}  # fmt: skip
_ENV_RULES: dict[str, Rule] = {
    "nworld": 1, "nthread": 0, "seed": 0, "first_world": 0, "horizon": 0, "device": "as 'cpu' or 'cuda:0'",
}  # fmt: skip


def _checked_limits(solver: Any) -> dict[str, int]:
    if not isinstance(solver, Mapping):
        raise ValueError(f"solver must be a dict of limits, such as solver={{'iterations': 4}}, not {solver!r}")
    if unknown := [name for name in solver if name not in SOLVER_LIMITS]:
        raise ValueError(f"there is no solver limit {unknown[0]!r}: use {', '.join(map(repr, SOLVER_LIMITS))}")
    return {name: whole_number(f"solver's {name}", value, low=SOLVER_LIMITS[name]) for name, value in solver.items()}


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsOptions:
    """Options of the simulation. None means the setting of the task or the model.

    Raises:
        ValueError: A value is unknown or out of range.
    """

    base: str | None = None
    """Name of a set of options in the task's ``physics``. Other options override this set. "exact" means the options of
    the task's model."""
    frame_skip: int | None = None
    """Substeps in a step."""
    timestep: float | None = None
    """Length of a substep in seconds."""
    cone: str | None = None
    """Friction cone: pyramidal or elliptic."""
    integrator: str | None = None
    """Integrator: euler, rk4, implicit, implicitfast or discrete. With discrete, servos, springs and contacts stay
    stable in long substeps, and ``qacc`` and accelerometers hold the mean over the substep."""
    jacobian: str | None = None
    """Constraint Jacobian: dense, sparse or auto. The choice affects speed and memory. Results differ only by
    rounding."""
    impratio: float | None = None
    """Ratio of frictional to normal impedance of contacts, for elliptic cones."""
    solver: Mapping[str, int] | None = None
    """Limits of the constraint solver: iterations, ls_iterations (of the line search) and noslip_iterations (0 for no
    noslip solver)."""
    discardvisual: bool | None = None
    """Leave out all geoms, meshes and materials that have no effect on the physics, as MuJoCo's compiler option of the
    same name does. Results do not change, but a substep takes less time if a model has many such geoms. Videos and
    viewers do not show these geoms."""
    nconmax: int | None = _for_engine(None)
    """Capacity of the Warp engine for contacts, as an average per world. The default is twice the peak in random
    rollouts."""
    njmax: int | None = _for_engine(None)
    """Capacity of the Warp engine for constraints in each world. The default is twice the peak in random rollouts,
    plus the inactive equality constraints."""
    deterministic: bool | None = _for_engine(None)
    """Make runs on a CUDA device reproducible bit for bit, as on the CPU. For hopper, half_cheetah and humanoid, a
    reproducible run takes 5 to 18 times the usual time and 5 to 7 times the usual memory."""

    def __post_init__(self) -> None:
        check_fields(self, _PHYSICS_RULES)
        if self.timestep is not None:
            object.__setattr__(self, "timestep", positive_number("timestep", self.timestep, "seconds"))
        # runs of earlier releases have False instead of None; with a base, False overrides the base's value
        if self.base is None:
            object.__setattr__(self, "deterministic", self.deterministic or None)
        if self.solver is not None:
            object.__setattr__(self, "solver", _checked_limits(self.solver) or None)

    def given(self) -> dict[str, Any]:
        """Get the options that differ from their defaults, by name."""
        return given_values(self)

    def resolved(self, named: Mapping[str, "PhysicsOptions"]) -> "PhysicsOptions":
        """Get all options: look up the set that ``base`` names, and override it with the other options."""
        if self.base is None:
            return self
        sets = {"exact": PhysicsOptions(), **named}
        if self.base not in sets:
            raise ValueError(f"there is no physics {self.base!r}: use {', '.join(map(repr, sets))}")
        return dataclasses.replace(sets[self.base], **(self.given() | {"base": None}))


@suggest_arguments
@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """Options of an environment: number of worlds, device, engine, start and end of episodes.

    Raises:
        ValueError: A value is of the wrong type or out of range.
    """

    nworld: int = 1
    """Number of worlds."""
    device: str | None = None
    """cpu (the default), or a CUDA device such as cuda:0."""
    engine: str | Callable[..., Any] = "auto"
    """mujoco (the C engine, on CPU cores), warp, or auto: warp on a CUDA device and mujoco on the CPU. To use your own
    engine, pass a callable with the signature of ``lyceum_warp.engines.base.Engine``."""
    nthread: int | None = _for_engine(None)
    """Threads of the C engine; by default all cores."""
    seed: int = 0
    """Seed of the worlds' random streams."""
    first_world: int = 0
    """Index of the first world in a batch that several processes simulate. A world's random stream depends on its index
    in the batch."""
    autoreset: bool = True
    """Whether a world starts its next episode in the step that ends an episode. If False, finished worlds keep stepping
    with ``done`` set until a reset. Only a world with a fault restarts in the same step."""
    horizon: int | None = None
    """Steps after which an episode is truncated, or 0 for never; by default the task's horizon."""
    graphs: bool = True
    """Whether to capture kernel launches as graphs and replay them. Turn graphs off to debug: results stay the same."""
    model: ModelSource | None = None
    """File or MjSpec that replaces the task's model."""
    fields: Collection[str] = ()
    """Further fields that ``env.field`` returns."""
    dynamics: Collection[str] = ()
    """Model fields that ``env.set_dynamics`` may set, besides the fields that the task randomizes."""
    fitted: str | None = None
    """Folder of a fit (``lw.fit``), whose values replace those of the model. Parameters that a task computes from its
    model keep the values of the model before the fit, so that an action means the same to the robot."""
    fitted_draws: bool = False
    """Whether each world draws its own values from what the fit left uncertain. A world keeps them for all episodes,
    and the task's own draws start from them."""
    objects: Collection[str] | None = None
    """Names of objects that the task declares, such as ``["cube", "mug"]``. Each world holds one of them. By default,
    worlds hold all of the task's objects, or the geoms of the model if the object's body has geoms."""
    cameras: Collection[Camera] | None = None
    """Cameras whose pictures are observations, such as ``[lw.Camera("fixed")]``; by default those of the task."""
    final_pictures: bool = False
    """Whether ``final_obs_groups`` holds pictures, too. All worlds are then rendered a second time in each step in
    which an episode ends. PPO and Distill do not need these pictures."""
    physics: PhysicsOptions = PhysicsOptions()
    """Physics options, or the name of options in the task's ``physics``. "exact" means the options of the task's
    model."""

    def __post_init__(self) -> None:
        check_fields(self, _ENV_RULES)
        if not isinstance(self.engine, str) and not callable(self.engine):
            raise ValueError(f"engine must be 'auto', 'mujoco', 'warp' or a callable, not {described(self.engine)}")
        # if the model is an MjModel, binding the task raises a more specific error
        if self.model is not None and not isinstance(self.model, mujoco.MjModel):
            check_kind("model", self.model, ModelSource, "a file or an MjSpec")
        object.__setattr__(self, "physics", _physics(self.physics))
        check_kind("fitted", self.fitted, str | Path | None, "the folder of a fit")
        if self.fitted is not None:
            object.__setattr__(self, "fitted", str(Path(self.fitted).expanduser().absolute()))
        elif self.fitted_draws:
            raise ValueError("fitted_draws=True needs a fit: pass its folder as fitted=...")
        if self.objects is not None:
            object.__setattr__(self, "objects", _names("objects", self.objects, "objects", "mug"))
            if len(set(self.objects)) < max(1, len(self.objects)):
                raise ValueError(f"objects must be at least one name, each once, not {list(self.objects)}")
        if self.cameras is not None:
            object.__setattr__(self, "cameras", cameras_of(self.cameras))
        for option, example in (("fields", "sensordata"), ("dynamics", "body_mass")):
            object.__setattr__(self, option, _names(option, getattr(self, option), "fields", example))

    @classmethod
    def split(cls, values: Mapping[str, Any], base: "EnvOptions | None" = None) -> tuple["EnvOptions", dict[str, Any]]:
        """Split keyword arguments into options and task parameters."""
        rest = {name: value for name, value in values.items() if name not in OPTIONS}
        options = {name: value for name, value in values.items() if name in OPTIONS}
        return (base or cls()).changed(options), rest

    def changed(self, changes: Mapping[str, Any]) -> "EnvOptions":
        """Return a copy of the options with the given changes."""
        physics = {name: value for name, value in changes.items() if name in _PHYSICS}
        others = {name: value for name, value in changes.items() if name not in _PHYSICS}
        if physics:
            others["physics"] = dataclasses.replace(_physics(others.get("physics", self.physics)), **physics)
        return dataclasses.replace(self, **others)

    def for_engine(self) -> dict[str, Any]:
        """Get the options for the engine's constructor, by name."""
        both = [(options, field) for options in (self, self.physics) for field in dataclasses.fields(options)]
        return {field.name: getattr(options, field.name) for options, field in both if field.metadata.get("engine")}

    def given(self) -> dict[str, Any]:
        """Get the options that differ from their defaults, by name, including those of the physics."""
        return {name: x for name, x in given_values(self).items() if name != "physics"} | self.physics.given()


def _names(option: str, names: Any, what: str, example: str) -> tuple[str, ...]:
    if not isinstance(names, list | tuple | Set) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{option} must be names of {what}, as in {option}=[{example!r}], not {names!r}")
    return tuple(names)


def _physics(physics: Any) -> PhysicsOptions:
    if isinstance(physics, str):
        return PhysicsOptions(base=physics)
    check_kind("physics", physics, PhysicsOptions, "as lw.PhysicsOptions(cone='elliptic')")
    return physics


_PHYSICS = tuple(field.name for field in dataclasses.fields(PhysicsOptions) if field.name != "base")
OPTIONS = (*(field.name for field in dataclasses.fields(EnvOptions)), *_PHYSICS)


def suggestion(word: str, others: Iterable[str] = ()) -> str:
    """Return "did you mean ...?" for an unknown name, or "" if no name is similar."""
    if word in SOLVER_LIMITS:
        return f"did you mean solver={{{word!r}: ...}}?"
    return did_you_mean(word, [*others, *OPTIONS])
