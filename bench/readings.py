"""Two readings of go1_velocity's rewards on the same transitions: the state that a step leads to, and mjlab's.

    python bench/readings.py --policy RUN --engine mujoco --nworld 256 --steps 1000

mjlab's rewards read velocities, orientations and contacts at the beginning of the last substep, and heights of feet at
the beginning of the step. Here the reward is go1_velocity's own, and ``measure`` computes both for every transition.
Without a policy actions are random.
"""

import dataclasses
import json
from pathlib import Path

import torch
import tyro
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks import go1_velocity as go1
from lyceum_warp.tasks.go1_velocity import Go1Velocity, Params, World

# further places in memory
PAST_TIMES = wp.constant(28)  # a memory whose contact times are those of the state before the last substep
PAST_QPOS = wp.constant(56)
PAST_QVEL = wp.constant(75)
LAST_QPOS = wp.constant(93)
LAST_QVEL = wp.constant(112)
# and in lasting memory
PAST_PEAK = wp.constant(17)


@wp.func
def substep(s: World, p: Params):
    for leg in range(4):
        s.memory[PAST_TIMES + go1.CONTACT_TIME + leg] = s.memory[go1.CONTACT_TIME + leg]
    for i in range(19):
        s.memory[PAST_QPOS + i] = s.memory[LAST_QPOS + i]
        s.memory[LAST_QPOS + i] = s.qpos[i]
    for i in range(18):
        s.memory[PAST_QVEL + i] = s.memory[LAST_QVEL + i]
        s.memory[LAST_QVEL + i] = s.qvel[i]
    go1.substep(s, p)


@wp.func
def past(s: World) -> World:
    """The world at the beginning of the last substep."""
    found = World()
    found.body_pos = s.body_pos
    found.site_pos = s.site_pos
    found.jnt_axis = s.jnt_axis
    found.geom_size = s.geom_size
    found.qpos = s.memory[PAST_QPOS : PAST_QPOS + 19]
    found.qvel = s.memory[PAST_QVEL : PAST_QVEL + 18]
    found.memory = s.memory[PAST_TIMES : PAST_TIMES + 28]
    return found


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    go1.advance(s0, action, s1, p, rng)
    seen = past(s1)
    for leg in range(4):
        peak = s0.lasting_memory[PAST_PEAK + leg]
        position, _ = go1.foot(s0, p, leg)
        seen_position, _ = go1.foot(seen, p, leg)
        if go1.landed(seen.memory[go1.CONTACT_TIME + leg], p):
            peak = 0.0
        elif not go1.touches(seen_position, seen, p):
            peak = wp.max(peak, go1.height(position))
        s1.lasting_memory[PAST_PEAK + leg] = peak


@wp.func
def mjlabs_terms(s0: World, action: Row[float], s1: World, p: Params) -> lw.vec10:
    seen, c = past(s1), go1.command(s0, p)
    clearance, swing, landing = float(0.0), float(0.0), float(0.0)
    for leg in range(4):
        position, _ = go1.foot(s0, p, leg)
        _, velocity = go1.foot(seen, p, leg)
        clearance += wp.abs(go1.height(position) - p.foot_height) * go1.speed(velocity)
        if go1.landed(seen.memory[go1.CONTACT_TIME + leg], p):
            error = s0.lasting_memory[PAST_PEAK + leg] / p.foot_height - 1.0
            swing += error * error
            landing += wp.length(go1.force(s1, p, leg))
    active, feet = go1.active(c, p), go1.foot_clearance_and_slip(c, seen, p)
    return p.dt * lw.vec10(
        p.track_linear_velocity * go1.track_linear_velocity(c, seen, p),
        p.track_angular_velocity * go1.track_angular_velocity(c, seen, p),
        p.upright * go1.upright(seen, p),
        p.pose * go1.pose(c, s1, p),
        p.dof_pos_limits * go1.dof_pos_limits(s1, p),
        p.action_rate_l2 * go1.action_rate_l2(s0, action),
        p.foot_clearance * clearance * active,
        p.foot_swing_height * swing * active,
        p.foot_slip * feet[1],
        p.soft_landing * landing * active,
    )


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    k = lw.put(metrics, 0, go1.terms(go1.command(s0, p), s0, action, s1, p))
    lw.put(metrics, k, mjlabs_terms(s0, action, s1, p))


TERMS = Go1Velocity.metrics[:10]


class Readings(Go1Velocity):
    """The task with both readings of its rewards as metrics."""

    model = str(Path(go1.__file__).with_name("go1.xml"))
    metrics = (*TERMS, *(f"{name} (mjlab)" for name in TERMS))
    memory, lasting_memory = 130, 21
    World, Params = World, Params
    observe, observe_critic, control = go1.observe, go1.observe_critic, go1.control
    reward, terminated, event, startup = go1.reward, go1.terminated, go1.event, go1.startup
    initialize, randomize = go1.initialize, go1.randomize


@dataclasses.dataclass
class Options:
    """What to compare the readings on."""

    policy: Path | None = None
    """The folder of a run, whose mean policy acts; without it actions are random."""
    engine: str = "auto"
    device: str = "cpu"
    nworld: int = 256
    steps: int = 1000
    seed: int = 0
    out: Path | None = None
    """Where to write the figures, as JSON."""


def compare(options: Options) -> dict[str, dict[str, float]]:
    """Means of each term, per second of a world, under both readings."""
    env = lw.make(
        Readings, engine=options.engine, device=options.device, nworld=options.nworld, seed=options.seed
    )  # fmt: skip
    policy = lw.load(options.policy).to(env.obs.device) if options.policy else None
    generator = torch.Generator(env.obs.device).manual_seed(options.seed)
    totals = torch.zeros(20, device=env.obs.device)
    for _ in range(options.steps):
        if policy is None:
            env.action.normal_(generator=generator)
        else:
            env.action.copy_(policy(env.obs))
        env.step()
        totals += torch.stack([env.metrics[name].mean() for name in Readings.metrics])
    means = (totals / (options.steps * env.timestep)).tolist()
    rows = {name: {"current": a, "mjlab": b} for name, a, b in zip(TERMS, means[:10], means[10:], strict=True)}
    current, theirs = (sum(row[key] for row in rows.values()) for key in ("current", "mjlab"))
    return rows | {"reward": {"current": current, "mjlab": theirs, "difference": current / theirs - 1.0}}


def main(options: Options) -> None:
    """Compare, print and save."""
    rows = compare(options)
    for name, row in rows.items():
        print(f"{name:24}", "  ".join(f"{key} {value:9.5f}" for key, value in row.items()))
    if options.out is not None:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
