"""Fit parameters by ``mujoco.sysid``, for comparison."""

import contextlib
import io
import os
import time
from collections.abc import Callable
from typing import Any

import experiment
import mujoco.rollout
import numpy as np
from experiment import Skipped

from lyceum_warp.fitting.parameters import Parameters

WIDEST = 3.0
"""Bound of parameters that have none, because the optimizer scales its steps by the bounds."""


def fit(
    bound: Parameters,
    controls: Callable[[float], np.ndarray],
    states: np.ndarray,
    noise: np.ndarray,
    steps: int,
) -> dict[str, Any]:
    """Fit parameters to a log with one row for each substep of the model.

    Roll-outs begin at measured states, which ``mujoco.sysid`` takes as exact. What it leaves to its users is that of
    ``lw.fit``: coordinates, models that are not compiled again, and delays of controls. Residuals are multiples of the
    true noise.

    Args:
        bound: The parameters.
        controls: The controls of all substeps, (rows, nu), for a delay in seconds.
        states: Measured positions and velocities, (rows, nq + nv).
        noise: Their standard deviations, (nq + nv,).
        steps: Substeps of a roll-out.
    """
    sysid: Any = experiment.installed("mujoco.sysid", "mujoco[sysid]")
    if not hasattr(sysid, "optimize"):  # the package hides which of its requirements is missing
        raise Skipped("mujoco.sysid lacks packages: pip install mujoco[sysid]")
    threads = len(os.sched_getaffinity(0))
    wall, cpu, model = time.perf_counter(), time.process_time(), bound.nominal
    series, times, starts = sysid.TimeSeries, model.opt.timestep * np.arange(steps + 1), []
    for begin in range(0, len(states) - steps, steps):
        rows = states[begin : begin + steps + 1]
        first = sysid.create_initial_state(model, rows[0, : model.nq], rows[0, model.nq :])
        # the roll-out below has controls of its own
        empty = series(times, np.zeros((steps + 1, model.nu)))
        starts.append(sysid.SystemTrajectory(model, empty, series(times, rows), first, None))

    def rolled(models: Any, datas: Any, initial_states: Any, param_dicts: Any, **_: Any) -> list[Any]:
        delays = [bound.signals(params.as_vector())["delay"][0] for params in param_dicts]
        cut = np.concatenate(
            [controls(delay)[: len(starts) * steps].reshape(len(starts), steps, -1) for delay in delays]
        )
        rows, _ = mujoco.rollout.rollout(models, datas, np.stack(initial_states), cut)
        return [
            sysid.SystemTrajectory(m, None, None, first, series(times[1:], row))
            for m, first, row in zip(models, initial_states, rows, strict=True)
        ]

    def errors(_params: Any, _predicted: Any, measured: Any, _model: Any, _all: bool, *, state: np.ndarray) -> Any:
        return np.clip((state[:, 1 : 1 + len(noise)] - measured.data[1:]) / noise, -1e4, 1e4), measured, measured

    def residual(x: np.ndarray, params: Any) -> tuple[list[np.ndarray], None, None]:
        residuals, _, _ = sysid.model_residual(
            x, params, lambda params: bound.model(params.as_vector()), starts, errors, rolled, threads,
            resample_true=False,
        )  # fmt: skip
        if x.ndim == 2:  # one column for each roll-out of each hypothesis
            residuals = residuals.reshape(-1, x.shape[1], len(starts)).transpose(2, 0, 1).reshape(-1, x.shape[1])
        return [np.nan_to_num(residuals, nan=1e4)], None, None

    params = sysid.ParameterDict()
    low, high = np.maximum(bound.low, -WIDEST), np.minimum(bound.high, WIDEST)
    params.add(sysid.Parameter("x", np.zeros(bound.size), low, high))
    params.move_off_bounds()
    with contextlib.redirect_stdout(io.StringIO()):  # its steps
        params, result = sysid.optimize(params, residual, verbose=False, x_scale="jac")
    x = params.as_vector()
    _, half = sysid.calculate_intervals(residual(x, params)[0], result.jac)
    used = {"cpu_seconds": time.process_time() - cpu, "wall_seconds": time.perf_counter() - wall}
    return {"value": x, "low": x - half, "high": x + half, **used}
