"""Task: what a user writes."""

import dataclasses
import sys
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


FUNCTIONS = (
    "observe",
    "control",
    "reward",
    "evaluate",
    "terminated",
    "success",
    "initialize",
    "randomize",
    "advance",
)
"""The functions of a task."""


class Element(int):
    """The place of a named element of the model, found when the model is known. See ``site`` and its like."""

    field: str
    name: str

    def __new__(cls, field: str, name: str) -> "Element":
        """An integer that says which element it stands for; its own value is never used."""
        element = super().__new__(cls, -1)
        element.field, element.name = field, name
        return element


def site(name: str) -> int:
    """As a default in Params: the index of a site, in ``site_xpos`` and its like."""
    return Element("site_xpos", name)


def body(name: str) -> int:
    """As a default in Params: the index of a body, in ``xpos`` and its like."""
    return Element("xpos", name)


def geom(name: str) -> int:
    """As a default in Params: the index of a geom, in ``geom_xpos`` and its like."""
    return Element("geom_xpos", name)


def qpos(joint: str) -> int:
    """As a default in Params: where a joint's coordinates begin in ``qpos``."""
    return Element("qpos", joint)


def dof(joint: str) -> int:
    """As a default in Params: where a joint's degrees of freedom begin in ``qvel`` and its like."""
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
    """What suits a task when MPPI plans for it.

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


class Task:
    """A model, the fields that are read, and a few functions of one world.

    A subclass names its model and the parts of its observation. Its module holds two Warp structs, ``World``
    (the fields that the functions read, by MuJoCo's names) and ``Params`` (the keyword arguments of ``make``,
    with defaults), and the functions, each a ``wp.func``. Either may also be an attribute of the class.

    =============================================== =====================================================
    ``observe(s, p, obs)``                          fills the observation; the only one that is required
    ``reward(s0, action, s1, p) -> float``          of one transition; default 0
    ``evaluate(s, p) -> float``                     the evaluation metric; default: the reward
    ``terminated(s, p) -> bool``                    default False
    ``success(s, p) -> bool``                       default False
    ``control(s, action, p, ctrl)``                 action to controls; default: copy (see ``action_range``)
    ``initialize(s, p)``                            changes the fixed initial state, the model's own
    ``randomize(s, p, rng)``                        turns the fixed initial state into a random one
    ``advance(s0, action, s1, p, rng)``             the only writer of task memory, ``s1.memory``
    =============================================== =====================================================

    Controls are clipped to the model's ranges; costs see the action as given. ``rng`` is drawn from with
    ``uniform`` and ``normal``. ``initialize`` and ``randomize`` may write qpos, qvel, act, mocap_pos,
    mocap_quat, userdata and memory where ``World`` lists them; positions and the like (``xpos``, ``site_xpos``,
    ``sensordata``) are computed only after them, so that these two must not read any.
    """

    model: ClassVar[Any]
    """A file (relative to the task's own file, or one that gymnasium ships), an MjSpec, or a static method
    without arguments that makes one."""
    frame_skip: ClassVar[int] = 1
    """Physics substeps in a step."""
    obs: ClassVar[Any]
    """The observation's parts and their sizes, in order; or a static method of the Params that gives them."""
    horizon: ClassVar[int] = 1000
    """Steps after which an episode is truncated; 0 for never."""
    lagged: ClassVar[tuple[str, ...]] = ()
    """Fields wanted as ``mj_step`` leaves them, one substep behind the state, as in some Gymnasium tasks."""
    memory: ClassVar[int] = 0
    """Floats that the task remembers, in the field ``memory``."""
    action_range: ClassVar[tuple[float, float] | None] = None
    """The range of an action that the default ``control`` maps to the model's control ranges; None: actions
    are controls."""
    planning: ClassVar[Planning] = Planning()
    """What suits this task when MPPI plans for it: settings of the planner, and options and parameters of its worlds,
    as ``lw.Planning(settings={"horizon": 16}, options={...}, params={...})``."""

    scope: ClassVar[dict[str, Any]] = {}
    """What the class's module held by the names above when the class was made."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        # now: another task, in a later cell of the same notebook, has the same names
        module = vars(sys.modules[cls.__module__])
        cls.scope = {name: module[name] for name in ("World", "Params", *FUNCTIONS) if name in module}
