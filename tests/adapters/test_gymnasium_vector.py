from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from conftest import SharedEnv
from full_task import Full
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

import lyceum_warp as lw
from lyceum_warp.gym import GymnasiumVectorEnv
from lyceum_warp.viz.video import NoVideoError

STEPS = 30
N = 4


@pytest.fixture
def vector(shared_env: SharedEnv) -> Callable[..., GymnasiumVectorEnv]:
    def get(**options: Any) -> GymnasiumVectorEnv:
        same_step = options.get("autoreset_mode", AutoresetMode.SAME_STEP) is AutoresetMode.SAME_STEP
        return GymnasiumVectorEnv(shared_env(Full, nworld=N, autoreset=same_step), **options)

    return get


def actions() -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    for _ in range(STEPS):
        yield rng.uniform(-1, 1, (N, 3)).astype(np.float32)


def as_array(value: Any) -> np.ndarray:
    return value.numpy().copy() if isinstance(value, torch.Tensor) else value


def by_hand(env: lw.Env) -> list[dict[str, np.ndarray]]:
    env.rand_reset(5)
    steps = []
    for action in actions():
        env.step(torch.from_numpy(action))
        values = {
            name: getattr(env, name) for name in ("obs", "final_obs", "reward", "terminated", "truncated", "done")
        }
        values |= {"critic": env.obs_groups["critic"], "final_critic": env.final_obs_groups["critic"], "eval": env.eval}
        values |= {"success": env.success, "done_reason": env.done_reason, "speed": env.metrics["speed"]}
        values |= {"cost_sum": env.episode_metrics["cost"]}
        steps.append({name: as_array(value) for name, value in values.items()})
    assert sum(step["done"].sum() for step in steps) > 3
    return steps


@pytest.mark.parametrize("tensors", [False, True], ids=["numpy", "torch"])
def test_step_returns_the_values_of_the_wrapped_environment(
    tensors: bool, vector: Callable[..., GymnasiumVectorEnv]
) -> None:
    envs = vector(torch=tensors)
    expected = by_hand(envs.env)
    obs, infos = envs.reset(seed=5)
    assert obs.keys() == {"policy", "critic"} and infos["eval"].shape == (N,)
    for step, action in zip(expected, actions(), strict=True):
        given: Any = torch.from_numpy(action) if tensors else action
        obs, reward, terminated, truncated, infos = envs.step(given)
        assert isinstance(reward, torch.Tensor if tensors else np.ndarray)
        shown = {
            "obs": obs["policy"], "critic": obs["critic"], "reward": reward, "terminated": terminated,
            "truncated": truncated, "eval": infos["eval"], "done_reason": infos["done_reason"],
            "success": infos["success"], "speed": infos["metrics"]["speed"],
            "cost_sum": infos["episode_metrics"]["cost"],
        }  # fmt: skip
        for name, value in shown.items():
            np.testing.assert_array_equal(as_array(value), step[name], err_msg=name)
        if not tensors:
            assert ("final_obs" in infos) == step["done"].any()
        if "final_obs" in infos:
            check_final(infos, step, tensors)


def check_final(infos: dict[str, Any], step: dict[str, np.ndarray], tensors: bool) -> None:
    ended = step["done"]
    for mask in ("_final_obs", "_final_info"):
        np.testing.assert_array_equal(as_array(infos[mask]), ended)
    np.testing.assert_array_equal(as_array(infos["final_info"]["eval"])[ended], step["eval"][ended])
    if tensors:
        np.testing.assert_array_equal(as_array(infos["final_obs"]["critic"]), step["final_critic"])
        return
    for world, final in enumerate(infos["final_obs"]):
        assert (final is not None) == ended[world]
        if final is not None:
            np.testing.assert_array_equal(final["policy"], step["final_obs"][world])
            np.testing.assert_array_equal(final["critic"], step["final_critic"][world])


@pytest.mark.parametrize("tensors", [False, True], ids=["numpy", "torch"])
def test_results_are_buffers_of_the_environment_only_without_copies(
    tensors: bool, vector: Callable[..., GymnasiumVectorEnv]
) -> None:
    for copy in (True, False):
        envs = vector(torch=tensors, copy=copy)
        obs, _ = envs.reset(seed=0)
        assert (torch.as_tensor(obs["policy"]).data_ptr() == envs.env.obs.data_ptr()) is not copy


@pytest.mark.parametrize("mask_of", [np.asarray, torch.as_tensor], ids=["numpy", "torch"])
def test_ended_world_waits_for_a_masked_reset_if_autoreset_is_disabled(
    mask_of: Callable[[np.ndarray], Any], vector: Callable[..., GymnasiumVectorEnv]
) -> None:
    envs = vector(autoreset_mode=AutoresetMode.DISABLED)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    envs.reset(seed=5)
    ended = np.zeros(N, dtype=bool)
    for action in actions():
        obs, _, terminated, truncated, infos = envs.step(action)
        assert (ended <= (terminated | truncated)).all() and "final_obs" not in infos
        ended = terminated | truncated
        if ended.any() and not ended.all():
            break
    np.testing.assert_array_equal(obs["policy"][ended], envs.env.final_obs.numpy()[ended])
    reset, infos = envs.reset(options={"reset_mask": mask_of(ended)})
    np.testing.assert_array_equal(reset["policy"][~ended], obs["policy"][~ended])
    assert (reset["policy"][ended] != obs["policy"][ended]).any()
    assert not envs.env.done.any() and (infos["done_reason"] == 0).all()
    assert (envs.env.episode_step.numpy()[ended] == 0).all()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_fault_truncates_the_episode_with_the_last_valid_observation(
    mode: AutoresetMode, vector: Callable[..., GymnasiumVectorEnv]
) -> None:
    envs = vector(autoreset_mode=mode)
    before, _ = envs.reset(seed=2)
    action = np.zeros((N, 3), dtype=np.float32)
    action[1] = np.nan
    obs, reward, terminated, truncated, infos = envs.step(action)
    assert not terminated.any() and truncated.tolist() == [False, True, False, False]
    last = infos["final_obs"][1]["policy"] if mode is AutoresetMode.SAME_STEP else obs["policy"][1]
    np.testing.assert_array_equal(last, before["policy"][1])
    assert reward[1] == 0 and infos["done_reason"][1] == lw.Done.ACTION


def test_next_step_mode_resets_a_world_in_the_step_after_its_end(vector: Callable[..., GymnasiumVectorEnv]) -> None:
    envs = vector(autoreset_mode=AutoresetMode.NEXT_STEP)
    envs.reset(seed=5)
    faults, ended, ends = envs.env.fault_counts, np.zeros(N, dtype=bool), 0
    for action in actions():
        action[ended] = np.nan
        obs, reward, terminated, truncated, infos = envs.step(action)
        assert not (ended & (terminated | truncated)).any() and (reward[ended] == 0).all()
        assert (envs.env.episode_step.numpy()[ended] == 0).all()
        ended = terminated | truncated
        np.testing.assert_array_equal(obs["policy"][ended], envs.env.final_obs.numpy()[ended])
        assert "final_obs" not in infos
        ends += ended.sum()
    assert ends > 3 and envs.env.fault_counts == faults


def test_resets_repeat_initial_states_only_with_the_same_seed(vector: Callable[..., GymnasiumVectorEnv]) -> None:
    envs = vector()
    first, again = (envs.reset(seed=2**40 + 3)[0]["policy"] for _ in range(2))
    other, going_on = envs.reset(seed=4)[0]["policy"], envs.reset()[0]["policy"]
    np.testing.assert_array_equal(first, again)
    assert (first != other).any() and (other != going_on).any()
    assert len(np.unique(first[:, 0])) == N


def test_first_reset_without_a_seed_uses_a_random_seed() -> None:
    def first(**options: Any) -> np.ndarray:
        return GymnasiumVectorEnv("hopper", 2, **options).reset()[0]

    assert (first() != first()).any()
    np.testing.assert_array_equal(first(seed=3), first(seed=3))


def test_gymnasium_spaces_have_the_bounds_of_the_environment(vector: Callable[..., GymnasiumVectorEnv]) -> None:
    envs = vector()
    assert envs.single_action_space == gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    assert {name: space.shape for name, space in envs.observation_space.items()} == {
        "policy": (N, 3),
        "critic": (N, 15),
    }
    obs, _ = envs.reset(seed=0)
    assert obs in envs.observation_space
    assert vector(dict_obs=False).single_observation_space.shape == (3,)
    assert GymnasiumVectorEnv("hopper", dict_obs=True).single_observation_space["policy"].shape == (11,)


def test_render_returns_a_picture_of_each_world(vector: Callable[..., GymnasiumVectorEnv]) -> None:
    envs = vector(render_mode="rgb_array", render_size=(64, 48))
    try:
        frames = envs.render()
    except NoVideoError as error:
        pytest.skip(str(error))
    assert frames is not None and len(frames) == N
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 for frame in frames)
    assert envs.call("render")[0].shape == (48, 64, 3)
    envs.close()


@pytest.mark.parametrize("tensors, action, text", [
    (False, np.zeros((4, 2), dtype=np.float32), r"\(4, 3\), not a float32 array of shape \(4, 2\)"),
    (False, [[0.0] * 3] * 4, r"\(4, 3\), not list"),
    (True, np.zeros((4, 3), dtype=np.float32), r"tensor .*, not a ndarray of shape \(4, 3\)"),
])  # fmt: skip
def test_actions_of_wrong_shape_or_type_raise_an_error(
    tensors: bool, action: Any, text: str, vector: Callable[..., GymnasiumVectorEnv]
) -> None:
    envs = vector(torch=tensors)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=text):
        envs.step(action)


def test_step_or_partial_reset_before_the_first_reset_raises_an_error(
    vector: Callable[..., GymnasiumVectorEnv],
) -> None:
    with pytest.raises(ResetNeeded):
        vector().step(np.zeros((N, 3), dtype=np.float32))
    with pytest.raises(ResetNeeded):
        vector().reset(options={"reset_mask": np.array([True, False, False, False])})


def test_invalid_arguments_raise_an_error() -> None:
    hopper = gymnasium.make_vec("lyceum_warp.gym:lyceum/Hopper-v0", num_envs=N)
    assert isinstance(hopper, GymnasiumVectorEnv)
    for reset, text in [({"mask": 1}, "mask"), ({"reset_mask": np.ones(3, dtype=bool)}, r"\(3,\)"),
                        ({"reset_mask": np.ones(4)}, "ndarray")]:  # fmt: skip
        with pytest.raises(ValueError, match=text):
            hopper.reset(options=reset)
    for options, text in [({"num_envs": 0}, "0"), ({"nworld": 4}, "nworld"), ({"autoreset_mode": "Never"}, "Never"),
                          ({"render_mode": "human"}, "human")]:  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=text):
            GymnasiumVectorEnv("hopper", **options)


def test_unsuitable_environment_raises_an_error(shared_env: SharedEnv) -> None:
    env, without = (shared_env(Full, nworld=N, autoreset=autoreset) for autoreset in (True, False))
    with pytest.raises(ValueError, match="horizon"):
        GymnasiumVectorEnv(env, horizon=3)
    with pytest.raises(ValueError, match="4 worlds, not num_envs=3"):
        GymnasiumVectorEnv(env, 3)
    with pytest.raises(ValueError, match="autoreset=False"):
        GymnasiumVectorEnv(env, autoreset_mode=AutoresetMode.DISABLED)
    assert GymnasiumVectorEnv(without).autoreset_mode is AutoresetMode.DISABLED
