"""Minimise the squared residuals of all windows over parameters and initial states."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from lyceum_warp.fitting.windows import WORLDS, Predictor, Windows

_HUBER, _CUT = 3.0, 1e4
"""Residuals count linearly beyond the first multiple of the noise, and are cut at the second."""
_BAD, _POWER = 1.3, 3
"""A window whose cost exceeds the first multiple of the median counts less, by this power of the ratio."""
_STEPS, _WIDEST, _SPARE, _FEWEST = (1e-5, 5e-4, 5e-5), 0.1, 3, 32
"""Finite differences of positions, velocities and activations; the largest ones of parameters in multiples of the
prior; worlds beyond the fewest that give all derivatives; and the fewest that average jumps."""
_MEMORY = 0.1
"""Seconds of memory of the simulation that guesses the initial states."""
_START = (0.1, 1.0, 1.0)
"""Standard deviations of a step of the initial states, which keep unmeasured numbers where they are."""
_STEADY = 0.1
"""The noise is known if its logarithm changes less."""
_SLACK = 1.01
"""A step may increase the cost to this multiple, because contacts change it, too."""
_DAMPINGS, _STATE_DAMPINGS = (0.0, 0.1, 3.0, 100.0), (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


@dataclasses.dataclass
class Estimate:
    """Parameters, initial states and noise at some iteration."""

    x: np.ndarray
    """Coordinates, (parameters,)."""
    states: np.ndarray
    """Initial states of the windows, (windows, nq + nv + na)."""
    noise: np.ndarray
    """Standard deviation of each column's noise, (columns,)."""
    spread: np.ndarray
    """A root of the parameters' covariance, (parameters, parameters)."""
    move: float = np.inf
    """Root mean square of the last Gauss-Newton step in standard deviations; infinite while the noise is not known."""
    rate: float = 1.0
    """About the share of a step that is left after it."""
    iteration: int = 0


@dataclasses.dataclass(frozen=True)
class Linear:
    """The normal equations of each window, around an estimate."""

    cost: np.ndarray
    """Costs of the windows, (windows,)."""
    weight: np.ndarray
    """Weights of the windows, (windows,)."""
    gradient: np.ndarray
    """Weighted, after elimination of the initial states, (windows, parameters)."""
    information: np.ndarray
    """Weighted Fisher information after elimination of the initial states, (windows, parameters, parameters)."""
    b: np.ndarray
    """(windows, parameters, nx)."""
    c: np.ndarray
    """(windows, nx, nx)."""
    by_state: np.ndarray
    """Gradients, (windows, nx)."""


class LeastSquares:
    """A problem of robust least squares with one initial state per window (multiple shooting).

    The initial states are eliminated from the normal equations window by window, so that a step costs
    5 + parameters + nx rollouts of the log, and about 15 more for the initial states after each step that is tried.

    Args:
        windows: The windows.
        predictor: Predicts them.
        groups: Groups of columns whose noise is estimated.
    """

    def __init__(self, windows: Windows, predictor: Predictor, groups: Mapping[str, np.ndarray]) -> None:
        self.windows, self.predictor, self.groups = windows, predictor, groups
        self.parameters, model = predictor.parameters, predictor.model
        sizes = (model.nv, model.nv, model.na)
        self.steps, self.ridge = np.repeat(_STEPS, sizes), np.repeat(_START, sizes) ** -2.0
        self.precision = self.parameters.std**-2.0
        self.seen = ~np.isnan(windows.measured)
        self.seen[..., [quat[-1] for quat in predictor.quats]] = False  # a rotation has three numbers

    def begin(self, x: np.ndarray, noise: np.ndarray, **more: Any) -> Estimate:
        """Start at parameters, and estimate the initial states."""
        more = {"spread": np.diag(_WIDEST * self.parameters.std)} | more
        at = self._joined(Estimate(x, self.predictor.track(self.windows, x, _MEMORY), noise, **more))[0]
        return self._settled(at, self.linearize(at, fixed=True), np.zeros(len(x)))[0]

    def linearize(self, at: Estimate, *, fixed: bool = False) -> Linear:
        """Make the normal equations from finite differences, with one world for each number and window.

        With ``fixed``, they are those of the initial states alone.
        """
        p = 0 if fixed else len(at.x)
        spread = np.diag(np.concatenate([np.zeros(p), self.steps]))
        spread[:p, :p] = at.spread[:p, :p]
        count = max(_FEWEST, 1 + len(spread) + _SPARE)
        # every world changes all numbers, in orthogonal directions: where a contact begins one substep later, the
        # prediction jumps, and the derivative by one number alone would be the jump
        normal = np.random.default_rng(at.iteration).standard_normal((count, count))
        normal[:, 0] = 1.0
        moves = np.sqrt(count) * np.linalg.qr(normal)[0][:, 1 : 1 + len(spread)] @ spread.T
        xs = np.tile(at.x, (1 + count, 1))
        xs[1:, :p] = np.clip(at.x[:p] + moves[:, :p], self.parameters.low[:p], self.parameters.high[:p])
        moves[:, :p] = xs[1:, :p] - at.x[:p]
        changes, units = np.concatenate([np.zeros((1, len(self.steps))), moves[:, p:]]), np.abs(moves).max(axis=0)
        inverse = np.linalg.pinv(np.column_stack([np.ones(count), moves / units]))[1:] / units[:, None]
        parts = [self._equations(rows, at, inverse, p) for rows, _ in self._rows(at, xs=xs, changes=changes[None])]
        cost, a, b, c, by_x, by_state = (np.concatenate(part) for part in zip(*parts, strict=True))
        share = np.maximum(cost, 1e-9) / np.maximum(1, self.seen.sum(axis=(1, 2)))
        weight = np.minimum(1.0, _BAD * np.median(share) / share) ** _POWER
        solved = np.linalg.solve(c, np.concatenate([b.swapaxes(1, 2), by_state[..., None]], axis=2))
        gradient = weight[:, None] * (by_x - np.einsum("wpk,wk->wp", b, solved[..., -1]))
        return Linear(cost, weight, gradient, weight[:, None, None] * (a - b @ solved[..., :-1]), b, c, by_state)

    def _equations(self, rows: np.ndarray, at: Estimate, inverse: np.ndarray, p: int) -> tuple[np.ndarray, ...]:
        scaled = np.clip(rows / at.noise, -_CUT, _CUT)
        flat = scaled[:, 0].reshape(len(rows), -1)
        jacobian = inverse @ (scaled[:, 1:] - scaled[:, :1]).reshape(len(rows), inverse.shape[1], -1)
        weighted = jacobian * np.minimum(1.0, _HUBER / np.maximum(np.abs(flat), _HUBER))[:, None]
        square, gradient = weighted @ jacobian.swapaxes(1, 2), (weighted @ flat[..., None])[..., 0]
        a, b, c = square[:, :p, :p], square[:, :p, p:], square[:, p:, p:] + np.diag(self.ridge)
        return self._costs(rows[:, :1], at.noise)[:, 0], a, b, c, gradient[:, :p], gradient[:, p:]

    def normal(self, x: np.ndarray, linear: Linear) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Add the prior: the gradient, the information, and a root of the covariance for finite differences."""
        gradient, information = linear.gradient.sum(axis=0), linear.information.sum(axis=0)
        wide = np.linalg.inv(information + np.diag(self.precision / _WIDEST**2))
        return gradient + self.precision * x, information + np.diag(self.precision), np.linalg.cholesky(wide)

    def iterate(self, at: Estimate) -> tuple[Estimate, Linear]:
        """Take a damped Gauss-Newton step, and estimate the noise for the next one."""
        linear = self.linearize(at)
        cost = linear.weight @ linear.cost + self.prior(at.x)
        gradient, information, spread = self.normal(at.x, linear)
        steps = [self._step(at.x, gradient, information, damping) for damping in _DAMPINGS]
        result, move = at, 0.0
        for step in steps:
            trial, costs = self._settled(at, linear, step)
            if linear.weight @ costs + self.prior(trial.x) < _SLACK * cost:
                result, move = trial, float(np.sqrt(steps[0] @ information @ steps[0] / len(at.x)))
                break
        noise = self._noise(result)
        move = move if np.abs(np.log(noise / at.noise)).max() < _STEADY else np.inf
        return dataclasses.replace(result, noise=noise, spread=spread, move=move, iteration=at.iteration + 1), linear

    def _settled(self, at: Estimate, linear: Linear, step: np.ndarray) -> tuple[Estimate, np.ndarray]:
        """Move the initial states with a step of the parameters; return the windows' costs, too.

        Each has its own best damping, because one bad contact must not stop the other windows.
        """
        gradient = linear.by_state + np.einsum("wpk,p->wk", linear.b, step[: linear.b.shape[1]])
        diagonal = np.eye(linear.c.shape[1]) * linear.c
        steps = [-np.linalg.solve(linear.c + mu * diagonal, gradient[..., None])[..., 0] for mu in _STATE_DAMPINGS]
        changes = np.stack([*steps, np.zeros_like(gradient)], axis=1)
        at = dataclasses.replace(at, x=at.x + step)
        best = self.judged(at, xs=np.tile(at.x, (changes.shape[1], 1)), changes=changes)[0].argmin(axis=1)
        states = self.predictor.moved(at.states, changes[np.arange(len(changes)), best])
        return self._joined(dataclasses.replace(at, states=states))

    def _joined(self, at: Estimate) -> tuple[Estimate, np.ndarray]:
        """Begin windows where the ones before them end, if this predicts them better; return the windows' costs, too.

        A state that follows from other measurements obeys the contacts, and has little of the sensors' noise.
        """
        states, (costs, ends) = at.states.copy(), self.judged(at)
        which = np.flatnonzero(self.windows.follows)
        while len(which):
            trial = dataclasses.replace(at, states=ends[which - 1])
            trial_costs, trial_ends = self.judged(trial, which)
            better = trial_costs[:, 0] < costs[which, 0]
            which = which[better]
            states[which], costs[which], ends[which] = trial.states[better], trial_costs[better], trial_ends[better]
            which = np.flatnonzero(self.windows.follows & np.isin(np.arange(len(costs)) - 1, which))
        return dataclasses.replace(at, states=states), costs[:, 0]

    def judged(self, at: Estimate, which: Any = slice(None), **more: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute costs under hypotheses, half the robust sums of squares, (windows, hypotheses), and last states."""
        parts = [(self._costs(rows, at.noise), ends) for rows, ends in self._rows(at, which, **more)]
        costs, ends = (np.concatenate(part) for part in zip(*parts, strict=True))
        return costs, ends

    def residuals(self, at: Estimate) -> np.ndarray:
        """Compute residuals in multiples of the noise, (windows, samples, columns)."""
        rows = np.concatenate([rows[:, 0] for rows, _ in self._rows(at)])
        return np.where(self.seen, np.clip(rows / at.noise, -_CUT, _CUT), np.nan)

    def _costs(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        scaled = np.minimum(np.abs(rows) / noise, _CUT)
        total: np.ndarray = np.where(scaled < _HUBER, 0.5 * scaled**2, _HUBER * (scaled - 0.5 * _HUBER)).sum((2, 3))
        return total

    def _rows(
        self, at: Estimate, which: Any = slice(None), *, xs: np.ndarray | None = None, changes: np.ndarray | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the residuals and the last states of some windows at a time."""
        windows, xs = self.windows.chosen(which), at.x[None] if xs is None else xs
        changes = np.zeros((1, len(xs), self.predictor.nx)) if changes is None else changes
        group = max(1, WORLDS // len(xs))
        for begin in range(0, len(windows), group):
            part = slice(begin, begin + group)
            shift = changes if len(changes) == 1 else changes[part]
            yield self.predictor.predict(windows.chosen(part), at.states[part], xs, shift)

    def prior(self, x: np.ndarray) -> Any:
        """Compute minus the logarithm of the prior of hypotheses."""
        return 0.5 * (x**2 @ self.precision)

    def covariance(self, linear: Linear) -> np.ndarray:
        """Compute the covariance of the posterior.

        If the residuals of a window have a common cause, such as wrong contacts, the curvature promises too much. The
        scatter of the windows then widens the intervals: the changes of the fit without each window (the jackknife).
        """
        prior, (count, p) = np.diag(self.precision), linear.gradient.shape
        inverse = np.linalg.inv(linear.information.sum(axis=0) + prior)
        left = np.eye(p) - linear.information @ inverse
        changes = np.linalg.solve(left, linear.gradient[..., None])[..., 0] @ inverse
        variance = count * changes.var(axis=0) + np.diag(inverse @ prior @ inverse)
        scale = np.sqrt(np.maximum(1.0, variance / np.diag(inverse)))
        covariance: np.ndarray = scale[:, None] * inverse * scale if count >= 2 * p else inverse
        return covariance

    def _step(self, x: np.ndarray, gradient: np.ndarray, information: np.ndarray, damping: float) -> np.ndarray:
        """Solve the damped normal equations of the parameters within their bounds."""
        low, high = self.parameters.low, self.parameters.high
        free = ((x > low) | (gradient <= 0.0)) & ((x < high) | (gradient >= 0.0))
        whole = np.where(np.outer(free, free), information, 0.0)
        whole[np.diag_indices(len(x))] = np.where(free, (1.0 + damping) * np.diag(information), 1.0)
        step: np.ndarray = np.clip(x - np.linalg.solve(whole, free * gradient), low, high) - x
        return step

    def _noise(self, at: Estimate) -> np.ndarray:
        """Estimate the noise of each group of columns from the median of the residuals."""
        noise, residuals = at.noise.copy(), np.abs(self.residuals(at))
        count = len(self.windows) * self.predictor.nx + len(at.x)
        free = max(0.1, 1.0 - count / self.seen.sum())  # what parameters and initial states leave of the errors
        for group in self.groups.values():
            noise[group] *= max(1e-6, float(np.nanmedian(residuals[..., group])) / 0.6745 / np.sqrt(free))
        return noise


def search(
    problem: LeastSquares, noise: np.ndarray, samples: int, seed: int, report: Callable[[int, float], Any]
) -> np.ndarray:
    """Search all parameters by the cross-entropy method.

    Each of five rounds draws hypotheses from a normal distribution, at first the prior, and fits the distribution to
    the best tenth.
    """
    rng, parameters = np.random.default_rng(seed), problem.parameters
    at = problem.begin(np.zeros(parameters.size), noise)
    mean, std, best = at.x, parameters.std.copy(), at.x
    for number in range(5):
        xs = np.clip(mean + std * rng.standard_normal((samples, len(mean))), parameters.low, parameters.high)
        xs[0] = best
        costs = problem.judged(at, xs=xs)[0].sum(axis=0) + problem.prior(xs)
        elites = xs[np.argsort(costs)[: max(4, samples // 10)]]
        best, mean, std = elites[0], elites.mean(axis=0), np.maximum(elites.std(axis=0), 0.02 * parameters.std)
        report(number, float(costs.min()))
    return best
