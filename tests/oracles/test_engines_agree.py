"""The C engine and the Warp engine give the same numbers for every task of the package.

Both run the task's own functions; what differs is the physics below them, float64 there and float32 here. With
pyramidal friction cones MuJoCo Warp lays the tangents of a capsule on a plane differently, a known difference
that has nothing to do with this package: elliptic cones, which do not depend on the tangents, are compared.
"""

import dataclasses
import pkgutil
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

import lyceum_warp as lw
import lyceum_warp.tasks
from lyceum_warp.arrays import torch_view

NWORLD = 32
TASKS = [module.name for module in pkgutil.iter_modules(lyceum_warp.tasks.__path__)]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]

FORCE_PARTS = {"humanoid": ("contact_force",)}
"""Parts of the observation that depend on constraint forces, which a solver finds to its tolerance."""


@dataclasses.dataclass(frozen=True)
class Bounds:
    """How far the engines may be apart after one substep: largest coordinate of a world, over worlds."""

    qpos_median: float
    qpos_p95: float
    qvel_median: float
    qvel_p95: float


# Each number is three to four times what was measured with mujoco and mujoco_warp 4.0.0 on the CPU, over 320 states
# along random rollouts, rounded to two digits. A float32 position of about 1 is good for 6e-8.
ONE_STEP = {  #                         measured: qpos median, 95 %; qvel median, 95 %
    # the 5 % are pens that lie on the palm's boxes
    "adroit_pen": Bounds(1.5e-7, 4e-6, 5e-6, 2e-3),  # 4.1e-8, 1.2e-6; 1.4e-6, 5.8e-4
    "cartpole_swingup": Bounds(2e-7, 4e-7, 4e-8, 1e-7),  # 6.2e-8, 1.1e-7; 1.2e-8, 2.9e-8
    "half_cheetah": Bounds(1e-7, 1e-6, 1e-5, 1e-4),  # 3.2e-8, 2.9e-7; 3.0e-6, 2.9e-5
    "hopper": Bounds(1e-7, 2e-7, 1e-6, 5e-6),  # 3.0e-8, 5.5e-8; 2.9e-7, 1.6e-6
    "humanoid": Bounds(2e-7, 4e-7, 3e-5, 1.2e-4),  # 5.6e-8, 1.1e-7; 8.8e-6, 3.9e-5
    "point_mass": Bounds(5e-8, 1.5e-7, 6e-8, 1.5e-7),  # 1.4e-8, 4.5e-8; 1.9e-8, 5.1e-8
    "reach": Bounds(5e-7, 2e-6, 5e-5, 2e-4),  # 1.5e-7, 5.8e-7; 1.5e-5, 5.8e-5
    "swimmer": Bounds(8e-8, 2e-7, 6e-7, 3e-6),  # 2.4e-8, 5.7e-8; 2.0e-7, 9.0e-7
    "walker2d": Bounds(1.2e-7, 2e-7, 2e-5, 8e-5),  # 3.7e-8, 5.8e-8; 6.2e-6, 2.4e-5
}


@dataclasses.dataclass
class Engines:
    """One task on both engines, one substep a step, and states to put them into."""

    task: str
    c: lw.Env
    warp: lw.Env
    states: list[torch.Tensor]
    """Along a random rollout of the task as it is, (NWORLD, size) each; every number is one of float32."""

    def action(self, rng: np.random.Generator) -> torch.Tensor:
        """Random actions for every world, some beyond the control range."""
        return random_action(self.c, rng, 1.3)


def random_action(env: lw.Env, rng: np.random.Generator, reach: float) -> torch.Tensor:
    low, high = env.action_space.low, env.action_space.high
    assert low is not None and high is not None
    values = (low + high) / 2 + reach * (high - low) / 2 * rng.uniform(-1.0, 1.0, env.action.shape)
    return torch.from_numpy(values.astype(np.float32))


def rollout_states(env: lw.Env) -> list[torch.Tensor]:
    """Every sixth state of 60 random steps, fallen and reset worlds among them."""
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
    """Where the Warp engine runs; the C engine always runs on the CPU."""
    return str(request.param)


@pytest.fixture(scope="module", params=TASKS)
def engines(request: pytest.FixtureRequest, device: str, shared_env: Callable[..., lw.Env]) -> Iterator[Engines]:
    task = request.param
    options = {"nworld": NWORLD, "cone": "elliptic", "frame_skip": 1, "autoreset": False, "horizon": 0}
    states = rollout_states(shared_env(task, engine="mujoco", nworld=NWORLD))
    c = shared_env(task, engine="mujoco", **options)
    warp = shared_env(task, engine="warp", device=device, **options)
    yield Engines(task, c, warp, states)


Outcome = dict[str, torch.Tensor]


def outcome(env: lw.Env) -> Outcome:
    names = ("obs", "reward", "eval", "terminated", "success")
    return {name: getattr(env, name).clone().cpu() for name in names}


def relative_error(a: torch.Tensor, b: torch.Tensor) -> float:
    """Largest difference, relative to the larger of 1 and the value."""
    return ((a - b).abs() / b.abs().clamp(min=1.0)).max().item() if a.numel() else 0.0


def check_same(ours: Outcome, other: Outcome, force_parts: dict[str, slice] | None = None) -> None:
    """Within 1e-5, flags equal; the named parts of the observation within 1e-3 of their largest magnitude."""
    forces = torch.zeros(ours["obs"].shape[1], dtype=torch.bool)
    for part in (force_parts or {}).values():
        forces[part] = True
        a, b = ours["obs"][:, part], other["obs"][:, part]
        assert (a - b).abs().max() <= 1e-3 * b.abs().max()
    assert relative_error(ours["obs"][:, ~forces], other["obs"][:, ~forces]) <= 1e-5
    for name in ("reward", "eval"):
        assert relative_error(ours[name], other[name]) <= 1e-5, name
    for name in ("terminated", "success"):
        assert torch.equal(ours[name], other[name]), name


def judge(env: lw.Env, before: Outcome, action: torch.Tensor, after: Outcome) -> Outcome:
    """What the task's functions make of given field values, wherever an engine would have taken them from."""
    for batch, values in ((env._before, before), (env._after, after)):
        for name, value in values.items():
            torch_view(getattr(batch, name)).copy_(value)
    torch_view(env._safe_action).copy_(action)
    env.done_reason.zero_()  # without automatic resets, what has ended stays so
    env._judge(env._everyone, env._no_fault, env._no_fault, transition=True)
    result = outcome(env)
    env.rand_reset(0)
    return result


def test_same_state_layout(engines: Engines) -> None:
    """A state of one engine is a state of the other: its parts lie in the same places."""
    assert engines.c.state_space == engines.warp.state_space
    assert engines.c.obs_space == engines.warp.obs_space
    assert engines.c.timestep == engines.warp.timestep


def test_same_fields(engines: Engines) -> None:
    """The same field values, likely or not, are judged alike."""
    rng = torch.Generator().manual_seed(0)
    numpy_rng = np.random.default_rng(1)
    fallen = 0
    for state in engines.states[:4]:
        engines.c.set_state(state)
        fields: Outcome = {name: torch_view(getattr(engines.c._after, name)).clone() for name in engines.c.task.fields}

        def near(values: Outcome) -> Outcome:
            return {k: v * (1.0 + 0.1 * noise(v)) + 0.1 * noise(v) for k, v in values.items()}

        def noise(like: torch.Tensor) -> torch.Tensor:
            return torch.randn(like.shape, generator=rng)

        before, after, action = near(fields), near(fields), engines.action(numpy_rng)
        results = [judge(env, before, action, after) for env in (engines.c, engines.warp)]
        assert results[0]["obs"].abs().max() > 0.1
        check_same(*results)
        fallen += int(results[0]["terminated"].sum())
    assert 0 < fallen < 4 * NWORLD or engines.c.task.functions["terminated"] is None


def test_same_states(engines: Engines) -> None:
    """Whole states of one engine, its contact forces included, are judged alike by both, through the interface."""
    rng = np.random.default_rng(2)
    for before, after in zip(engines.states[:-1:3], engines.states[1::3], strict=True):
        action = engines.action(rng)
        results = []
        for env in (engines.c, engines.warp):
            s0, a, s1 = (x.to(env.action.device) for x in (before, action, after))
            results.append(
                {
                    "obs": env.get_obs(s1).cpu(),
                    "eval": env.get_eval(s1).cpu(),
                    "terminated": env.get_terminated(s1).cpu(),
                    "reward": env.get_reward(s0, a, s1).cpu(),
                    "success": torch.zeros(0),
                }
            )
        check_same(*results)


def test_same_injected_states(engines: Engines) -> None:
    """From the same positions and velocities, each engine computes the same observation for itself."""
    parts = {name: engines.c.obs_space.parts[name] for name in FORCE_PARTS.get(engines.task, ())}
    largest = 0.0
    for state in engines.states:
        results = []
        for env in (engines.c, engines.warp):
            env.set_state(state.to(env.action.device))
            # a state brings fields with it that are as the last substep left them; here each engine makes its own
            env.engine.refresh(env._everyone)
            env._judge_state()
            results.append(outcome(env))
        check_same(*results, parts)
        largest = max([largest, *(results[0]["obs"][:, part].abs().max().item() for part in parts.values())])
    assert largest > 1.0 or not parts, "no state has a contact: there is nothing to compare"


def test_one_step(engines: Engines) -> None:
    """One substep from the same states under the same actions leaves the engines about a float32 rounding apart."""
    assert engines.task in ONE_STEP, f"measure {engines.task} with pytest -rP and write its bounds into ONE_STEP"
    rng = np.random.default_rng(3)
    errors: dict[str, list[torch.Tensor]] = {"qpos": [], "qvel": []}
    for state in engines.states:
        action = engines.action(rng)
        results = []
        for env in (engines.c, engines.warp):
            env.set_state(state.to(env.action.device))
            env.step(action.to(env.action.device))
            assert not (env.done_reason & ~int(lw.Done.TERMINATED)).any()
            results.append(env.state_space.split(env.get_state().cpu()))
        for name, values in errors.items():
            values.append((results[0][name] - results[1][name]).abs().amax(dim=1))
    figures = [
        float(np.percentile(torch.cat(errors[name]).numpy(), q)) for name in ("qpos", "qvel") for q in (50.0, 95.0)
    ]
    print(f"{engines.task}: qpos {figures[0]:.1e}, {figures[1]:.1e}; qvel {figures[2]:.1e}, {figures[3]:.1e}")
    for name, figure in zip(("qpos_median", "qpos_p95", "qvel_median", "qvel_p95"), figures, strict=True):
        assert figure <= getattr(ONE_STEP[engines.task], name), f"{name} is {figure:.1e}"
