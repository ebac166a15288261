"""NPG's learning curves on our environments, and of the same NPG fed by Gymnasium's vector environments (figure 2).

    lyceum-warp bench npg --threads 2 --jobs 16

Both sides run the same class with the same settings, the same number of worlds and the same seeds; only the buffer of
samples is filled by other environments. Gymnasium's have the faster one of its two vector modes on these cores,
measured before the clock starts. Beside them learn PPO of stable-baselines3 and TRPO of sb3-contrib with the settings
that RL Baselines3 Zoo tuned for these tasks, for twelve minutes each, and, with --device cuda, our NPG and PPO on the
same worlds of a GPU.

The policies of all contestants are judged by the same judge: the mean action, in single environments of Gymnasium,
from the same initial states. The clock stands still meanwhile, and starts once kernels are compiled and environments
exist. Every case is a process of its own on cores of its own; those of stable-baselines3 use one core, as a second
makes them slower. Runs on a GPU have it one after the other, and their policies are judged once they have left it.
"""

import contextlib
import copy
import dataclasses
import fcntl
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import comparison
import experiment
import gymnasium
import numpy as np
import torch
from experiment import Row, Table, choose, installed, median_and_range
from gymnasium_rollout import TASKS, GymnasiumRollout, rates, vector
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, NullFormatter

import lyceum_warp as lw
from lyceum_warp.viz.style import finish_axes

CONFIGS = {
    "swimmer": lw.NPGConfig(gamma=0.999, mean_every=0),
    "hopper": lw.NPGConfig(mean_every=0),
    "walker2d": lw.NPGConfig(mean_every=0),
}
"""Settings of NPG: the default ones, except for Swimmer's discount, which an earlier table chose."""

SHORT: dict[str, Any] = {"samples": 500, "value_epochs": 1}
"""Other settings of NPG in the short mode."""

CONTESTANTS = {
    "npg": "NPG, our environments",
    "npg_gymnasium": "NPG, Gymnasium's environments",
    "ppo_sb3": "PPO, stable-baselines3",
    "trpo_sb3": "TRPO, sb3-contrib",
    "npg_gpu": "NPG, our environments on a GPU",
    "ppo_rsl_rl": "PPO, our environments on a GPU",  # the stored runs are of rsl_rl's PPO, which ours equals
}
ON_CPU, ON_GPU, YARDSTICKS = tuple(CONTESTANTS)[:4], tuple(CONTESTANTS)[4:], ("ppo_sb3", "trpo_sb3")

COLORS = dict(zip(CONTESTANTS, ("#c8502d", "#3d6fa5", "#5a8f4e", "#8a6bb1", "#d99a2b", "#58a6a6"), strict=True))

GPU_WORLDS = {"npg_gpu": 2048, "ppo_rsl_rl": 4096}

SECONDS = {"npg": 90.0, "npg_gymnasium": 200.0, "ppo_sb3": 1700.0, "trpo_sb3": 350.0}
"""Rough time of a case of a million samples on its cores, the judge included."""

EVERY_100K = tuple(range(100_000, 1_000_001, 100_000))
"""Samples at which the curves are compared."""

ZOO = "https://github.com/DLR-RM/rl-baselines3-zoo"
"""Where the settings below come from (hyperparams/ppo.yml and hyperparams/trpo.yml)."""

_TUNED_NETWORK = {"log_std_init": -2.0, "ortho_init": False, "activation_fn": torch.nn.ReLU,
                  "net_arch": {"pi": [256, 256], "vf": [256, 256]}}  # fmt: skip

PPO: dict[str, dict[str, Any]] = {
    "swimmer": {"gamma": 0.9999},
    "hopper": {
        "batch_size": 32, "n_steps": 512, "gamma": 0.999, "learning_rate": 9.80828e-05, "ent_coef": 0.00229519,
        "clip_range": 0.2, "n_epochs": 5, "gae_lambda": 0.99, "max_grad_norm": 0.7, "vf_coef": 0.835671,
        "policy_kwargs": _TUNED_NETWORK,
    },
    "walker2d": {
        "batch_size": 32, "n_steps": 512, "gamma": 0.99, "learning_rate": 5.05041e-05, "ent_coef": 0.000585045,
        "clip_range": 0.1, "n_epochs": 20, "gae_lambda": 0.95, "max_grad_norm": 1.0, "vf_coef": 0.871923,
    },
}  # fmt: skip
"""Settings of stable-baselines3's PPO, with one environment and normalised observations and rewards."""

_TRPO = {"batch_size": 128, "n_steps": 1024, "gamma": 0.99, "gae_lambda": 0.95, "sub_sampling_factor": 1,
         "cg_max_steps": 25, "cg_damping": 0.1, "n_critic_updates": 20, "learning_rate": 1e-3}  # fmt: skip

TRPO = {"swimmer": _TRPO | {"gamma": 0.9999}, "hopper": _TRPO, "walker2d": _TRPO}
"""Settings of sb3-contrib's TRPO, with two environments and normalised observations and rewards."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Learning curves of NPG and of its peers."""

    threads: int | None = 2
    """Cores of each case, of which stable-baselines3's learners and those on a GPU use one."""
    samples: int = 1_000_000
    """Samples of a run on the CPU."""
    nworld: int = 64
    """Worlds of NPG on the CPU, ours and Gymnasium's."""
    yardstick_seconds: float = 720.0
    """Seconds of learning after which PPO and TRPO on the CPU end, if they have not had all samples before."""
    gpu_seconds: float = 30.0
    """Seconds of learning on a GPU."""
    judgements: int = 20
    """How often a run's policy is judged after the start."""
    episodes: int = 16
    """Episodes of a judgement."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One run."""

    task: str
    contestant: str
    seed: int
    threads: int
    nworld: int | None
    """Worlds, where they do not follow from the contestant's settings."""
    samples: int | None
    """Samples after which it ends."""
    limit: float | None
    """Seconds of learning after which it ends, if it has not ended before."""
    judgements: int
    episodes: int
    short: bool


def cases(options: Options) -> list[Case]:
    """The runs; those that are compared have the same seeds and follow one another, those on a GPU come last."""
    short, cuda = options.short, options.device.startswith("cuda")
    contestants = choose(options.contestants, CONTESTANTS, ON_CPU + (ON_GPU if cuda else ()), what="contestant")
    for name in contestants:
        if name in ON_GPU and not cuda:
            raise ValueError(f"{name} needs a GPU: give --device cuda")
    limits = dict.fromkeys(YARDSTICKS, options.yardstick_seconds)
    limits |= dict.fromkeys(ON_GPU, 3.0 if short else options.gpu_seconds)
    if options.judgements < 2:
        raise ValueError(f"judgements must be at least 2, not {options.judgements}")
    return [
        Case(
            task, name, seed, 1 if name in (*YARDSTICKS, *ON_GPU) else options.threads or 1,
            GPU_WORLDS[name] if name in ON_GPU else None if name in YARDSTICKS else 8 if short else options.nworld,
            None if name in ON_GPU else 1000 if short else options.samples,
            limits.get(name), 2 if short else options.judgements, 2 if short else options.episodes, short,
        )
        for group in (ON_CPU, ON_GPU)
        for seed in options.seeds or (range(2) if short else range(5))
        for task in choose(options.tasks, TASKS, ("swimmer",) if short else (), what="task")
        for name in contestants if name in group
    ]  # fmt: skip


def estimate(case: Case) -> float:
    judge, limit = 0.1 * case.judgements * case.episodes + 10.0, case.limit or math.inf
    if case.samples is None:
        return limit + judge + 10.0
    return min(SECONDS[case.contestant] * case.samples / 1e6 + 10.0, limit + judge)


# the judge, and the points of a curve

Act = Callable[[np.ndarray], np.ndarray]
"""From observations (n, nobs) to actions (n, nact)."""


class Judge:
    """Evaluates policies in single environments of Gymnasium, from the same initial states each time."""

    def __init__(self, task: str, episodes: int) -> None:
        self.envs = [gymnasium.make(TASKS[task], disable_env_checker=True) for _ in range(episodes)]

    def __call__(self, act: Act) -> float:
        """Mean return over the episodes."""
        current = [env.reset(seed=2**31 - 1 - i)[0] for i, env in enumerate(self.envs)]
        returns, running = np.zeros(len(self.envs)), list(range(len(self.envs)))
        while running:
            actions, still = act(np.stack([current[i] for i in running])), []
            for i, action in zip(running, actions, strict=True):
                current[i], reward, terminated, truncated, _ = self.envs[i].step(action)
                returns[i] += reward
                if not (terminated or truncated):
                    still.append(i)
            running = still
        return float(returns.mean())


class Curve:
    """The points of a run's curve, and its clock, which stands still while a policy is judged."""

    def __init__(self, case: Case) -> None:
        self.case, self.judge = case, Judge(case.task, case.episodes)
        self._points: list[tuple[int, float, float | Act, float | None]] = []
        self.returns: list[float] = []
        """Returns of the episodes that ended since the last point, of the policy with its noise."""
        self._began, self._waited = 0.0, 0.0
        self._next = 0

    def start(self, act: Act) -> None:
        """Judge the first policy and start the clock."""
        self._began, self._waited = time.perf_counter(), 0.0
        self.add(0, act)

    def seconds(self) -> float:
        return time.perf_counter() - self._began - self._waited

    def ended(self, samples: int) -> bool:
        """Whether the run has reached its end."""
        case = self.case
        return samples >= (case.samples or math.inf) or self.seconds() >= (case.limit or math.inf)

    def due(self, samples: int) -> bool:
        """Whether the policy is to be judged now: at even distances, and at the end."""
        return self.ended(samples) or self._distances(samples) >= self._next

    def _distances(self, samples: int) -> float:
        """How much of the run is over, in distances between judgements."""
        case = self.case
        over = (samples, case.samples), (self.seconds(), case.limit)
        return max(case.judgements * spent / (whole or math.inf) for spent, whole in over)

    def add(self, samples: int, act: Act) -> None:
        """Judge a policy, or keep it until the run has left the GPU; then it must not change with further learning."""
        seconds = self.seconds()
        self._next = int(self._distances(samples)) + 1
        before = time.perf_counter()
        noisy = statistics.fmean(self.returns) if self.returns else None
        judged = act if self.case.contestant in ON_GPU else self.judge(act)
        self._points.append((samples, round(seconds, 4), judged, noisy))
        self.returns = []
        self._waited += time.perf_counter() - before

    def finish(self, samples: int, act: Act) -> None:
        """Judge the last policy, if that has not been done: the time may have passed after it."""
        if self._points[-1][0] < samples:
            self.add(samples, act)

    def points(self) -> list[tuple[int, float, float, float | None]]:
        """Samples; seconds of learning; return of the mean policy; mean return of the training episodes that ended."""
        return [
            (samples, seconds, round(self.judge(found) if callable(found) else found, 3), noisy)
            for samples, seconds, found, noisy in self._points
        ]


# NPG, on our environments and on Gymnasium's


def mean_action(policy: torch.nn.Module) -> Act:
    """A policy as it is now, and as the judge calls it."""
    now = copy.deepcopy(policy).cpu()

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        return now(torch.as_tensor(obs, dtype=torch.float32)).numpy()

    return act


def config_of(case: Case) -> lw.NPGConfig:
    changes = dict(SHORT) if case.short else {}
    if case.contestant not in ON_GPU:
        changes["min_restarts"] = 0.0  # on both sides: Gymnasium's buffer cannot restart some of its worlds
    return dataclasses.replace(CONFIGS[case.task], **changes)


def environment(case: Case, options: Options, nworld: int) -> lw.Env:
    if case.contestant in ON_GPU:
        return lw.make(case.task, nworld=nworld, seed=case.seed, device=options.device, engine="warp")
    return lw.make(case.task, nworld=nworld, seed=case.seed, engine="mujoco", nthread=case.threads)


def npg(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    """Our NPG; Gymnasium's environments are made first, because their processes are forks."""
    assert case.nworld is not None
    more: dict[str, Any] = {}
    with contextlib.ExitStack() as stack:
        envs = None
        if case.contestant == "npg_gymnasium":
            more["rates"] = rates(case.task, case.nworld, 20 if case.short else 100)
            more["mode"] = max(more["rates"], key=more["rates"].get)
            envs = stack.enter_context(contextlib.closing(vector(case.task, case.nworld, more["mode"])))
        config = config_of(case)
        # compiles kernels
        next(lw.NPG(environment(case, options, 2), config=dataclasses.replace(config, samples=64), seed=case.seed))
        env = environment(case, options, case.nworld)
        learner = lw.NPG(env, config=config, seed=case.seed)
        if envs is not None:
            learner.rollout = GymnasiumRollout(env, learner.rollout.steps, envs, case.seed, segments=learner.segments)
        return more | iterate(learner, curve, lambda it: it.time_gradient + it.time_solve + it.time_value)


def ppo(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    """PPO with its default settings."""
    assert case.nworld is not None
    config = lw.PPOConfig(mean_every=0)
    next(lw.PPO(environment(case, options, config.minibatches), config=config, seed=case.seed))  # compiles kernels
    learner = lw.PPO(environment(case, options, case.nworld), config=config, seed=case.seed)
    return iterate(learner, curve, lambda it: it.time_update)


def iterate(learner: Any, curve: Curve, update: Callable[[Any], float]) -> dict[str, Any]:
    """Run a learner of this package until its curve is complete."""
    sampling = updates = 0.0
    curve.start(mean_action(learner.policy))
    while not curve.ended(learner.samples):
        it = next(learner)  # it ends with a copy to the host, so that a GPU has done its work
        sampling, updates = sampling + it.time_sample, updates + update(it)
        rollout = learner.rollout
        ended = rollout.done & ~rollout.episode_return.isnan()
        curve.returns += rollout.episode_return[ended].tolist()
        if curve.due(learner.samples):
            curve.add(learner.samples, mean_action(learner.policy))
    curve.finish(learner.samples, mean_action(learner.policy))
    return {"sampling_seconds": sampling, "update_seconds": updates}


# stable-baselines3 and sb3-contrib


def stable_baselines3(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    """PPO or TRPO with the settings that are published for the task, on environments of Gymnasium."""
    installed("stable_baselines3", "stable-baselines3")
    import stable_baselines3 as sb3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    if case.contestant == "trpo_sb3":
        algorithm, settings, count = installed("sb3_contrib", "sb3-contrib").TRPO, TRPO[case.task], 2
    else:
        algorithm, settings, count = sb3.PPO, PPO[case.task], 1

    def agent(**changes: int) -> tuple[Any, VecNormalize]:
        made = [lambda: Monitor(gymnasium.make(TASKS[case.task], disable_env_checker=True))] * count
        envs = VecNormalize(DummyVecEnv(made), gamma=settings["gamma"])
        words = copy.deepcopy(settings) | changes
        return algorithm("MlpPolicy", envs, seed=case.seed, device="cpu", **words), envs

    class Watch(BaseCallback):
        """Judges the policy between two updates."""

        def _on_step(self) -> bool:
            curve.returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
            return curve.seconds() < (case.limit or math.inf)

        def _on_rollout_start(self) -> None:
            if self.num_timesteps and curve.due(self.num_timesteps) and not curve.ended(self.num_timesteps):
                curve.add(self.num_timesteps, act)

    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(obs), deterministic=True)[0]

    agent(n_steps=64, batch_size=64)[0].learn(1)  # torch's first calls take longer
    model, envs = agent(**({"n_steps": 256, "batch_size": 64} if case.short else {}))
    assert case.samples is not None
    curve.start(act)
    model.learn(case.samples, callback=Watch())
    curve.finish(model.num_timesteps, act)
    return {}


RUN = {"npg": npg, "npg_gymnasium": npg, "npg_gpu": npg, "ppo_rsl_rl": ppo, "ppo_sb3": stable_baselines3,
       "trpo_sb3": stable_baselines3}  # fmt: skip


@contextlib.contextmanager
def alone(name: str) -> Iterator[None]:
    """Wait until no other process of this machine is in here: jobs would share the GPU."""
    path = Path(tempfile.gettempdir()) / f"lyceum_warp-{os.getuid()}-{name}.lock"
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(case.threads)
    curve = Curve(case)
    on_gpu = case.contestant in ON_GPU
    with experiment.cores(case.threads), alone("gpu") if on_gpu else contextlib.nullcontext():
        more = RUN[case.contestant](case, options, curve)
    points = curve.points()
    samples, seconds, mean, noisy = points[-1]
    return {"samples": samples, "seconds": seconds, "mean_return": mean, "noisy_return": noisy, **more,
            "curve": points}  # fmt: skip


# tables and figure


def runs(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """Runs by task and contestant."""
    found: dict[str, dict[str, list[Row]]] = {task: {} for task in TASKS}
    for row in rows:
        found[row.case["task"]].setdefault(row.case["contestant"], []).append(row)
    return {
        task: {name: sorted(same[name], key=lambda row: row.case["seed"]) for name in CONTESTANTS if name in same}
        for task, same in found.items() if same
    }  # fmt: skip


def values_at(row: Row, samples: Sequence[float], column: int = 2) -> np.ndarray:
    """A column of a curve at numbers of samples, by linear interpolation; nan beyond the curve's end."""
    points = [point for point in row.result["curve"] if point[column] is not None]
    if not points:
        return np.full(len(samples), np.nan)
    x, y = [point[0] for point in points], [point[column] for point in points]
    return np.interp(samples, x, y, left=np.nan, right=np.nan)


def seconds_to(row: Row, target: float) -> float | None:
    """Seconds of learning until the mean policy first returned so much."""
    return next((point[1] for point in row.result["curve"] if point[2] >= target), None)


def tables(rows: Sequence[Row]) -> list[Table]:
    found = runs(rows)
    made = [ends(found)]
    for task, same in found.items():
        if {"npg", "npg_gymnasium"} <= same.keys() and (agreed := agreement(task, same)) is not None:
            made.append(agreed)
    return made


def ends(found: dict[str, dict[str, list[Row]]]) -> Table:
    """How the runs ended, and when they reached nine tenths of what the Gymnasium-fed NPG returns in the end."""
    lines = []
    for task, same in found.items():
        ours = {row.case["seed"]: row for row in same.get("npg", ())}
        fed = same.get("npg_gymnasium", ())
        target = 0.9 * statistics.fmean(row.result["mean_return"] for row in fed) if fed else None
        for name, group in same.items():
            noisy = [row.result["noisy_return"] for row in group if row.result["noisy_return"] is not None]
            reached = [] if target is None else [seconds_to(row, target) for row in group]
            arrived = [seconds for seconds in reached if seconds is not None]
            share = f" ({len(arrived)} of {len(reached)})" if len(arrived) < len(reached) else ""
            ratios = [pace(row) / pace(ours[row.case["seed"]]) for row in group
                      if row.case["seed"] in ours and name in ON_CPU]  # fmt: skip
            phases = [row.result["sampling_seconds"] for row in group if "sampling_seconds" in row.result]
            modes = sorted({row.result["mode"] for row in group if "mode" in row.result})
            lines.append([
                task, CONTESTANTS[name] + (f" ({', '.join(modes)})" if modes else ""), str(len(group)),
                f"{statistics.median(row.result['samples'] for row in group):,.0f}",
                interval(comparison.mean_interval([row.result["mean_return"] for row in group])),
                interval(comparison.mean_interval(noisy)) if noisy else "",
                median_and_range([row.result["seconds"] for row in group], ".1f"),
                f"{statistics.median(phases):.1f}" if phases else "",
                median_and_range(ratios),
                f"{statistics.median(arrived):.1f}{share}" if arrived else share.strip(),
            ])  # fmt: skip
    title = (
        "At the end of learning: mean over the seeds ± half of its 95 % interval (Student's t); seconds and ratios are "
        "medians over the seeds (smallest to largest). The last column has the seconds until the mean policy first "
        "returned 90 % of what NPG on Gymnasium's environments returns in the end."
    )
    header = ["task", "contestant", "seeds", "samples", "mean policy", "with noise", "seconds", "of them sampling",
              "time of a sample by ours", "to 90 %, s"]  # fmt: skip
    return Table(title, header, lines)


def pace(row: Row) -> float:
    """Seconds of learning for each sample."""
    return row.result["seconds"] / row.result["samples"]


def interval(found: tuple[float, float], form: str = ",.0f") -> str:
    mean, half = found
    return f"{mean:{form}}" if half != half else f"{mean:{form}} ± {half:{form}}"


def agreement(task: str, same: dict[str, list[Row]]) -> Table | None:
    """The mean policy's return of both NPGs at every hundred thousand samples, and whether they differ.

    None with a single seed, or with runs that end before.
    """
    ours, fed = (np.array([values_at(row, EVERY_100K) for row in same[name]]) for name in ("npg", "npg_gymnasium"))
    there = ~np.isnan(np.concatenate([ours, fed])).any(axis=0)
    if not there.any() or min(len(ours), len(fed)) < 2:
        return None
    ours, fed, places = ours[:, there], fed[:, there], np.array(EVERY_100K)[there]
    p = comparison.permutation_test(ours, fed)
    gaps = [comparison.difference_interval(a, b) for a, b in zip(ours.T, fed.T, strict=True)]
    lines = [
        [f"{place:,}", interval(comparison.mean_interval(a)), interval(comparison.mean_interval(b)), interval(gap),
         "yes" if abs(gap[0]) <= gap[1] else "no", f"{value:.3f}"]
        for place, a, b, gap, value in zip(places, ours.T, fed.T, gaps, p, strict=True)
    ]  # fmt: skip
    differing = int((p < 0.05).sum())
    verdict = f"differ at {differing} of them" if differing else "differ at none of them"
    inside = sum(line[4] == "yes" for line in lines)
    title = (
        f"{task}: at {len(lines)} points, the curves of our and of Gymnasium's environments {verdict} (permutation of "
        f"whole curves, adjusted for all points, level 5 %; smallest p {p.min():.3f}); the 95 % interval of the "
        f"difference (Welch) contains 0 at {inside} points."
    )
    header = ["samples", "our environments", "Gymnasium's", "difference", "0 inside", "adjusted p"]
    return Table(title, header, lines)


def figure(rows: Sequence[Row]) -> Figure:
    """Returns against samples and against seconds: mean over the seeds with its 95 % interval."""
    found = runs(rows)
    drawn = Figure(figsize=(max(4.0 * len(found), 7.0), 6.6), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(2, len(found), squeeze=False)
    for column, (task, same) in enumerate(found.items()):
        for name, group in same.items():
            if name in ON_CPU or not any(other in ON_CPU for other in same):
                draw(axes[0, column], group, name, 0)
            draw(axes[1, column], group, name, 1)
        axes[0, column].set_title(task, loc="left")
        axes[0, column].set_xlabel("samples")
        axes[1, column].set_xlabel("seconds of learning")
        axes[1, column].set_xscale("log")
        axes[1, column].xaxis.set_major_formatter(EngFormatter(sep=""))
        axes[1, column].xaxis.set_minor_formatter(NullFormatter())
        axes[0, column].xaxis.set_major_formatter(EngFormatter(sep=""))
    for row in axes:
        row[0].set_ylabel("return of the mean policy\n(dotted: of the policy with its noise)")
    handles = {label: handle for panel in axes.flat for handle, label in zip(*panel.get_legend_handles_labels(),
                                                                             strict=True)}  # fmt: skip
    drawn.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(3, len(found) + 1), frameon=False
    )
    finish_axes(axes.flat)
    return drawn


def draw(axes: Any, group: Sequence[Row], name: str, x: int) -> None:
    """The curves of a contestant against samples (x = 0) or seconds (x = 1)."""
    last = min(row.result["curve"][-1][x] for row in group)
    # the first policy is at 0 seconds, which a logarithmic axis does not have
    first = min(max(row.result["curve"][x][x] for row in group), last)
    grid = np.linspace(first, last, 101) if x == 0 else np.geomspace(first, last, 101)
    for column, style in ((2, "-"), (3, ":")):
        curves = []
        for row in group:
            points = [point for point in row.result["curve"] if point[column] is not None]
            if points:
                curves.append(np.interp(grid, [p[x] for p in points], [p[column] for p in points], left=np.nan))
        if not curves:
            continue
        each = [comparison.mean_interval(values) for values in np.array(curves).T]
        mean, half = np.array(each).T
        axes.plot(grid, mean, style, color=COLORS[name], linewidth=1.6 if column == 2 else 1.0,
                  label=CONTESTANTS[name] if column == 2 else None)  # fmt: skip
        if column == 2 and len(group) > 1:
            axes.fill_between(grid, mean - half, mean + half, color=COLORS[name], alpha=0.18, linewidth=0)


EXPERIMENT = experiment.Experiment(
    name="npg", summary="NPG's learning curves on our environments and on Gymnasium's, beside PPO and TRPO",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
    packages=("stable-baselines3", "sb3-contrib"), apart=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
