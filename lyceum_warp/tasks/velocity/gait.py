"""Add a gait clock to the walking tasks of robots with two legs.

The clock says when each foot should stand and when it should swing. It is part of both observation groups, and the
reward depends on how well the feet follow it. Its frequency is ``gait_frequency``. In each cycle, a foot should first
be on the ground, for the fraction ``stance_share``, and then in the air. The feet are half a cycle apart. Without the
clock, policies make 5 to 7 short steps a second with each foot. A cycle lasts 0.8 s, as in unitree_rl_gym and nanoG1.
Two costs of fast motion grow with the number of steps. With the full costs from the start, a robot learns to stand
still.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.velocity import walking

joint_velocity_l2 = terms.joint_velocity_l2


@wp.struct
class World(walking.World):
    clock: Row[wp.vec2] = lw.memory()  # sine and cosine of the phase


@wp.struct
class Params(walking.BipedParams):
    gait_frequency: float = 1.25  # cycles of the clock per second, Hz
    stance_share: float = 0.55  # fraction of a cycle in which a foot should be on the ground
    foot_lift: float = 0.07  # greatest height of a swing, m
    standing_height: float = 0.04  # height of the feet's sites above the soles, m
    growth_steps: float = 4000.0  # steps of each world until the costs reach their full weight


@wp.struct
class Policy(walking.Policy):
    clock: Row[wp.vec2] = lw.part()


@wp.struct
class Critic(walking.Critic):
    clock: Row[wp.vec2] = lw.part()


@wp.func
def phase_clock(cycles: float) -> wp.vec2:
    return wp.vec2(wp.sin(2.0 * wp.pi * cycles), wp.cos(2.0 * wp.pi * cycles))


@wp.func
def swing(clock: Row[wp.vec2], foot: int, stance_share: float) -> float:
    """Return the progress of a foot's swing, from 0 to 1; negative while the foot should stand."""
    cycles = wp.atan2(clock[0][0], clock[0][1]) / (2.0 * wp.pi) + 0.5 * float(foot)
    return (cycles - wp.floor(cycles) - stance_share) / (1.0 - stance_share)


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    walking.observe(s, p, obs, rng)
    obs.clock[0] = s.clock[0]


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    walking.observe_critic(s, p, obs)
    obs.clock[0] = s.clock[0]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    walking.advance(s0, action, s1, p, rng)
    turn = phase_clock(p.dt * p.gait_frequency)
    sine, cosine = s0.clock[0][0], s0.clock[0][1]
    s1.clock[0] = wp.normalize(wp.vec2(sine * turn[1] + cosine * turn[0], cosine * turn[1] - sine * turn[0]))


@wp.func
def initialize(s: World, p: Params):
    walking.initialize(s, p)
    s.clock[0] = phase_clock(0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    walking.randomize(s, p, rng)
    s.clock[0] = phase_clock(lw.uniform(rng, 0.0, 1.0))


@wp.func
def gait_clock(clock: Row[wp.vec2], contact_time: Row[float], stance_share: float, active: float) -> float:
    """Return the fraction of the feet that do what the clock requires, which is to stand or to swing."""
    right = float(0.0)
    for foot in range(contact_time.shape[0]):
        stands = swing(clock, foot, stance_share) < 0.0
        right += wp.where(stands == (contact_time[foot] > 0.0), 1.0, 0.0)
    return active * right / float(contact_time.shape[0])


@wp.func
def foot_lift_l2(active: float, s: World, p: Params) -> float:
    """Return the sum of ((height - target) / ``foot_lift``)^2 over the feet.

    While a foot swings, its target height rises and falls like half a sine wave.
    """
    total = float(0.0)
    for foot in range(p.feet.shape[0]):
        x, _ = walking.foot_motion(s, p, foot)
        progress = swing(s.clock, foot, p.stance_share)
        target = p.standing_height + p.foot_lift * wp.where(progress > 0.0, wp.sin(wp.pi * progress), 0.0)
        error = (x[2] - walking.ground(x, s, p) - target) / p.foot_lift
        total += error * error
    return active * total


@wp.func
def growth(env_steps: Row[float], growth_steps: float) -> float:
    return wp.min(1.0, env_steps[0] / growth_steps)


@wp.func
def growing_action_rate_l2(action_rate_l2: float, growth: float) -> float:
    return growth * action_rate_l2


@wp.func
def growing_joint_velocity_l2(joint_velocity_l2: float, growth: float) -> float:
    return growth * joint_velocity_l2


class Gait(walking.Biped):
    """A robot with two legs that steps in time with a clock."""

    training = lw.Training(
        algorithm="ppo", iterations=430, physics="coarse", exact_from=350,
        settings={"log_std": -0.7, "entropy_coef": 0.002, "symmetry": "exact", "mean_every": 0},
    )  # fmt: skip
    rewards = {
        **{name: weight for name, weight in walking.Biped.rewards.items()
           if name not in ("foot_clearance", "foot_swing_height")},
        "track_linear_velocity": 4.0,
        "roll_pitch_rate_l2": -0.3,
        "gait_clock": 4.0,
        "foot_lift_l2": -1.0,
        "growing_action_rate_l2": -1.5,
        "growing_joint_velocity_l2": -0.006,
    }  # fmt: skip
