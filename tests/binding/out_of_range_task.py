"""Define a task in which a chosen function writes outside its array."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qfrc_applied: Row[float]
    body_mass: Row[float]
    counts: Row[float] = lw.memory(2)
    level: Row[float] = lw.lasting_memory(3)


@wp.struct
class Params:
    dt: float
    function: int = 0
    index: int = 0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    if p.function == 1:
        obs[p.index] = 1.0


@wp.func
def observe_critic(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qpos[1]
    if p.function == 2:
        obs[p.index] += 0.0


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = s1.qpos[0]
    if p.function == 3:
        metrics[p.index] = 1.0


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for i in range(3):
        ctrl[i] = action[i]
    if p.function == 4:
        ctrl[p.index] = 1.0
    if p.function == 5:
        s.qfrc_applied[p.index] = 1.0


@wp.func
def substep(s: World, p: Params):
    if p.function == 6:
        s.counts[p.index] = 1.0


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 7:
        s1.counts[p.index] = 1.0


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 8:
        s.level[p.index] = 1.0


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 9:
        s.body_mass[p.index] = 1.0


@wp.func
def initialize(s: World, p: Params):
    if p.function == 10:
        s.qpos[p.index] = 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 11:
        s.qpos[p.index] = 1.0
    if p.function == 12:
        rng[p.index] = wp.uint32(1)


class OutOfRange(lw.Task):
    model = "hopper.xml"
    obs = {"policy": {"x": 1}, "critic": {"x": 2}}
    metrics = ("x",)
