"""AcrobotSwingup: swing up a double pendulum with a motor at the elbow."""

from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]  # shoulder, elbow
    qvel: Row[float]


def lengths(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the lengths of upper and lower arm, m."""
    return np.array([model.body("lower_arm").pos[2], model.site_pos[p.tip, 2]])


def inertia(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return a, b, c of the mass matrix [[a + 2 c cos(q2), b + c cos(q2)], [b + c cos(q2), b]], kg m^2."""
    mass, center, around = model.body_mass[1:], model.body_ipos[1:, 2], model.body_inertia[1:, 1]
    upper, lower = around + mass * center**2
    return np.array([upper + lower + mass[1] * p.lengths[0] ** 2, lower, mass[1] * p.lengths[0] * center[1]])


def lift(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return e1, e2 of the potential energy e1 cos(q1) + e2 cos(q1 + q2), J."""
    mass, center = model.body_mass[1:], model.body_ipos[1:, 2]
    return -model.opt.gravity[2] * np.array([mass[0] * center[0] + mass[1] * p.lengths[0], mass[1] * center[1]])


def balance_effort(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the matrix P that determines the least effort of balancing from a state near upright.

    The effort is the integral of the squared action, in s. From the state x = (qpos, qvel), the best actions bring the
    arms to rest upright with the effort x^T P x. The linearized dynamics are dx/dt = A x + B u, with unstable modes
    z_i = w_i^T x, A^T w_i = r_i w_i and b_i = w_i^T B. The effort is z^T G^-1 z with G_ij = b_i b_j / (r_i + r_j).
    """
    (a, b, c), (e1, e2) = p.inertia, p.lift
    mobility = np.linalg.inv([[a + 2.0 * c, b + c], [b + c, b]])
    to_velocity = np.block([mobility @ [[e1 + e2, e2], [e2, e2]], -mobility * model.dof_damping])
    rates, modes = np.linalg.eig(np.vstack([np.eye(2, 4, 2), to_velocity]).T)
    rates, modes = rates[rates > 0.0], modes[:, rates > 0.0]
    pushed = modes[2:].T @ mobility[:, 1] * model.actuator_gear[0, 0]
    gramian = np.outer(pushed, pushed) / np.add.outer(rates, rates)
    return modes @ np.linalg.solve(gramian, modes.T)


@wp.struct
class Params:
    margin: float = 1.0  # m
    energy_weight: float = 0.0  # only planners set this weight
    energy_margin: float = 40.0  # J; lifting the arms from hanging to upright takes 39 J
    balance_weight: float = 0.0  # only planners set this weight
    balance_margin: float = 0.3  # s; the effort of the largest torque, applied for 0.3 s
    tip: int = lw.site("tip")
    target: int = lw.site("target")
    target_size: float = lw.from_model(lambda model, p: model.site_size[p.target, 0])  # radius, m
    lengths: wp.vec2 = lw.from_model(lengths)  # of the links, m
    inertia: wp.vec3 = lw.from_model(inertia)  # a, b and c of the mass matrix, kg m^2
    lift: wp.vec2 = lw.from_model(lift)  # e1 and e2 of the potential energy, J
    balance_effort: wp.mat44 = lw.from_model(balance_effort)  # P of the effort x^T P x, s


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    upper, lower = s.qpos[0], s.qpos[0] + s.qpos[1]
    k = lw.put(obs, 0, wp.vec4(wp.sin(upper), wp.sin(lower), wp.cos(upper), wp.cos(lower)))
    lw.put(obs, k, s.qvel)


@wp.func
def missing_energy(s: World, p: Params) -> float:
    """Compute the energy, in J, that the arms would lack to reach the upright pose if the elbow locked now.

    Locking the elbow stops the spin of the lower arm, but conserves the angular momentum about the shoulder. If the
    spin counted as energy, some plans would keep the lower arm spinning, and would never reach the upright pose.
    """
    coupling = p.inertia[2] * wp.cos(s.qpos[1])
    inertia = p.inertia[0] + 2.0 * coupling
    momentum = inertia * s.qvel[0] + (p.inertia[1] + coupling) * s.qvel[1]
    kinetic = 0.5 * momentum * momentum / inertia
    return p.lift[0] * (1.0 - wp.cos(s.qpos[0])) + p.lift[1] * (1.0 - wp.cos(s.qpos[0] + s.qpos[1])) - kinetic


@wp.func
def turned(angle: float) -> float:  # between -pi and pi
    return angle - 2.0 * wp.pi * wp.round(angle / (2.0 * wp.pi))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    upper, lower = s1.qpos[0], s1.qpos[0] + s1.qpos[1]
    # vector from the target to the tip; in the upright pose, the tip is at the target
    x = p.lengths[0] * wp.sin(upper) + p.lengths[1] * wp.sin(lower)
    z = p.lengths[0] * (wp.cos(upper) - 1.0) + p.lengths[1] * (wp.cos(lower) - 1.0)
    total = lw.tolerance(wp.sqrt(x * x + z * z), wp.vec2(0.0, p.target_size), p.margin)
    if p.energy_weight > 0.0:
        near = lw.tolerance(missing_energy(s1, p), wp.vec2(0.0), p.energy_margin, lw.Sigmoid.LINEAR, 0.0)
        total += p.energy_weight * near
    if p.balance_weight > 0.0:
        state = wp.vec4(turned(s1.qpos[0]), turned(s1.qpos[1]), s1.qvel[0], s1.qvel[1])
        effort = wp.dot(state, p.balance_effort * state)
        total += p.balance_weight * lw.tolerance(effort, wp.vec2(0.0), p.balance_margin, lw.Sigmoid.RECIPROCAL, 0.5)
    return total


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] = lw.uniform(rng, -wp.pi, wp.pi)


@lw.register
class AcrobotSwingup(lw.Task):
    model, frame_skip = suite.model("acrobot"), 1
    obs = {"orientations": 4, "velocity": 2}
    # the motor is too weak to lift the arms in one swing, so the planner gets a reward for the arms' energy
    planning = lw.Planning(
        settings={"horizon": 36, "samples": 20, "noise": 0.7, "temperature": 0.5, "knots": 12, "spline": "zero"},
        options={"timestep": 0.05, "integrator": "rk4"},
        params={"energy_weight": 5.0, "balance_weight": 15.0},
    )


@lw.register
class AcrobotSwingupSparse(AcrobotSwingup):
    """Swing up a double pendulum. The reward is 1 near the target and 0 elsewhere."""

    params = {"margin": 0.0}
