"""Compare the C engine with the Warp engine for every task of the package.

The C engine uses float64, and the Warp engine float32. The tests use elliptic friction cones. With pyramidal cones, the
engines differ for a capsule on a plane, because they use different contact frames.
"""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from form_tasks import Drawn, Pushed

import lyceum_warp as lw
from lyceum_warp.binding import package_task_names
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.tasks.dm import TASKS as SUITE
from lyceum_warp.tasks.velocity import TASKS as VELOCITY

NWORLD = 32
TASKS = package_task_names()
# together, these small models have most of the model features that the tasks use
quick = pytest.mark.quick("cartpole_swingup", "go1_velocity", "hopper", "reach", "soft_ball")
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]

FORCE_PARTS = ("contact_force", "touch", "imu", "force_torque")
"""Parts of the observation that depend on constraint forces. These are exact only to the solver's tolerance."""


WALKERS = tuple(name for names in VELOCITY.values() for name in names if name != "go1_velocity")
CONVERGED = {"iterations": 100, "ls_iterations": 50}
PARAMS: dict[str, dict[str, Any]] = {
    **{name: {"fall_angle": 0.5, "solver": CONVERGED} for name in WALKERS},
    "go1_velocity": {"fall_angle": 0.5},
    "soft_ball": {"reach": 0.15},
}
"""With these parameters, some episodes end during the tests.

Higher solver limits let the solver converge. Otherwise the engines would not agree up to rounding.
"""


# These are bounds on the difference between the engines after one substep: median and 95 % quantile of qpos, then of
# qvel. In each world, only the coordinate with the largest difference counts. Each bound is three to four times a
# difference measured on the CPU with mujoco and mujoco_warp 4.0.0, in 320 states of random rollouts. A float32 position
# of about 1 has a precision of 6e-8.
ONE_STEP = {  #                         measured
    "adroit_door": (1.5e-7, 7e-7, 2e-5, 3.5e-4),  # 4.1e-8, 1.9e-7; 6.2e-6, 9.6e-5
    "adroit_hammer": (6e-7, 8e-7, 3e-4, 4e-4),  # 1.6e-7, 2.2e-7; 8.0e-5, 1.1e-4
    # in the worst 5 % of the states, the pen touches the boxes of the palm
    "adroit_pen": (1.5e-7, 4e-6, 5e-6, 2e-3),  # 4.1e-8, 1.2e-6; 1.4e-6, 5.8e-4
    "aloha_lift": (2e-7, 2e-7, 1.5e-6, 4e-6),  # 5.2e-8, 5.9e-8; 4.3e-7, 9.2e-7
    "adroit_relocate": (2e-7, 4.5e-7, 8e-5, 2.5e-4),  # 5.1e-8, 1.2e-7; 2.0e-5, 6.2e-5
    "ant": (1.5e-7, 3e-7, 1.5e-6, 2e-5),  # 5.2e-8, 9.8e-8; 4.4e-7, 6.5e-6
    "arm_hand_pickup": (4e-7, 7e-7, 4e-8, 1.2e-7),  # 1.2e-7, 2.2e-7; 1.2e-8, 3.8e-8
    "cartpole": (7e-9, 4e-8, 5e-8, 2e-7),  # 2.0e-9, 1.1e-8; 1.3e-8, 5.3e-8
    "cartpole_swingup": (2e-7, 4e-7, 4e-8, 1e-7),  # 6.2e-8, 1.1e-7; 1.2e-8, 2.9e-8
    "g1_full_velocity": (8e-7, 2.4e-6, 2e-4, 6e-4),  # 2.1e-7, 6.0e-7; 5.2e-5, 1.5e-4
    "g1_stand": (2e-7, 1.2e-6, 4e-5, 2.5e-4),  # 6.8e-8, 3.6e-7; 1.0e-5, 7.2e-5
    "g1_velocity": (4e-7, 1.9e-6, 1e-4, 4.8e-4),  # 1.0e-7, 4.7e-7; 2.5e-5, 1.2e-4
    "g1_walk": (2e-7, 1.2e-6, 4e-5, 2.5e-4),  # as g1_stand
    "h1_velocity": (2.4e-7, 7e-7, 1.7e-5, 1.8e-4),  # 5.9e-8, 1.7e-7; 4.3e-6, 4.5e-5
    "spot_velocity": (2.4e-7, 8e-7, 8e-6, 2e-4),  # 6.0e-8, 1.9e-7; 2.0e-6, 5.1e-5
    "t1_velocity": (2.5e-7, 1.4e-6, 4.4e-5, 3.4e-4),  # 6.2e-8, 3.5e-7; 1.1e-5, 8.6e-5
    # on a height field, the engines create different numbers of contacts
    "g1_rough_velocity": (3e-4, 8e-3, 8e-2, 2.2),  # 8.5e-5, 2.2e-3; 2.1e-2, 5.6e-1
    "go1_rough_velocity": (1.2e-5, 1.4e-3, 2e-3, 3e-1),  # 3.0e-6, 3.7e-4; 5.1e-4, 7.5e-2
    "go1_velocity": (4e-7, 1.5e-6, 4e-5, 3e-4),  # 9.8e-8, 4.4e-7; 1.1e-5, 8.7e-5
    "half_cheetah": (1e-7, 1e-6, 1e-5, 1e-4),  # 3.2e-8, 2.9e-7; 3.0e-6, 2.9e-5
    # MuJoCo Warp finds fewer contact points between two boxes
    "herb_reach": (4e-7, 8e-7, 5e-5, 2e-4),  # 1.1e-7, 2.2e-7; 1.3e-5, 4.8e-5
    "hopper": (1e-7, 2e-7, 1e-6, 5e-6),  # 3.0e-8, 5.5e-8; 2.9e-7, 1.6e-6
    "humanoid": (2e-7, 4e-7, 3e-5, 1.2e-4),  # 5.6e-8, 1.1e-7; 8.8e-6, 3.9e-5
    "humanoid_get_up": (2e-7, 4e-7, 5e-5, 2e-4),  # 5.3e-8, 1.1e-7; 1.3e-5, 5.3e-5
    "humanoid_stand": (2e-7, 4e-7, 5e-5, 2e-4),  # 6.0e-8, 1.1e-7; 1.5e-5, 5.1e-5
    "humanoid_standup": (2e-7, 4e-7, 2e-5, 8e-5),  # 5.3e-8, 1.0e-7; 6.1e-6, 2.3e-5
    "humanoid_walk": (2e-7, 4e-7, 5e-5, 2e-4),  # as humanoid_stand
    "inverted_double_pendulum": (3e-8, 1e-7, 6e-7, 2e-6),  # 6.9e-9, 2.9e-8; 1.6e-7, 6.4e-7
    "inverted_pendulum": (6e-9, 2e-8, 2e-7, 6e-7),  # 1.8e-9, 6.5e-9; 5.4e-8, 1.8e-7
    "leap_objects": (6e-5, 6e-3, 1.2e-2, 1.2),  # 1.5e-5, 1.5e-3; 3.1e-3, 2.9e-1
    "leap_reorient": (7e-4, 1.5e-2, 1.2e-1, 3.5),  # 1.8e-4, 3.9e-3; 3.0e-2, 8.8e-1
    "leap_rotate": (6e-4, 1.6e-2, 1.3e-1, 3.5),  # 1.5e-4, 4.1e-3; 3.3e-2, 8.7e-1
    "panda_lift": (3e-7, 4e-7, 5e-6, 1.2e-5),  # 8.0e-8, 1.2e-7; 1.5e-6, 3.4e-6
    "point_mass": (5e-8, 1.5e-7, 6e-8, 1.5e-7),  # 1.4e-8, 4.5e-8; 1.9e-8, 5.1e-8
    "pusher": (1.5e-7, 3e-7, 6e-7, 2e-6),  # 4.3e-8, 8.0e-8; 1.8e-7, 5.4e-7
    "reach": (5e-7, 2e-6, 5e-5, 2e-4),  # 1.5e-7, 5.8e-7; 1.5e-5, 5.8e-5
    "reacher": (1.2e-7, 5e-7, 7e-7, 2e-6),  # 3.5e-8, 1.6e-7; 2.0e-7, 6.5e-7
    # MuJoCo Warp, unlike MuJoCo, merges flex contacts less than 1 mm apart
    "soft_ball": (3e-8, 3e-3, 2.5e-6, 6e-1),  # 8.5e-9, 8.8e-4; 6.8e-7, 1.8e-1
    "swimmer": (8e-8, 2e-7, 6e-7, 3e-6),  # 2.4e-8, 5.7e-8; 2.0e-7, 9.0e-7
    "walker2d": (1.2e-7, 2e-7, 2e-5, 8e-5),  # 3.7e-8, 5.8e-8; 6.2e-6, 2.4e-5
}
SUITE_ONE_STEP = {
    "acrobot": (2e-7, 4e-7, 2.2e-7, 8e-7),  # 5.4e-8, 1.1e-7; 6.1e-8, 2.3e-7
    "ball_in_cup": (1.2e-8, 4e-8, 1.2e-7, 3.5e-7),  # 3.5e-9, 1.2e-8; 3.3e-8, 9.7e-8
    "cartpole": (2e-7, 4e-7, 5e-8, 2e-7),  # 5.9e-8, 1.1e-7; 1.3e-8, 5.3e-8
    "cheetah": (1e-7, 7e-7, 1e-5, 7e-5),  # 2.8e-8, 2.0e-7; 2.7e-6, 2.0e-5
    "finger": (1.1e-7, 2.4e-7, 2.5e-6, 9e-6),  # 3.1e-8, 6.8e-8; 7.1e-7, 2.5e-6
    "fish": (2.6e-7, 9e-7, 4e-5, 2.3e-4),  # 7.4e-8, 2.6e-7; 1.1e-5, 6.5e-5
    "hopper": (2e-7, 4e-7, 1.7e-6, 1.3e-5),  # 6.0e-8, 1.2e-7; 4.8e-7, 3.7e-6
    "humanoid": (4e-7, 1.4e-6, 8e-5, 2.8e-4),  # 1.2e-7, 3.9e-7; 2.2e-5, 7.9e-5
    "manipulator": (3.5e-7, 2.5e-6, 1.5e-5, 7e-5),  # 9.7e-8, 7.1e-7; 4.1e-6, 2.0e-5
    "pendulum": (2e-7, 6e-7, 2e-7, 8e-7),  # 5.4e-8, 1.8e-7; 6.0e-8, 2.2e-7
    "point_mass": (1.5e-8, 5e-8, 2e-9, 4e-9),  # 4.2e-9, 1.3e-8; 5.4e-10, 1.2e-9
    "quadruped": (2e-7, 5e-7, 1.5e-5, 9e-5),  # 5.6e-8, 1.5e-7; 4.4e-6, 2.7e-5
    "reacher": (1.4e-7, 4e-7, 7e-7, 3e-6),  # 4.0e-8, 1.1e-7; 2.1e-7, 8.8e-7
    "swimmer": (9e-7, 3e-6, 4e-4, 1.5e-3),  # with 15 links: 2.5e-7, 8.5e-7; 1.2e-4, 4.3e-4
    "walker": (2e-7, 4e-7, 9e-6, 4e-5),  # 5.9e-8, 1.1e-7; 2.6e-6, 1.1e-5
}
ONE_STEP |= {name: SUITE_ONE_STEP[module.removeprefix("dm_")] for module, names in SUITE.items() for name in names}


@dataclasses.dataclass
class Engines:
    """A task on both engines with one substep per step."""

    task: str
    c: lw.Env
    warp: lw.Env
    states: list[torch.Tensor]
    """States (NWORLD, size) of a random rollout, rounded to float32."""


def random_action(env: lw.Env, rng: np.random.Generator, reach: float) -> torch.Tensor:
    low, high = env.action_space.low, env.action_space.high
    assert low is not None and high is not None
    # unbounded actions get the bounds -1 and 1
    low, high = np.nan_to_num(low, neginf=-1.0), np.nan_to_num(high, posinf=1.0)
    values = (low + high) / 2 + reach * (high - low) / 2 * rng.uniform(-1.0, 1.0, env.action.shape)
    return torch.from_numpy(values.astype(np.float32))


def rollout_states(env: lw.Env) -> list[torch.Tensor]:
    rng, states = np.random.default_rng(0), []
    counters = [env.state_space.parts[name] for name in ("step", "key", "episode")]
    for i in range(60):
        env.step(random_action(env, rng, 1.0))
        if i % 6 == 5:
            exact = env.get_state()
            state = exact.float().double()
            for part in counters:
                state[:, part] = exact[:, part]
            states.append(state)
    return states


@pytest.fixture(scope="module", params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Return the Warp engine's device. The C engine always runs on the CPU."""
    return str(request.param)


@pytest.fixture(scope="module", params=TASKS)
def engines(request: pytest.FixtureRequest, device: str, shared_env: SharedEnv) -> Engines:
    task = request.param
    options = {"nworld": NWORLD, "cone": "elliptic", "frame_skip": 1, "autoreset": False, "horizon": 0}
    options |= PARAMS.get(task, {})
    states = rollout_states(shared_env(task, engine="mujoco", nworld=NWORLD))
    c = shared_env(task, engine="mujoco", **options)
    warp = shared_env(task, engine="warp", device=device, **options)
    return Engines(task, c, warp, states)


Outcome = dict[str, torch.Tensor]


def outcome(env: lw.Env) -> Outcome:
    names = ("obs", "reward", "eval", "terminated", "success")
    return {name: getattr(env, name).clone().cpu() for name in names}


def relative_error(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the largest |a - b| / max(1, |b|)."""
    return ((a - b).abs() / b.abs().clamp(min=1.0)).max().item() if a.numel() else 0.0


def check_same(ours: Outcome, other: Outcome, force_parts: dict[str, slice] | None = None) -> None:
    """Compare numbers with a tolerance of 1e-5, and flags exactly.

    The tolerance of ``force_parts`` is 1e-3 of their maximum, or 0.01 N if that is larger.
    """
    forces = torch.zeros(ours["obs"].shape[1], dtype=torch.bool)
    for part in (force_parts or {}).values():
        forces[part] = True
        a, b = ours["obs"][:, part], other["obs"][:, part]
        assert (a - b).abs().max() <= max(1e-2, 1e-3 * float(b.abs().max()))
    assert relative_error(ours["obs"][:, ~forces], other["obs"][:, ~forces]) <= 1e-5
    for name in ("reward", "eval"):
        assert relative_error(ours[name], other[name]) <= 1e-5, name
    for name in ("terminated", "success"):
        assert torch.equal(ours[name], other[name]), name


def judge(env: lw.Env, before: Outcome, action: torch.Tensor, after: Outcome) -> Outcome:
    """Evaluate the task's functions on given field values, without physics."""
    kept = []
    for batch, values in ((env.worlds.before, before), (env.worlds.after, after)):
        for name, value in values.items():
            field = torch_view(getattr(batch, name))
            if field.stride(0) == 0:
                continue
            kept.append((field, field.clone()))
            field.copy_(value)
    env.worlds.judge_transition(action)
    result = outcome(env)
    for field, value in kept:  # MuJoCo Warp never recomputes the world body's position
        field.copy_(value)
    env.rand_reset(0)
    return result


def disturbed(fields: Outcome, rng: torch.Generator) -> Outcome:
    noise = {name: torch.randn(2, *value.shape, generator=rng) for name, value in fields.items()}
    return {k: v * (1.0 + 0.1 * noise[k][0]) + 0.1 * noise[k][1] for k, v in fields.items()}


@quick
def test_equal_field_values_give_equal_results_on_both_engines(engines: Engines) -> None:
    rng = torch.Generator().manual_seed(0)
    numpy_rng = np.random.default_rng(1)
    fallen = 0
    for state in engines.states[:4]:
        for env in (engines.c, engines.warp):
            env.set_state(state.to(env.action.device))
        live = engines.c.worlds.after
        fields = {name: torch_view(getattr(live, name)) for name in engines.c.task.types}
        before, after = disturbed(fields, rng), disturbed(fields, rng)
        values = before, random_action(engines.c, numpy_rng, 1.3), after
        results = [judge(env, *values) for env in (engines.c, engines.warp)]
        assert results[0]["obs"].abs().max() > 0.1
        check_same(*results)
        fallen += int(results[0]["terminated"].sum())
    assert 0 < fallen < 4 * NWORLD or engines.c.task.functions["terminated"] is None


@quick
def test_equal_positions_and_velocities_give_equal_observations_on_both_engines(engines: Engines) -> None:
    parts = {name: part for name, part in engines.c.obs_space.parts.items() if name in FORCE_PARTS}
    largest = 0.0
    for state in engines.states:
        results = []
        for env in (engines.c, engines.warp):
            env.set_state(state.to(env.action.device))
            for phase in env.worlds.reset_phases(randomly=False):
                if phase.name not in ("restart", "settle"):
                    phase.run()
            results.append(outcome(env))
        check_same(*results, parts)
        largest = max([largest, *(results[0]["obs"][:, part].abs().max().item() for part in parts.values())])
    assert largest >= 1.0 or not parts, "no state has a contact, so nothing was compared"


@quick
def test_engines_differ_only_by_rounding_after_one_substep(engines: Engines) -> None:
    assert engines.task in ONE_STEP, f"add bounds of {engines.task} to ONE_STEP; pytest -rP shows the differences"
    rng = np.random.default_rng(3)
    errors: dict[str, list[torch.Tensor]] = {"qpos": [], "qvel": []}
    for state in engines.states:
        action = random_action(engines.c, rng, 1.3)
        results = []
        for env in (engines.c, engines.warp):
            env.set_state(state.to(env.action.device))
            env.step(action.to(env.action.device))
            assert not (env.done_reason & ~int(lw.Done.TERMINATED)).any()
            results.append(env.state_space.split(env.get_state().cpu()))
        for name, values in errors.items():
            values.append((results[0][name] - results[1][name]).abs().amax(dim=1))
    figures = [np.percentile(torch.cat(values).numpy(), q) for values in errors.values() for q in (50.0, 95.0)]
    print(f"{engines.task}: qpos {figures[0]:.1e}, {figures[1]:.1e}; qvel {figures[2]:.1e}, {figures[3]:.1e}")
    assert (np.array(figures) <= ONE_STEP[engines.task]).all()


@pytest.mark.parametrize(
    ("task", "params"),
    [(Pushed, {}), (Pushed, {"reach": 0.0}), (Pushed, {"force": 0.0}), (Drawn, {}), (Drawn, {"spread": 0.0})],
    ids=["pushes_and_moves", "pushes", "moves_a_mocap_body", "draws", "draws_gravity"],
)
def test_engines_agree_over_fifty_steps_with_inputs_and_randomized_models(
    task: type[lw.Task], params: dict[str, float], device: str
) -> None:
    c = lw.make(task, nworld=8, seed=1, **params)
    warp = lw.make(task, nworld=8, seed=1, engine="warp", device=device, **params)
    start, rng, worst, far = positions_of(c), np.random.default_rng(0), 0.0, 0.0
    for i in range(50):
        action = random_action(c, rng, 1.0)
        c.step(action)
        warp.step(action.to(warp.action.device))
        assert torch.equal(c.truncated, warp.truncated.cpu()), f"step {i}"
        worst = max(worst, (positions_of(c) - positions_of(warp)).abs().max().item())
        far = max(far, (positions_of(c) - start).abs().max().item())
    assert far > 0.02, "nothing moved"
    print(f"qpos {worst:.1e}")
    assert worst <= 3e-6, f"qpos differs by {worst:.1e}"  # measured: 7.8e-7


def positions_of(env: lw.Env) -> torch.Tensor:
    return env.state_space.split(env.get_state().cpu())["qpos"].clone()
