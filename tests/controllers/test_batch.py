import dataclasses
from pathlib import Path

import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos import evaluation_seed
from lyceum_warp.controllers import Trajectory, control, episode_env, load_episodes, policy_episodes
from lyceum_warp.core import Done


def push(obs: torch.Tensor) -> torch.Tensor:
    return torch.tanh(3 * obs[:, :3])


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("hopper", nworld=3, horizon=60, autoreset=False)


def test_policy_episodes_have_the_same_returns_as_evaluate(env: lw.Env, shared_env: SharedEnv) -> None:
    counts: list[tuple[int, int]] = []
    evaluated = lw.evaluate(shared_env("hopper", nworld=3, horizon=60), push, 5, seed=2)  # type: ignore[arg-type]
    progress = lambda *count: counts.append(count)  # noqa: E731
    episodes = list(policy_episodes(env, push, 5, seed=evaluation_seed(2), progress=progress))
    assert [episode.steps for episode in episodes] == evaluated.lengths[:5].int().tolist()
    returns = torch.tensor([episode.episode_return for episode in episodes])
    torch.testing.assert_close(returns, evaluated.returns[:5], rtol=1e-5, atol=1e-5)
    assert len(set(returns.tolist())) == 5
    assert counts and all(done <= total == 120 for done, total in counts)
    for episode in episodes:
        ended = Done.TRUNCATED if episode.steps == 60 else Done.TERMINATED
        assert episode.done_reason == ended and episode.states.shape == (episode.steps + 1, env.state_space.size)
        assert episode.controller["name"] == "function"
    assert [(e.controller["world"], e.controller["episode"]) for e in episodes] == [
        (0, 0),
        (1, 0),
        (2, 0),
        (0, 1),
        (1, 1),
    ]


def test_an_episode_can_be_replayed_bit_for_bit(env: lw.Env) -> None:
    episode = list(policy_episodes(env, push, 2, seed=1))[1]
    one = lw.make("hopper", horizon=60, autoreset=False)
    one.set_state(episode.states[:1])
    for k, action in enumerate(episode.actions):
        assert torch.equal(one.obs[0], episode.obs[k])
        one.step(action[None])
        assert torch.equal(one.get_state()[0], episode.states[k + 1])
        assert one.reward.item() == episode.rewards[k]


def test_episodes_hold_the_pictures_of_their_states(shared_env: SharedEnv, tmp_path: Path) -> None:
    cameras = [lw.Camera("side", 16, 12), lw.Camera("above", 8, 8, "depth", "above/1", pos=(0, 0, 4), lookat=(0, 0, 1))]
    env = shared_env("cartpole", nworld=2, autoreset=False, horizon=40, cameras=cameras)
    _, episode = policy_episodes(env, lambda obs: torch.ones(2, 1), 2, seed=0)
    assert {group: tuple(seen.shape) for group, seen in episode.pictures.items()} == {
        "camera": (41, 12, 16, 3), "above/1": (41, 8, 8, 1),
    }  # fmt: skip
    loaded = Trajectory.load(episode.save(tmp_path / "episode.npz"))
    one = episode_env(loaded)  # has the same cameras
    for k in (0, 20, 40):
        one.set_state(loaded.states[k : k + 1])
        for group, seen in loaded.pictures.items():
            assert torch.equal(seen[k], one.obs_groups[group][0]), (k, group)
    assert not torch.equal(loaded.pictures["camera"][0], loaded.pictures["camera"][40])
    controlled = control(one, lambda state, obs: torch.ones(1), steps=3, seed=0)
    assert controlled.pictures["camera"].shape == (4, 12, 16, 3)
    dataclasses.replace(episode, pictures={}).save(tmp_path / "other.npz")
    with pytest.raises(ValueError, match=r"other.npz has pictures \{\}, but .*episode.npz has .*'camera'"):
        load_episodes(tmp_path)
    episode.pictures["camera"] = episode.pictures["camera"][:-1]
    with pytest.raises(ValueError, match="pictures 'camera' have the shape"):
        Trajectory.load(episode.save(tmp_path / "short.npz"))


def test_episodes_whose_pictures_do_not_fit_into_memory_are_refused(shared_env: SharedEnv) -> None:
    env = shared_env("cartpole", nworld=2, autoreset=False, horizon=10**9, cameras=[lw.Camera("side", 16, 12)])
    with pytest.raises(ValueError, match="2 worlds of 1000000000 steps with pictures need about 1.15e"):
        next(policy_episodes(env, lambda obs: torch.ones(2, 1), 2))


def test_episode_has_the_parameters_of_its_own_world() -> None:
    env = lw.make("point_mass", nworld=2, horizon=3, autoreset=False, success_distance=[0.1, 0.2])
    first, second = policy_episodes(env, lambda obs: torch.zeros(2, 2), 2)
    assert first.params["success_distance"] == pytest.approx([0.1])
    assert second.params["success_distance"] == pytest.approx([0.2])
