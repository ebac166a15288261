"""Fit model fields, delays and sensors to a log: ``lw.fit``."""

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.binding import compile_model, find_task, task_spec
from lyceum_warp.core import FIT_FORMAT, MOVED_INERTIA, EnvOptions, ModelFile, Task, load_spec
from lyceum_warp.env import Env
from lyceum_warp.fitting.least_squares import Estimate, LeastSquares, Linear, search
from lyceum_warp.fitting.log import Controls, Log, LogSource, read_log
from lyceum_warp.fitting.parameters import Parameter, Parameters
from lyceum_warp.fitting.report import write_report
from lyceum_warp.fitting.result import Fit
from lyceum_warp.fitting.windows import Predictor, cut_windows
from lyceum_warp.support.files import replaced
from lyceum_warp.support.validate import finite_number, positive_number, whole_number

DRAWS = 1024
"""Draws from the posterior that the folder holds."""
DEFAULT = ("kp.*", "kd.*", "dof_armature.*", "dof_damping.*", "dof_frictionloss.*", "delay.ctrl.*")
"""Parameters of a fit, if none are given; those that the model lacks are left out."""
SOLVER_ITERATIONS = 50
"""Least number of iterations of MuJoCo's solver in a fit."""
_USUAL = {
    "qpos": 0.002, "qvel": 0.05, "base position": 0.005, "base rotation": 0.005, "base velocity": 0.05,
    "base angular velocity": 0.02, "gyro": 0.02, "accelerometer": 0.2, "framequat": 0.005, "jointpos": 0.002,
    "jointvel": 0.05,
}  # fmt: skip
"""Standard deviations of the noise of usual sensors, by kind of measurement."""
_SHARE_OF_SIGNAL = 0.02
_LEVELS, _BLOCK, _FEWEST = (16, 4, 1), 10, 20
"""The first iterations use one of 16 blocks of windows, further ones one of 4, if these are not too few windows."""
_ROUGH, _CONVERGED = 2.0, 0.5
"""A level ends if a Gauss-Newton step is below the first multiple of a standard deviation; and the last level, if the
step times the ratio of the last two steps of the levels before, which is about what is left, is below the second."""
_KNOWN = 0.3
"""A parameter is determined if its posterior is narrower than this multiple of its prior."""
_LARGE = 2.0
Progress = Callable[[str, int, float], object]


def fit(
    model: str | Path | type[Task] | mujoco.MjSpec | ModelFile,
    log: LogSource,
    parameters: Iterable[Parameter | str] | None = None,
    *,
    out: str | Path | None = None,
    window: float | None = None,
    held_out: float = 0.2,
    samples: int = 128,
    iterations: int = 30,
    seed: int = 0,
    nthread: int = 0,
    hangs: bool = False,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Fit:
    """Fit a model to a log of the robot, and say what the log determines.

    The log is cut into windows. Each window starts from its own initial state, which is estimated with the parameters
    (multiple shooting). The cross-entropy method searches all parameters over ``samples`` hypotheses, each in its own
    worlds. Gauss-Newton steps with finite differences follow, on the C engine in float64. Residuals count in multiples
    of the noise, and linearly beyond 3 of them; windows that the model explains badly count less. Intervals come from
    the Fisher information, and are widened by the scatter of the windows if the model can't explain the log.

    Args:
        model: A task, or a model file (MJCF or URDF) or MjSpec without a task.
        log: The log; ``docs/fitting.md`` describes its columns.
        parameters: What to fit: ``lw.Parameter`` or names such as "dof_damping.*_knee". The default is ``DEFAULT``.
        out: Folder for the results, as for ``lw.make(..., fitted=out)``.
        window: Seconds of a window; by default 0.25, or 0.1 if the robot's base moves, because contacts are chaotic.
        held_out: Share of the windows, at the end of the log, that is held back to measure errors of prediction.
        samples: Hypotheses per round of the search; 0 starts at the nominal values.
        iterations: Most Gauss-Newton steps.
        seed: Seed of the search and of the draws from the posterior.
        nthread: Threads; 0 means all cores.
        hangs: Whether the robot hung at a fixed base: the free joint is taken away.
        resume: Whether to continue a fit of the same problem in ``out``.
        progress: Called with "search", the round and the least cost, and then with "fit", the iteration and the step's
            root mean square in standard deviations of the parameters.
        options: Options and parameters of ``lw.make``, such as ``physics`` or ``timestep``.

    Raises:
        FileNotFoundError: The model or the log is missing.
        ValueError: The log does not fit the model, or an argument is invalid.
    """
    began = time.perf_counter()
    seed = whole_number("seed", seed, low=0)
    samples, iterations = whole_number("samples", samples, low=0), whole_number("iterations", iterations, low=1)
    held_out = finite_number("held_out", held_out, low=0.0, high=0.9)
    if resume and out is None:
        raise ValueError("resume=True needs the folder of the fit: pass it as out=...")
    name, compiled, controls = _compiled(model, options, hangs=hangs)
    moves = bool((compiled.jnt_type == mujoco.mjtJoint.mjJNT_FREE.value).any())
    window = positive_number("window", (0.1 if moves else 0.25) if window is None else window, "seconds")
    data = read_log(log, compiled, controls)
    if not any(column.field == "sensordata" for column in data.columns):
        compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    columns = [column.name for column in data.columns]
    wanted = [name for name in DEFAULT if _fits(name, compiled, columns)] if parameters is None else parameters
    bound = Parameters(wanted, compiled, columns)
    groups, usual = _noise(data, compiled)
    windows, predictor = cut_windows(data, bound, window), Predictor(data, bound, nthread=nthread)
    count = len(windows) - round(held_out * len(windows))
    blocks = np.arange(count) // _BLOCK
    problems = [LeastSquares(windows.chosen(np.flatnonzero(blocks % every == 0)), predictor, groups)
                for every in _LEVELS if every == 1 or (blocks % every == 0).sum() >= _FEWEST]  # fmt: skip
    report = progress or (lambda stage, iteration, cost: None)
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    if resume and folder is not None and (folder / "estimate.npz").is_file():
        at = _load(folder / "estimate.npz", problems)
    else:
        start = np.zeros(bound.size)
        if samples:
            few = np.unique(np.linspace(0, count - 1, 12).astype(int))
            coarse = LeastSquares(windows.chosen(few), predictor, {})
            start = search(coarse, 5.0 * usual, max(8, samples), seed, lambda k, cost: report("search", k, cost))
        at = problems[0].begin(start, usual)
    for problem in problems:
        linear, before = None, np.inf
        if len(problem.windows) < len(at.states):  # a level that was finished
            continue
        if len(problem.windows) > len(at.states):
            at = problem.begin(at.x, at.noise, spread=at.spread, rate=at.rate, iteration=at.iteration)
        limit = _CONVERGED / at.rate if problem is problems[-1] else _ROUGH
        while at.iteration < iterations and at.move >= limit:
            before, (at, linear) = at.move, problem.iterate(at)
            if folder is not None:
                with replaced(folder / "estimate.npz") as path, path.open("wb") as file:
                    np.savez(file, names=bound.names, begin=problem.windows.begin, **dataclasses.asdict(at))
            report("fit", at.iteration, at.move)
        if at.move and before < np.inf:
            at.rate = float(np.clip(at.move / before, 0.1, 1.0))
    linear = linear or problem.linearize(at)
    held = LeastSquares(windows.chosen(slice(count, None)), predictor, {}) if count < len(windows) else problem
    errors = [at.noise * held.residuals(held.begin(x, at.noise)) for x in (np.zeros(bound.size), at.x)]
    notes = [*data.notes]
    if held is problem:
        notes.append("no window was held back: errors of prediction are those of the fitted windows")
    notes += [
        f"the errors of {label} are {at.noise[i] / usual[i]:.1f} times a sensor's usual noise: the model lacks "
        "something, or the log has other units or another order"
        for label, (i, *_) in groups.items() if at.noise[i] > _LARGE * usual[i]
    ]  # fmt: skip
    covariance = problem.covariance(linear)
    result = _result(bound, covariance, at, linear, groups, errors, notes, time.perf_counter() - began, folder)
    if folder is not None:
        _write(folder, result, name, bound, covariance, at, seed)
        times = problem.windows.begin[:, None] + compiled.opt.timestep * problem.windows.time
        write_report(folder, result, name, times, problem.residuals(at), groups)
    return result


def _fits(name: str, model: mujoco.MjModel, columns: Sequence[str]) -> bool:
    try:
        Parameters([name], model, columns)
    except ValueError:
        return False
    return not name.startswith(("kp", "kd")) or bool((model.actuator_biasprm[:, 1] < 0.0).any())


def _compiled(model: Any, options: Mapping[str, Any], *, hangs: bool) -> tuple[str, mujoco.MjModel, Controls | None]:
    """Compile the model of a task or a file. The last result converts a task's actions to controls."""
    env_options, params = EnvOptions.split(options)
    controls: Controls | None = None
    if isinstance(model, mujoco.MjSpec | ModelFile) or str(model).lower().endswith((".xml", ".urdf", ".mjcf")):
        if params:
            raise ValueError(f"the option {min(params)!r} needs a task, and the model is a file: leave it out")
        spec, physics = load_spec(model), env_options.physics
        name = spec.modelname
    else:
        task = find_task(model)
        spec, physics = task_spec(task, env_options.model), env_options.physics.resolved(task.physics)
        name, controls = task.__name__, functools.partial(_controls, task, env_options, params)
    if hangs:
        for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
            spec.delete(joint)
        for key in list(spec.keys):  # keyframes have the coordinates of the free joint
            spec.delete(key)
    physics = dataclasses.replace(physics, discardvisual=True)
    compiled = compile_model(spec, ["sensordata"], physics, varied=MOVED_INERTIA)
    # finite differences of a solver that stops early are mostly noise
    compiled.opt.iterations = max(SOLVER_ITERATIONS, compiled.opt.iterations)
    compiled.opt.ls_iterations = max(SOLVER_ITERATIONS, compiled.opt.ls_iterations)
    if hangs:
        compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if compiled.nu == 0:
        raise ValueError(f"the model {name!r} has no actuators, so that controls can't move it: add actuators to it")
    if np.any(compiled.actuator_delay > 0.0):
        raise ValueError(f"the actuators of {name!r} have delays of their own: take them away, and fit 'delay.ctrl.*'")
    return name, compiled, controls


def _controls(task: type[Task], options: EnvOptions, params: Mapping[str, Any], actions: np.ndarray) -> np.ndarray:
    """Convert actions to controls by the task, as in worlds that were just reset."""
    env = Env(task, options.changed({"nworld": len(actions), "engine": "mujoco", "device": "cpu"}), params)
    if actions.shape[1] != env.action.shape[1]:
        raise ValueError(f"'action' has {actions.shape[1]} numbers per time, and the task's has {env.action.shape[1]}")
    for memory in env.lasting.values():
        memory.zero_()  # a startup's draws, such as errors of encoders, are not those of this robot
    env.reset()
    env.action.copy_(torch.as_tensor(actions))
    env.worlds.act()
    result: np.ndarray = env.field("ctrl").double().numpy().copy()
    return result


def _noise(log: Log, model: mujoco.MjModel) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Group the columns by kind of measurement, and get each column's first noise."""
    sensors = np.repeat(model.sensor_type, model.sensor_dim)
    names = {("sensordata", i): mujoco.mjtSensor(kind).name.removeprefix("mjSENS_").lower()
             for i, kind in enumerate(sensors)}  # fmt: skip
    for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        parts = {"qpos": ["position"] * 3 + ["rotation"] * 4, "qvel": ["velocity"] * 3 + ["angular velocity"] * 3}
        for field, start in (("qpos", model.jnt_qposadr[j]), ("qvel", model.jnt_dofadr[j])):
            names |= {(field, start + k): f"base {part}" for k, part in enumerate(parts[field])}
    kinds = np.array([names.get((column.field, column.index), column.field) for column in log.columns])
    groups = {str(kind): np.flatnonzero(kinds == kind) for kind in dict.fromkeys(kinds)}
    spread = np.nanstd(np.concatenate([take.measured for take in log.takes]), axis=0)
    return groups, np.array([_USUAL.get(k, _SHARE_OF_SIGNAL * spread[i]) for i, k in enumerate(kinds)])


def _result(
    bound: Parameters, covariance: np.ndarray, at: Estimate, linear: Linear, groups: Mapping[str, np.ndarray],
    errors: Sequence[np.ndarray], notes: Sequence[str], seconds: float, folder: Path | None,
) -> Fit:  # fmt: skip
    deviation = np.sqrt(np.diag(covariance))
    ends = [np.clip(at.x + sign * 1.96 * deviation, bound.low, bound.high) for sign in (0.0, -1.0, 1.0)]
    value, low, high = (np.array([c.value(x) for c, x in zip(bound.coordinates, end, strict=True)]) for end in ends)
    # in multiples of the priors, a direction of information 1 is known as well from the prior as from the log
    strength, vectors = np.linalg.eigh(bound.std[:, None] * linear.information.sum(axis=0) * bound.std)
    weak = vectors.T[1.0 / np.sqrt(np.maximum(strength, 0.0) + 1.0) > _KNOWN]
    directions = [{bound.names[i]: float(v[i]) for i in np.argsort(-np.abs(v)) if abs(v[i]) > 0.2} for v in weak]
    rms: dict[str, Any] = {
        label: tuple(float(np.sqrt(np.nanmean(e[..., group] ** 2))) for e in errors) for label, group in groups.items()
    }
    nominal, fitted = (float(np.sqrt(np.nanmean((e / at.noise) ** 2))) for e in errors)
    delay = bound.signals(at.x)["delay"]
    return Fit(
        bound.names, [c.kind for c in bound.coordinates], value, low, high, deviation < _KNOWN * bound.std, directions,
        covariance / np.outer(deviation, deviation), {k: float(at.noise[group[0]]) for k, group in groups.items()},
        rms, (nominal, fitted), bound.fields(at.x),
        {name: float(delay[i]) for name, i in bound.actuators.items() if delay[i] > 0.0}, notes, seconds, folder,
    )  # fmt: skip


def _write(
    folder: Path, result: Fit, name: str, bound: Parameters, covariance: np.ndarray, at: Estimate, seed: int
) -> None:
    """Write fit.json and draws.npz, which ``lw.make(..., fitted=...)`` reads."""
    xs = np.random.default_rng(seed).multivariate_normal(at.x, covariance, size=DRAWS, method="eigh")
    rows = [bound.fields(x) for x in np.clip(xs, bound.low, bound.high)]
    draws: dict[str, Any] = {f"{field}.{name}": np.array([row[field][name] for row in rows])
                             for field, parts in result.fields.items() for name in parts}  # fmt: skip
    content = {"format": FIT_FORMAT, "model": name} | {
        field.name: value.tolist() if isinstance(value := getattr(result, field.name), np.ndarray) else value
        for field in dataclasses.fields(result) if field.name not in ("folder", "correlation")
    }  # fmt: skip
    with replaced(folder / "draws.npz") as path, path.open("wb") as file:
        np.savez_compressed(file, **draws)
    with replaced(folder / "fit.json") as path:
        path.write_text(json.dumps(content, indent=1))


def _load(path: Path, problems: Sequence[LeastSquares]) -> Estimate:
    """Read the estimate of an unfinished fit."""
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    names, begin = arrays.pop("names").tolist(), arrays.pop("begin")
    if names != problems[0].parameters.names or not any(np.array_equal(begin, p.windows.begin) for p in problems):
        raise ValueError(f"{path} belongs to another log, model or parameters: choose another folder")
    return Estimate(**{key: value.item() if value.ndim == 0 else value for key, value in arrays.items()})
