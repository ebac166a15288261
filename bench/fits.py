"""Fit hidden robots, and compare the fitted with the hidden values.

    lyceum-warp bench fits --parts hanging --robots 10
    lyceum-warp bench fits --parts ground actuators wrong

Part "hanging": Go1s in a frame whose gains, armatures, frictions and delay were drawn within 30 %. Part "ground": Go1s
on the ground, measured by motion capture, whose trunks have other masses and centres, too. The log has 200 samples per
second with the noise of real sensors. A wrong plant has substeps of half the length, calves 3 % heavier, and softer
contacts, none of which are fitted. Part "actuators": logs of servos with and without a delay, each fitted with and
without a delay. Part "wrong": the answers to damaged logs.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from typing import Any

import experiment
import mujoco
import numpy as np
from experiment import Experiment, Row, Table, choose

import lyceum_warp as lw
from lyceum_warp.binding import compile_model, find_task, task_spec
from lyceum_warp.fitting.parameters import Parameters

PARTS = ("hanging", "ground", "actuators", "wrong")
HOME = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
STEP, SAMPLES_PER_STEP = 0.02, 4
FIELDS = ("kd", "dof_armature", "dof_frictionloss")
TRUNK = ("body_mass.trunk", "body_ipos.trunk")
RANGES = {"factor": (np.log(0.7), np.log(1.3)), "delay": (0.002, 0.015)}


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """hanging, ground, actuators and wrong; by default all."""
    robots: int = 10
    """Hidden robots of a part; every second one differs from the model in more than the fitted parameters."""
    seconds: float = 30.0
    """Seconds of log."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    contestant: str
    """"exact" or "wrong" plants, or the actuator of a log."""
    seed: int
    seconds: float


def cases(options: Options) -> list[Case]:
    parts = choose(options.parts, PARTS, what="part")
    seconds, robots = (3.0, 1) if options.short else (options.seconds, options.robots)
    contestants = {"actuators": ("ideal", "delayed"), "wrong": ("logs",)}
    return [
        Case(part, contestant, seed, seconds)
        for part in parts
        for seed in range(robots if part in ("hanging", "ground") else 1)
        for contestant in contestants.get(part, (("exact", "wrong")[seed % 2],))
    ]


def parameters(*, ground: bool) -> list[lw.Parameter | str]:
    shared = [f"{field}.*_{joint}" for field in FIELDS for joint in ("hip", "thigh", "calf")]
    return [lw.Parameter(name="kp.*", each=True), *shared, "delay.ctrl.*", *(TRUNK if ground else ())]


def hidden_log(
    seed: int, seconds: float, *, ground: bool = False, exact: bool = True, delayed: bool = True
) -> tuple[np.ndarray, dict[str, Any]]:
    """Draw a robot and log it. Returns the values of its parameters, and the log."""
    spec = task_spec(find_task("go1_velocity"))
    if not ground:
        for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
            spec.delete(joint)
        for key in list(spec.keys):
            spec.delete(key)
    model = compile_model(spec, [], lw.PhysicsOptions(), varied=["body_ipos"])
    bound, rng = Parameters(parameters(ground=ground), model), np.random.default_rng(seed)
    draws = [rng.uniform(*RANGES[c.kind]) if c.kind in RANGES
             else rng.uniform(-0.02, 0.02) if c.low < 0.0 else rng.uniform(0.05, 0.3)
             for c in bound.coordinates]  # fmt: skip
    x = np.array(draws) * ([delayed or c.kind != "delay" for c in bound.coordinates])
    hidden, delay = bound.model(x), x[bound.names.index("delay.ctrl.*")]
    if not ground:
        hidden.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if not exact:
        calves = [hidden.body(f"{leg}_calf").id for leg in ("FR", "FL", "RR", "RL")]
        hidden.opt.timestep /= 2
        hidden.geom_solref[:, 0] *= 1.5
        hidden.body_mass[calves] *= 1.03
        hidden.body_inertia[calves] *= 1.03
        mujoco.mj_setConst(hidden, mujoco.MjData(hidden))
    reach = 0.12 if ground else 0.4
    moves = [lw.excitation(HOME - reach, HOME + reach, kind, seconds=seconds / 3, frequencies=(0.2, 4.0), seed=seed)
             for kind in ("chirp", "steps", "walk")]  # fmt: skip
    control, data, h = np.concatenate(moves), mujoco.MjData(hidden), hidden.opt.timestep
    if ground:
        data.qpos[2] = 0.28
    data.qpos[-12:] = HOME
    rows, substeps = [], round(STEP / h)
    for k in range(len(control) * substeps):
        if k % (substeps // SAMPLES_PER_STEP) == 0:
            rows.append(np.concatenate([data.qpos, data.qvel]))
        # the mean over the substep of the control that arrives late
        times = h * (k + (np.arange(40) + 0.5) / 40) - delay
        data.ctrl[:] = control[np.maximum(0, np.floor(times / STEP + 1e-9).astype(int))].mean(axis=0)
        mujoco.mj_step(hidden, data)
    base = ([0.003] * 3 + [0.002] * 4, [0.05] * 3 + [0.02] * 3) if ground else ([], [])
    noise = np.array([*base[0], *[0.002] * 12, *base[1], *[0.05] * 12])
    noisy = np.array(rows) + noise * rng.standard_normal((len(rows), len(noise)))
    values = np.array([c.value(v) for c, v in zip(bound.coordinates, x, strict=True)])
    log = {"time": STEP / SAMPLES_PER_STEP * np.arange(len(rows)), "ctrl": np.repeat(control, SAMPLES_PER_STEP, axis=0)}
    return values, log | {"qpos": noisy[:, : model.nq], "qvel": noisy[:, model.nq :]}


def measure(case: Case, options: Options) -> dict[str, Any]:
    short: dict[str, Any] = {"samples": 0, "iterations": 2} if options.short else {}
    if case.part == "wrong":
        return {"answers": wrong_logs()}
    ground, wanted = case.part == "ground", parameters(ground=case.part == "ground")
    truth, log = hidden_log(
        case.seed, case.seconds, ground=ground, exact=case.contestant != "wrong", delayed=case.contestant != "ideal"
    )
    if case.part == "actuators":
        given: dict[str, Any] = {"noise": {"qpos": 0.002, "qvel": 0.05}, "samples": 0} | short
        fits = {name: lw.fit("go1_velocity", log, wanted[: 10 + delay], hangs=True, **given)
                for name, delay in (("ideal", False), ("delayed", True))}  # fmt: skip
        return {"held_out": {name: fit.held_out[1] for name, fit in fits.items()}}
    began = time.process_time()
    fit = lw.fit("go1_velocity", log, wanted, hangs=not ground, **short)
    return {
        "cpu_seconds": time.process_time() - began, "wall_seconds": fit.seconds, "substeps": fit.substeps,
        "held_out": fit.held_out, "names": list(fit.names), "kinds": list(fit.kinds), "truth": truth.tolist(),
        "value": fit.value.tolist(), "low": fit.low.tolist(), "high": fit.high.tolist(),
        "determined": fit.determined.tolist(),
    }  # fmt: skip


def wrong_logs() -> dict[str, str]:
    """Damage a log in several ways, and collect the answers."""
    _, log = hidden_log(0, 3.0)
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
    found = []
    for part, title in (
        ("hanging", "Go1s that hang in a frame: 22 parameters."),
        ("ground", "Go1s on the ground, measured by motion capture: 26 parameters."),
    ):
        lines = [line(row.case, row.result) for row in rows if row.case["part"] == part]
        header = ["plant", "robot", "log, s", "CPU s", "determined", "largest error", "median error", "below 2 %",
                  "median half width", "covered", "held out, nominal", "fitted"]  # fmt: skip
        found += [Table(title, header, lines)] if lines else []
    lines = [[row.case["contestant"], *(f"{row.result['held_out'][name]:.3f}" for name in ("ideal", "delayed"))]
             for row in rows if row.case["part"] == "actuators"]  # fmt: skip
    title = "Errors of prediction in windows held back, in multiples of the noise: a log of an actuator in two models."
    found += [Table(title, ["log", "model without delay", "with delay"], lines)] if lines else []
    answers = [list(pair) for row in rows if row.case["part"] == "wrong" for pair in row.result["answers"].items()]
    return [*found, *([Table("Answers to wrong logs.", ["log", "answer"], answers)] if answers else [])]


def line(case: dict[str, Any], result: dict[str, Any]) -> list[str]:
    truth, value, low, high = (np.array(result[name]) for name in ("truth", "value", "low", "high"))
    known = np.array(result["determined"])
    # errors relative to the value, and of a trunk's centre relative to 0.1 m
    scale = np.where(["body_ipos" in name for name in result["names"]], 0.1, truth)
    error, half = np.abs((value - truth) / scale)[known], (0.5 * (high - low) / scale)[known]
    covered = ((low <= truth) & (truth <= high))[known]
    return [
        case["contestant"], str(case["seed"]), f"{case['seconds']:g}", f"{result['cpu_seconds']:.0f}",
        f"{known.sum()} of {len(known)}", f"{error.max():.1%}", f"{np.median(error):.2%}", f"{(error < 0.02).sum()}",
        f"{np.median(half):.2%}", f"{covered.sum()} of {len(covered)}",
        *(f"{number:.2f}" for number in result["held_out"]),
    ]  # fmt: skip


EXPERIMENT = Experiment(
    name="fits", conditions="Robots are simulated and fitted on the C engine.",
    summary="Hidden Go1s, fitted by logs of their joints: errors, intervals, models of actuators, and wrong logs.",
    cases=cases, estimate=lambda case: 300.0 if case.part == "ground" else 60.0, measure=measure, tables=tables,
    options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
