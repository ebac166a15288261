"""Minimise the squared residuals of all windows over parameters and initial states."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lyceum_warp.fitting.windows import WORLDS, Predictor, Windows

_HUBER, _CUT = 3.0, 1e4
"""Residuals count linearly beyond the first multiple of the noise, and are cut at the second."""
_BAD, _POWER = 1.3, 3
"""A window whose cost exceeds the first multiple of the median counts less, by this power of the ratio."""
_STEPS, _PARAMETER_STEP = (1e-6, 2e-5, 1e-5), 1e-4
"""Finite differences of positions, velocities and activations, and of parameters in multiples of the prior."""
_MEMORIES = (0.015, 0.1, 0.5)
"""Seconds of memory of the simulations that guess the initial states."""
_JUMP, _CURVED = 0.003, 0.01
"""A prediction has jumped in a finite difference if the change by all differences together is not the sum of the single
changes, up to the first multiple of the noise and the second multiple of the sum of sizes. A few jumps would outweigh
all smooth changes, make steps much too short, and intervals too narrow."""
_START = (0.1, 1.0, 1.0)
"""Standard deviations of a step of the initial states, which keep unmeasured numbers where they are."""
_SETTLE = 4
"""Steps of the initial states alone, to predict windows with given parameters."""
_STEADY = 0.03
"""The noise is known if its logarithm changes less."""
_NEAR, _SLACK = 2.0, 1.01
"""Steps below the first multiple of a standard deviation are averaged, because contacts make each of them uncertain. A
step may increase the cost to the second multiple, because contacts change that, too."""
_SHIFTS = np.array([0.0, -0.3, -0.1, -0.03, 0.03, 0.1, 0.3])
"""Changes of a delay that are tried, in substeps. At whole substeps, the cost of stiff joints has ridges: the samples
after a step of the controls, which show the delay best, have other derivatives on the other side."""
_DRAWS = np.array([0.0] + 5 * [0.1, 0.3, 1.0])
"""Draws of initial states, in multiples of their posterior's deviation."""
_DAMPINGS, _STATE_DAMPINGS = (0.0, 0.1, 3.0, 100.0), (0.0, 1.0, 100.0)


@dataclasses.dataclass
class Estimate:
    """Parameters, initial states and noise at some iteration."""

    x: np.ndarray
    """Coordinates, (parameters,)."""
    states: np.ndarray
    """Initial states of the windows, (windows, nq + nv + na)."""
    noise: np.ndarray
    """Standard deviation of each column's noise, (columns,)."""
    move: float = np.inf
    """The last step's largest change of a parameter in standard deviations, divided by the root of the number of
    averaged steps; infinite while the noise is not known."""
    iteration: int = 0
    averaged: int = 0
    """Steps whose mean the parameters are."""


@dataclasses.dataclass(frozen=True)
class Linear:
    """The normal equations of each window, around an estimate."""

    residuals: np.ndarray
    """In multiples of the noise, (windows, samples, columns)."""
    cost: np.ndarray
    """Costs of the windows, (windows,)."""
    weight: np.ndarray
    """Weights of the windows, (windows,)."""
    a: np.ndarray
    """(windows, parameters, parameters)."""
    b: np.ndarray
    """(windows, parameters, nx)."""
    c: np.ndarray
    """(windows, nx, nx)."""
    by_x: np.ndarray
    """Gradients, (windows, parameters)."""
    by_state: np.ndarray
    """Gradients, (windows, nx)."""

    def reduced(self) -> tuple[np.ndarray, np.ndarray]:
        """Eliminate the initial states: each window's weighted gradient, and its Fisher information."""
        solved = np.linalg.solve(self.c, np.concatenate([self.b.swapaxes(1, 2), self.by_state[..., None]], axis=2))
        gradients = self.by_x - np.einsum("wpk,wk->wp", self.b, solved[..., -1])
        return self.weight[:, None] * gradients, self.weight[:, None, None] * (self.a - self.b @ solved[..., :-1])


class LeastSquares:
    """A problem of robust least squares with one initial state per window (multiple shooting).

    The initial states are eliminated from the normal equations window by window, so that a step costs
    1 + parameters + nx rollouts of the log, and about 20 more for the initial states after each step that is tried.

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
        self.seen = ~np.isnan(windows.measured)
        self.seen[..., [quat[-1] for quat in predictor.quats]] = False  # a rotation has three numbers

    def begin(self, x: np.ndarray, noise: np.ndarray) -> Estimate:
        """Start at parameters, and guess the initial states."""
        return self._guessed(Estimate(x, np.zeros((0, 0)), noise), [])[0]

    def linearize(self, at: Estimate) -> Linear:
        """Make the normal equations from finite differences, with one world for each number and window."""
        p, nx = self.parameters.size, self.predictor.nx
        eps = np.where(at.x >= self.parameters.high, -_PARAMETER_STEP, _PARAMETER_STEP) * self.parameters.std
        steps, both = np.concatenate([eps, self.steps]), np.array([[1.0], [-1.0]])
        moves = np.concatenate([np.zeros((1, p + nx)), np.diag(steps), both * steps])
        rows = self._rows(at, at.x + moves[:, :p], moves[None, :, p:])
        parts = [self._equations(part, at, steps) for part in rows]
        residuals, *blocks = (np.concatenate(part) for part in zip(*parts, strict=True))
        cost = self._costs(residuals[:, None], np.ones(len(at.noise)))[:, 0]
        return Linear(residuals, cost, self._weights(cost), *blocks)

    def _weights(self, cost: np.ndarray) -> np.ndarray:
        share = np.maximum(cost, 1e-9) / np.maximum(1, self.seen.sum(axis=(1, 2)))
        weights: np.ndarray = np.minimum(1.0, _BAD * np.median(share) / share) ** _POWER
        return weights

    def _equations(self, rows: np.ndarray, at: Estimate, steps: np.ndarray) -> tuple[np.ndarray, ...]:
        p, count, scale = self.parameters.size, len(rows), np.outer(steps, steps)
        base = np.clip(rows[:, 0] / at.noise, -_CUT, _CUT)
        with np.errstate(invalid="ignore"):
            change, together = np.split((rows[:, 1:] - rows[:, :1]) / at.noise, [len(steps)], axis=1)
            total, most = change.sum(axis=1), np.maximum(_JUMP, _CURVED * np.abs(change).sum(axis=1))
            smooth = (np.abs(together[:, 0] - total) < most) & (np.abs(together[:, 1] + total) < most)
        # a jump, such as a contact one substep later, has no derivative: the sample says nothing in this step
        jumps = ~smooth[:, None]
        jacobian, flat = np.where(jumps, 0.0, change).reshape(count, len(steps), -1), base.reshape(count, -1)
        weighted = jacobian * np.minimum(1.0, _HUBER / np.maximum(np.abs(flat), _HUBER))[:, None]
        square, gradient = weighted @ jacobian.swapaxes(1, 2) / scale, (weighted @ flat[..., None])[..., 0] / steps
        c = square[:, p:, p:] + np.diag(self.ridge)
        return base, square[:, :p, :p], square[:, :p, p:], c, gradient[:, :p], gradient[:, p:]

    def iterate(self, at: Estimate) -> Estimate:
        """Shift the delays, take a damped Gauss-Newton step, and estimate the noise for the next one."""
        at = self._shifted(at)
        linear = self.linearize(at)
        cost, noise = linear.weight @ linear.cost + self.prior(at.x[None])[0], self._noise(at, linear)
        steady = np.abs(np.log(noise / at.noise)).max() < _STEADY
        prior, (gradient, information) = self.parameters.std**-2.0, (part.sum(axis=0) for part in linear.reduced())
        gradient, information = gradient + prior * at.x, information + np.diag(prior)
        deviation = np.sqrt(np.diag(np.linalg.inv(information)))
        steps = [self._step(at.x, gradient, information, damping) for damping in _DAMPINGS]
        near = steady and np.max(np.abs(steps[0]) / deviation) < _NEAR
        result, move, averaged = at, 0.0, at.averaged + 1 if near else 0
        for step in steps:
            x = at.x + step / max(1, averaged)
            trial, costs = self._guessed(dataclasses.replace(at, x=x), [self._settled(at, linear, x)])
            if linear.weight @ costs + self.prior(x[None])[0] < _SLACK * cost:
                result, move = trial, float(np.max(np.abs(step) / deviation)) / max(1, averaged) ** 0.5
                break
        move, iteration = move if steady else np.inf, at.iteration + 1
        return dataclasses.replace(result, noise=noise, move=move, iteration=iteration, averaged=averaged)

    def _shifted(self, at: Estimate) -> Estimate:
        """Move each delay to another side of a ridge if the cost is clearly lower there."""
        for i in [i for i, c in enumerate(self.parameters.coordinates) if c.kind == "delay"]:
            xs = np.tile(at.x, (len(_SHIFTS), 1))
            xs[:, i] += _SHIFTS * self.predictor.model.opt.timestep
            xs = np.clip(xs, self.parameters.low, self.parameters.high)
            costs = self.costs(at, xs, np.zeros((1, len(xs), self.predictor.nx)))
            total = self._weights(costs[:, 0]) @ costs + self.prior(xs)
            if _SLACK * total.min() < total[0]:
                at = dataclasses.replace(at, x=xs[total.argmin()], averaged=0)
        return at

    def _guessed(self, at: Estimate, states: Sequence[np.ndarray]) -> tuple[Estimate, np.ndarray]:
        """Choose each window's best initial state among the given ones and guesses; return the windows' costs, too."""
        guesses = np.stack([*states, *self.predictor.track(self.windows, at.x, _MEMORIES)])
        none, trials = np.zeros((1, 1, self.predictor.nx)), [dataclasses.replace(at, states=s) for s in guesses]
        costs = np.concatenate([self.costs(trial, at.x[None], none) for trial in trials], axis=1).T
        best = guesses[costs.argmin(axis=0), np.arange(len(self.windows))]
        return dataclasses.replace(at, states=best), costs.min(axis=0)

    def _settled(self, at: Estimate, linear: Linear, x: np.ndarray) -> np.ndarray:
        """Move the initial states with the parameters, each by its own best damping and best draw of its posterior.

        One bad contact must not stop the other windows, and beside a contact only a draw finds the way.
        """
        gradient = (linear.by_state + np.einsum("wpk,p->wk", linear.b, x - at.x))[..., None]
        diagonal = np.eye(linear.c.shape[1]) * linear.c
        steps = [-np.linalg.solve(linear.c + mu * diagonal, gradient)[..., 0] for mu in _STATE_DAMPINGS]
        best = self._best(at, x, np.stack([*steps, np.zeros_like(steps[0])], axis=1))
        draws = np.random.default_rng(at.iteration).standard_normal((*best.shape, len(_DRAWS))) * _DRAWS
        spread = np.linalg.cholesky(np.linalg.inv(linear.c)) @ draws
        changes = self._best(at, x, best[:, None] + spread.swapaxes(1, 2))
        return self.predictor.moved(at.states, changes)

    def _best(self, at: Estimate, x: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Choose each window's best change of its initial state among (windows, changes, nx)."""
        costs = self.costs(at, np.tile(x, (changes.shape[1], 1)), changes)
        result: np.ndarray = changes[np.arange(len(changes)), costs.argmin(axis=1)]
        return result

    def prediction(self, x: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Compute residuals with given parameters, after an estimate of the initial states alone."""
        at = self.begin(x, noise)
        for _ in range(_SETTLE):
            at = dataclasses.replace(at, states=self._settled(at, self.linearize(at), x))
        none = np.zeros((1, 1, self.predictor.nx))
        rows = np.concatenate([rows[:, 0] for rows in self._rows(at, x[None], none)])
        return np.where(self.seen, np.clip(rows / noise, -_CUT, _CUT) * noise, np.nan)

    def costs(self, at: Estimate, xs: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Compute half the robust sum of squares of each window under hypotheses, (windows, hypotheses)."""
        return np.concatenate([self._costs(rows, at.noise) for rows in self._rows(at, xs, changes)])

    def _costs(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        scaled = np.minimum(np.abs(rows) / noise, _CUT)
        total: np.ndarray = np.where(scaled < _HUBER, 0.5 * scaled**2, _HUBER * (scaled - 0.5 * _HUBER)).sum((2, 3))
        return total

    def _rows(self, at: Estimate, xs: np.ndarray, changes: np.ndarray) -> Any:
        """Yield the residuals of some windows at a time."""
        group = max(1, WORLDS // len(xs))
        for begin in range(0, len(self.windows), group):
            part = slice(begin, begin + group)
            shift = changes if len(changes) == 1 else changes[part]
            yield self.predictor.predict(self.windows.chosen(part), at.states[part], xs, shift)

    def prior(self, xs: np.ndarray) -> np.ndarray:
        """Compute minus the logarithm of the prior of hypotheses, (hypotheses,)."""
        total: np.ndarray = 0.5 * ((xs / self.parameters.std) ** 2).sum(axis=1)
        return total

    def covariance(self, linear: Linear) -> np.ndarray:
        """Compute the covariance of the posterior.

        If the residuals of a window have a common cause, such as wrong contacts, the curvature promises too much. The
        scatter of the windows then widens the intervals: the changes of the fit without each window (the jackknife).
        """
        gradients, informations = linear.reduced()
        prior, (count, p) = np.diag(self.parameters.std**-2.0), gradients.shape
        inverse = np.linalg.inv(informations.sum(axis=0) + prior)
        changes = np.linalg.solve(np.eye(p) - informations @ inverse, gradients[..., None])[..., 0] @ inverse
        variance = (changes**2).sum(axis=0) + np.diag(inverse @ prior @ inverse)
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

    def _noise(self, at: Estimate, linear: Linear) -> np.ndarray:
        """Estimate the noise of each group of columns from the median of the residuals."""
        noise, count = at.noise.copy(), len(linear.b) * linear.b.shape[2] + len(at.x)
        free = max(0.1, 1.0 - count / self.seen.sum())  # what parameters and initial states leave of the errors
        for group in self.groups.values():
            sizes = np.abs(linear.residuals[..., group][self.seen[..., group]])
            noise[group] *= max(1e-6, float(np.median(sizes)) / 0.6745 / np.sqrt(free))
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
    mean, std, none = at.x, parameters.std.copy(), np.zeros((1, samples, problem.predictor.nx))
    best = at.x
    for number in range(5):
        xs = np.clip(mean + std * rng.standard_normal((samples, len(mean))), parameters.low, parameters.high)
        xs[0] = best
        costs = problem.costs(at, xs, none).sum(axis=0) + problem.prior(xs)
        elites = xs[np.argsort(costs)[: max(4, samples // 10)]]
        best, mean, std = elites[0], elites.mean(axis=0), np.maximum(elites.std(axis=0), 0.02 * parameters.std)
        report(number, float(costs.min()))
    return best
