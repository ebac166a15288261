"""Define the options of an environment and of its physics.

``make``, ``replicate``, MPPI, the command line, the help texts and the suggestions for misspelt names are all generated
from these two classes. To add an option, add a field here.
"""

import dataclasses
import difflib
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Set
from pathlib import Path
from typing import Any, TypeAlias

import mujoco

from lyceum_warp.model_files import ModelFile
from lyceum_warp.support.docstrings import attribute_docs, document_attributes, listed
from lyceum_warp.support.validate import check_flag, check_kind, described, finite_number, positive_number, whole_number

ModelSource: TypeAlias = str | Path | mujoco.MjSpec | ModelFile
"""The source of a model: a file or an MjSpec."""

CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
JACOBIANS = {
    "dense": mujoco.mjtJacobian.mjJAC_DENSE, "sparse": mujoco.mjtJacobian.mjJAC_SPARSE,
    "auto": mujoco.mjtJacobian.mjJAC_AUTO,
}  # fmt: skip
SOLVER_LIMITS = {"iterations": 1, "ls_iterations": 1, "noslip_iterations": 0}
"""The limits of the constraint solver that ``solver`` accepts, with the smallest value of each."""


def _for_engine(default: Any) -> Any:
    """The dataclass field of an option that is passed to the engine's constructor."""
    return dataclasses.field(default=default, metadata={"engine": True})


def given_values(options: Any) -> dict[str, Any]:
    """The fields of a dataclass that differ from their defaults, by name."""
    values = {field.name: (getattr(options, field.name), field.default) for field in dataclasses.fields(options)}
    return {name: value for name, (value, default) in values.items() if value is not default and value != default}


def _whole(options: Any, name: str, low: int) -> None:
    if (value := getattr(options, name)) is not None:
        object.__setattr__(options, name, whole_number(name, value, low=low))


def _flags(options: Any, *names: str) -> None:
    for name in names:
        check_flag(name, getattr(options, name))


def _one_of(what: str, name: Any, known: Mapping[str, Any]) -> None:
    if name is not None and (not isinstance(name, str) or name not in known):
        *others, last = map(repr, known)
        raise ValueError(f"there is no {what} {name!r}: use {', '.join(others)} or {last}")


def _checked_limits(solver: Any) -> dict[str, int]:
    if not isinstance(solver, Mapping):
        raise ValueError(f"solver must be a dict of limits, as solver={{'iterations': 4}}, not {solver!r}")
    if unknown := [name for name in solver if name not in SOLVER_LIMITS]:
        raise ValueError(f"solver has no limit {unknown[0]!r}: it takes {', '.join(map(repr, SOLVER_LIMITS))}")
    return {name: whole_number(f"solver's {name}", value, low=SOLVER_LIMITS[name]) for name, value in solver.items()}


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsOptions:
    """How the worlds are simulated. None keeps the setting of the task or its model.

    Raises:
        ValueError: A value is unknown or out of range.
    """

    base: str | None = None
    """Name of one of the task's ``physics``, to which the other options are applied; "exact" means the task's own
    physics."""
    frame_skip: int | None = None
    """Substeps in a step."""
    timestep: float | None = None
    """Length of a substep in seconds."""
    cone: str | None = None
    """Friction cone: pyramidal or elliptic."""
    integrator: str | None = None
    """Integrator: euler, rk4, implicit or implicitfast."""
    jacobian: str | None = None
    """Constraint Jacobian: dense, sparse or auto. The form changes speed and memory, and results only by rounding."""
    impratio: float | None = None
    """Stiffness of contacts against slip, relative to their stiffness against penetration; for elliptic cones."""
    solver: Mapping[str, int] | None = None
    """Limits of the constraint solver: any of iterations, ls_iterations (of its line search) and noslip_iterations
    (0 turns the noslip solver off)."""
    nconmax: int | None = _for_engine(None)
    """Contact capacity per world, on average (Warp engine); by default twice the peak of random rollouts."""
    njmax: int | None = _for_engine(None)
    """Constraint capacity of each world (Warp engine); by default twice the peak of random rollouts, plus room for
    inactive equality constraints."""
    deterministic: bool = _for_engine(False)
    """Make runs on a CUDA device reproducible bit for bit, as runs on the CPU always are. Takes 5 to 18 times the time
    and 5 to 7 times the memory on hopper, half_cheetah and humanoid."""

    def __post_init__(self) -> None:
        """Check every value."""
        check_kind("base", self.base, str | None, "the name of one of the task's physics, as 'exact'")
        for name, low in (("frame_skip", 1), ("nconmax", 1), ("njmax", 1)):
            _whole(self, name, low)
        if self.timestep is not None:
            object.__setattr__(self, "timestep", positive_number("timestep", self.timestep, "seconds"))
        if self.impratio is not None:
            object.__setattr__(self, "impratio", finite_number("impratio", self.impratio, low=1e-15))
        _one_of("friction cone", self.cone, CONES)
        _one_of("integrator", self.integrator, INTEGRATORS)
        _one_of("Jacobian", self.jacobian, JACOBIANS)
        _flags(self, "deterministic")
        if self.solver is not None:
            object.__setattr__(self, "solver", _checked_limits(self.solver) or None)

    def given(self) -> dict[str, Any]:
        """The options that differ from their defaults, by name."""
        return given_values(self)

    def resolved(self, named: Mapping[str, "PhysicsOptions"]) -> "PhysicsOptions":
        """Replace ``base`` by the options that it names.

        Args:
            named: The task's physics.

        Raises:
            ValueError: The task has no physics of this name.
        """
        if self.base is None:
            return self
        known = {"exact": PhysicsOptions(), **named}
        if self.base not in known:
            raise ValueError(f"the task has no physics {self.base!r}: it has {', '.join(map(repr, known))}")
        return dataclasses.replace(known[self.base], **(self.given() | {"base": None}))


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """The number of worlds, where they run, and how their episodes start and end.

    Raises:
        ValueError: A value is of the wrong type or out of range.
    """

    nworld: int = 1
    """Number of worlds."""
    device: str | None = None
    """cpu (the default), or a CUDA device such as cuda:0."""
    engine: str | Callable[..., Any] = "auto"
    """mujoco (the C engine, on CPU cores), warp, or auto: warp on a CUDA device and mujoco on the CPU. Also a callable
    with the signature of ``lyceum_warp.engines.base.Engine``, for an engine of your own."""
    nthread: int | None = _for_engine(None)
    """Threads of the C engine; by default all cores."""
    seed: int = 0
    """Seed of the worlds' random streams."""
    first_world: int = 0
    """Index of the first world, if several processes share a batch: a world's random stream depends on its index in the
    whole batch."""
    autoreset: bool = True
    """Whether a world whose episode ended starts a new one within the same step. If False, finished worlds keep
    stepping with ``done`` set until they are reset; only worlds with a fault restart at once."""
    horizon: int | None = None
    """Steps after which an episode is truncated, or 0 for never; by default the task's horizon."""
    graphs: bool = True
    """Whether launches are captured as graphs and replayed. False is for debugging, and gives the same
    results."""
    model: ModelSource | None = None
    """A model that replaces the task's: a file or an MjSpec."""
    fields: Collection[str] = ()
    """Additional fields to keep, for ``env.field``."""
    dynamics: Collection[str] = ()
    """Model fields that may differ between worlds, for ``env.set_dynamics``, in addition to the fields that the task
    randomizes."""
    physics: PhysicsOptions = PhysicsOptions()
    """How the worlds are simulated; also the name of one of the task's ``physics``, or "exact" for its own."""

    def __post_init__(self) -> None:
        """Check every value."""
        for name, low in (("nworld", 1), ("nthread", 0), ("seed", 0), ("first_world", 0), ("horizon", 0)):
            _whole(self, name, low)
        check_kind("device", self.device, str | None, "as 'cpu' or 'cuda:0'")
        if not isinstance(self.engine, str) and not callable(self.engine):
            raise ValueError(f"engine must be 'auto', 'mujoco', 'warp' or a callable, not {described(self.engine)}")
        if self.model is not None and not isinstance(self.model, mujoco.MjModel):  # MjModel has a specific error
            check_kind("model", self.model, ModelSource, "a file or an MjSpec")
        object.__setattr__(self, "physics", _physics(self.physics))
        _flags(self, "autoreset", "graphs")
        for option, example in (("fields", "sensordata"), ("dynamics", "body_mass")):
            names = getattr(self, option)
            if not isinstance(names, list | tuple | Set) or not all(isinstance(name, str) for name in names):
                raise ValueError(f"{option} must be names of fields, as in {option}=[{example!r}], not {names!r}")
            object.__setattr__(self, option, tuple(names))

    @classmethod
    def split(cls, words: Mapping[str, Any], base: "EnvOptions | None" = None) -> tuple["EnvOptions", dict[str, Any]]:
        """Split keyword arguments into options and task parameters.

        Args:
            words: The keyword arguments.
            base: The options to start from; by default ``EnvOptions()``.
        """
        rest = {name: value for name, value in words.items() if name not in OPTIONS}
        options = {name: value for name, value in words.items() if name in OPTIONS}
        return (base or cls()).changed(options), rest

    def changed(self, words: Mapping[str, Any]) -> "EnvOptions":
        """Copy with some options changed, by name, including physics options."""
        physics = {name: value for name, value in words.items() if name in _PHYSICS}
        others = {name: value for name, value in words.items() if name not in _PHYSICS}
        if physics:
            others["physics"] = dataclasses.replace(_physics(others.get("physics", self.physics)), **physics)
        return dataclasses.replace(self, **others)

    def for_engine(self) -> dict[str, Any]:
        """The options of the engine's constructor, by name."""
        both = [(options, field) for options in (self, self.physics) for field in dataclasses.fields(options)]
        return {field.name: getattr(options, field.name) for options, field in both if field.metadata.get("engine")}

    def given(self) -> dict[str, Any]:
        """The options that differ from their defaults, by name, including physics options."""
        own = given_values(self)
        own.pop("physics", None)
        return own | self.physics.given()


def _physics(given: Any) -> PhysicsOptions:
    if isinstance(given, str):
        return PhysicsOptions(base=given)
    check_kind("physics", given, PhysicsOptions, "as lw.PhysicsOptions(cone='elliptic')")
    return given


_PHYSICS = tuple(field.name for field in dataclasses.fields(PhysicsOptions) if field.name != "base")
OPTIONS = (*(field.name for field in dataclasses.fields(EnvOptions)), *_PHYSICS)
"""Names of all options, in the order of the help text."""

_DOCS = {**attribute_docs(EnvOptions), **attribute_docs(PhysicsOptions)}

OPTION_DOCS = listed({name: _DOCS[name] for name in OPTIONS})
"""The options with their docstrings, as the body of an ``Args:`` section."""

_OTHER_WORDS = {
    "num_envs": "nworld", "n_envs": "nworld", "xml_file": "model", "max_episode_steps": "horizon", "record": "graphs",
    "iterations": "solver={'iterations': ...}", "ls_iterations": "solver={'ls_iterations': ...}",
    "noslip_iterations": "solver={'noslip_iterations': ...}",
}  # fmt: skip
"""Names of options in other packages and in earlier releases, with their names here."""


def suggestion(word: str, others: Iterable[str] = ()) -> str:
    """A hint "did you mean ...?" for an unknown name; empty if no known name is similar.

    Args:
        word: The unknown name.
        others: Known names in addition to the options.
    """
    close = [_OTHER_WORDS[word]] if word in _OTHER_WORDS else difflib.get_close_matches(word, [*others, *OPTIONS], 3)
    return f"did you mean {' or '.join(close)}?" if close else ""


def signature_of_options(function: Callable[..., Any]) -> inspect.Signature:
    """The signature of a function with every option as a keyword in place of ``**words``."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    options = [
        inspect.Parameter(field.name, keyword, default=field.default, annotation=field.type)
        for kind in (EnvOptions, PhysicsOptions)
        for field in dataclasses.fields(kind)
        if field.name in OPTIONS
    ]
    rest = inspect.Parameter("params", inspect.Parameter.VAR_KEYWORD, annotation=Any)
    signature = inspect.signature(function)
    positional = [p for p in signature.parameters.values() if p.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD]
    return signature.replace(parameters=[*positional, *options, rest])
