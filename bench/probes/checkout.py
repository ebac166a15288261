"""Run a checkout of the package and write its results as arrays; bench/compare.py compares two checkouts.

The first answer lists the checkout's tasks and learners. Each further line on stdin is a unit (the keyword arguments of
a function in PARTS as JSON), and each line on stdout is an answer. The arrays of a unit are written to the file given
as the program's argument. The program uses only public names of the package, because private names may differ between
checkouts.
"""

import contextlib
import csv
import dataclasses
import faulthandler
import gc
import json
import os
import subprocess
import sys
import tempfile
import traceback
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

torch.set_num_threads(1)  # the order of a sum depends on the number of threads
torch.manual_seed(0)

LEARNERS = ("NPG", "PPO", "SAC")
"""A learner is compared if both checkouts have it."""


class MissingModel(Exception):  # noqa: N818
    """A task's model needs an optional dependency that is not installed."""


class Numbers:
    """The arrays of a unit by name, in the order of their computation."""

    def __init__(self) -> None:
        self.axes: dict[str, list[str]] = {}
        self._arrays: dict[str, Any] = {}

    def add(self, name: str, value: Any, *axes: str, along: str | None = None) -> None:
        """Add an array, a number, a string, or every leaf of a mapping, a dataclass or a list; omit None.

        Args:
            name: Name of the value. The name of a leaf is appended to it.
            value: The value.
            axes: Names of the leading axes.
            along: Name of an additional leading axis, along which the values of several calls are stacked.
        """
        if dataclasses.is_dataclass(value):
            value = vars(value)
        if isinstance(value, Mapping):
            for key, part in value.items():
                self.add(f"{name}/{key}", part, *axes, along=along)
        elif isinstance(value, (list, tuple)):
            for i, part in enumerate(value):
                self.add(f"{name}/{i}", part, *axes, along=along)
        elif value is not None:
            # the array is copied, because buffers change in place
            array = value.detach().cpu().numpy().copy() if isinstance(value, torch.Tensor) else np.array(value)
            self.axes[name] = [*([along] if along else []), *axes]
            if along:
                self._arrays.setdefault(name, []).append(array)
            else:
                self._arrays[name] = array

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: np.stack(value) if isinstance(value, list) else value for name, value in self._arrays.items()}


# helpers


def make(task: str, engine: str, device: str, **options: Any) -> Any:
    """Make an environment. On a GPU, it is deterministic."""
    import lyceum_warp as lw

    try:
        return lw.make(task, **placed(engine, device), **options)
    except (FileNotFoundError, ImportError) as error:
        raise MissingModel(str(error)) from error


def placed(engine: str, device: str) -> dict[str, Any]:
    on_gpu = engine == "warp" and device != "cpu"
    return {"engine": engine, "device": device if on_gpu else "cpu", "deterministic": on_gpu}


def draw_actions(env: Any, task: str, steps: int) -> torch.Tensor:
    """Draw actions, (steps, nworld, nact). About a quarter of them exceed their bounds."""
    space = env.action_space
    unit = np.random.default_rng(zlib.crc32(task.encode())).uniform(-1.3, 1.3, (steps, env.nworld, space.size))
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    bounded = np.isfinite(low) & np.isfinite(high)
    middle, half = np.where(bounded, (low + high) / 2, 0.0), np.where(bounded, (high - low) / 2, 1.0)
    return torch.as_tensor((middle + half * unit).astype(np.float32), device=env.action.device)


def split(env: Any, state: torch.Tensor) -> dict[str, torch.Tensor]:
    return {name: state[..., part] for name, part in env.state_space.parts.items()}


def observed(env: Any) -> dict[str, Any]:
    names = ("reward", "eval", "terminated", "truncated", "done", "done_reason", "success", "episode_step", "time")
    return {
        "state": split(env, env.get_state()),
        "obs": env.obs_groups,
        "final_obs": env.final_obs_groups,
        **{name: getattr(env, name) for name in names},
        "metrics": env.metrics,
        "episode_metrics": env.episode_metrics,
        "action": env.action,
    }


def constants(model: Any) -> Iterator[tuple[str, Any]]:
    for name in dir(model):
        if name.startswith("_") or name == "paths":
            continue
        value = getattr(model, name)
        if name in ("opt", "stat"):
            yield from ((f"{name}.{part}", number) for part, number in constants(value))
        elif isinstance(value, bytes):
            yield name, np.frombuffer(value, np.uint8)
        elif isinstance(value, (int, float, np.ndarray)):
            yield name, value


def without_clocks(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return an iteration's numbers without measured times; None becomes nan."""
    return {
        name: without_clocks(value) if isinstance(value, Mapping) else np.nan if value is None else value
        for name, value in row.items()
        if not (name.startswith("time_") or name.endswith("per_second"))
    }


# the parts


def environment(numbers: Numbers, *, task: str, engine: str, device: str, steps: int) -> None:
    """Add arrays of an environment: model, resets, short episodes, getters, a fault, and a rollout of given actions."""
    import lyceum_warp as lw

    env = make(task, engine, device, nworld=4, horizon=max(2, steps // 3))
    for name, value in constants(env.model):
        numbers.add(f"model/{name}", value)
    for name in ("state_space", "action_space"):
        space = getattr(env, name)
        bounds = {bound: getattr(space, bound) for bound in ("low", "high")}
        numbers.add(name, {"parts": json.dumps({n: [p.start, p.stop] for n, p in space.parts.items()}), **bounds})
    numbers.add("obs_space", {
        group: json.dumps({n: [p.start, p.stop] for n, p in space.parts.items()})
        for group, space in env.obs_spaces.items()
    })  # fmt: skip
    numbers.add("timestep", env.timestep)

    env.reset()
    numbers.add("reset", observed(env), "world")
    env.rand_reset(seed=1)
    numbers.add("rand_reset", observed(env), "world")
    states, actions = [env.get_state()], draw_actions(env, task, steps)
    for action in actions:
        env.step(action)
        states.append(env.get_state())
        numbers.add("steps", observed(env), "world", along="step")

    for t in sorted({0, steps // 2, steps - 1}):
        judged = {"reward": env.get_reward(states[t], actions[t], states[t + 1])}
        judged["obs"] = {group: env.get_obs(states[t], group=group) for group in env.obs_groups}
        judged |= {"eval": env.get_eval(states[t]), "terminated": env.get_terminated(states[t])}
        numbers.add("of_states", judged, "world", along="state")
    numbers.add("after_getters", observed(env), "world")
    env.set_state(states[0])
    numbers.add("restored", observed(env), "world")
    env.step(actions[0])
    numbers.add("restored_step", observed(env), "world")
    mask = torch.tensor([False, True, False, True], device=env.action.device)
    env.rand_reset(mask=mask)
    numbers.add("masked_rand_reset", observed(env), "world")
    env.reset(mask=~mask)
    numbers.add("masked_reset", observed(env), "world")
    env.step(actions[0])
    numbers.add("masked_step", observed(env), "world")
    env.step(torch.where(mask[:, None], torch.nan, actions[0]))
    numbers.add("fault", observed(env), "world")
    numbers.add("fault_counts", env.fault_counts)

    env = make(task, engine, device, nworld=4, autoreset=False)
    env.rand_reset(seed=2)
    state, horizon = env.get_state()[0], min(5, steps)
    rollout = lw.OpenLoop(env, horizon)
    rollout.state.copy_(state)
    rollout.actions.copy_(actions[:horizon])
    rollout.run()
    for name in ("reward", "terminated"):
        numbers.add(f"rollout/{name}", getattr(rollout, name), "step", "world")
    for name in ("final_obs_groups", "fault"):
        numbers.add(f"rollout/{name}", getattr(rollout, name), "world")


VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "MPPI": ("MPPI", {}),
    "CEM": ("CEM", {}),
    "PredictiveSampling": ("PredictiveSampling", {}),
    "knots": ("MPPI", {"knots": 2}),
    "plants": ("MPPI", {"plants": 3}),
    "control": ("MPPI", {}),
}

PLAN = (
    "actions", "nominal", "knot_actions", "standard_noise", "sampled", "returns", "weights", "adapted_noise",
)  # fmt: skip

TRAJECTORY = (
    "states", "obs", "actions", "rewards", "evals", "success", "plan_of", "plan_steps", "plan_failed", "plan_effective",
    "done_reason",
)  # fmt: skip


def plans(numbers: Numbers, *, task: str, engine: str, device: str, variants: Sequence[str]) -> None:
    import lyceum_warp as lw

    for variant in variants:
        kind, settings = VARIANTS[variant]
        plants = settings.get("plants", 1)
        env = make(task, engine, device, nworld=plants, autoreset=False)
        planner = getattr(lw, kind)(task, samples=6, horizon=4, seed=3, **settings, **placed(engine, device))
        if variant == "control":
            trajectory = lw.control(env, planner, steps=4, seed=4)
            numbers.add(variant, {name: getattr(trajectory, name, None) for name in TRAJECTORY})
            continue
        env.rand_reset(seed=4)
        for _ in range(4):
            state = env.get_state()
            action = planner(state if plants > 1 else state[0])
            plan = {"action": action, **{name: getattr(planner, name, None) for name in PLAN}}
            numbers.add(variant, plan, along="plan")
            env.step(action.reshape(env.action.shape).to(env.action.device))
            numbers.add(f"{variant}/plant", {"state": split(env, env.get_state()), "reward": env.reward}, "world",
                        along="plan")  # fmt: skip


def learning(numbers: Numbers, *, task: str, engine: str, device: str, learner: str, iterations: int) -> None:
    import lyceum_warp as lw

    env = make(task, engine, device, nworld=4, seed=5)
    configs: dict[str, Any] = {
        "NPG": lambda: lw.NPGConfig(samples=1024, mean_every=5, mean_episodes=2),
        "PPO": lambda: lw.PPOConfig(),
        "SAC": lambda: lw.SACConfig(warmup=200, num_steps=50, batch=32, mean_every=5, mean_episodes=2),
    }
    learns = getattr(lw, learner)(env, seed=6, config=configs[learner]())
    for _ in range(iterations):
        numbers.add("iterations", without_clocks(vars(next(learns))), along="iteration")
    for name in ("policy", "value"):
        if (network := getattr(learns, name, None)) is not None:
            numbers.add(name, dict(network.state_dict()))
    numbers.add("env", {"state": split(env, env.get_state())}, "world")


def commands(numbers: Numbers, *, task: str, engine: str, device: str, iterations: int) -> None:
    where = placed(engine, device)
    flags = ["--engine", engine, "--device", where["device"], *(["--deterministic"] if where["deterministic"] else [])]
    flags += ["--samples", "1024", "--nworld", "4", "--seed", "7", "--mean-every", "2", "--mean-episodes", "2"]
    quiet = ["--no-video", "--no-plot"]
    make(task, engine, device)  # raises MissingModel if the model is not installed
    with tempfile.TemporaryDirectory(dir=".") as folder, contextlib.chdir(folder):
        command("train", task, "--iterations", str(iterations), "--out", "whole", *flags, *quiet)
        command("train", task, "--iterations", str(iterations // 2), "--out", "resumed", *flags, *quiet)
        command("train", "--resume", "resumed", "--iterations", str(iterations), *quiet)
        for run in ("whole", "resumed"):
            with Path(run, "metrics.csv").open(newline="") as file:
                for row in csv.DictReader(file):
                    cells = {name: float(cell or "nan") for name, cell in row.items()}
                    numbers.add(f"{run}/metrics.csv", without_clocks(cells), along="row")
            for name in ("policy.pt", "best.pt"):
                numbers.add(f"{run}/{name}", torch.load(Path(run, name), map_location="cpu", weights_only=True))


def command(*arguments: str) -> None:
    program = [sys.executable, "-P", "-m", "lyceum_warp.cli", *arguments]
    done = subprocess.run(program, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if done.returncode:
        last = " ".join(done.stderr.split("\n")[-4:]).strip()
        raise RuntimeError(f"lyceum-warp {' '.join(arguments)} ended with {done.returncode}: {last}")


PARTS = {"env": environment, "plans": plans, "learners": learning, "commands": commands}


# the functions below exchange messages with compare.py


def contents() -> dict[str, Any]:
    import lyceum_warp as lw

    return {
        "file": str(Path(lw.__file__).resolve()),
        "tasks": lw.task_names(),
        "learners": [name for name in LEARNERS if hasattr(lw, name)],
    }


def failure(error: Exception) -> dict[str, Any]:
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return {"text": text, "trace": traceback.format_exc(), "missing": isinstance(error, MissingModel)}


def compute(unit: dict[str, Any], file: Path) -> dict[str, Any]:
    """Run a unit of work, and write its arrays to ``file``. If it fails, write the arrays that are complete."""
    numbers, answer = Numbers(), {}
    try:
        PARTS[unit.pop("part")](numbers, **unit)
    except Exception as error:
        answer["failure"] = failure(error)
    np.savez(file, **numbers.arrays())
    gc.collect()  # free environments now, because they contain reference cycles
    return {**answer, "axes": numbers.axes}


def main() -> None:
    faulthandler.enable()
    # the package's prints go to stderr
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def answer(content: Mapping[str, Any]) -> None:
        print(json.dumps(content), file=answers, flush=True)

    try:
        answer(contents())
    except Exception as error:
        answer({"failure": failure(error)})
        return
    for line in sys.stdin:
        answer(compute(json.loads(line), Path(sys.argv[1])))


if __name__ == "__main__":
    main()
