"""Define the base class of tasks and the table of task functions."""

import dataclasses
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.core.cameras import Camera
from lyceum_warp.core.gate import Gate
from lyceum_warp.core.objects import Objects
from lyceum_warp.core.options import PhysicsOptions
from lyceum_warp.support.upstream import extend_structs

extend_structs()

if TYPE_CHECKING:
    T = TypeVar("T")

    class Row(Generic[T]):
        """One world's values of a field. Inside a kernel, it is a one-dimensional Warp array."""

        shape: tuple[int, ...]

        def __getitem__(self, i: int) -> T: ...
        def __setitem__(self, i: int, value: T) -> None: ...
        def __len__(self) -> int: ...
else:
    Row = wp.array


@dataclasses.dataclass(frozen=True)
class TaskFunction:
    """Signature and default of a task function."""

    name: str
    arguments: str
    result: type | None = None
    """Type of the result: float, bool, or None for a function that writes into its arguments."""
    default: str | None = None
    """Body of the function that stands in for a task's own."""
    optional: str = ""
    """Last arguments, which a task's function may omit."""
    writes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """What the function may write into each argument. The values are "inputs", "memory", "lasting" (lasting
    memory and model fields) and "start" (everything that a reset may write). Arguments for results, such as ``obs``,
    are always writable."""

    @property
    def signature(self) -> str:
        """Get the first line of the function's definition without ``def``."""
        return f"{self.name}({self.arguments})" + (f" -> {self.result.__name__}" if self.result else "")

    @property
    def argument_names(self) -> tuple[str, ...]:
        """List the names of all arguments."""
        arguments = ", ".join(filter(None, (self.arguments, self.optional)))
        return tuple(argument.partition(": ")[0] for argument in arguments.split(", "))

    @property
    def kinds(self) -> tuple[str, ...]:
        """List the annotations of the required arguments."""
        return _kinds(self.arguments)

    @property
    def all_kinds(self) -> tuple[str, ...]:
        """List the annotations of all arguments."""
        return self.kinds + _kinds(self.optional)


def _kinds(arguments: str) -> tuple[str, ...]:
    return tuple(argument.partition(": ")[2] for argument in arguments.split(", ") if argument)


_TRANSITION = "s0: World, action: Row[float], s1: World, p: Params"

_RNG = "rng: Row[wp.uint32]"

FUNCTIONS = {
    function.name: function
    for function in (
        TaskFunction("observe", "s: World, p: Params, obs: Row[float]", optional=_RNG),
        TaskFunction(
            "control", "s: World, action: Row[float], p: Params, ctrl: Row[float]", default="pass",
            writes={"s": "inputs"},
        ),
        TaskFunction("reward", _TRANSITION, float, "return 0.0"),
        TaskFunction("measure", f"{_TRANSITION}, metrics: Row[float]", default="pass"),
        TaskFunction("evaluate", "s: World, p: Params", float, "return 0.0"),
        TaskFunction("terminated", "s: World, p: Params", bool, "return False"),
        TaskFunction("truncated", "s: World, p: Params", bool, "return False"),
        TaskFunction("success", "s: World, p: Params", bool, "return False"),
        TaskFunction("startup", f"s: World, p: Params, {_RNG}", default="pass", writes={"s": "lasting"}),
        TaskFunction("initialize", "s: World, p: Params", default="pass", writes={"s": "start"}),
        TaskFunction("randomize", f"s: World, p: Params, {_RNG}", default="pass", writes={"s": "start"}),
        TaskFunction("reject", "s: World, p: Params", bool, "return False"),
        TaskFunction("event", f"s: World, p: Params, {_RNG}", default="pass", writes={"s": "start"}),
        TaskFunction("substep", "s: World, p: Params", default="pass", writes={"s": "memory"}),
        TaskFunction("advance", f"{_TRANSITION}, {_RNG}", default="pass", writes={"s1": "memory"}),
        TaskFunction("tally", f"{_TRANSITION}, ended: bool, sums: Sums", optional="terminated: bool"),
        TaskFunction("share", "shared: Shared, sums: Sums, p: Params"),
    )
}  # fmt: skip
"""The functions of a task, by name. ``help(lw.Task)`` gives their purposes."""


RESULTS = ("obs", "ctrl", "metrics", "rng", "sums", "shared")
"""Arguments for results: each is one world's row of an array."""

MEMORIES = ("memory", "lasting_memory")
"""Kinds of memory in World. Every world has a row of floats for ``memory``, and another for ``lasting_memory``."""

GROUP_PREFIX = "observe_"
"""Prefix of functions that write a group of observations: ``observe_critic`` writes the group ``critic``."""


def observer_name(group: str) -> str:
    """Get the name of the function that writes a group of observations."""
    return "observe" if group == "policy" else f"{GROUP_PREFIX}{group}"


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a world's memory or of an observation."""

    kind: str
    size: int | str
    """Number of elements. The name of a table in Params stands for the table's number of rows."""


def memory(size: int | str = 1) -> Any:
    """Declare a task's memory in World, as in ``air_time: Row[float] = lw.memory(4)``.

    ``advance`` or ``substep`` writes the memory, and a reset clears it. The memory is part of the state. The field's
    type is ``Row[float]``, ``Row[wp.vec3]`` or another row of numbers.

    Args:
        size: Number of elements. The name of a table in Params stands for the table's number of rows.
    """
    return Part("memory", size)


def lasting_memory(size: int | str = 1) -> Any:
    """Declare memory in World that resets do not clear, as in ``level: Row[float] = lw.lasting_memory()``.

    Lasting memory is cleared only when a world's random stream starts (``rand_reset(seed=...)``). ``startup`` may
    then write it.

    Args:
        size: Number of elements. The name of a table in Params stands for the table's number of rows.
    """
    return Part("lasting_memory", size)


def part(size: int | str = 1) -> Any:
    """Declare a field of Shared, of Sums or of an observation struct, as in ``angles: Row[float] = lw.part(6)``.

    Args:
        size: Number of elements. The name of a table in Params stands for the table's number of rows.
    """
    return Part("obs", size)


class Element(int):
    """Name of a model element, as returned by ``site`` and similar functions. The element's index replaces it."""

    field: str
    name: str

    def __new__(cls, field: str, name: str) -> "Element":
        """Make an element. Its integer value is -1, because its index is not known yet."""
        element = super().__new__(cls, -1)
        element.field, element.name = field, name
        return element


def _elements(name: str, names: str, field: str, index: str) -> tuple[Callable[[str], int], Callable[..., Any]]:
    """Make a function for an element's index, and one for a table of such indices."""

    def one(name: str) -> int:
        return Element(field, name)

    def several(*names: str) -> Any:
        return [Element(field, name) for name in names]

    one.__name__ = one.__qualname__ = name
    one.__doc__ = f"Return a default for ``Params``: {index}."
    several.__name__ = several.__qualname__ = names
    several.__doc__ = f"Return a default for a ``wp.array[int]`` in ``Params``: for each name, {index}."
    return one, several


site, sites = _elements("site", "sites", "site_xpos", "a site's index in ``site_xpos`` and other ``site_`` fields")
body, bodies = _elements("body", "bodies", "xpos", "a body's index in ``xpos`` and other fields of bodies")
geom, geoms = _elements("geom", "geoms", "geom_xpos", "a geom's index in ``geom_xpos`` and other ``geom_`` fields")
camera, _ = _elements("camera", "", "cam_xpos", "a camera's index in ``cam_xpos`` and other ``cam_`` fields")
tendon, _ = _elements("tendon", "", "ten_length", "a tendon's index in ``ten_`` and ``tendon_`` fields")
equality, _ = _elements("equality", "", "eq_active", "an equality constraint's index in ``eq_`` fields")
actuator, actuators = _elements(
    "actuator", "actuators", "actuator_force", "an actuator's index in ``actuator_`` fields"
)
ctrl, _ = _elements("ctrl", "", "ctrl", "the index in ``ctrl`` of an actuator's first control; most have one")
act, _ = _elements("act", "", "act", "the index in ``act`` of an actuator's first activation")
joint, joints = _elements("joint", "joints", "xanchor", "a joint's index in ``xanchor``, ``xaxis`` and ``jnt_`` fields")
qpos, qposes = _elements("qpos", "qposes", "qpos", "the index in ``qpos`` of a joint's first coordinate")
dof, dofs = _elements("dof", "dofs", "qvel", "the index of a joint's first degree of freedom, as in ``qvel``")
sensor, sensors = _elements("sensor", "sensors", "sensordata", "the index in ``sensordata`` of a sensor's first number")
mocap, _ = _elements("mocap", "", "mocap_pos", "a mocap body's index in ``mocap_pos`` and ``mocap_quat``")


@dataclasses.dataclass(frozen=True)
class FromModel:
    """A parameter that is computed from the compiled model; see ``from_model``."""

    function: Callable[[mujoco.MjModel, Any], Any]


def from_model(function: Callable[[mujoco.MjModel, Any], Any]) -> Any:
    """Let a function compute a parameter's default from the compiled model and other parameters.

    For example, ``mass: float = lw.from_model(lambda model, p: model.body_subtreemass[p.trunk])`` is the mass of the
    robot. The parameter is computed again when another parameter changes, unless the user gave it a value.

    Args:
        function: Function with two arguments: the MjModel, and an object whose attributes are parameters. The object
            has every parameter with an ordinary default. It also has the computed parameters that Params declares
            before this one.
    """
    return FromModel(function)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planning:
    """Settings of a task for MPPI: settings of the planner, and options and parameters of its worlds.

    Raises:
        ValueError: A part is not a dict.
    """

    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Values of ``lw.MPPIConfig`` for the planner."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Arguments of ``lw.make`` for the planner's worlds, as in ``{"physics": "fast"}``."""
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Values of the task's ``Params`` for the planner's worlds. MPPI with a value function ignores these values,
    because the value function was fitted to the rewards of the unchanged task."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not isinstance(part := getattr(self, field.name), Mapping):
                raise ValueError(f"{field.name} of lw.Planning must be a dict, not {part!r}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """A task's settings for ``lyceum-warp train``. Flags override them.

    Raises:
        ValueError: ``settings`` is not a dict.
    """

    algorithm: str = "npg"
    """Name of the algorithm: npg, ppo, sac or distill."""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Hyperparameters of the algorithm, by their names in ``lw.NPGConfig``, ``lw.PPOConfig``, ``lw.SACConfig`` or
    ``lw.DistillConfig``. They are ignored if a flag chooses another algorithm."""
    iterations: int = 100
    """Number of iterations."""
    physics: str | None = None
    """Name of a set of options in the task's ``physics``, for learning. Policies are judged in "exact" physics."""
    exact_from: int | None = None
    """Number of iterations after which learning goes on in "exact" physics."""

    def __post_init__(self) -> None:
        if not isinstance(self.settings, Mapping):
            raise ValueError(f"settings of lw.Training must be a dict, not {self.settings!r}")


class Task:
    """Base class of tasks: a model, the fields that functions read, and functions that run in each world.

    A subclass names its model and the parts of its observation. The module of the subclass has two Warp structs and the
    task's functions. All of them may also be attributes of the class. The struct ``World`` lists the fields that the
    functions read. The struct ``Params`` lists the keyword arguments of ``make`` with defaults. Its fields ``dt`` and
    ``substep_dt`` are the seconds of a step and a substep. Each function is a ``wp.func``.

    ``World`` lists fields of MjData and MjModel by MuJoCo's names, such as ``qpos``, ``site_xpos`` and ``body_mass``. A
    model field differs between worlds, and is part of the state, if ``startup``, ``initialize``, ``randomize`` or
    ``event`` writes it. Otherwise all worlds share it. ``World`` also declares memory, as in ``air_time: Row[float] =
    lw.memory(4)``. Resets clear this memory. They do not clear lasting memory, which ``lw.lasting_memory(4)`` declares.

    A default in ``Params`` may name an element of the model, such as ``tip: int = lw.site("tip")``. Functions get the
    element's index. There are also ``lw.body``, ``lw.geom``, ``lw.camera``, ``lw.joint``, ``lw.qpos``, ``lw.dof``,
    ``lw.actuator``, ``lw.ctrl``, ``lw.act``, ``lw.tendon``, ``lw.equality``, ``lw.sensor`` and ``lw.mocap``. A field of
    a type such as ``wp.array[float]`` or ``wp.array2d[wp.vec3]`` is a table that all worlds share. Its default is a
    nested list or an array. ``feet: wp.array[int] = lw.sites("left_foot", "right_foot")`` is a table of elements. There
    are also ``lw.bodies``, ``lw.geoms``, ``lw.joints``, ``lw.qposes``, ``lw.dofs``, ``lw.actuators`` and
    ``lw.sensors``. ``lw.from_model`` computes a default from the compiled model.

    Functions:
        observe(s: World, p: Params, obs: Row[float])
            Writes the observation, into a row or into a struct of named parts. Every task needs this
            function. With ``rng`` as its last argument, the function may draw noise.
        control(s: World, action: Row[float], p: Params, ctrl: Row[float])
            Turns an action into controls, and writes further inputs. Default: copies or scales the action
            (see ``action_range``).
        reward(s0: World, action: Row[float], s1: World, p: Params) -> float
            Reward of one transition. ``advance`` has already written the memory of ``s1``. Default: 0.
        measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float])
            Writes the metrics of one transition, in the order of the attribute ``metrics``. Default: none.
        evaluate(s: World, p: Params) -> float
            The evaluation metric, separate from the reward. Default: the reward.
        terminated(s: World, p: Params) -> bool
            Whether the state ends the episode. Default: False.
        truncated(s: World, p: Params) -> bool
            Whether the episode ends without a failure, such as at the end of a clip. Learners then
            bootstrap from the last observation. Planners ignore it. Default: False.
        success(s: World, p: Params) -> bool
            Whether the state meets the task's goal; ``success_steps`` may require several steps in a row.
            Default: False.
        startup(s: World, p: Params, rng: Row[wp.uint32])
            Draws model fields and lasting memory once for each world, when its random stream starts.
            Default: no change.
        initialize(s: World, p: Params)
            Changes the fixed initial state, which the model defines. Default: no change.
        randomize(s: World, p: Params, rng: Row[wp.uint32])
            Turns the fixed initial state into a random initial state. Default: no change.
        reject(s: World, p: Params) -> bool
            Whether a random initial state must be drawn again, at most ``draws`` times. Default: False.
        event(s: World, p: Params, rng: Row[wp.uint32])
            Changes the state between two steps, after the reward and before the next observation. Default:
            no change.
        substep(s: World, p: Params)
            Writes task memory after each substep. Default: no change.
        advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32])
            Writes task memory of ``s1`` after each step and before ``reward``. Default: no change.
        tally(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums)
            Writes what one transition adds to sums over all worlds. ``ended`` is True at an episode's end.
            With ``terminated`` as its last argument, the function can tell failures from truncations. It is
            called only in environments with automatic resets. Default: none.
        share(shared: Shared, sums: Sums, p: Params)
            Updates the memory that all worlds share, from the sums since the last update.
            ``env.update_shared`` calls this function. Default: no change.

    The argument ``s`` has one world's fields in the current state. ``s0`` has the fields before the step, and ``s1``
    has them after the step. Fields of the position and velocity stages belong to this state. Fields of the acceleration
    stage (forces, accelerations) come from the last substep. A sensor belongs to the stage that computes its quantity.
    Controls are clipped to the model's ranges, but ``reward`` gets the unclipped action. The argument ``rng`` is the
    world's random stream, for ``lw.uniform`` and ``lw.normal``.

    A function may write only the following fields, and only if ``World`` lists them:

    - ``control``: the inputs xfrc_applied, qfrc_applied, mocap_pos, mocap_quat and userdata. An input keeps its value
      until the next write or reset.
    - ``initialize``, ``randomize`` and ``event``: qpos, qvel, act, ctrl, eq_active, the inputs, memory, lasting memory
      and model fields. Every reset first restores the nominal values of model fields, so random changes do not
      accumulate.
    - ``startup``: model fields and lasting memory. Resets do not change them.
    - ``substep`` and ``advance``: both kinds of memory. ``advance`` writes the memory of ``s1``.

    ``startup``, ``initialize`` and ``randomize`` must not read derived fields (``xpos``, ``site_xpos``,
    ``sensordata``), because these are computed afterwards.

    A reset calls ``reject`` before the substeps of ``settle``. During these substeps, ``substep`` is not called.

    An event runs after the reward and the termination of a step, and before the next observation. It does not run in
    worlds that restart. Open-loop rollouts and planners run no events.

    Quaternions in fields have MuJoCo's order w, x, y, z and the type ``Row[lw.quat]``. Warp's quaternion functions
    expect the order x, y, z, w and refuse ``lw.quat``: use ``lw.quat_rotate``, ``lw.quat_mul``,
    ``lw.quat_from_axis_angle`` and others.
    """

    model: ClassVar[Any]
    """The model: a file name, ``lw.package_model(...)``, an MjSpec, or a static method without arguments that returns
    one of these. A file name is relative to the task's file, or names one of gymnasium's models."""
    frame_skip: ClassVar[int] = 1
    """Substeps in a step."""
    obs: ClassVar[Any]
    """Parts of the observation and their sizes, such as ``{"position": 5, "velocity": 6}``. A static method may compute
    them from the Params. A task may have several groups of observations, such as ``{"policy": {"position": 5},
    "critic": {"position": 5, "mass": 1}}``. Then ``observe`` writes the group ``policy`` (``env.obs``).
    ``observe_critic`` has the same arguments and writes the group ``critic``. Omit ``obs`` if the last argument of
    ``observe`` is a Warp struct whose fields have the default ``lw.part(size)``."""
    cameras: ClassVar[tuple[Camera, ...]] = ()
    """Cameras whose pictures are further groups of observations, such as ``(lw.Camera("fixed", width=64),)``."""
    objects: ClassVar[Objects | None] = None
    """Models of a body, of which each world holds one, such as ``lw.Objects("object", {"cube": lw.shape("box", 0.03,
    0.03, 0.03), "mug": lw.mesh("mug.stl")})``. ``World`` may list ``object: Row[float]``; its element is the index of
    the world's object in this dict."""
    params: ClassVar[Mapping[str, Any]] = {}
    """Defaults that replace those of ``Params``, such as ``{"move_speed": 8.0}`` for a faster variant of a task."""
    rewards: ClassVar[Mapping[str, float]] = {}
    """Terms of the reward with weights per second, such as ``{"upright": 1.0, "effort": -0.1}``. They replace
    ``reward``. A term is a function in the task's module that returns a float. Its arguments are found by name. A name
    may be ``s0``, ``action``, ``s1`` (or ``s``) or ``p``, another function, a parameter, or a field of World. The
    reward is dt times the weighted sum of the terms. ``lw.make(task, upright=2.0)`` and ``set_params`` change weights.
    There is also a metric for each term: the term times its weight and dt. ``env.task.reward_text`` is the generated
    source."""
    terminations: ClassVar[tuple[str, ...]] = ()
    """Names of functions that end the episode if one of them returns True. They replace ``terminated``. Their arguments
    are ``s``, ``p``, and any others that a term may have. Each function is also a metric: 1 if it returns True after
    the step, and 0 otherwise."""
    truncations: ClassVar[tuple[str, ...]] = ()
    """Names of functions that end the episode without a failure, such as at the end of a clip or of the ground. They
    replace ``truncated``. Their arguments and metrics are those of ``terminations``."""
    metrics: ClassVar[tuple[str, ...]] = ()
    """Names of the metrics that ``measure`` writes. Without ``measure``, each is the name of a function that returns a
    float or a bool. Its arguments may be those of a term."""
    horizon: ClassVar[int] = 1000
    """Number of steps after which an episode is truncated, or 0 for never."""
    success_steps: ClassVar[int] = 1
    """Number of successes in a row before ``env.success`` is True. If it is more than 1, the state has a part
    ``success_steps`` with the count so far. A reset clears the count."""
    lagged: ClassVar[tuple[str, ...]] = ()
    """Fields that keep the values from ``mj_step``, as in some Gymnasium tasks. These values are one substep older than
    the state."""
    cleared: ClassVar[tuple[str, ...]] = ()
    """Fields of the last substep, such as contact forces, that a reset clears before ``initialize``. A forward pass
    computes all other fields in worlds that restart."""
    actions: ClassVar[Mapping[str, int | str] | None] = None
    """Parts of an action and their sizes, such as ``{"speed": 1, "turn": 1}``, if actions are not controls. ``control``
    converts them. A size may be the name of a table in Params. The part then has one number per row. With None, an
    action has one number for each control."""
    action_range: ClassVar[tuple[float, float] | None] = None
    """The range of actions. The default ``control`` scales it to the model's control ranges. With None, actions are not
    scaled, and are unbounded if the task declares ``actions``."""
    keyframe: ClassVar[str | None] = None
    """Name of the keyframe that a reset loads before it calls ``initialize``; None means ``qpos0``."""
    draws: ClassVar[int] = 10
    """Maximum number of initial states that a reset draws until ``reject`` accepts one. If ``reject`` refuses all, the
    reset uses the last one."""
    settle: ClassVar[int] = 0
    """Number of substeps that are simulated before the first observation of an episode, so that objects come to rest.
    They use the initial state's controls and do not call ``substep``. The episode's time starts after these
    substeps."""
    gymnasium: ClassVar[str | None] = None
    """Id of the Gymnasium environment that the task reimplements, such as "Hopper-v5". Model, observation, reward,
    termination, reset and parameters are the same as in that environment. Subclasses do not inherit this attribute."""
    ghost: ClassVar[Any] = None
    """A static method ``ghost(p, state)`` that returns the coordinates of a pose, (nq,). The viewer and videos show
    this pose as a transparent robot, such as the reference of a clip. ``p`` has the parameters as attributes, and
    ``state`` has the parts of a state by their names."""
    trace: ClassVar[str | None] = None
    """Name of a site or body whose path the viewer draws for a planner's samples. By default, this is the centre of
    mass of a robot with a floating base, or the end of an arm."""
    mirror: ClassVar[Any] = None
    """The task's mirror image, for symmetric policies: ``lw.Mirror(...)``, or a static method ``mirror(model, p)`` that
    returns an ``lw.Mirror``."""
    physics: ClassVar[Mapping[str, PhysicsOptions]] = {}
    """Physics options by name. For example, ``{"fast": lw.PhysicsOptions(integrator="implicitfast")}`` is for
    ``lw.make(task, physics="fast")``. The default, "exact", means the options of the model and ``frame_skip``."""
    planning: ClassVar[Planning] = Planning()
    """The task's settings for MPPI, such as ``lw.Planning(settings={"horizon": 16}, options={...}, params={...})``."""
    gate: ClassVar[Gate | None] = None
    """A test that a policy of the task must pass, for ``lw.gate`` and ``lyceum-warp gate``."""
    training: ClassVar[Training] = Training()
    """The task's settings for ``lyceum-warp train``, such as ``lw.Training(algorithm="ppo", settings={...})``."""

    # World, Params and the Warp functions at the time of the class's definition
    scope: ClassVar[dict[str, Any]]

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Change the model's spec in place, before MuJoCo compiles it.

        The spec describes the task's model, or the model passed to ``make``. The ``edit_model`` of each parent class
        runs first, so it must not be called.
        """

    @staticmethod
    def deployment(model: mujoco.MjModel, p: Any, memory: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Return metadata for ONNX files, such as a robot's gains. The values must be convertible to JSON.

        The argument ``model`` is the compiled model, and ``p`` has the parameters as attributes. ``memory`` has the
        shared memory, each (size,), and the lasting memory, each (nworld, size), at the end of training.
        """
        return {}

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "gymnasium" not in vars(cls):
            cls.gymnasium = None
        # copy them now, because a later cell of a notebook may define another task
        module = vars(sys.modules[cls.__module__])
        cls.scope = {
            name: value
            for name, value in module.items()
            if name in ("World", "Params") or isinstance(value, wp.Function)
        }
