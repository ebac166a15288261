from collections import Counter
from typing import Any

import pytest
import torch
import warp as wp
from form_tasks import Pushed
from object_task import Drop
from scene_task import Scene, Traced
from varied_task import Varied

import lyceum_warp as lw

LOOK = {"cameras": [lw.Camera("look", 16, 16, pos=(0.2, -2, 1), lookat=(0.2, 0, 0.2))], "horizon": 4}

CASES: dict[str, tuple[type[lw.Task], dict[str, Any]]] = {
    "no poses read": (Scene, {}),
    "velocities read": (Scene, {"fields": ["cvel"]}),
    "forces read": (Scene, {"fields": ["qacc", "site_xpos"]}),
    "poses read in substeps": (Traced, {}),
    "mocap bodies moved": (Pushed, LOOK),
    "lengths drawn": (Varied, LOOK | {"cameras": ["fixed"]}),
    "meshes drawn": (Drop, LOOK),
}


def random_actions(*envs: lw.Env, seed: int) -> None:
    action = torch.rand(envs[0].action.shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1
    for env in envs:
        env.action.copy_(action)


@pytest.mark.parametrize(("task", "options"), CASES.values(), ids=CASES)
def test_pictures_show_the_state_and_do_not_affect_steps(task: type[lw.Task], options: dict[str, Any]) -> None:
    env = lw.make(task, nworld=3, engine="warp", final_pictures=True, **options)
    blind = lw.make(task, nworld=3, engine="warp", **options | {"cameras": []})
    other = lw.make(task, nworld=3, engine="mujoco", **options)  # its renderer computes all poses from the states
    ended = 0
    for i in range(10):
        random_actions(env, blind, seed=i)
        for each in (env, blind):
            if i == 3:
                state = each.get_state()
                state[:, each.state_space.parts["qpos"].start] += 0.1
                each.set_state(state, torch.tensor([True, False, True]))
            elif i == 6:
                each.rand_reset(mask=torch.tensor([False, True, False]))
            else:
                each.step()
        ended += int(env.done.sum())
        assert torch.equal(env.get_state(), blind.get_state()) and torch.equal(env.obs, blind.obs), i
        other.set_state(env.get_state())
        for group in env.final_obs_groups.keys() - blind.final_obs_groups.keys():
            assert torch.equal(env.obs_groups[group], other.obs_groups[group]), (i, group)
    assert ended > 2


@pytest.mark.parametrize(("task", "camera"), [(Varied, "fixed"), (Traced, "eye")])
def test_rollouts_do_not_need_pictures_of_their_initial_states(task: type[lw.Task], camera: str) -> None:
    start, ends = lw.make(task, seed=1).get_state()[0], []
    for cameras in ([camera], []):
        env = lw.make(task, nworld=2, engine="warp", autoreset=False, cameras=cameras)
        rollouts = lw.OpenLoop(env, horizon=3)
        rollouts.state.copy_(start)
        rollouts.actions.fill_(0.5)
        rollouts.run()
        ends.append(env.get_state())
    assert torch.equal(*ends)


@pytest.mark.parametrize("fields", [(), ("cvel",)])
def test_a_step_with_pictures_computes_no_pose_twice(monkeypatch: pytest.MonkeyPatch, fields: tuple[str, ...]) -> None:
    launch, launches = wp.launch, list[Counter[str]]()

    def count(kernel: wp.Kernel, *args: Any, **words: Any) -> Any:
        launches[-1][kernel.key] += 1
        return launch(kernel, *args, **words)

    options: dict[str, Any] = {"nworld": 2, "engine": "warp", "graphs": False, "fields": fields}
    envs = [lw.make(Varied, cameras=cameras, **options) for cameras in (["fixed"], [])]
    monkeypatch.setattr(wp, "launch", count)
    for env in envs:
        launches.append(Counter[str]())
        env.step()
    more = launches[0] - launches[1]
    assert more.total() == 3, more  # bounds, rays, and bytes
