"""What a viewer costs: frames a second, deadlines missed by a planner, and the speed of a training run.

Three measurements, each without a viewer and with one whose page a browser shows:

- many worlds under a policy, in real time: the frames that the window takes, and the simulated seconds per second;
- a planner that keeps its plant's rate: the plans that took longer than a period, and the steps that began late;
- a training run that is followed: samples a second.

    python bench/viewer.py
    python bench/viewer.py --parts training --device cuda --train-worlds 4096 --iterations 200
    python bench/viewer.py --no-browser    # the page is served, and stays closed

Nothing else should run on the machine meanwhile.
"""

import contextlib
import dataclasses
import json
import math
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.viewer.protocol import Command, Frame
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.window_process import Window

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --enable-unsafe-swiftshader --use-angle=swiftshader --no-proxy-server "
    "--remote-debugging-port=0"
).split()
_LOADING = 12.0  # seconds in which the page loads, before anything is measured


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure a viewer."""

    parts: tuple[Literal["worlds", "planner", "training"], ...] = ("worlds", "planner")
    """What is measured."""
    worlds_task: str = "half_cheetah"
    """Task of the many worlds."""
    nworld: int = 256
    """Number of its worlds."""
    planner_task: str = "reach"
    """Task of the planner, with its own settings of MPPI."""
    seconds: float = 30.0
    """Seconds of each measurement."""
    repeats: int = 1
    """How often each is made; with and without a viewer take turns."""
    nthread: int | None = None
    """Threads of the planner; all cores by default."""
    train_task: str = "hopper"
    """Task of the training run."""
    train_worlds: int = 64
    """Number of its worlds."""
    iterations: int = 60
    """Number of its iterations; the first ones, in which the viewer starts, do not count."""
    device: str = "cpu"
    """Where it trains."""
    browser: bool = True
    """Whether a browser shows the page."""
    out: Path | None = None
    """JSON file for the numbers."""


class Timed:
    """A window, or none, that closes after a time; counts what is shown once the page has loaded."""

    def __init__(self, window: Window | None, loading: float, seconds: float) -> None:
        self.window, self.begin = window, time.perf_counter() + loading
        self.end, self.frames = self.begin + seconds, 0
        self.status: list[Any] = []

    def show(self, frame: Frame) -> None:
        if time.perf_counter() >= self.begin:
            self.frames += 1
            self.status.append(frame.status)
        if self.window is not None:
            self.window.show(frame)

    @property
    def wants_frame(self) -> bool:
        return self.window is None or self.window.wants_frame

    def commands(self) -> Iterable[Command]:
        return [] if self.window is None else self.window.commands()

    def is_open(self) -> bool:
        return time.perf_counter() < self.end and (self.window is None or self.window.is_open())

    def close(self) -> None:
        if self.window is not None:
            self.window.close()


@contextlib.contextmanager
def page(address: str, shown: bool) -> Iterator[None]:
    """A browser that shows the page."""
    if not shown:
        yield
        return
    program = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if program is None:
        raise SystemExit(f"no browser is found (of {', '.join(_BROWSERS)}): install one, or give --no-browser")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [program, *_FLAGS, f"--user-data-dir={profile}", "--window-size=1280,800", address]
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, process_group=0)
        try:
            yield
        finally:
            os.killpg(process.pid, 9)
            process.wait()


def shown(session: Session, options: Options) -> Timed:
    """Run a session whose page is open."""
    window = Window(session.stage.scene, "web")
    with page(window.address, options.browser):
        timed = Timed(window, _LOADING if options.browser else 1.0, options.seconds)
        session.run(timed)
    return timed


def worlds(options: Options, viewer: bool) -> dict[str, float]:
    """Many worlds under a policy."""
    env = lw.make(options.worlds_task, nworld=options.nworld)
    policy = lw.GaussianPolicy(env.obs_space.size, env.action_space.size)
    session = Session(env, controllers={"policy": policy}, seed=0)
    if viewer:
        timed = shown(session, options)
    else:
        timed = Timed(None, 1.0, options.seconds)
        session.fps = 1.0
        session.run(timed)
    speeds = [status.measured_speed for status in timed.status if not math.isnan(status.measured_speed)]
    return {"frames a second": timed.frames / options.seconds, "speed": sum(speeds) / max(len(speeds), 1)}


def planner(options: Options, viewer: bool) -> dict[str, float]:
    """A planner against the clock."""
    env = lw.make(options.planner_task, autoreset=False, horizon=0, nthread=1)
    plan = lw.MPPI(options.planner_task, nthread=options.nthread)
    frames = math.nan
    done: list[lw.Trajectory] = []
    if viewer:
        # the first seconds, in which the page loads, do not count
        session = Session(env, controllers={"mppi": plan}, seed=0, on_trajectory=done.append)
        timed = shown(session, options)
        frames = timed.frames / options.seconds
        first = int((_LOADING if options.browser else 1.0) / env.timestep)
        (whole,) = done
        steps = torch.arange(whole.steps) >= first
        plans = whole.plan_steps >= first
        times, late = whole.plan_times[plans], whole.late[steps]
    else:
        whole = lw.control_async(env, plan, seconds=options.seconds, seed=0)
        times, late = whole.plan_times[1:], whole.late
    return {
        "frames a second": frames,
        "plans": len(times),
        "plan p50 ms": 1000 * float(times.quantile(0.5)),
        "plan p99 ms": 1000 * float(times.quantile(0.99)),
        "missed deadlines %": 100 * float((times > env.timestep).double().mean()),
        "late steps %": 100 * float(late.double().mean()),
    }


def training(options: Options, viewer: bool) -> dict[str, float]:
    """A training run; a viewer follows it from the end of the first iteration."""
    env = lw.make(options.train_task, nworld=options.train_worlds, device=options.device)
    npg = lw.NPG(env, config=lw.NPGConfig(mean_every=0))
    times: list[float] = []
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place, contextlib.ExitStack() as ends:
        folder = Path(place, "run")

        def callback(iteration: lw.Iteration) -> None:
            times.append(time.perf_counter())
            if viewer and len(times) == 1:
                address = started(folder, ends)
                ends.enter_context(page(address, options.browser))
                time.sleep(_LOADING)

        lw.train(npg, folder, iterations=options.iterations, callback=callback)
    seconds = times[-1] - times[2]  # the second iteration holds the start of the viewer
    return {"samples a second": npg.samples / len(times) * (len(times) - 3) / seconds}


def started(folder: Path, ends: contextlib.ExitStack) -> str:
    """Start a viewer of a run in a process of its own; returns the address of its page."""
    words = [sys.executable, "-m", "lyceum_warp.cli", "view", str(folder), "--follow", "--gfx", "web"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.nice(10))
    ends.callback(process.wait)
    ends.callback(process.terminate)
    for line in process.stdout or ():
        if found := re.search(r"http://\S+", line):
            return found[0]
    raise SystemExit("the viewer did not start")


def main(options: Options) -> None:
    torch.set_num_threads(1)
    console, found = Console(width=110), {}
    names = {
        "worlds": f"{options.nworld} worlds of {options.worlds_task}",
        "planner": f"{options.planner_task} under MPPI",
        "training": f"training of {options.train_task}, {options.train_worlds} worlds on {options.device}",
    }
    for part in options.parts:
        name, measure = names[part], {"worlds": worlds, "planner": planner, "training": training}[part]
        table = Table("", "without a viewer", "with a viewer", title=name)
        runs: dict[bool, list[dict[str, float]]] = {False: [], True: []}
        for _ in range(options.repeats):
            for viewer in (False, True):
                runs[viewer].append(measure(options, viewer))
        for row in runs[True][0]:
            cells = [", ".join(f"{run[row]:.4g}" for run in runs[viewer]) for viewer in (False, True)]
            table.add_row(row, *cells)
        console.print(table)
        found[name] = {"without": runs[False], "with": runs[True]}
    if options.out is not None:
        content = {"versions": measurements.context(options.device), **found}
        options.out.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
