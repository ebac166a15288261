"""Find the feet of a walking robot and the joints that move them, for lyceum-warp new --template velocity."""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace

import mujoco
import numpy as np

from lyceum_warp.models import walkers

_NEAR = 0.1
"""Maximum height of a foot above the lowest foot, as a fraction of the base's height."""

_FLAT = 0.01
"""Maximum height of the sole's spheres above the foot's lowest point, in metres."""

_AT = 0.06
"""Maximum distance between the centre of a sole and a site that marks the foot, in metres."""

_Kind = mujoco.mjtObj


@dataclasses.dataclass(frozen=True)
class Foot:
    """A foot, which is marked by a site of the model or by a new one."""

    site: str
    body: int
    height: float
    """Height of the site in the home pose, in the world's axes, m."""
    element: str = ""
    """The name of the foot's body, or of a joint or geom in it. Empty if the model already has the site."""
    position: tuple[float, ...] = ()
    """Position of a new site in the body, m."""


class Legs:
    """The feet, joints and home pose of a robot with a floating base.

    Args:
        model: The model, which must contain a floor.
        feet: Names of the sites, bodies or geoms that are feet; by default the lowest ends of legs.
        joints: Names of the joints to control; by default the leg joints that have an actuator.

    Raises:
        ValueError: The model has no floor, no floating base or no legs, or no element of a given name.
    """

    def __init__(self, model: mujoco.MjModel, feet: Sequence[str] = (), joints: Sequence[str] = ()) -> None:
        if not (model.geom_bodyid == 0).any():
            raise ValueError("the model has no floor: give the file of a scene with the robot and a plane")
        self.model = model
        self.base = walkers.base(model)
        self.has_home = mujoco.mj_name2id(model, _Kind.mjOBJ_KEY, "home") >= 0
        self.data = mujoco.MjData(model)
        self.data.qpos[:] = walkers.home_qpos(model)
        if not self.has_home:  # move hinge joints into the middle 90 % of their ranges
            hinges = np.flatnonzero(model.jnt_limited & (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE))
            low, high = model.jnt_range[hinges].T
            places, margin = model.jnt_qposadr[hinges], 0.05 * (high - low)
            self.data.qpos[places] = np.clip(self.data.qpos[places], low + margin, high - margin)
        mujoco.mj_kinematics(model, self.data)
        self.feet = [self._named_foot(name) for name in feet] or self._lowest_feet()
        self.joints = list(joints) or self._leg_joints()
        for name in self.joints:
            if mujoco.mj_name2id(model, _Kind.mjOBJ_JOINT, name) < 0:
                raise ValueError(f"the model has no joint {name!r}: give names after --joints, separated by spaces")
        indices = [model.joint(name).id for name in self.joints]
        servos = walkers.servos(model, SimpleNamespace(joints=indices))
        self.has_motors = bool((model.actuator_biastype[servos] == mujoco.mjtBias.mjBIAS_NONE).any())
        """Whether motors move some of the joints; position servos move the others."""
        self.pose: list[float] = self.data.qpos[model.jnt_qposadr[indices]].tolist()
        """Positions of the joints in the home pose, rad."""
        self.ground = min(self._lowest_point(foot.body) for foot in self.feet)
        """Height of the soles in the home pose, m."""
        self.height = float(self.data.xpos[self.base, 2]) - self.ground
        """Height of the base above the soles in the home pose, m."""

    def _spheres(self, body: int) -> np.ndarray:
        geoms = walkers.contact_geoms(self.model, body)
        return np.concatenate([np.zeros((0, 4)), *(walkers.spheres_of(self.model, self.data, geom) for geom in geoms)])

    def _lowest_point(self, body: int) -> float:
        spheres = self._spheres(body)
        return float(np.min(spheres[:, 2] - spheres[:, 3], initial=np.inf))

    def _lowest_feet(self) -> list[Foot]:
        in_tree = self.model.body_rootid == self.model.body_rootid[self.base]
        ends = [body for body in np.flatnonzero(in_tree).tolist() if body not in self.model.body_parentid]
        heights = {body: self._lowest_point(body) for body in ends if body != self.base}
        ground = min(heights.values(), default=np.inf)
        if np.isinf(ground):
            raise ValueError("no leg of the robot can touch the ground with its end: name the feet with --feet")
        limit = ground + _NEAR * (float(self.data.xpos[self.base, 2]) - ground)
        bodies = [body for body, height in heights.items() if height <= limit]
        return [self._foot(body, f"foot_{i}") for i, body in enumerate(bodies, 1)]

    def _named_foot(self, name: str) -> Foot:
        if (site := mujoco.mj_name2id(self.model, _Kind.mjOBJ_SITE, name)) >= 0:
            return Foot(name, int(self.model.site_bodyid[site]), float(self.data.site_xpos[site, 2]))
        if (geom := mujoco.mj_name2id(self.model, _Kind.mjOBJ_GEOM, name)) >= 0:
            return self._foot(int(self.model.geom_bodyid[geom]), f"{name}_foot")
        if (body := mujoco.mj_name2id(self.model, _Kind.mjOBJ_BODY, name)) >= 0:
            return self._foot(body, f"{name}_foot")
        raise ValueError(f"the model has no site, geom or body {name!r}: give names after --feet, separated by spaces")

    def _foot(self, body: int, name: str) -> Foot:
        """Find a site near the centre of a body's sole, or describe a new one."""
        spheres = self._spheres(body)
        if not len(spheres):
            raise ValueError(f"the foot {self._element_of(body)} has no geom that can touch the ground")
        bottoms = spheres[:, 2] - spheres[:, 3]
        centre = spheres[bottoms <= bottoms.min() + _FLAT, :3].mean(axis=0)
        for site in np.flatnonzero(self.model.site_bodyid == body):
            position = self.data.site_xpos[site]
            if self.model.site(site).name and np.linalg.norm(position - centre) <= _AT:
                return Foot(self.model.site(site).name, body, float(position[2]))
        local = (centre - self.data.xpos[body]) @ self.data.xmat[body].reshape(3, 3)
        return Foot(name, body, float(centre[2]), self._element_of(body), tuple((local.round(4) + 0.0).tolist()))

    def _element_of(self, body: int) -> str:
        """Return the name of a body, or of a joint or geom in it."""
        m = self.model
        elements = [m.body(body), *map(m.joint, np.flatnonzero(m.jnt_bodyid == body))]
        elements += map(m.geom, np.flatnonzero(m.geom_bodyid == body))
        for element in elements:
            if element.name:
                return str(element.name)
        raise ValueError(f"body number {body}, its joints and its geoms have no names: name the body of each foot")

    def _leg_joints(self) -> list[str]:
        chains = [walkers.leg_of(self.model, foot.body) for foot in self.feet]
        is_moved = self._is_moved()
        joints = [joint for joint in dict.fromkeys(np.concatenate(chains).tolist()) if is_moved[joint]]
        names = [self.model.joint(joint).name for joint in joints]
        if not joints or not all(names):
            problem = "a joint of the legs has no name" if joints else "no actuator moves a joint of the legs"
            raise ValueError(f"{problem}: name the joints in the model, or give --joints")
        return names

    def _is_moved(self) -> np.ndarray:
        """Return which joints an actuator moves, directly or through a tendon, (njnt,) bool."""
        m, d = self.model, self.data
        mujoco.mj_forward(m, d)
        moment = np.zeros((m.nu, m.nv))
        mujoco.mju_sparse2dense(moment, d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind)
        return np.any(moment, axis=0)[m.jnt_dofadr]
