"""Compare NPG on lyceum_warp's environments with NPG, PPO and TRPO on Gymnasium's (the paper's figure 2).

    lyceum-warp bench npg --threads 2 --jobs 16

On both kinds of environments, NPG is the same class with the same settings and seeds. Gymnasium's environments run in
the faster of their two vector modes. The PPO of stable-baselines3 and the TRPO of sb3-contrib learn for twelve minutes,
with the settings of RL Baselines3 Zoo. All policies are evaluated in single Gymnasium environments, with mean actions
and from the same initial states. The clock starts after kernels are compiled and environments are made. It stops during
evaluations.
"""

import contextlib
import copy
import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import comparison
import experiment
import gymnasium
import numpy as np
import torch
from experiment import STYLES, Row, Table, choose, installed, median_and_range
from gymnasium_rollout import TASKS, GymnasiumRollout, rates, vector
from matplotlib.ticker import EngFormatter, NullFormatter

import lyceum_warp as lw
from lyceum_warp.support.intervals import mean_interval
from lyceum_warp.viz import finish_axes, new_figure

CONFIGS = {
    "swimmer": lw.NPGConfig(gamma=0.999, mean_every=0),
    "hopper": lw.NPGConfig(mean_every=0),
    "walker2d": lw.NPGConfig(mean_every=0),
}
"""Settings of NPG: the defaults, except for Swimmer's discount."""

SHORT: dict[str, Any] = {"samples": 500, "value_epochs": 1}

CONTESTANTS = {
    "npg": "NPG, lyceum_warp",
    "npg_gymnasium": "NPG, Gymnasium's environments",
    "ppo_sb3": "PPO, stable-baselines3",
    "trpo_sb3": "TRPO, sb3-contrib",
    "npg_gpu": "NPG, lyceum_warp on a GPU",
    "ppo_gpu": "PPO, lyceum_warp on a GPU",
    # only stored results of an earlier commit have this contestant
    "ppo_rsl_rl": "rsl_rl's PPO, lyceum_warp on a GPU",
}
ON_CPU, ON_GPU, YARDSTICKS = tuple(CONTESTANTS)[:4], tuple(CONTESTANTS)[4:6], ("ppo_sb3", "trpo_sb3")

GPU_WORLDS = {"npg_gpu": 2048, "ppo_gpu": 4096}

EVERY_100K = tuple(range(100_000, 1_000_001, 100_000))

LIMITS = dict.fromkeys(YARDSTICKS, 720.0) | dict.fromkeys(ON_GPU, 30.0)

EVALUATIONS, EPISODES = 20, 16
"""Number of evaluations after the initial one, and number of episodes in each evaluation."""

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
"""From https://github.com/DLR-RM/rl-baselines3-zoo (hyperparams/ppo.yml), with one environment."""

_TRPO = {"batch_size": 128, "n_steps": 1024, "gamma": 0.99, "gae_lambda": 0.95, "sub_sampling_factor": 1,
         "cg_max_steps": 25, "cg_damping": 0.1, "n_critic_updates": 20, "learning_rate": 1e-3}  # fmt: skip

TRPO = {"swimmer": _TRPO | {"gamma": 0.9999}, "hopper": _TRPO, "walker2d": _TRPO}
"""From hyperparams/trpo.yml, with two environments."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    threads: int | None = 2
    """Cores per case. Learners of stable-baselines3 use only one core, and so do learners on a GPU."""
    samples: int = 1_000_000
    """Number of samples of a run on the CPU."""
    nworld: int = 64
    """Number of worlds of each contestant that runs NPG on the CPU."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    contestant: str
    seed: int
    threads: int
    nworld: int | None
    """Number of worlds; None if the contestant's settings determine it."""
    samples: int | None
    short: bool

    @property
    def limit(self) -> float:
        return LIMITS.get(self.contestant, math.inf) / (10.0 if self.short else 1.0)


def cases(options: Options) -> list[Case]:
    short, cuda = options.short, options.device.startswith("cuda")
    contestants = choose(options.contestants, ON_CPU + ON_GPU, ON_CPU + (ON_GPU if cuda else ()), what="contestant")
    for name in contestants:
        if name in ON_GPU and not cuda:
            raise ValueError(f"{name} needs a GPU: give --device cuda")
        if name in ON_GPU and options.jobs > 1:
            raise ValueError(f"{name} is timed alone on the GPU: give --jobs 1")
    return [
        Case(
            task, name, seed, 1 if name in (*YARDSTICKS, *ON_GPU) else options.threads or 1,
            GPU_WORLDS[name] if name in ON_GPU else None if name in YARDSTICKS else 8 if short else options.nworld,
            None if name in ON_GPU else 1000 if short else options.samples, short,
        )
        for group in (ON_CPU, ON_GPU)
        for seed in options.seeds or (range(2) if short else range(5))
        for task in choose(options.tasks, TASKS, ("swimmer",) if short else (), what="task")
        for name in contestants if name in group
    ]  # fmt: skip


def estimate(case: Case) -> float:
    return 50.0 + min(case.limit, 200.0 * (case.samples or math.inf) / 1e6)


# evaluations

Act = Callable[[np.ndarray], np.ndarray]


class Judge:
    def __init__(self, task: str, episodes: int) -> None:
        self.envs = [gymnasium.make(TASKS[task], disable_env_checker=True) for _ in range(episodes)]

    def __call__(self, act: Act) -> float:
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
    def __init__(self, case: Case) -> None:
        self.case, self.judge = case, Judge(case.task, 2 if case.short else EPISODES)
        self.points: list[tuple[int, float, float]] = []
        """(samples, seconds of learning, return of the mean policy) per point."""
        self._stopped, self._next = 0.0, 0

    def start(self, act: Act) -> None:
        self._stopped = time.perf_counter()
        self.add(0, act)

    def seconds(self) -> float:
        return time.perf_counter() - self._stopped

    def ended(self, samples: int) -> bool:
        return samples >= (self.case.samples or math.inf) or self.seconds() >= self.case.limit

    def due(self, samples: int) -> bool:
        return self.ended(samples) or self._evaluations(samples) >= self._next

    def _evaluations(self, samples: int) -> float:
        progress = max(samples / (self.case.samples or math.inf), self.seconds() / self.case.limit)
        return (2 if self.case.short else EVALUATIONS) * progress

    def add(self, samples: int, act: Act) -> None:
        """Evaluate a policy and add a point, unless this number of samples already has a point."""
        if self.points and self.points[-1][0] == samples:
            return
        seconds, self._next = self.seconds(), int(self._evaluations(samples)) + 1
        before = time.perf_counter()
        self.points.append((samples, round(seconds, 4), round(self.judge(act), 3)))
        self._stopped += time.perf_counter() - before


# NPG on lyceum_warp's and on Gymnasium's environments


def mean_action(policy: torch.nn.Module) -> Act:
    now = copy.deepcopy(policy).cpu()

    @torch.no_grad()
    def act(obs: np.ndarray) -> np.ndarray:
        return now(torch.as_tensor(obs, dtype=torch.float32)).numpy()

    return act


def config_of(case: Case) -> lw.NPGConfig:
    changes = dict(SHORT) if case.short else {}
    if case.contestant not in ON_GPU:
        changes["min_restarts"] = 0.0  # Gymnasium's vector environments cannot restart individual worlds
    return dataclasses.replace(CONFIGS[case.task], **changes)


def environment(case: Case, options: Options, nworld: int) -> lw.Env:
    if case.contestant in ON_GPU:
        return lw.make(case.task, nworld=nworld, seed=case.seed, device=options.device, engine="warp")
    return lw.make(case.task, nworld=nworld, seed=case.seed, engine="mujoco", nthread=case.threads)


def npg(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    """Run NPG. Gymnasium's environments are made first, because their processes are forked."""
    assert case.nworld is not None
    more: dict[str, Any] = {}
    with contextlib.ExitStack() as stack:
        envs = None
        if case.contestant == "npg_gymnasium":
            found = rates(case.task, case.nworld, 20 if case.short else 100)
            more["mode"] = max(found, key=found.get)
            envs = stack.enter_context(contextlib.closing(vector(case.task, case.nworld, more["mode"])))
        config = config_of(case)
        # compiles kernels
        next(lw.NPG(environment(case, options, 2), config=dataclasses.replace(config, samples=64), seed=case.seed))
        env = environment(case, options, case.nworld)
        learner = lw.NPG(env, config=config, seed=case.seed)
        if envs is not None:
            learner.rollout = GymnasiumRollout(env, learner.rollout.steps, envs, case.seed, segments=learner.segments)
        return more | iterate(learner, curve)


def ppo(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    assert case.nworld is not None
    config = lw.PPOConfig(mean_every=0)
    next(lw.PPO(environment(case, options, config.minibatches), config=config, seed=case.seed))  # compiles kernels
    learner = lw.PPO(environment(case, options, case.nworld), config=config, seed=case.seed)
    return iterate(learner, curve)


def iterate(learner: Any, curve: Curve) -> dict[str, Any]:
    sampling = 0.0
    curve.start(mean_action(learner.policy))
    while not curve.ended(learner.samples):
        sampling += next(learner).time_sample  # an iteration ends with a copy to the host, which waits for the GPU
        if curve.due(learner.samples):
            curve.add(learner.samples, mean_action(learner.policy))
    curve.add(learner.samples, mean_action(learner.policy))
    return {"sampling_seconds": sampling}


# stable-baselines3 and sb3-contrib


def stable_baselines3(case: Case, options: Options, curve: Curve) -> dict[str, Any]:
    """Run PPO or TRPO with the published settings of the task, on Gymnasium's environments."""
    installed("stable_baselines3", "stable-baselines3")
    import stable_baselines3 as sb3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    if case.contestant == "trpo_sb3":
        algorithm, settings, count = installed("sb3_contrib", "sb3-contrib").TRPO, TRPO[case.task], 2
    else:
        algorithm, settings, count = sb3.PPO, PPO[case.task], 1

    def agent(**changes: int) -> tuple[Any, VecNormalize]:
        made = [lambda: gymnasium.make(TASKS[case.task], disable_env_checker=True)] * count
        envs = VecNormalize(DummyVecEnv(made), gamma=settings["gamma"])
        words = copy.deepcopy(settings) | changes
        return algorithm("MlpPolicy", envs, seed=case.seed, device="cpu", **words), envs

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            return curve.seconds() < case.limit

        def _on_rollout_start(self) -> None:
            if self.num_timesteps and curve.due(self.num_timesteps) and not curve.ended(self.num_timesteps):
                curve.add(self.num_timesteps, act)

    def act(obs: np.ndarray) -> np.ndarray:
        return model.predict(envs.normalize_obs(obs), deterministic=True)[0]

    agent(n_steps=64, batch_size=64)[0].learn(1)  # torch's first calls take longer than later calls
    model, envs = agent(**({"n_steps": 256, "batch_size": 64} if case.short else {}))
    assert case.samples is not None
    curve.start(act)
    model.learn(case.samples, callback=Watch())
    curve.add(model.num_timesteps, act)
    return {}


RUN = {"npg": npg, "npg_gymnasium": npg, "npg_gpu": npg, "ppo_gpu": ppo, "ppo_sb3": stable_baselines3,
       "trpo_sb3": stable_baselines3}  # fmt: skip


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(case.threads)
    curve = Curve(case)
    with experiment.cores(case.threads):
        more = RUN[case.contestant](case, options, curve)
    samples, seconds, mean = curve.points[-1]
    return {"samples": samples, "seconds": seconds, "mean_return": mean, **more, "curve": curve.points}


# tables and figure


def runs(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    found: dict[str, dict[str, list[Row]]] = {task: {} for task in TASKS}
    for row in rows:
        found[row.case["task"]].setdefault(row.case["contestant"], []).append(row)
    return {
        task: {name: sorted(same[name], key=lambda row: row.case["seed"]) for name in CONTESTANTS if name in same}
        for task, same in found.items() if same
    }  # fmt: skip


def values_at(row: Row, samples: Sequence[float]) -> np.ndarray:
    x, _, y = zip(*row.result["curve"], strict=True)
    return np.interp(samples, x, y, left=np.nan, right=np.nan)


def seconds_to(row: Row, target: float) -> float | None:
    return next((point[1] for point in row.result["curve"] if point[2] >= target), None)


def tables(rows: Sequence[Row]) -> list[Table]:
    found = runs(rows)
    made = [ends(found)]
    for task, same in found.items():
        if {"npg", "npg_gymnasium"} <= same.keys() and (agreed := agreement(task, same)) is not None:
            made.append(agreed)
    return made


def ends(found: dict[str, dict[str, list[Row]]]) -> Table:
    """Make a table of final returns, and of the seconds until a target return.

    The target is 90 % of the final return that NPG reaches on Gymnasium's environments.
    """
    lines = []
    for task, same in found.items():
        ours = {row.case["seed"]: row for row in same.get("npg", ())}
        fed = same.get("npg_gymnasium", ())
        target = 0.9 * statistics.fmean(row.result["mean_return"] for row in fed) if fed else None
        for name, group in same.items():
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
                interval(mean_interval([row.result["mean_return"] for row in group])),
                median_and_range([row.result["seconds"] for row in group], ".1f"),
                f"{statistics.median(phases):.1f}" if phases else "",
                median_and_range(ratios),
                f"{statistics.median(arrived):.1f}{share}" if arrived else share.strip(),
            ])  # fmt: skip
    title = (
        "At the end of learning: mean over the seeds ± half of its 95 % interval (Student's t); seconds and ratios are "
        "medians over the seeds (smallest to largest). The last column is the time until the mean policy first "
        "reached 90 % of the final return of NPG on Gymnasium's environments."
    )
    header = ["task", "contestant", "seeds", "samples", "return", "seconds", "of them sampling",
              "time of a sample, relative to lyceum_warp's", "to 90 %, s"]  # fmt: skip
    return Table(title, header, lines)


def pace(row: Row) -> float:
    return row.result["seconds"] / row.result["samples"]


def interval(found: tuple[float, float], form: str = ",.0f") -> str:
    mean, half = found
    return f"{mean:{form}}" if half != half else f"{mean:{form}} ± {half:{form}}"


def agreement(task: str, same: dict[str, list[Row]]) -> Table | None:
    """Compare the returns of both NPGs every 100,000 samples; return None if there is too little data."""
    ours, fed = (np.array([values_at(row, EVERY_100K) for row in same[name]]) for name in ("npg", "npg_gymnasium"))
    there = ~np.isnan(np.concatenate([ours, fed])).any(axis=0)
    if not there.any() or min(len(ours), len(fed)) < 2:
        return None
    ours, fed, places = ours[:, there], fed[:, there], np.array(EVERY_100K)[there]
    p = comparison.permutation_test(ours, fed)
    lines = [
        [f"{place:,}", interval(mean_interval(a)), interval(mean_interval(b)), f"{value:.3f}"]
        for place, a, b, value in zip(places, ours.T, fed.T, p, strict=True)
    ]
    title = (
        f"{task}: the curves on lyceum_warp's and on Gymnasium's environments differ at {int((p < 0.05).sum())} of "
        f"{len(lines)} points (permutation of whole curves, adjusted for all points, level 5 %; "
        f"smallest p {p.min():.3f})."
    )
    header = ["samples", "lyceum_warp", "Gymnasium", "adjusted p"]
    return Table(title, header, lines)


def figure(rows: Sequence[Row]) -> Any:
    """Plot returns over samples and over seconds: mean over the seeds with its 95 % interval."""
    found = runs(rows)
    drawn = new_figure("npg", max(4.0 * len(found), 7.0), 6.6)
    axes = drawn.subplots(2, len(found), squeeze=False)
    for column, (task, same) in enumerate(found.items()):
        for name, group in same.items():
            if name in ON_CPU or not any(other in ON_CPU for other in same):
                draw(axes[0, column], group, name, 0)
            draw(axes[1, column], group, name, 1)
        axes[0, column].set_title(task, loc="left")
        axes[0, column].set_xlabel("samples")
        axes[1, column].set_xlabel("seconds of learning (log scale)")
        axes[1, column].set_xscale("log")
        axes[1, column].xaxis.set_major_formatter(EngFormatter(sep=""))
        axes[1, column].xaxis.set_minor_formatter(NullFormatter())
        axes[0, column].xaxis.set_major_formatter(EngFormatter(sep=""))
    for row in axes:
        row[0].set_ylabel("return of the mean policy")
    handles = {label: handle for panel in axes.flat for handle, label in zip(*panel.get_legend_handles_labels(),
                                                                             strict=True)}  # fmt: skip
    drawn.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=min(3, len(found) + 1), frameon=False
    )
    finish_axes(axes.flat)
    return drawn


def draw(axes: Any, group: Sequence[Row], name: str, x: int) -> None:
    color, marker, line = STYLES[list(CONTESTANTS).index(name)]
    last = min(row.result["curve"][-1][x] for row in group)
    # a logarithmic axis cannot show 0 seconds
    first = min(max(row.result["curve"][x][x] for row in group), last)
    grid = np.linspace(first, last, 101) if x == 0 else np.geomspace(first, last, 101)
    curves = [
        np.interp(grid, [p[x] for p in row.result["curve"]], [p[2] for p in row.result["curve"]]) for row in group
    ]
    mean, half = np.array([mean_interval(values) for values in np.array(curves).T]).T
    # markers of coinciding curves must not cover each other
    every = (3 * list(CONTESTANTS).index(name), 16)
    axes.plot(grid, mean, color=color, linestyle=line, marker=marker, markevery=every, markersize=5, linewidth=1.5,
              label=CONTESTANTS[name])  # fmt: skip
    if len(group) > 1:
        axes.fill_between(grid, mean - half, mean + half, color=color, alpha=0.13, linewidth=0)


EXPERIMENT = experiment.Experiment(
    name="npg",
    conditions="NPG learns on the C engine, on Gymnasium's environments or (on a GPU) on the Warp engine, with exact "
    "physics.",
    summary="NPG's learning curves on lyceum_warp's and Gymnasium's environments, with PPO and TRPO.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
    packages=("stable-baselines3", "sb3-contrib"), apart=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
