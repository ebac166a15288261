"""Task, the base class of every task, and the one table of a task's functions."""

import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import warp as wp

from lyceum_warp.docstrings import document_attributes

if TYPE_CHECKING:
    T = TypeVar("T")

    class Row(Generic[T]):
        """One world's values of a field; inside a kernel, a one-dimensional Warp array."""

        shape: tuple[int, ...]

        def __getitem__(self, i: int) -> T: ...
        def __setitem__(self, i: int, value: T) -> None: ...
        def __len__(self) -> int: ...
else:
    Row = wp.array


@dataclasses.dataclass(frozen=True)
class TaskFunction:
    """One of a task's functions: its signature, its purpose and its default."""

    name: str
    arguments: str
    """The arguments as they are written in a task's file."""
    result: type | None
    """The type of its result: float, bool, or None for a function that writes into its arguments."""
    about: str
    """Its purpose and its default, for the documentation."""
    default: str | None = None
    """The body of the function that stands in for it; None where it is required."""

    @property
    def signature(self) -> str:
        """The line that defines it, without ``def``."""
        return f"{self.name}({self.arguments})" + (f" -> {self.result.__name__}" if self.result else "")

    @property
    def kinds(self) -> tuple[str, ...]:
        """The annotations of its arguments, in order."""
        return tuple(argument.partition(": ")[2] for argument in self.arguments.split(", "))


_TRANSITION = "s0: World, action: Row[float], s1: World, p: Params"

FUNCTIONS = {
    function.name: function
    for function in (
        TaskFunction("observe", "s: World, p: Params, obs: Row[float]", None,
                     "Writes the observation. The only function that is required."),
        TaskFunction("control", "s: World, action: Row[float], p: Params, ctrl: Row[float]", None,
                     "Turns an action into controls. Default: copies it, or scales it (see ``action_range``).", "pass"),
        TaskFunction("reward", _TRANSITION, float,
                     "Reward of one transition. ``s1.memory`` is already that of ``advance``. Default: 0.",
                     "return 0.0"),
        TaskFunction("evaluate", "s: World, p: Params", float,
                     "The evaluation metric, separate from the reward. Default: the reward.", "return 0.0"),
        TaskFunction("terminated", "s: World, p: Params", bool,
                     "Whether the state ends the episode. Default: False.", "return False"),
        TaskFunction("success", "s: World, p: Params", bool,
                     "Whether the task's goal is met. Default: False.", "return False"),
        TaskFunction("initialize", "s: World, p: Params", None,
                     "Changes the fixed initial state, the model's own. Default: keeps it.", "pass"),
        TaskFunction("randomize", "s: World, p: Params, rng: Row[wp.uint32]", None,
                     "Turns the fixed initial state into a random one. Default: keeps it.", "pass"),
        TaskFunction("advance", f"{_TRANSITION}, rng: Row[wp.uint32]", None,
                     "Writes task memory, ``s1.memory``, after each step and before ``reward``. Default: keeps it.",
                     "pass"),
    )
}  # fmt: skip
"""The functions of a task, by name. Checks, kernels, error messages and ``help(lw.Task)`` are made from this table."""


def _document_functions(cls: type["Task"]) -> type["Task"]:
    """Class decorator: put the table of functions into the docstring."""
    rows = []
    for function in FUNCTIONS.values():
        rows += [f"    {function.signature}", *textwrap.wrap(function.about, 108, initial_indent=" " * 8,
                                                              subsequent_indent=" " * 8)]  # fmt: skip
    cls.__doc__ = inspect.cleandoc(cls.__doc__ or "").replace("{functions}", "\n".join(rows))
    return cls


class Element(int):
    """The place of a named element of the model, found when the model is known. Functions such as ``site`` make it."""

    field: str
    name: str

    def __new__(cls, field: str, name: str) -> "Element":
        """An integer that holds the element's name; its own value is never used."""
        element = super().__new__(cls, -1)
        element.field, element.name = field, name
        return element


def site(name: str) -> int:
    """As a default in Params: the index of a site, in ``site_xpos`` and the other ``site_`` fields."""
    return Element("site_xpos", name)


def body(name: str) -> int:
    """As a default in Params: the index of a body, in ``xpos`` and the other fields of bodies."""
    return Element("xpos", name)


def geom(name: str) -> int:
    """As a default in Params: the index of a geom, in ``geom_xpos`` and the other ``geom_`` fields."""
    return Element("geom_xpos", name)


def qpos(joint: str) -> int:
    """As a default in Params: where a joint's coordinates begin in ``qpos``."""
    return Element("qpos", joint)


def dof(joint: str) -> int:
    """As a default in Params: where a joint's degrees of freedom begin in ``qvel`` and fields of its size."""
    return Element("qvel", joint)


def sensor(name: str) -> int:
    """As a default in Params: where a sensor's numbers begin in ``sensordata``."""
    return Element("sensordata", name)


def mocap(body: str) -> int:
    """As a default in Params: the index of a mocap body, in ``mocap_pos`` and ``mocap_quat``."""
    return Element("mocap_pos", body)


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class Planning:
    """A task's settings for MPPI: those of the planner, and options and parameters of its worlds.

    Raises:
        ValueError: A part is not a dict.
    """

    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the planner, by the names of ``lw.MPPIConfig``."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options of the planner's worlds, by the names that ``lw.make`` knows, as ``{"integrator": "euler"}``."""
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Parameters of the planner's worlds, by the names of the task's ``Params``. They do not apply where MPPI is given
    a value function, because that was fitted to the rewards of the task itself."""

    def __post_init__(self) -> None:
        """Check the type of every part."""
        for field in dataclasses.fields(self):
            if not isinstance(part := getattr(self, field.name), Mapping):
                raise ValueError(f"{field.name} of lw.Planning must be a dict, not {part!r}")


@_document_functions
@document_attributes
class Task:
    """A model, the fields that are read, and a few functions of one world.

    A subclass names its model and the parts of its observation. Its module holds two Warp structs, ``World`` (the
    fields that the functions read, by MuJoCo's names) and ``Params`` (the keyword arguments of ``make``, with
    defaults; ``dt``, the seconds in a step, is filled in), and the functions, each a ``wp.func``. Each of these may
    also be an attribute of the class.

    A default in ``Params`` may name an element of the model, as ``tip: int = lw.site("tip")``: the functions then get
    its index. ``lw.body``, ``lw.geom``, ``lw.qpos``, ``lw.dof``, ``lw.sensor`` and ``lw.mocap`` work likewise.

    Functions:
    {functions}

    ``s``, ``s0`` and ``s1`` are one world's fields: now, before the step, and after it. Fields of the position and
    velocity stages belong to that state; fields of the acceleration stage (forces, accelerations) are those of the last
    substep. Controls are clipped to the model's ranges; costs see the action as given. ``rng`` is the world's random
    stream: pass it to ``lw.uniform`` and ``lw.normal``.

    ``initialize`` and ``randomize`` may write qpos, qvel, act, mocap_pos, mocap_quat, userdata and memory where
    ``World`` lists them. They must not read derived fields (``xpos``, ``site_xpos``, ``sensordata``): these are
    computed afterwards.

    Quaternions in fields are in MuJoCo's order w, x, y, z, and typed ``Row[lw.quat]``. Warp's own quaternion functions
    expect x, y, z, w and refuse them: use ``lw.quat_rotate``, ``lw.quat_mul``, ``lw.quat_from_axis_angle`` and others.
    """

    model: ClassVar[Any]
    """The model: a file (relative to the task's own file, or one that gymnasium ships), an MjSpec, or a static method
    without arguments that returns one."""
    frame_skip: ClassVar[int] = 1
    """Substeps in a step."""
    obs: ClassVar[Any]
    """The observation's parts and their sizes, in order, as ``{"position": 5, "velocity": 6}``; or a static method of
    the Params that returns them."""
    horizon: ClassVar[int] = 1000
    """Steps after which an episode is truncated; 0 for never."""
    lagged: ClassVar[tuple[str, ...]] = ()
    """Fields to read as ``mj_step`` leaves them, one substep behind the state, as some Gymnasium tasks do."""
    memory: ClassVar[int] = 0
    """Number of floats in the field ``memory``, which the task writes in ``advance`` and which belongs to the state.
    ``World`` must list it as ``memory: Row[float]``."""
    action_range: ClassVar[tuple[float, float] | None] = None
    """The range of an action that the default ``control`` scales to the model's control ranges; None: actions are
    controls."""
    planning: ClassVar[Planning] = Planning()
    """The task's settings for MPPI: those of the planner, and options and parameters of its worlds, as
    ``lw.Planning(settings={"horizon": 16}, options={...}, params={...})``."""

    # World, Params and functions of the class's module when the class was made; each subclass has its own
    scope: ClassVar[dict[str, Any]]

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # now: another task, in a later cell of the same notebook, has the same names
        module = vars(sys.modules[cls.__module__])
        cls.scope = {name: module[name] for name in ("World", "Params", *FUNCTIONS) if name in module}
