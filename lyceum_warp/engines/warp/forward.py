"""Compute forward passes and substeps: whole ones, the parts that fields need, and those of a few worlds."""

import functools
import inspect
import types
from collections.abc import Callable, Collection, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.engines.warp.group import Turns
from lyceum_warp.engines.warp.sizes import report_pool_overflow
from lyceum_warp.engines.warp.varied_model import ModelRows, StaticGeoms
from lyceum_warp.fields import Stage
from lyceum_warp.kernels.state import copy_rows
from lyceum_warp.support.arrays import launch_rows
from lyceum_warp.support.upstream import forward_functions

Part = Callable[[mjw.Model, mjw.Data], None]
"""A part of a forward pass, in every world of a data."""

POSITION: tuple[Part, ...] = (mjw.kinematics, mjw.com_pos, mjw.camlight, mjw.flex, mjw.tendon)
"""The parts that a substep and a forward pass begin with; they are functions of positions alone."""


def step(model: mjw.Model, data: mjw.Data, done: Collection[Part] = ()) -> None:
    """Advance every world of a data by one substep.

    Args:
        model: MuJoCo Warp's model.
        data: Its data.
        done: Parts of ``POSITION`` that are already computed for the data's state.
    """
    _without(frozenset(done))["step"](model, data)


def forward(model: mjw.Model, data: mjw.Data) -> None:
    """Compute everything that follows from the states of a data."""
    _without(frozenset())["forward"](model, data)


def inertia(model: mjw.Model, data: mjw.Data) -> None:
    """Compute the inertia matrix, with the armature of tendons and of the actuators that pull at them."""
    mjw.crb(model, data)
    forward_functions()["smooth"].tendon_armature(model, data)


@functools.cache
def _without(done: frozenset[Part]) -> dict[str, Callable[..., None]]:
    """MuJoCo Warp's own functions, in whose first forward pass some parts are left out.

    They are copies whose global names stand for other functions, so that whatever else MuJoCo Warp does in a step is
    done here, too, and so that nothing changes for other users of its module.

    ``mjw.make_constraint`` reads the velocities of bodies for connect and weld constraints, and MuJoCo Warp computes
    them only later: it finds the last forward pass's, of another state, or, after a fault, not-a-number. Here they
    follow the positions, in every stage of a Runge-Kutta step.
    """
    own_smooth = vars(forward_functions()["smooth"])
    smooth = types.SimpleNamespace(**own_smooth | {part.__name__: _nothing for part in done})
    positions = _copy("fwd_kinematics", smooth=smooth)

    def fwd_kinematics(model: mjw.Model, data: mjw.Data) -> None:
        positions(model, data)
        if model.eq_connect_adr.size or model.eq_wld_adr.size:
            mjw.com_vel(model, data)

    fwd_position = _copy("fwd_position", fwd_kinematics=fwd_kinematics)
    whole = _copy("_forward", fwd_position=fwd_position)
    forward = _copy("forward", _forward=whole)
    stage = _without(frozenset())["_forward"] if done else whole
    step = _copy("step", forward=forward, rungekutta4=_copy("rungekutta4", _forward=stage))
    return {"_forward": whole, "forward": forward, "step": step}


def _copy(function: str, **names: Any) -> Callable[..., Any]:
    """A copy of a function of MuJoCo Warp's, in which some of its global names stand for other objects."""
    inner: Any = inspect.unwrap(forward_functions()[function])
    if unknown := names.keys() - set(inner.__code__.co_names):
        raise ImportError(f"{function} of this mujoco_warp uses no {min(unknown)}: use mujoco-warp 4.0")
    return types.FunctionType(inner.__code__, inner.__globals__ | names, function, inner.__defaults__)


def _nothing(model: mjw.Model, data: mjw.Data) -> None:
    """Do nothing: the part is already done."""


_NEEDS: dict[Part, tuple[Part, ...]] = {
    mjw.kinematics: (),
    mjw.com_pos: (mjw.kinematics,),
    mjw.camlight: (mjw.com_pos,),
    mjw.flex: (mjw.com_pos,),
    mjw.tendon: (mjw.com_pos,),
    inertia: (mjw.com_pos, mjw.tendon),
    mjw.transmission: (mjw.com_pos, mjw.tendon),
    mjw.com_vel: (mjw.com_pos,),
    mjw.fwd_velocity: (mjw.com_pos, mjw.flex, mjw.tendon, mjw.transmission),
    mjw.subtree_vel: (mjw.com_vel,),
}
"""The parts without collisions and constraints, in their order, and what each needs; ``fwd_velocity`` has ``com_vel``
in it."""

_FIELDS: dict[Part, str] = {
    mjw.kinematics: "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat",
    mjw.com_pos: "subtree_com cdof cinert",
    mjw.camlight: "cam_xpos cam_xmat light_xpos light_xdir",
    mjw.flex: "flexvert_xpos flexedge_length",
    mjw.tendon: "ten_length",
    inertia: "crb",
    mjw.transmission: "actuator_length",
    mjw.com_vel: "cvel cdof_dot",
    mjw.fwd_velocity: "ten_velocity actuator_velocity qfrc_bias qfrc_spring qfrc_damper qfrc_gravcomp qfrc_fluid "
    "qfrc_passive",
    mjw.subtree_vel: "subtree_linvel subtree_angmom",
}
"""The fields that each part computes."""

_PART_OF = {name: part for part, names in _FIELDS.items() for name in names.split()}

_SENSORS: dict[str, tuple[Part, ...]] = {
    "JOINTPOS BALLQUAT JOINTVEL BALLANGVEL CLOCK": (),
    "MAGNETOMETER FRAMEPOS FRAMEQUAT FRAMEXAXIS FRAMEYAXIS FRAMEZAXIS INSIDESITE": (mjw.kinematics,),
    "RANGEFINDER": (mjw.kinematics, mjw.flex),
    "SUBTREECOM": (mjw.com_pos,),
    "CAMPROJECTION": (mjw.camlight,),
    "TENDONPOS": (mjw.tendon,),
    "ACTUATORPOS": (mjw.transmission,),
    "E_POTENTIAL": (mjw.kinematics, mjw.flex, mjw.tendon),
    "E_KINETIC": (inertia,),
    "VELOCIMETER GYRO FRAMELINVEL FRAMEANGVEL SUBTREELINVEL SUBTREEANGMOM": (mjw.com_vel,),
    "TENDONVEL ACTUATORVEL": (mjw.fwd_velocity,),
}
"""What sensors of the position and velocity stages need, by their types; those of other types need a forward pass."""

_PARTS_OF_SENSOR = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}")): parts
    for kinds, parts in _SENSORS.items()
    for kind in kinds.split()
}


def forward_parts(model: mujoco.MjModel, names: Collection[str]) -> tuple[Part, ...] | None:
    """The parts of a forward pass that compute the named fields, in order, without collisions and constraints.

    Of ``sensordata`` the parts compute the sensors of the position and velocity stages.

    Args:
        model: The compiled model.
        names: The fields.

    Returns:
        The parts, or None if the fields need collisions or constraints.
    """
    wanted: set[Part] = set()
    for name in names:
        if name != "sensordata" and name not in _PART_OF:
            return None
        wanted.update(() if name == "sensordata" else (_PART_OF[name],))
    sensors: list[Part] = []
    if "sensordata" in names:
        needed = _parts_of_sensors(model)
        if needed is None:
            return None
        wanted |= needed
        sensors = [mjw.sensor_pos, mjw.sensor_vel][: int(_last_stage(model))]
    for part in reversed(_NEEDS):
        if part in wanted:
            wanted.update(_NEEDS[part])
    if mjw.fwd_velocity in wanted:
        wanted.discard(mjw.com_vel)
    if _touching(model) and wanted & {mjw.transmission, mjw.fwd_velocity}:
        return None
    return (*(part for part in _NEEDS if part in wanted), *sensors)


def _parts_of_sensors(model: mujoco.MjModel) -> set[Part] | None:
    """The parts that the sensors of the position and velocity stages need, or None."""
    wanted: set[Part] = set()
    camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
    for i in range(model.nsensor):
        if model.sensor_needstage[i] >= Stage.ACCELERATION:
            continue
        parts = _PARTS_OF_SENSOR.get(int(model.sensor_type[i]))
        if parts is None:
            return None
        wanted.update(parts)
        if camera in (model.sensor_objtype[i], model.sensor_reftype[i]):
            wanted.add(mjw.camlight)
    return wanted


def _last_stage(model: mujoco.MjModel) -> Stage:
    """The last stage before the acceleration that a sensor belongs to."""
    stages = [int(stage) for stage in model.sensor_needstage if stage < Stage.ACCELERATION]
    return Stage(max(stages, default=0))


def _touching(model: mujoco.MjModel) -> bool:
    """Whether contacts act on actuators or passive forces: adhesion, and contacts of a flex that are springs."""
    by_body = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)).any()
    return bool(by_body or model.flg_adhesion or model.flex_passive.any())


_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


class PartialForward:
    """Computes fields of the masked worlds in a group of other worlds, and copies them back.

    Few worlds restart in a step, none in most steps of a small batch, and a forward pass of all worlds costs as much
    as a substep. So the masked worlds' states are copied into a small group, in as many turns as it takes.

    Args:
        rows: The group's view of MuJoCo Warp's model.
        data: MuJoCo Warp's data of all worlds.
        group: The same of the group.
        states: Room for the integration states of all worlds, (nworld, integration size), float32.
        static: Geoms whose poses a forward pass does not compute.
    """

    def __init__(self, rows: ModelRows, data: mjw.Data, group: mjw.Data, states: wp.array, static: StaticGeoms) -> None:
        self._rows, self._data, self._group, self._states, self._static = rows, data, group, states, static
        self._device = wp.get_device(data.qpos.device)
        with wp.ScopedDevice(self._device):
            self._group_states = wp.zeros((group.nworld, states.shape[1]), dtype=float)
            self._everyone = wp.full(group.nworld, True, dtype=bool)
            self._no_time = wp.zeros((data.nworld, 1), dtype=float)
        self._turns = Turns(data.nworld, group.nworld, self._device)

    def __call__(
        self, mask: wp.array, forward: Callable[[mjw.Model, mjw.Data], None], targets: Mapping[str, wp.array]
    ) -> None:
        """Compute fields of the masked worlds; made of launches.

        Args:
            mask: Which worlds, (nworld,) bool.
            forward: Computes the fields of a data.
            targets: Where the fields go, (nworld, ...), by their names in MuJoCo Warp's data.
        """
        data, group = self._data, self._group

        def turn() -> None:
            self._enter()
            forward(self._rows.model, group)
            report_pool_overflow(group, self._everyone)
            results = {name: (getattr(group, name), target) for name, target in targets.items()}
            for source, target in results.values():
                self._turns.give(source, target)
            self._turns.give_bits(group.overflow, data.overflow)

        with wp.ScopedDevice(self._device):
            mjw.get_state(self._rows.whole, data, self._states, _SPEC, mask)
            self._turns.run(mask, turn)

    def settle(self, mask: wp.array, nstep: int) -> None:
        """Advance the masked worlds' states by some substeps, and set their time to 0; made of launches."""
        data, group = self._data, self._group

        def turn() -> None:
            self._enter()
            for _ in range(nstep):
                step(self._rows.model, group)
            mjw.get_state(self._rows.model, group, self._group_states, _SPEC)
            self._turns.give(self._group_states, self._states)
            self._turns.give_bits(group.overflow, data.overflow)

        with wp.ScopedDevice(self._device):
            mjw.get_state(self._rows.whole, data, self._states, _SPEC, mask)
            self._turns.run(mask, turn)
            launch_rows(copy_rows, mask, self._no_time, self._states[:, :1])  # time is the first number of a state
            mjw.set_state(self._rows.whole, data, self._states, _SPEC, mask)

    def _enter(self) -> None:
        """Put the group into the models and states of its worlds."""
        self._rows.take(self._turns)
        self._static.place(self._rows.model, self._group, self._everyone)
        self._turns.take(self._states, self._group_states)
        mjw.set_state(self._rows.model, self._group, self._group_states, _SPEC)
        self._group.overflow.zero_()
