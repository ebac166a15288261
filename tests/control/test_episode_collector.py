"""What is kept of a controlled world: its planner's samples, interrupted episodes, names of columns, settings."""

import dataclasses
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.control.control_report import control_report
from lyceum_warp.control.loop import ControlProgress, control, control_async
from lyceum_warp.control.trajectory import Trajectory

Run = Callable[..., Trajectory]
BOTH = pytest.mark.parametrize("run", [control, control_async])


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


class Sampler:
    """Tells how many of its samples failed, one plan after the other, and takes its time for each."""

    def __init__(self, *failed: float, seconds: float = 0.0) -> None:
        self.samples, self.failed, self.seconds, self.calls = 8, failed, seconds, 0
        self.actions = torch.zeros(4, 2)
        self.settings = {"samples": 8, "odd": object(), "smoothing": (1.0, 0.0)}

    def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> object:
        self.calls += 1
        time.sleep(self.seconds)
        return object()  # the actions are enough: of a GPU's, a second copy would be a second wait

    def reset(self, seed: int | None = None) -> None:
        self.calls = 0

    @property
    def summary(self) -> dict[str, float]:
        failed = self.failed[min(self.calls, len(self.failed)) - 1]
        return {"failed_samples": failed, "effective_samples": math.nan if failed == 8 else 2.0}


def test_failed_samples_are_told(env: lw.Env, tmp_path: Path) -> None:
    episode = control(env, Sampler(0, 8, 8, 2), steps=4, seed=1)
    assert episode.plan_failed.tolist() == [0, 8, 8, 2] and episode.plan_effective.tolist() == [2, 0, 0, 2]
    report = control_report(episode)
    assert (report.blind_plans, report.known_plans, report.failed_share) == (2, 4, 18 / 32)
    assert report.effective_samples_mean == 1.0
    rows = dict(report.rows())
    assert rows["plans without a good sample"] == "2 of 4" and rows["failed samples"] == "56.2 %"
    assert rows["effective samples, mean"] == "1"
    loaded = Trajectory.load(episode.save(tmp_path / "episode.npz"))
    assert torch.equal(loaded.plan_failed, episode.plan_failed) and loaded.plan_failed.dtype == torch.float64
    assert (control_async(env, Sampler(8), steps=3, period=0.01).plan_failed == 8).all()


def test_of_other_controllers_there_is_nothing_to_tell(env: lw.Env) -> None:
    episode = control(env, lambda state, obs: torch.zeros(2), steps=3)
    assert episode.plan_failed.isnan().all() and episode.plan_effective.isnan().all()
    report = control_report(episode)
    assert report.blind_plans is None and report.failed_share is None and report.effective_samples_mean is None
    assert not any("sample" in label for label, _ in report.rows())


@BOTH
def test_mppi_whose_samples_all_fail(run: Run, env: lw.Env) -> None:
    options = dict(horizon=4, samples=3, nthread=1)
    blind = lw.MPPI("point_mass", **options, value=lambda obs: torch.full((3,), math.nan))
    report = control_report(run(env, blind, steps=4, seed=0))
    assert report.blind_plans == report.known_plans > 0 and report.failed_share == 1
    assert report.effective_samples_mean == 0
    report = control_report(run(env, lw.MPPI("point_mass", **options), steps=4, seed=0))
    assert report.blind_plans == 0 and report.failed_share == 0
    assert report.effective_samples_mean is not None and 1 <= report.effective_samples_mean <= 3


@BOTH
@pytest.mark.parametrize("kind", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_episode_is_handed_out(run: Run, kind: type[BaseException], env: lw.Env) -> None:
    def stop(progress: ControlProgress) -> None:
        if progress.step == 5:
            raise kind

    parts: list[Trajectory] = []
    with pytest.raises(kind):
        run(env, Sampler(0), seed=3, on_step=stop, on_abort=parts.append)
    (part,) = parts
    assert part.steps == 5 and len(part.states) == 6 and part.done_reason == 0 and part.seed == 3
    assert len(part.times) == len(part.plan_of) == len(part.late) == 5 and part.wall_seconds > part.times[-1]
    whole = control(env, Sampler(0), seed=3)
    assert torch.equal(part.states, whole.states[:6])
    assert control_report(part).steps == 5


@BOTH
def test_before_the_first_step_there_is_nothing_to_hand_out(run: Run, env: lw.Env) -> None:
    def fails(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(env, fails, on_abort=lambda part: pytest.fail("there was no step"))


def test_an_interrupted_step_leaves_nothing(env: lw.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    step, calls, parts = env.step, [], []

    def stop() -> None:
        calls.append(0)
        if len(calls) == 3:
            raise KeyboardInterrupt
        step()

    monkeypatch.setattr(env, "step", stop)
    with pytest.raises(KeyboardInterrupt):
        control(env, Sampler(0), on_abort=parts.append)
    assert parts[0].steps == 2 and len(parts[0].actions) == 2 and len(parts[0].plan_times) == 3


def test_an_exception_does_not_wait_for_the_plan_under_way(env: lw.Env) -> None:
    released = threading.Event()

    class Slow(Sampler):
        def __call__(self, state: torch.Tensor, obs: torch.Tensor) -> object:
            if state[env.state_space.parts["step"]] > 0:
                released.wait(20)
            return None

    def stop(progress: ControlProgress) -> None:
        if progress.step == 4:
            raised.append(time.perf_counter())
            raise KeyboardInterrupt

    raised: list[float] = []
    with pytest.raises(KeyboardInterrupt):
        control_async(env, Slow(0), period=0.01, on_step=stop)
    took = time.perf_counter() - raised[0]
    released.set()
    assert took < 5


def test_a_program_ends_while_mppi_plans(tmp_path: Path) -> None:
    program = """
import threading, time, torch, lyceum_warp as lw
plan = lw.MPPI("point_mass", horizon=20, samples=4000, iterations=300, nthread=1)
env = lw.make("point_mass", autoreset=False)
def stop(progress):
    if progress.step == 3:
        raise KeyboardInterrupt
class Late:
    timestep = plan.timestep
    def __call__(self, state, obs):
        return torch.zeros(2) if state[env.state_space.parts["step"]] == 0 else plan(state)
try:
    lw.control_async(env, Late(), on_step=stop)
except KeyboardInterrupt:
    print("ended", sum(thread.name == "lyceum_warp planner" for thread in threading.enumerate()))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout == "ended 1\n", done.stderr


def test_the_file_tells_its_columns_and_its_planner(env: lw.Env, tmp_path: Path) -> None:
    plan = lw.MPPI("point_mass", horizon=4, samples=3, temperature=0.3, nthread=1)
    path = control(env, plan, steps=3, seed=7).save(tmp_path / "episode.npz")
    with np.load(path, allow_pickle=False) as file:  # with numpy alone
        info = json.loads(str(file["info"]))
        assert info["seed"] == 7 and info["action_names"] == ["x", "y"]
        start, stop = info["state_parts"]["step"]
        assert file["states"][:, start:stop].ravel().tolist() == [0, 1, 2, 3]
        assert max(stop for _, stop in info["obs_parts"].values()) == file["obs"].shape[1]
        assert max(stop for _, stop in info["state_parts"].values()) == file["states"].shape[1]
    controller = info["controller"]
    assert controller["name"] == "MPPI" and controller["engine"] == "mujoco" and controller["device"] == "cpu"
    assert controller.items() >= plan.settings.items() and controller["temperature"] == 0.3
    report = json.loads(control_report(Trajectory.load(path)).to_json())
    assert report["controller"] == controller
    assert Trajectory.load(path).controller == controller


def test_any_controller_can_be_described(env: lw.Env, tmp_path: Path) -> None:
    def zeros(state: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        return torch.zeros(2)

    episode = control(env, zeros, steps=1)
    assert episode.controller == {"name": "zeros"} and episode.seed is None
    assert Trajectory.load(episode.save(tmp_path / "a.npz")).seed is None
    episode = control(env, Sampler(0), steps=1)
    assert episode.controller["name"] == "Sampler" and episode.controller["smoothing"] == [1.0, 0.0]
    assert Trajectory.load(episode.save(tmp_path / "a.npz")).controller == episode.controller


def test_unlike_episodes_have_no_report(env: lw.Env) -> None:
    one = control(env, Sampler(0), steps=2)
    controller = {**one.controller, "samples": 9}
    with pytest.raises(ValueError, match=r"differ in their controller \(samples\)"):
        control_report([one, dataclasses.replace(one, controller=controller)])
    with pytest.raises(ValueError, match=r"differ in their params \(success_distance\)"):
        control_report([one, dataclasses.replace(one, params={**one.params, "success_distance": 1.0})])
    odd = dataclasses.replace(one, params={**one.params, "odd": math.nan})
    assert control_report([odd, dataclasses.replace(odd, params={**one.params, "odd": float("nan")})]).episodes == 2


@BOTH
def test_progress_counts_the_step_and_the_plans(run: Run, env: lw.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    step = env.step

    def slow() -> None:
        time.sleep(0.01)
        step()

    monkeypatch.setattr(env, "step", slow)
    seen: list[ControlProgress] = []
    episode = run(env, Sampler(0), steps=6, on_step=seen.append)
    assert seen[0].time >= 0.01  # not the moment of the action, at which a step would have taken no time
    assert all(now.step / now.time <= 100 for now in seen)
    assert [now.plans - 1 for now in seen] == episode.plan_of.tolist()


def test_ages_are_told_in_steps(env: lw.Env) -> None:
    episode = control(env, Sampler(0), steps=3)
    old = dataclasses.replace(episode, plan_steps=episode.plan_steps - 1, ages=episode.ages * 0 + 0.0202)
    rows = dict(control_report(old).rows())
    assert rows["age of the action, max"] == rows["age of the action, mean"] == "1 step (20.2 ms)"


@BOTH
def test_the_planners_own_environment_is_no_plant(run: Run) -> None:
    plan = lw.MPPI("point_mass", horizon=4, samples=1)
    with pytest.raises(ValueError, match="the very environment that it is to control"):
        run(plan.env, plan, steps=4)
