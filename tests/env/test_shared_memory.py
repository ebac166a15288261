from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import warp as wp
from tiny_task import with_function, write

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task


@wp.struct
class Shared:
    mean_angle: Row[float] = lw.part()
    turns: Row[float] = lw.part()  # episodes that ended by speed
    falls: Row[float] = lw.part("levels")


@wp.struct
class Sums:
    steps: Row[float] = lw.part()
    angle: Row[float] = lw.part()
    turns: Row[float] = lw.part()
    falls: Row[float] = lw.part("levels")


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    shared: Shared
    level: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float
    limit: float = 0.2
    fastest: float = 2.0  # rad/s
    levels: wp.array[float] = [0.0, 0.5, 1.0]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[1]
    obs[1] = s.shared.falls[int(s.level[0])]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return 1.0 - wp.abs(s1.qpos[1] - s1.shared.mean_angle[0])


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.abs(s.qpos[1]) > p.limit


@wp.func
def truncated(s: World, p: Params) -> bool:
    return wp.abs(s.qvel[1]) > p.fastest


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.level[0] = wp.floor(lw.uniform(rng, 0.0, float(p.levels.shape[0])))


@wp.func
def tally(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums, terminated: bool):
    sums.steps[0] = 1.0
    sums.angle[0] = s1.qpos[1]
    if terminated:
        sums.falls[int(s1.level[0])] = 1.0
    elif ended:
        sums.turns[0] = 1.0


@wp.func
def share(shared: Shared, sums: Sums, p: Params):
    shared.mean_angle[0] = sums.angle[0] / sums.steps[0]
    shared.turns[0] = sums.turns[0]
    for i in range(p.levels.shape[0]):
        shared.falls[i] = 0.5 * shared.falls[i] + 0.5 * sums.falls[i]


class Balance(lw.Task):
    model, obs = "inverted_pendulum.xml", {"angle": 1, "falls": 1}
    frame_skip, horizon = 2, 50

    @staticmethod
    def edit_model(spec):
        spec.option.timestep = 0.02


@pytest.fixture(scope="module")
def env() -> Iterator[lw.Env]:
    yield lw.make(Balance, nworld=8, seed=0)


def steps(env: lw.Env, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    angles, fallen, cut = [], [], []
    for _ in range(count):
        env.step(6.0 * torch.rand(env.nworld, 1, generator=generator) - 3.0)
        angles.append(env.final_obs[:, 0].clone())
        fallen.append(env.terminated.clone())
        cut.append(env.truncated & ~env.terminated)
    return torch.stack(angles), torch.stack(fallen), torch.stack(cut)


def test_shared_memory_is_updated_from_sums_over_worlds_and_steps(env: lw.Env) -> None:
    env.rand_reset(seed=1)
    env.set_shared(torch.zeros_like(env.get_shared()))
    level = env.state_space.split(env.get_state())["level"][:, 0].long()
    for _ in range(2):
        before = env.shared["falls"].clone()
        angles, fallen, cut = steps(env, 30)
        assert torch.equal(env.shared["falls"], before)
        env.update_shared()
        falls = torch.zeros(3).index_add_(0, level, fallen.sum(0).float())
        assert falls.sum() > 5 and cut.sum() > 5
        torch.testing.assert_close(env.shared["falls"], 0.5 * before + 0.5 * falls)
        assert env.shared["turns"].item() == cut.sum()
        torch.testing.assert_close(env.shared["mean_angle"], angles.mean().view(1), atol=2e-6, rtol=0.0)


def test_sums_do_not_depend_on_the_order_of_worlds(env: lw.Env) -> None:
    env.rand_reset(seed=2)
    start, found = env.get_state(), []
    for order in (torch.arange(8), torch.randperm(8, generator=torch.Generator().manual_seed(0))):
        env.set_state(start[order])
        env.set_shared(torch.zeros_like(env.get_shared()))
        for t in range(10):
            env.step(torch.sin(torch.arange(8.0) * t)[order, None])
        found.append(env.get_shared())
    assert found[0].any() and torch.equal(*found)


def test_states_do_not_contain_shared_memory(env: lw.Env) -> None:
    env.rand_reset(seed=4)
    state = env.get_state()
    steps(env, 5)
    env.update_shared()
    kept = env.get_shared()
    env.set_state(state)
    env.rand_reset(seed=4)
    assert torch.equal(env.get_shared(), kept)
    env.set_shared(2.0 * kept)
    assert torch.equal(env.get_shared(), 2.0 * kept)


def test_getters_replicas_and_planners_use_shared_memory(env: lw.Env) -> None:
    env.rand_reset(seed=5)
    env.shared["falls"].copy_(torch.tensor([1.0, 2.0, 3.0]))
    env.shared["mean_angle"].fill_(0.5)
    level = env.state_space.split(env.get_state())["level"][:, 0].long()
    assert torch.equal(env.get_obs(env.get_state())[:, 1], env.shared["falls"][level])
    planner = env.replicate(autoreset=False)
    rollout = lw.OpenLoop(planner, horizon=3)
    rollout.state.copy_(env.get_state()[0])
    rollout.run()
    few = env.replicate(nworld=2)
    few.follow(env)
    for other in (planner, few):
        assert torch.equal(other.shared["falls"], env.shared["falls"])
    steps(planner, 3)
    assert not planner.get_shared()[5:].any()  # without automatic resets, the sums do not change
    before = planner.get_state()
    planner.step(torch.zeros(8, 1))
    expected = 1.0 - (planner.field("qpos")[:, 1] - 0.5).abs()
    torch.testing.assert_close(planner.reward, expected)
    torch.testing.assert_close(env.get_reward(before, torch.zeros(8, 1), planner.get_state()), expected)


def test_resumed_training_gives_the_same_shared_memory(tmp_path: Path, env: lw.Env) -> None:
    def learner() -> lw.PPO:
        env.rand_reset(seed=6)
        env.set_shared(torch.zeros_like(env.get_shared()))
        return lw.PPO(env, config=lw.PPOConfig(num_steps=16, epochs=1, minibatches=1, hidden=(8,), mean_every=0))

    straight = learner()
    for _ in range(4):
        next(straight)
    expected = env.get_shared()
    assert expected.any()
    first = learner()
    for _ in range(2):
        next(first)
    state = first.state_dict()
    second = learner()
    second.load_state_dict(state)
    for _ in range(2):
        next(second)
    assert torch.equal(env.get_shared(), expected)


def test_sums_of_shared_memory_are_added_across_processes(env: lw.Env) -> None:
    env.rand_reset(seed=7)
    env.set_shared(torch.zeros_like(env.get_shared()))
    _, fallen, _ = steps(env, 30)
    env.update_shared(lambda sums: sums.mul_(2))  # simulate another process that computed the same sums
    assert env.shared["falls"].sum() == fallen.sum()


def test_task_with_shared_memory_passes_check_task() -> None:
    check_task(Balance, nworld=4, steps=20)


def test_writing_shared_memory_in_a_function_other_than_share_raises_an_error() -> None:
    @wp.func
    def writes(s0: World, action: Row[float], s1: World, p: Params) -> float:
        s1.shared.falls[0] = 1.0
        return 0.0

    with pytest.raises(ValueError, match="reward writes s1.shared"):
        lw.make(type("Lawless", (Balance,), {"reward": writes}))


@pytest.mark.parametrize(("name", "row"), [("tally", "sums"), ("share", "shared")])
def test_make_raises_an_error_for_writes_beyond_shared_memory(name: str, row: str) -> None:
    @wp.func
    def beyond_sums(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums):
        sums.falls[3] = 1.0

    @wp.func
    def beyond_shared(shared: Shared, sums: Sums, p: Params):
        shared.falls[3] = 1.0

    function = {"tally": beyond_sums, "share": beyond_shared}[name]
    with pytest.raises(ValueError, match=f"{name} writes .* into {row}, but {row.title()} decl"):
        lw.make(type("Beyond", (Balance,), {name: function}))


def test_task_that_defines_share_without_tally_raises_an_error(tmp_path: Path) -> None:
    file = write(tmp_path, with_function("def share(shared: World, sums: World, p: Params):\n    pass"))
    with pytest.raises(ValueError, match="a part of shared memory is missing: it needs the structs Shared and Sums"):
        lw.make(str(file))
