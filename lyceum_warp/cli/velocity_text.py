"""Generate the text of a velocity task for a walking robot, for lyceum-warp new --template velocity."""

import dataclasses
import textwrap
from collections.abc import Sequence
from types import SimpleNamespace

import mujoco
import numpy as np

from lyceum_warp.cli.task_text import indented, literal
from lyceum_warp.models import walkers

TRAINING = "--algorithm ppo --device cuda --iterations 800"
"""Options of lyceum-warp train that suffice to learn walking on one GPU."""

_STEP = 0.02
"""Seconds in a step."""

_NEAR = 0.1
"""Maximum height of a foot above the lowest foot, as a fraction of the base's height."""

_FLAT = 0.01
"""Maximum height of the sole's spheres above the foot's lowest point, in metres."""

_AT = 0.06
"""Maximum distance between the centre of a sole and a site that marks the foot, in metres."""

_Kind = mujoco.mjtObj


@dataclasses.dataclass
class _Foot:
    name: str
    body: int
    element: str = ""
    """The name of the foot's body, or of a joint or geom in it. Empty if the model already has the site."""
    position: tuple[float, ...] = ()
    """The position of the new site in the body, m."""
    height: float = 0.0
    """The height of the site in the home pose, m."""


class Walker:
    """Finds a robot's base, its feet, and the joints that move the feet.

    Args:
        spec: The model.
        feet: Names of the sites, bodies or geoms that are feet; by default the lowest ends of legs.
        joints: Names of the joints to control; by default the leg joints that have an actuator.
    """

    def __init__(self, spec: mujoco.MjSpec, feet: Sequence[str] = (), joints: Sequence[str] = ()) -> None:
        self.model = spec.copy().compile()
        if not (self.model.geom_bodyid == 0).any():
            raise ValueError("the model has no floor: give the file of a scene with the robot and a plane")
        self.base = walkers.base(self.model)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = walkers.home_qpos(self.model)
        self.has_home = mujoco.mj_name2id(self.model, _Kind.mjOBJ_KEY, "home") >= 0
        if not self.has_home:
            self._bend()
        mujoco.mj_kinematics(self.model, self.data)
        self.feet = [self._named_foot(name) for name in feet] if feet else self._found_feet()
        self.joints = list(joints) or self._leg_joints()
        for name in self.joints:
            if mujoco.mj_name2id(self.model, _Kind.mjOBJ_JOINT, name) < 0:
                raise ValueError(f"the model has no joint {name!r}: give names after --joints, separated by spaces")
        ids = [self.model.joint(name).id for name in self.joints]
        self.servos = walkers.servos(self.model, SimpleNamespace(joints=ids))
        self.pose = [float(self.data.qpos[self.model.jnt_qposadr[joint]]) for joint in ids]
        lowest = min(self._lowest(foot.body) for foot in self.feet)
        self.height = float(self.data.xpos[self.base, 2]) - lowest
        """The height of the base above the soles in the home pose, m."""
        for foot in self.feet:
            foot.height -= lowest

    def _bend(self) -> None:
        """Move hinge joints into the middle 90 % of their ranges."""
        for joint in np.flatnonzero(self.model.jnt_limited & (self.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)):
            low, high = self.model.jnt_range[joint]
            margin = 0.05 * (high - low)
            place = self.model.jnt_qposadr[joint]
            self.data.qpos[place] = np.clip(self.data.qpos[place], low + margin, high - margin)

    def _spheres(self, body: int) -> np.ndarray:
        geoms = walkers.contact_geoms(self.model, body)
        return np.concatenate([np.zeros((0, 4)), *(walkers.spheres_of(self.model, self.data, g) for g in geoms)])

    def _lowest(self, body: int) -> float:
        spheres = self._spheres(body)
        return float((spheres[:, 2] - spheres[:, 3]).min()) if len(spheres) else np.inf

    def _found_feet(self) -> list[_Foot]:
        parents = set(self.model.body_parentid.tolist())
        tree = np.flatnonzero(self.model.body_rootid == self.model.body_rootid[self.base]).tolist()
        lowest = {body: self._lowest(body) for body in tree if body not in parents and body != self.base}
        ground = min(lowest.values(), default=np.inf)
        near = ground + _NEAR * (float(self.data.xpos[self.base, 2]) - ground)
        bodies = [body for body, height in lowest.items() if np.isfinite(height) and height <= near]
        if not bodies:
            raise ValueError("no leg of the robot can touch the ground with its end: name the feet with --feet")
        return [self._foot(body, f"foot_{i}") for i, body in enumerate(bodies, 1)]

    def _named_foot(self, name: str) -> _Foot:
        for kind, bodies in ((_Kind.mjOBJ_SITE, self.model.site_bodyid), (_Kind.mjOBJ_GEOM, self.model.geom_bodyid),
                             (_Kind.mjOBJ_BODY, np.arange(self.model.nbody))):  # fmt: skip
            if (i := mujoco.mj_name2id(self.model, kind, name)) >= 0:
                if kind == _Kind.mjOBJ_SITE:
                    return _Foot(name, int(bodies[i]), height=float(self.data.site_xpos[i, 2]))
                return self._foot(int(bodies[i]), f"{name}_foot")
        raise ValueError(f"the model has no site, geom or body {name!r}: give names after --feet, separated by spaces")

    def _foot(self, body: int, name: str) -> _Foot:
        """Find a site near the centre of a body's sole, or describe a new one."""
        spheres = self._spheres(body)
        if not len(spheres):
            raise ValueError(f"the foot {self._called(body)} has no geom that can touch the ground")
        bottoms = spheres[:, 2] - spheres[:, 3]
        middle = spheres[bottoms <= bottoms.min() + _FLAT, :3].mean(axis=0)
        for site in np.flatnonzero(self.model.site_bodyid == body).tolist():
            known, place = mujoco.mj_id2name(self.model, _Kind.mjOBJ_SITE, site), self.data.site_xpos[site]
            if known and np.linalg.norm(place - middle) <= _AT:
                return _Foot(known, body, height=float(place[2]))
        axes = self.data.xmat[body].reshape(3, 3)
        local = (middle - self.data.xpos[body]) @ axes
        return _Foot(name, body, self._called(body), tuple(round(float(x), 4) + 0.0 for x in local), float(middle[2]))

    def _called(self, body: int) -> str:
        ids = ((_Kind.mjOBJ_BODY, [body]), (_Kind.mjOBJ_JOINT, np.flatnonzero(self.model.jnt_bodyid == body)),
               (_Kind.mjOBJ_GEOM, np.flatnonzero(self.model.geom_bodyid == body)))  # fmt: skip
        names = [mujoco.mj_id2name(self.model, kind, int(i)) for kind, found in ids for i in found]
        if not any(names):
            raise ValueError(
                f"body number {body}, its joints and its geoms have no names: give the body of each foot a name"
            )
        return next(name for name in names if name)

    def _leg_joints(self) -> list[str]:
        chains = [walkers.leg_of(self.model, foot.body) for foot in self.feet]
        moved = self._moved()
        joints = [joint for joint in dict.fromkeys(joint for chain in chains for joint in chain) if moved[joint]]
        names = [mujoco.mj_id2name(self.model, _Kind.mjOBJ_JOINT, joint) for joint in joints]
        if not joints or not all(names):
            what = "a joint of the legs has no name" if joints else "no actuator moves a joint of the legs"
            raise ValueError(f"{what}: name the joints in the model, or give --joints")
        return names

    def _moved(self) -> np.ndarray:
        """Return which joints an actuator moves, directly or through a tendon, (njnt,) bool."""
        m, d = self.model, self.data
        mujoco.mj_forward(m, d)
        moment = np.zeros((m.nu, m.nv))
        mujoco.mju_sparse2dense(moment, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind)
        return np.any(moment, axis=0)[m.jnt_dofadr]


def substeps(model: mujoco.MjModel) -> int:
    """Return the number of substeps in a step of the task."""
    return max(1, round(_STEP / model.opt.timestep))


def velocity_text(file: str, class_name: str, source: str, walker: Walker) -> str:
    """Generate the text of a robot's task file, as ``task_text`` does."""
    biped = len(walker.feet) == 2
    model, new = walker.model, [foot for foot in walker.feet if foot.element]
    fastest = round(0.4 * float(np.sqrt(9.81 * walker.height)), 1)
    swing = max(foot.height for foot in walker.feet) + float(np.clip(0.1 * walker.height, 0.03, 0.1))
    params = [
        "joints: wp.array[int] = lw.joints(*JOINTS)",
        "feet: wp.array[int] = lw.sites(*FEET)",
        f"action_scale: wp.array[float] = {len(walker.joints)} * [0.3]  # rad",
        f"swing_target: float = {swing:.3g}  # height of a foot's site in a swing, m",
        f"stages: wp.array2d[float] = [[0.0, {-fastest:g}, {fastest:g}, 0.7]]  # step, forward velocities, yaw rate",
        f"lateral_velocity: float = {fastest / 2:g}",
    ]
    if biped:
        params.append(f"least_height: float = {0.45 * walker.height:.2f}  # of the base; an episode ends below it")
    if not walker.has_home:
        params.append(f"start_height: float = {walker.height:.3f}")
        params += _wrapped("default_pose: wp.array[float] = [", [f"{q:.4g}" for q in walker.pose], "]")
    settings = [
        f"model = {source}",
        f"frame_skip = {substeps(model)}  # substeps of {1000 * model.opt.timestep:g} ms in a step",
    ]
    if walker.has_home != biped:
        settings.append(f"keyframe = {literal('home') if walker.has_home else None}")
    edits = ["walkers.add_feet(spec, NEW_SITES)"] if new else []
    if (model.actuator_biastype[walker.servos] == mujoco.mjtBias.mjBIAS_NONE).any():  # a motor, not a position servo
        edits.append("walkers.use_servos(spec, JOINTS)")
    edits.append("walkers.prepare_walker(spec, FEET)")
    head = _wrapped("FEET = [", [literal(foot.name) for foot in walker.feet], "]", 0)
    if new:
        sites = [f"    {literal(foot.name)}: ({literal(foot.element)}, {foot.position})," for foot in new]
        head += ["NEW_SITES = {  # a body, or a joint or geom in it, and a position there", *sites, "}"]
    return _TEXT.format(
        file=file, class_name=class_name, training=TRAINING, kind="Biped" if biped else "Velocity",
        params_class="BipedParams" if biped else "Params", feet="\n".join(head),
        joints="\n".join(_wrapped("JOINTS = [", [literal(name) for name in walker.joints], "]", 0)),
        params=indented(params), settings=indented(settings), edits=indented(edits, 8),
    )  # fmt: skip


def _wrapped(start: str, parts: Sequence[str], end: str, indent: int = 4) -> list[str]:
    line = f"{start}{', '.join(parts)}{end}"
    if indent + len(line) <= 120:
        return [line]
    body = textwrap.wrap(", ".join(parts) + ",", 120 - indent - 4, break_long_words=False)
    return [start, *(f"    {text}" for text in body), f"{end}  # fmt: skip"]


_TEXT = '''"""{class_name}: a robot walks at a commanded velocity.

``lyceum-warp check {file}`` checks this task. This trains it; docs/velocity.md has settings for a CPU:

    lyceum-warp train {file} {training}

Every other number is a parameter of the family: see help(walking.Params).
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp.models import walkers
from lyceum_warp.tasks.velocity import walking

{feet}
{joints}


@wp.struct
class Params(walking.{params_class}):
{params}


@lw.register
class {class_name}(walking.{kind}):
{settings}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
{edits}
'''
