from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from full_task import Full

import lyceum_warp as lw
from lyceum_warp import worlds
from lyceum_warp.engines.c import mujoco_engine
from lyceum_warp.graphs import capture
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.kernels.step_types import OUTCOMES
from lyceum_warp.tasks.point_mass import PointMass

ENGINES = ["mujoco", "warp"]


class Held(PointMass):
    """A point_mass task whose point must stay at its target for three steps."""

    model = lw.package_model("lyceum_warp", "tasks/point_mass.xml")
    success_steps = 3


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


def held_and_plain(engine: str, nworld: int = 16, **options: Any) -> tuple[lw.Env, lw.Env]:
    """Make two tasks.

    Success takes three steps in the first task, and one step in the second. The goals of the worlds differ.
    """
    goals = {"success_distance": np.linspace(0.3, 2.5, nworld)}
    held, plain = (lw.make(task, engine=engine, nworld=nworld, **goals, **options) for task in (Held, PointMass))
    for env in (held, plain):
        state = env.get_state()
        env.state_space.split(state)["qvel"][:, :2] = torch.linspace(-9.0, 9.0, nworld)[:, None]
        env.set_state(state)
    return held, plain


@pytest.mark.parametrize("engine", ENGINES)
def test_success_steps_must_be_consecutive_within_an_episode(engine: str) -> None:
    held, plain = held_and_plain(engine, horizon=12)
    rows, rises, falls = torch.zeros(16), 0, 0
    generator = torch.Generator().manual_seed(0)
    for i in range(40):
        action = 2.0 * torch.rand(held.action.shape, generator=generator) - 1.0
        if i == 20:
            action[-1] = torch.nan
        before = held.success.clone()
        for env in (held, plain):
            env.step(action)
        rows = torch.where(plain.success, rows + 1, 0.0)
        assert torch.equal(held.success, rows >= 3), i
        rises, falls = rises + int((held.success & ~before).sum()), falls + int((~held.success & before).sum())
        for name in ("obs", "final_obs", "reward", "eval", "done_reason"):
            assert torch.equal(getattr(held, name), getattr(plain, name)), f"{name} at step {i}"
        rows[plain.done] = 0.0
        state = held.get_state()
        column = held.state_space.parts["success_steps"]
        assert torch.equal(state[:, column].squeeze(1), rows.double().clamp(max=3)), i
        assert torch.equal(state[:, : column.start], plain.get_state())
    assert rises > 20 and falls > 20
    assert "success_steps" not in plain.state_space.parts


def test_random_numbers_depend_on_the_world_index_over_all_processes() -> None:
    whole, part = lw.make("point_mass", nworld=4), lw.make("point_mass", nworld=2, first_world=2)
    for env in (whole, part):
        env.rand_reset(7)
    assert torch.equal(whole.get_state()[2:], part.get_state())
