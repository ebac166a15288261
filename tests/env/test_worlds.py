from typing import Any

import full_task
import pytest
import torch
import warp as wp
from full_task import Full

import lyceum_warp as lw
from lyceum_warp.engines.c import mujoco_engine
from lyceum_warp.env import worlds
from lyceum_warp.graphs import capture
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.kernels.step_types import OUTCOMES

ENGINES = ["mujoco", "warp"]


class CountsPositions(Full):
    @staticmethod
    @wp.func
    def substep(s: full_task.World, p: full_task.Params):
        s.travel[0] = s.travel[0] + s.qpos[0]


class CountsPlaces(Full):
    @staticmethod
    @wp.func
    def substep(s: full_task.World, p: full_task.Params):
        s.travel[0] = s.travel[0] + s.site_xpos[p.top][0]


def outcomes_with_faults(
    engine: str, *, judging: int = 1, observing: int = 1
) -> tuple[list[torch.Tensor], dict[str, int]]:
    env = lw.make(Full, nworld=4, engine=engine, seed=2)
    own, kept = env.worlds, []
    own._judging, own._observing = judging, observing
    for i in range(25):
        env.action.fill_(0.1 * (i % 10))
        if i == 5:
            env.action[1, 0] = torch.nan
        for step, part, bad in (
            (8, "draws", torch.nan),
            (12, "smooth", torch.nan),
            (16, "geom_friction", -1.0),
        ):
            if i == step:
                state = env.get_state()
                env.state_space.split(state)[part][2, -1] = bad
                env.set_state(state, check=False)
        env.step()
        groups = [*own.obs_groups.values(), *own.final_obs_groups.values()]
        metrics = [wp.to_torch(own.metrics), wp.to_torch(own.episode_metrics)]
        outcome = [own.buffers[name] for name in OUTCOMES]
        kept += [array.clone() for array in (*groups, *metrics, *outcome, own.changed_view, env.get_state())]
    assert own.changed_view.any(), "no event changed a world"
    return kept, {kind: count for kind, count in env.fault_counts.items() if count}


@pytest.mark.parametrize("engine", ENGINES)
def test_several_threads_per_world_give_the_same_results_as_one_thread(
    engine: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def launch_three(kernel: wp.Kernel, nworld: int, args: list[Any], device: wp.Device) -> None:
        wp.launch(kernel, (nworld, 3), [*args, 3, 0], device=device)

    one, counts = outcomes_with_faults(engine)
    assert counts == {"action": 1, "nan": 1, "model": 1}
    monkeypatch.setattr(worlds, "launch_lanes", launch_three)
    three, same_counts = outcomes_with_faults(engine, judging=5, observing=2)
    assert counts == same_counts
    assert all(torch.equal(a, b) for a, b in zip(one, three, strict=True))


def test_results_do_not_depend_on_how_threads_divide_the_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    together, counts = outcomes_with_faults("mujoco")
    monkeypatch.setattr(capture, "SECONDS_A_THREAD", 1e-9)
    monkeypatch.setattr(mujoco_engine, "cpu_cores", lambda: 3)
    shared, run = [], Workers.run
    monkeypatch.setattr(Workers, "run", lambda self, calls: (shared.append(len(calls)), run(self, calls)))
    apart, same_counts = outcomes_with_faults("mujoco")
    assert len(shared) > 20 and set(shared) == {3}
    assert counts == same_counts
    assert all(torch.equal(a, b) for a, b in zip(together, apart, strict=True))


@pytest.mark.parametrize("engine", ENGINES)
def test_substeps_see_current_fields(engine: str) -> None:
    envs = [lw.make(task, nworld=3, engine=engine) for task in (CountsPositions, CountsPlaces)]
    for _ in range(4):
        sums = []
        for env in envs:
            env.step(torch.ones_like(env.action))
            sums.append(env.state_space.split(env.get_state())["travel"])
    assert torch.equal(*sums) and (sums[0] != 0.0).all()


def test_random_numbers_depend_on_the_world_index_over_all_processes() -> None:
    whole, part = lw.make("point_mass", nworld=4), lw.make("point_mass", nworld=2, first_world=2)
    for env in (whole, part):
        env.rand_reset(7)
    assert torch.equal(whole.get_state()[2:], part.get_state())
