import time
from collections.abc import Callable

import pytest
import torch
from conftest import SharedEnv
from toy_controllers import SamplingPlanner, towards

import lyceum_warp as lw
from lyceum_warp.controllers.control_report import control_report
from lyceum_warp.controllers.episode_collector import ControlProgress
from lyceum_warp.controllers.loop import control
from lyceum_warp.controllers.real_time import control_async
from lyceum_warp.controllers.trajectory import Trajectory

Run = Callable[..., Trajectory]
BOTH = pytest.mark.parametrize("run", [control, control_async])


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


@BOTH
def test_control_of_unsuitable_environments_raises_an_error(run: Run, shared_env: SharedEnv) -> None:
    for options, message in (
        ({}, "one world without automatic resets, not nworld=1, autoreset=True"),
        ({"nworld": 2, "autoreset": False}, "one world without automatic resets, not nworld=2, autoreset=False"),
        ({"autoreset": False, "horizon": 0}, "pass steps, or give make"),
    ):
        with pytest.raises(ValueError, match=message):
            run(shared_env("point_mass", **options), towards)


@BOTH
def test_control_with_invalid_arguments_raises_an_error(run: Run, env: lw.Env) -> None:
    control(env, towards)
    for arguments, message in (
        ({"steps": 0}, "steps must be a whole number from 1 to .*, not 0"),
        ({"seed": 1, "reset": False}, "seed=1 has no effect with reset=False"),
        ({"reset": False}, "current episode is already over: reset the environment"),
    ):
        with pytest.raises(ValueError, match=message):
            run(env, towards, **arguments)


@BOTH
def test_progress_includes_the_step_and_counts_the_plans(
    run: Run, env: lw.Env, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = env.step

    def slow() -> None:
        time.sleep(0.01)
        step()

    monkeypatch.setattr(env, "step", slow)
    seen: list[ControlProgress] = []
    episode = run(env, SamplingPlanner(0), steps=6, on_step=seen.append)
    assert seen[0].time >= 0.01
    assert all(now.step / now.time <= 100 for now in seen)
    assert [now.plans - 1 for now in seen] == episode.plan_of.tolist()
    assert [now.step for now in seen] == list(range(1, 7))
    assert seen[-1].eval == episode.evals[-1] and seen[4].age == episode.ages[4]


@BOTH
def test_abort_callback_receives_the_complete_steps(run: Run, env: lw.Env) -> None:
    def stop(progress: ControlProgress) -> None:
        if progress.step == 5:
            raise KeyboardInterrupt

    parts: list[Trajectory] = []
    with pytest.raises(KeyboardInterrupt):
        run(env, SamplingPlanner(0), seed=3, on_step=stop, on_abort=parts.append)
    (part,) = parts
    assert part.steps == 5 and len(part.states) == 6 and part.done_reason == 0 and part.seed == 3
    assert len(part.times) == len(part.plan_of) == len(part.late) == 5 and part.wall_seconds > part.times[-1]
    whole = control(env, SamplingPlanner(0), seed=3)
    assert torch.equal(part.states, whole.states[:6])
    assert control_report(part).steps == 5


@BOTH
def test_abort_callback_is_not_called_before_the_first_step(run: Run, env: lw.Env) -> None:
    def fails(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(env, fails, on_abort=lambda part: pytest.fail("on_abort was called before the first step"))


def test_trajectory_omits_an_interrupted_step(env: lw.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    step, calls, parts = env.step, [], []

    def stop() -> None:
        calls.append(0)
        if len(calls) == 3:
            raise KeyboardInterrupt
        step()

    monkeypatch.setattr(env, "step", stop)
    with pytest.raises(KeyboardInterrupt):
        control(env, SamplingPlanner(0), on_abort=parts.append)
    assert parts[0].steps == 2 and len(parts[0].actions) == 2 and len(parts[0].plan_times) == 3
