"""Compute substeps and full or partial forward passes, in all worlds or in a group of worlds."""

import functools
import inspect
import types
from collections.abc import Callable, Collection, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from lyceum_warp.core.fields import Stage
from lyceum_warp.engines.warp.group import Turns
from lyceum_warp.engines.warp.sizes import report_pool_overflow
from lyceum_warp.engines.warp.varied_model import ModelRows, StaticGeoms
from lyceum_warp.engines.warp.warp_kernels import correct_ground_contacts
from lyceum_warp.kernels.state import copy_rows
from lyceum_warp.support.arrays import launch_rows
from lyceum_warp.support.upstream import forward_functions

Part = Callable[[mjw.Model, mjw.Data], None]

POSES: tuple[Part, ...] = (mjw.kinematics, mjw.com_pos, mjw.camlight, mjw.flex)
"""The parts that compute the poses of geoms, cameras and lights, and the vertices of flexes."""

SKIPPED: tuple[Part, ...] = (*POSES, mjw.tendon, mjw.com_vel)
"""The parts that a substep can skip. They depend only on positions and velocities."""


def step(model: mjw.Model, data: mjw.Data, done: Collection[Part] = ()) -> None:
    """Advance every world of a Data by one substep. Skip the parts in ``done``, which must be parts of ``SKIPPED``."""
    _without(frozenset(done))["step"](model, data)


def forward(model: mjw.Model, data: mjw.Data) -> None:
    """Run a full forward pass for all worlds of a Data."""
    _without(frozenset())["forward"](model, data)


def positions(model: mjw.Model, data: mjw.Data) -> None:
    """Run the part of a forward pass that depends only on positions, for all worlds of a Data."""
    _without(frozenset())["fwd_position"](model, data, factorize=False)


def inertia(model: mjw.Model, data: mjw.Data) -> None:
    """Compute the inertia matrix, with the armature of tendons and of their actuators."""
    mjw.crb(model, data)
    forward_functions()["smooth"].tendon_armature(model, data)


@functools.cache
def _without(done: frozenset[Part]) -> dict[str, Callable[..., None]]:
    """Copy MuJoCo Warp's ``step`` and ``forward`` so that the first forward pass skips the parts in ``done``.

    MuJoCo Warp itself does not change.

    For connect and weld constraints, ``mjw.make_constraint`` reads body velocities before MuJoCo Warp has computed
    them. It thus reads stale values of the last forward pass or, after a fault, NaN. In the copies, ``com_vel`` runs
    right after the positions, in every stage of a Runge-Kutta step.

    If a sphere's centre or a capsule's axis lies in a height field, collision detection with 32-bit coordinates often
    finds contacts that are metres deep, the more often the farther away the field's centre is. The copies correct them.
    """
    functions = vars(forward_functions()["smooth"])
    smooth = types.SimpleNamespace(**functions | {part.__name__: _nothing for part in done})
    kinematics = _copy("fwd_kinematics", smooth=smooth)

    def fwd_kinematics(model: mjw.Model, data: mjw.Data) -> None:
        kinematics(model, data)
        if model.eq_connect_adr.size or model.eq_wld_adr.size:
            mjw.com_vel(model, data)

    def collision(model: mjw.Model, data: mjw.Data, **options: Any) -> None:
        mjw.collision(model, data, **options)
        if model.hfield_size.size:
            c, geoms = data.contact, [model.geom_type, model.geom_dataid, model.geom_rbound, model.geom_size]
            fields = [model.hfield_size, model.hfield_nrow, model.hfield_ncol, model.hfield_adr, model.hfield_data]
            args = [*geoms, *fields, data.geom_xpos, data.geom_xmat, data.nacon, c.geom, c.worldid]
            wp.launch(correct_ground_contacts, data.naconmax, [*args, c.dist, c.pos, c.frame])

    driver = types.SimpleNamespace(collision=collision)
    fwd_position = _copy("fwd_position", fwd_kinematics=fwd_kinematics, collision_driver=driver)
    inner = _copy("_forward", fwd_position=fwd_position, fwd_velocity=_copy("fwd_velocity", smooth=smooth))
    forward = _copy("forward", _forward=inner)
    runge_kutta_forward = _without(frozenset())["_forward"] if done else inner
    step = _copy("step", forward=forward, rungekutta4=_copy("rungekutta4", _forward=runge_kutta_forward))
    return {"fwd_position": fwd_position, "_forward": inner, "forward": forward, "step": step}


def _copy(function: str, **names: Any) -> Callable[..., Any]:
    """Copy a MuJoCo Warp function with some of its global names replaced."""
    inner: Any = inspect.unwrap(forward_functions()[function])
    if unknown := names.keys() - set(inner.__code__.co_names):
        raise ImportError(f"{function} of this mujoco_warp does not use {min(unknown)}: install mujoco-warp 4.0")
    return types.FunctionType(inner.__code__, inner.__globals__ | names, function, inner.__defaults__)


def _nothing(model: mjw.Model, data: mjw.Data) -> None:
    """Do nothing. The copied functions call this instead of the parts in ``done``."""


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
"""Maps each part of a forward pass to the parts that must run first. None of these parts needs collisions or
constraints. ``fwd_velocity`` includes ``com_vel``."""

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
"""Maps types of sensors to the parts that compute their inputs. Other types need a full forward pass."""

_PARTS_OF_SENSOR = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}")): parts
    for kinds, parts in _SENSORS.items()
    for kind in kinds.split()
}


def forward_parts(model: mujoco.MjModel, names: Collection[str]) -> tuple[Part, ...] | None:
    """Return the parts of a forward pass that compute the named fields, or None if they need collisions or constraints.

    For ``sensordata``, the parts compute the sensors of the position and velocity stages.
    """
    parts, sensors = {_PART_OF.get(name) for name in names if name != "sensordata"}, list[Part]()
    if "sensordata" in names:
        parts |= _parts_of_sensors(model)
        last = max((int(stage) for stage in model.sensor_needstage if stage < Stage.ACCELERATION), default=0)
        sensors = [mjw.sensor_pos, mjw.sensor_vel][:last]
    for part in reversed(_NEEDS):
        if part in parts:
            parts.update(_NEEDS[part])
    if mjw.fwd_velocity in parts:
        parts.discard(mjw.com_vel)
    if None in parts or (_touching(model) and parts & {mjw.transmission, mjw.fwd_velocity}):
        return None
    return (*(part for part in _NEEDS if part in parts), *sensors)


def _parts_of_sensors(model: mujoco.MjModel) -> set[Part | None]:
    """Return the parts that position and velocity sensors need. They include None for a full forward pass."""
    parts: set[Part | None] = set()
    camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
    for i in np.flatnonzero(model.sensor_needstage < Stage.ACCELERATION):
        parts.update(_PARTS_OF_SENSOR.get(int(model.sensor_type[i]), (None,)))
        if camera in (model.sensor_objtype[i], model.sensor_reftype[i]):
            parts.add(mjw.camlight)
    return parts


def _touching(model: mujoco.MjModel) -> bool:
    """Whether contacts affect actuators or passive forces, such as adhesion."""
    by_body = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)).any()
    return bool(by_body or model.flg_adhesion or model.flex_passive.any())


_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


class PartialForward:
    """Computes the masked worlds' fields in a small group of scratch worlds, and copies them back.

    In most steps, only a few worlds restart. A forward pass of these worlds is cheaper than a forward pass of all
    worlds, which costs as much as a substep. If the group is too small for all masked worlds, it processes them in
    several batches.
    """

    def __init__(self, rows: ModelRows, data: mjw.Data, group: mjw.Data, states: wp.array, static: StaticGeoms) -> None:
        self._rows, self._static = rows, static
        self._data, self._group, self._states = data, group, states
        self._device = wp.get_device(data.qpos.device)
        with wp.ScopedDevice(self._device):
            self._group_states = wp.zeros((group.nworld, states.shape[1]), dtype=float)
            self._everyone = wp.full(group.nworld, True, dtype=bool)
            self._no_time = wp.zeros((data.nworld, 1), dtype=float)
        self._turns = Turns(data.nworld, group.nworld, self._device)

    def __call__(
        self, mask: wp.array, forward: Callable[[mjw.Model, mjw.Data], None], targets: Mapping[str, wp.array]
    ) -> None:
        """Call ``forward`` for the masked worlds, and copy their fields into the targets. Use only Warp launches."""
        group = self._group

        def work() -> None:
            forward(self._rows.model, group)
            report_pool_overflow(group, self._everyone)
            for name, target in targets.items():
                self._turns.give(getattr(group, name), target)

        with wp.ScopedDevice(self._device):
            self._run(mask, work)

    def settle(self, mask: wp.array, nstep: int) -> None:
        """Step the masked worlds ``nstep`` times, and set their time to 0, by Warp launches only."""

        def work() -> None:
            for _ in range(nstep):
                step(self._rows.model, self._group)
            mjw.get_state(self._rows.model, self._group, self._group_states, _SPEC)
            self._turns.give(self._group_states, self._states)

        with wp.ScopedDevice(self._device):
            self._run(mask, work)
            launch_rows(copy_rows, mask, self._no_time, self._states[:, :1])  # column 0 is the time
            mjw.set_state(self._rows.source, self._data, self._states, _SPEC, mask)

    def _run(self, mask: wp.array, work: Callable[[], None]) -> None:
        """Call ``work`` for each group of masked worlds."""
        model, group = self._rows.model, self._group

        def turn() -> None:
            self._rows.take(self._turns)
            self._static.place(model, group, self._everyone)
            self._turns.take(self._states, self._group_states)
            mjw.set_state(model, group, self._group_states, _SPEC)
            group.overflow.zero_()
            work()
            self._turns.give_bits(group.overflow, self._data.overflow)

        mjw.get_state(self._rows.source, self._data, self._states, _SPEC, mask)
        self._turns.run(mask, turn)
