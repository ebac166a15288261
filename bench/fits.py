"""Fit hidden robots, compare the fitted with the hidden values, and train policies for the hidden robots.

    lyceum-warp bench fits --parts hanging ground --jobs 8 --threads 2
    lyceum-warp bench fits --parts hanging --tasks go1 --contestants lyceum_warp
    lyceum-warp bench fits --parts actuators wrong
    lyceum-warp bench fits --parts policies --device cuda

Part "hanging": robots in a frame whose gains, armatures, frictions and delay were drawn within 30 %, and the torso's
mass of a G1. Part "ground": Go1s on the ground, measured by motion capture, whose trunks have other masses and centres,
too. The log has a sample for each substep of the model, with the noise of real sensors. A wrong plant has substeps of
half the length, lower legs 3 % heavier, and softer contacts, none of which are fitted. Part "actuators": logs of servos
with and without a delay, each fitted with and without a delay. Part "wrong": the answers to damaged logs.

Part "policies": policies that learned from draws around the fits of hidden Go1s (part "ground"), without or with the
task's own draws, from the task's own draws alone, and from the nominal robot, each on the hidden Go1s, on the C engine.
The folder of ``--fits`` keeps the fits.
"""

import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import experiment
import mujoco.rollout
import mujoco_sysid
import numpy as np
from experiment import Experiment, Row, Table, choose

import lyceum_warp as lw
from lyceum_warp.binding import compile_model, find_task, task_spec
from lyceum_warp.core import FIT_FORMAT, element_names, elements
from lyceum_warp.engines import options_on_cores
from lyceum_warp.fitting import read_log
from lyceum_warp.fitting.least_squares import LeastSquares
from lyceum_warp.fitting.parameters import Parameters
from lyceum_warp.fitting.windows import Predictor, cut_windows
from lyceum_warp.support.intervals import mean_interval, share_interval
from lyceum_warp.tasks.velocity import g1

PARTS = ("hanging", "ground", "actuators", "wrong", "policies")
CONTESTANTS = ("lyceum_warp", "mujoco.sysid")
POLICIES = ("fit", "fit and wide", "wide", "nominal")
PLANTS = 4
STEP = 0.02
RANGES = {"factor": (np.log(0.7), np.log(1.3)), "delay": (0.002, 0.015)}
WINDOWS = {"hanging": (0.5, 2.0), "ground": (0.1, 0.25, 1.0)}
"""Seconds of the roll-outs of mujoco.sysid. Tables show those with the least median error."""
SECONDS = "Seconds are left out if other programs used the cores."
G1_JOINTS = ("*hip*,*knee*", "*ankle*", "waist*", "*shoulder*,*elbow*,*wrist*")


@dataclasses.dataclass(frozen=True)
class Robot:
    task: str
    parameters: tuple[lw.Parameter | str, ...]
    heavier: str
    """End of the names of the bodies that are 3 % heavier in wrong plants."""
    home: tuple[float, ...] = ()
    """Joint positions; by default those of the model's first keyframe."""


DELAY = "delay.ctrl.*"
TRUNK = ("body_mass.trunk", "body_ipos.trunk")
ROBOTS = {
    "go1": Robot(
        "go1_velocity",
        (
            lw.Parameter(name="kp.*", each=True),
            lw.Parameter(name="dof_frictionloss.*_hip,*_thigh,*_calf", each=True),
            *(f"kd.*_{joint}" for joint in ("hip", "thigh", "calf")),
            "dof_armature.*_hip,*_thigh", "dof_armature.*_calf",
        ),
        "_calf",
        (0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2,
    ),
    "g1": Robot(
        "g1_full_velocity",
        (
            *(f"kp.*{joint}_joint" for joint in (*g1.LEG, *g1.WAIST, *g1.ARM)),
            *(f"dof_{field}.{names}" for field in ("damping", "armature", "frictionloss") for names in G1_JOINTS),
            "body_mass.torso_link",
        ),
        "_knee_link",
    ),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """hanging, ground, actuators, wrong and policies; by default all."""
    robots: int = 5
    """Hidden robots of each model; every second one differs from the model in more than the fitted parameters."""
    seconds: float = 60.0
    """Seconds of log."""
    fits: Path = Path("fits")
    """Folder of the fits for the part policies. A finished fit there is used again."""
    iterations: int = 300
    """Iterations of a policy."""
    nworld: int = 4096
    """Worlds of a policy."""
    episodes: int = 200
    """Episodes of each policy on each hidden robot."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    robot: str
    plant: str
    """"exact" or "wrong", or the actuator of a log."""
    contestant: str
    seed: int
    seconds: float
    training: tuple[int, int, int] = (0, 0, 0)
    """Iterations, worlds and episodes of a policy."""


def kind(seed: int) -> str:
    return ("exact", "wrong")[seed % 2]


def cases(options: Options) -> list[Case]:
    parts, robots = (
        choose(options.parts, PARTS, what="part"),
        choose(options.tasks, ROBOTS, ("go1",) if options.short else (), what="robot"),
    )
    seconds, count, plants = (3.0, 1, 1) if options.short else (options.seconds, options.robots, PLANTS)
    training = (2, 32, 4) if options.short else (options.iterations, options.nworld, options.episodes)
    every = [
        Case(part, robot, kind(seed), contestant, seed, seconds)
        for part in parts if part in ("hanging", "ground")
        for robot in robots if part == "hanging" or robot == "go1"
        for seed in range(count) for contestant in CONTESTANTS
    ] + [
        Case(part, "go1", plant, "lyceum_warp", 0, min(seconds, 30.0))
        for part, all_plants in (("actuators", ("ideal", "delayed")), ("wrong", ("logs",))) if part in parts
        for plant in all_plants
    ] + [
        Case("policies", "go1", kind(seed) if "fit" in policy else "all", policy, seed, min(seconds, 15.0), training)
        for policy in POLICIES if "policies" in parts for seed in range(plants if "fit" in policy else 1)
    ]  # fmt: skip
    return [case for case in every if case.contestant in options.contestants or not options.contestants]


class Plant:
    """A hidden robot.

    Args:
        robot: Its model.
        seed: Seed of the values.
        ground: Whether it stands on the ground.
        kind: "exact", "wrong", or "ideal" (no delay).
    """

    def __init__(self, robot: str, seed: int, *, ground: bool, kind: str = "exact") -> None:
        self.robot, self.ground = ROBOTS[robot], ground
        spec = task_spec(find_task(self.robot.task))
        self.home = np.array(self.robot.home or [*spec.keys[0].qpos][7:])
        if not ground:
            for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
                spec.delete(joint)
            for key in list(spec.keys):
                spec.delete(key)
        model = compile_model(spec, [], lw.PhysicsOptions(), varied=["body_ipos"])
        model.opt.iterations = model.opt.ls_iterations = 50  # a robot's solver does not stop early
        if not ground:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.wanted = [*self.robot.parameters, *(TRUNK if ground else ()), DELAY]
        self.bound, self.rng = Parameters(self.wanted, model), np.random.default_rng(seed)
        self._draw(kind)
        while not self._holds(seed):  # servos may be unstable with a long delay
            self._draw(kind)
        base = ([0.003] * 3 + [0.002] * 4, [0.05] * 3 + [0.02] * 3) if ground else ([], [])
        joints = len(self.home)
        self.noise = np.array([*base[0], *[0.002] * joints, *base[1], *[0.05] * joints])
        # errors are relative to the value, and those of a trunk's centre relative to 0.1 m
        self.scale = np.where(["body_ipos" in name for name in self.bound.names], 0.1, self.values)

    def _draw(self, kind: str) -> None:
        """Draw the values, and make the model with them."""
        draws = [self.rng.uniform(*RANGES[c.kind]) if c.kind in RANGES
                 else self.rng.uniform(-0.02, 0.02) if c.low < 0.0 else self.rng.uniform(0.05, 0.3)
                 for c in self.bound.coordinates]  # fmt: skip
        self.x = np.array(draws) * [kind != "ideal" or c.kind != "delay" for c in self.bound.coordinates]
        self.values = np.array([c.value(v) for c, v in zip(self.bound.coordinates, self.x, strict=True)])
        self.model, self.delay = self.bound.model(self.x), float(self.values[-1])
        if kind == "wrong":
            self.model.opt.timestep /= 2
            self.model.geom_solref[:, 0] *= 1.5
            bodies = [self.model.body(name).id for name in element_names(self.model, "body_mass")
                      if name.endswith(self.robot.heavier)]  # fmt: skip
            self.model.body_mass[bodies] *= 1.03
            self.model.body_inertia[bodies] *= 1.03
            mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def _holds(self, seed: int) -> bool:
        """Return whether the joints stay in their ranges, or less than 0.5 rad beyond, in short test motions."""
        positions = self._move(6.0, seed)[1][:, self.model.nq - len(self.home) : self.model.nq]
        low, high = self.model.jnt_range[-len(self.home) :].T
        return bool(((low - 0.5 < positions) & (positions < high + 0.5)).all())

    def _move(self, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the controls of test motions, and the positions and velocities in which each substep begins."""
        reach = 0.12 if self.ground else 0.4
        same: dict[str, Any] = {"frequencies": (0.2, 4.0), "seed": seed}
        moves = [lw.excitation(self.home - reach, self.home + reach, kind, seconds=seconds / 3, **same)
                 for kind in ("chirp", "steps", "walk")]  # fmt: skip
        control = np.concatenate(moves)
        data, substep, each = mujoco.MjData(self.model), self.model.opt.timestep, self.bound.nominal.opt.timestep
        if self.ground:
            data.qpos[2] = 0.28
        data.qpos[-len(self.home) :] = self.home
        full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(mujoco.mj_stateSize(self.model, full))
        mujoco.mj_getState(self.model, data, start, full)
        rows, _ = mujoco.rollout.rollout(self.model, data, start[None], delayed(control, substep, self.delay)[None])
        return control, np.concatenate([start[None], rows[0, :-1]])[:: round(each / substep), 1:]

    def log(self, seconds: float, seed: int) -> dict[str, np.ndarray]:
        """Move the robot by test motions, and log it."""
        control, rows = self._move(seconds, seed)
        rows = rows + self.noise * self.rng.standard_normal(rows.shape)
        nq, each = self.model.nq, self.bound.nominal.opt.timestep
        return {
            "time": each * np.arange(len(rows)), "ctrl": np.repeat(control, round(STEP / each), axis=0),
            "qpos": rows[:, :nq], "qvel": rows[:, nq:],
        }  # fmt: skip

    def half_widths(self, log: dict[str, np.ndarray], window: float) -> np.ndarray:
        """Compute relative half-widths of 95 % intervals from the Fisher information at the hidden values."""
        read = read_log(log, self.bound.nominal)
        bound = Parameters(self.wanted, self.bound.nominal, [column.name for column in read.columns])
        problem = LeastSquares(cut_windows(read, bound, window), Predictor(read, bound), {})
        at = problem.begin(self.x, self.noise)
        at = dataclasses.replace(at, spread=problem.normal(at.x, problem.linearize(at))[2])
        deviation = np.sqrt(np.diag(np.linalg.inv(problem.normal(at.x, problem.linearize(at))[1])))
        factor = np.array([c.kind == "factor" for c in self.bound.coordinates])
        half: np.ndarray = 1.96 * deviation * np.where(factor, self.values, 1.0) / self.scale
        return half

    def write(self, folder: str) -> None:
        """Write the hidden values as a fit, for ``lw.make``."""
        fields = {
            field: {name: getattr(self.model, field)[elements(self.model, field, name)].tolist()
                    for name in element_names(self.model, field)}
            for field in ("body_mass", "body_inertia", "geom_solref")
        }  # fmt: skip
        content = dict.fromkeys(("names", "value", "low", "high", "determined"), ()) | {
            "format": FIT_FORMAT, "delays": dict.fromkeys(self.bound.actuators, self.delay),
            "fields": self.bound.fields(self.x) | fields,
        }  # fmt: skip
        (Path(folder) / "fit.json").write_text(json.dumps(content))


def delayed(control: np.ndarray, substep: float, delay: float) -> np.ndarray:
    """Compute the mean over each substep of controls that arrive late, (substeps, nu)."""
    time = STEP * np.arange(len(control) + 1)
    integral = np.concatenate([-control[:1], np.zeros((1, control.shape[1])), STEP * np.cumsum(control, axis=0)])
    edges = substep * np.arange(round(time[-1] / substep) + 1) - delay
    columns = [np.diff(np.interp(edges, [-1.0, *time], column)) / substep for column in integral.T]
    return np.stack(columns, axis=1)


def measure(case: Case, options: Options) -> dict[str, Any]:
    settings: dict[str, Any] = {"samples": 0, "iterations": 2} if options.short else {}
    settings["nthread"] = len(os.sched_getaffinity(0))
    if case.part == "wrong":
        return {"answers": wrong_logs()}
    if case.part == "policies":
        return policy(case, options, settings)
    plant = Plant(case.robot, case.seed, ground=case.part == "ground", kind=case.plant)
    log = plant.log(case.seconds, case.seed)
    if case.part == "actuators":
        fits = {name: lw.fit(plant.robot.task, log, wanted, hangs=True, **({"samples": 0} | settings))
                for name, wanted in (("ideal", plant.wanted[:-1]), ("delayed", plant.wanted))}  # fmt: skip
        return {"errors": {name: fit.errors["qpos"][1] for name, fit in fits.items()}}
    shared = {"names": plant.bound.names, "truth": plant.values.tolist(), "scale": plant.scale.tolist()}
    if case.contestant == "mujoco.sysid":
        return shared | {"settings": by_sysid(plant, log, case)}
    began = time.process_time()
    fit = lw.fit(plant.robot.task, log, plant.wanted, hangs=not plant.ground, **settings)
    return shared | {
        "cpu_seconds": time.process_time() - began, "wall_seconds": fit.seconds,
        "held_out": fit.held_out, "determined": fit.determined.tolist(),
        "fisher": plant.half_widths(log, 0.1 if plant.ground else 0.25).tolist(),
        **{name: getattr(fit, name).tolist() for name in ("value", "low", "high")},
    }  # fmt: skip


def by_sysid(plant: Plant, log: dict[str, np.ndarray], case: Case) -> dict[str, Any]:
    """Fit a log by mujoco.sysid, with roll-outs of several lengths."""
    step, control = plant.bound.nominal.opt.timestep, log["ctrl"][:: round(STEP / plant.bound.nominal.opt.timestep)]
    states, settings = np.concatenate([log["qpos"], log["qvel"]], axis=1), {}
    for window in WINDOWS[case.part]:
        steps = min(len(states) - 1, round(window / step))
        result = mujoco_sysid.fit(plant.bound, lambda delay: delayed(control, step, delay), states, plant.noise, steps)
        ends = {
            name: [float(c.value(x)) for c, x in zip(plant.bound.coordinates, result.pop(name), strict=True)]
            for name in ("value", "low", "high")
        }
        settings[f"{steps * step:g}"] = result | ends
    return settings


# policies


def policy(case: Case, options: Options, settings: dict[str, Any]) -> dict[str, Any]:
    """Train a policy, and judge it on hidden robots."""
    iterations, nworld, _ = case.training
    feet = task_spec(find_task("go1_velocity")).geom("FR_foot").friction
    same = dict(zip(("sliding_friction", "spinning_friction", "rolling_friction"), ([f, f] for f in feet), strict=True))
    trunk: dict[str, Any] = {"trunk_offset": [0.0, 0.0, 0.0]}
    folder = options.fits / f"go1-{case.seed}"
    fitted: dict[str, Any] = {"fitted": folder, "fitted_draws": True}
    params_of = {"fit": trunk | fitted, "fit and wide": fitted, "wide": {},
                 "nominal": trunk | same | {"encoder_bias": 0.0}}  # fmt: skip
    began, own = time.perf_counter(), "fit" in case.contestant
    if own:
        plant = Plant("go1", case.seed, ground=True, kind=case.plant)
        if not (folder / "fit.json").exists():
            lw.fit("go1_velocity", plant.log(case.seconds, case.seed), plant.wanted, out=folder, **settings)
    fit_ended = time.perf_counter()
    env = lw.make("go1_velocity", nworld=nworld, device=options.device, seed=case.seed, **params_of[case.contestant])
    learner = lw.PPO(env, config=lw.PPOConfig(symmetry="exact", mean_every=0), seed=case.seed)
    while learner.iteration < iterations:
        next(learner)
    learned = time.perf_counter()
    actor = learner.policy.to("cpu")
    seeds = [case.seed] if own else range(1 if options.short else PLANTS)
    judged = {f"{seed}": judge(actor, seed, case.training[2], trunk | same) for seed in seeds}
    return {"fit_seconds": fit_ended - began, "training_seconds": learned - fit_ended, "plants": judged}


def judge(actor: Any, seed: int, episodes: int, params: dict[str, Any]) -> dict[str, Any]:
    """Play a policy on a hidden robot, with the task's noise and pushes."""
    plant = Plant("go1", seed, ground=True, kind=kind(seed))
    with tempfile.TemporaryDirectory() as folder:
        plant.write(folder)
        step = plant.model.opt.timestep
        env = lw.make("go1_velocity", nworld=min(100, episodes), fitted=folder, timestep=step,
                      frame_skip=round(STEP / step), **params, **options_on_cores())  # fmt: skip
        played = lw.evaluate(env, actor, episodes, seed=seed)
    errors = played.step_metrics["velocity_error"]
    return {"velocity_error": errors.double().numpy().round(4).tolist(), "falls": played.terminated.int().tolist()}


def wrong_logs() -> dict[str, str]:
    """Damage a log in several ways, and collect the answers."""
    log = Plant("go1", 0, ground=False).log(3.0, 0)
    legs = np.r_[3:6, 0:3, 6:12]
    damage: dict[str, dict[str, Any]] = {
        "legs swapped": {"qpos": log["qpos"][:, legs], "qvel": log["qvel"][:, legs]},
        "degrees": {"qpos": np.degrees(log["qpos"]), "qvel": np.degrees(log["qvel"])},
        "velocities in degrees": {"qvel": np.degrees(log["qvel"])},
        "milliseconds": {"time": 1e3 * log["time"]},
        "another robot": {"qpos": log["qpos"][:, :8]},
        "another joint": {"qpos.FR_knee_joint": log["qpos"][:, 0]},
        "a dead sensor": {"qvel": np.zeros_like(log["qvel"])},
        "NaN in controls": {"ctrl": np.where(np.arange(len(log["ctrl"]))[:, None] == 7, np.nan, log["ctrl"])},
        "no data between gaps": {"time": log["time"] + 0.5 * (np.arange(len(log["time"])) // 10)},
    }
    answers = {}
    for name, change in damage.items():
        try:
            lw.fit("go1_velocity", log | change, hangs=True, samples=0, iterations=1)
            answers[name] = "no error"
        except ValueError as error:
            answers[name] = str(error)
    return answers


def tables(rows: Sequence[Row]) -> list[Table]:
    listed = []
    for part, robot, title in (
        ("hanging", "go1", "Go1s that hang in a frame: 30 parameters. " + SECONDS),
        ("hanging", "g1", "G1s that hang in a frame: 30 parameters. " + SECONDS),
        ("ground", "go1", "Go1s on the ground, measured by motion capture: 34 parameters. " + SECONDS),
    ):
        chosen = [row for row in rows if (row.case["part"], row.case["robot"]) == (part, robot)]
        chosen.sort(key=lambda row: (row.case["plant"], row.case["seed"], row.case["contestant"]))
        header = ["plant", "robot", "fitted by", "log, s", "seconds", "CPU s", "largest error", "median error",
                  "below 2 %", "determined to 2 %", "of these below 2 %", "undetermined", "median half width",
                  "covered", "held out, nominal", "fitted"]  # fmt: skip
        listed += [Table(title, header, [line(row.case, row.result) for row in chosen])] if chosen else []
    lines = [[row.case["plant"], *(f"{1e3 * row.result['errors'][name]:.2f}" for name in ("ideal", "delayed"))]
             for row in rows if row.case["part"] == "actuators"]  # fmt: skip
    title = "Errors of joint positions in windows held back, in mrad (noise: 2): a log of an actuator in two models."
    listed += [Table(title, ["log", "model without delay", "with delay"], lines)] if lines else []
    answers = [list(pair) for row in rows if row.case["part"] == "wrong" for pair in row.result["answers"].items()]
    listed += [Table("Answers to wrong logs.", ["log", "answer"], answers)] if answers else []
    lines = policy_lines([row for row in rows if row.case["part"] == "policies"])
    title = (
        "Policies on hidden Go1s, with noise and pushes. They learned from draws around the fit of the same Go1, from "
        "these and the task's own wide draws, from the wide draws alone, or from the nominal Go1. Mean velocity error, "
        "falls in episodes of 20 s, and differences from the first policy in the same episodes, with 95 % intervals."
    )
    header = ["plant", "robot", "learned from", "velocity error, m/s", "difference", "falls", "difference",
              "training, s"]  # fmt: skip
    return [*listed, *([Table(title, header, lines)] if lines else [])]


def line(case: dict[str, Any], result: dict[str, Any]) -> list[str]:
    truth, scale = np.array(result["truth"]), np.array(result["scale"])
    label, contestant = result, case["contestant"]
    if settings := result.get("settings"):
        window = min(settings, key=lambda name: np.median(np.abs(np.array(settings[name]["value"]) - truth) / scale))
        label, contestant = settings[window], f"{contestant}, roll-outs of {window} s"
    value, low, high = (np.array(label[name]) for name in ("value", "low", "high"))
    error, covered = np.abs((value - truth) / scale), (low <= truth) & (truth <= high)
    precise, wall, cpu = np.array(result.get("fisher", [])) < 0.02, label["wall_seconds"], label["cpu_seconds"]
    return [
        case["plant"], str(case["seed"]), contestant, f"{case['seconds']:g}", f"{wall:.0f}" if cpu > 0.9 * wall else "",
        f"{cpu:.0f}", f"{error.max():.1%}", f"{np.median(error):.2%}",
        f"{(error < 0.02).sum()} of {len(error)}",
        *([str(precise.sum()), str((error[precise] < 0.02).sum()), str((~np.array(result["determined"])).sum())]
          if len(precise) else [""] * 3),
        f"{np.median(0.5 * (high - low) / scale):.2%}", f"{covered.sum()} of {len(covered)}",
        *(f"{number:.2f}" for number in result.get("held_out", ())), *([] if len(precise) else [""] * 2),
    ]  # fmt: skip


def policy_lines(rows: Sequence[Row]) -> list[list[str]]:
    played = {(plant, POLICIES.index(row.case["contestant"])): (row, numbers)
              for row in rows for plant, numbers in row.result["plants"].items()}  # fmt: skip
    lines = []
    for (plant, which), (row, numbers) in sorted(played.items(), key=lambda item: item[0]):
        errors, falls = np.array(numbers["velocity_error"]), np.array(numbers["falls"], bool)
        mean, half = mean_interval(errors)
        changes = ["", ""]
        if which and (plant, 0) in played:
            other = played[plant, 0][1]
            change, width = mean_interval(errors - np.array(other["velocity_error"]))
            low, high = share_interval(np.array(other["falls"], bool), falls)
            changes = [f"{change:+.3f} ± {width:.3f}", f"{low:+.1%} to {high:+.1%}"]
        lines.append([
            kind(int(plant)), plant, POLICIES[which], f"{mean:.3f} ± {half:.3f}", changes[0],
            f"{falls.sum()} of {len(falls)}", changes[1], f"{row.result['training_seconds']:.0f}",
        ])  # fmt: skip
    return lines


def estimate(case: Case) -> float:
    if case.part == "policies":
        return 240.0
    return case.seconds * {"ground": 15.0}.get(case.part, 3.0)


EXPERIMENT = Experiment(
    name="fits", conditions="Robots are simulated and fitted on the C engine.",
    summary="Hidden robots, fitted by logs of their joints: errors, intervals, wrong logs, and policies that learned "
    "from the fits.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
    parallel=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
