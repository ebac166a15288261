"""Implement MPPI, CEM and predictive sampling in NumPy, directly from their definitions."""

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import torch

import lyceum_warp as lw


def smoothed(noise: np.ndarray, betas: tuple[float, ...]) -> np.ndarray:
    """Apply a smoothing filter over time to noise of shape (horizon, ...).

    From the third step on, each step is mixed with the previous two.
    """
    result = noise.copy()
    for t in range(2, len(noise)):
        result[t] = betas[0] * noise[t] + betas[1] * result[t - 1] + betas[2] * result[t - 2]
    return result


def hermite(before: Any, left: Any, right: Any, after: Any, f: float) -> Any:
    """Evaluate a cubic Hermite spline with slopes from central differences."""
    slopes = (right - before) / 2, (after - left) / 2
    basis = 2 * f**3 - 3 * f**2 + 1, f**3 - 2 * f**2 + f, -2 * f**3 + 3 * f**2, f**3 - f**2
    return basis[0] * left + basis[1] * slopes[0] + basis[2] * right + basis[3] * slopes[1]


class Grid:
    """A grid of knots at fixed times. With K knots over H steps, knot j is at step j H / K."""

    def __init__(self, horizon: int, knots: int, spline: str) -> None:
        self.horizon, self.distance, self.spline, self.now = horizon, Fraction(horizon, knots), spline, 0

    def first(self) -> int:
        """Return the index of the first knot on which the plan depends."""
        return self.now // self.distance - (self.spline == "cubic")

    def actions(self, knots: np.ndarray) -> np.ndarray:
        """Interpolate the actions of all steps. The first row of ``knots`` (n, ...) is the knot with the index
        ``first()``."""
        result = []
        for t in range(self.horizon):
            place = (self.now + t) / self.distance
            j, f = place // 1 - self.first(), float(place % 1)
            if self.spline == "zero":
                result.append(knots[j])
            elif self.spline == "linear":
                result.append((1 - f) * knots[j] + f * knots[j + 1] if f else knots[j])
            else:
                result.append(hermite(*knots[j - 1 : j + 3], f))
        return np.array(result)


class Plain:
    """A planner in float64 that follows the definitions. The caller passes the standard normal numbers.

    Args:
        knots: Number of knots over the horizon. With None, the noise of each step is independent.
        count: Number of knots in a plan.
        fields: Model fields by name, (models, size). World i uses row i modulo the number of models.
    """

    def __init__(
        self,
        task: str,
        *,
        engine: str,
        horizon: int,
        samples: int,
        temperature: float,
        noise: Any,
        smoothing: tuple[float, ...] = (0.25, 0.8, 0.0),
        discount: float = 1.0,
        fill: Any = "zero",
        termination: str = "stop",
        value: Callable[[torch.Tensor], torch.Tensor] | None = None,
        update: str = "mppi",
        elites: int = 1,
        min_noise: Any = 0.0,
        include_plan: bool | None = None,
        knots: int | None = None,
        spline: str = "cubic",
        count: int | None = None,
        fields: dict[str, np.ndarray] | None = None,
        risk: str = "mean",
        **options: Any,
    ) -> None:
        self.fields = fields or {}
        self.models = max([len(rows) for rows in self.fields.values()], default=1)
        nworld = samples * self.models
        self.env = lw.make(task, engine=engine, nworld=nworld, autoreset=False, horizon=0, **options)
        self.low, self.high = self.env.action_space.low, self.env.action_space.high
        nu = len(self.low)
        array = np.asarray(noise, dtype=float)
        self.factor = np.linalg.cholesky(array) if array.ndim == 2 else np.diag(np.broadcast_to(array, nu))
        self.temperature, self.smoothing, self.discount = temperature, smoothing, discount
        self.stop, self.value, self.repeat = termination == "stop", value, isinstance(fill, str) and fill == "repeat"
        self.fill = np.zeros(nu) if isinstance(fill, str) else np.asarray(fill, dtype=float)
        self.update, self.elites, self.min_noise, self.risk = update, elites, min_noise, risk
        self.include_plan = update != "cem" if include_plan is None else include_plan
        self.grid = None if knots is None else Grid(horizon, knots, spline)
        if self.grid:
            self.smoothing = (1.0, 0.0, 0.0)
        self.knots = np.tile(np.clip(self.fill, self.low, self.high), (count or horizon, 1))
        self.deviation = np.tile(np.diag(self.factor), (len(self.knots), 1))
        # the standard deviation of smoothed noise, computed from the impulse response
        self.spread = np.sqrt((smoothed(np.eye(len(self.knots)), self.smoothing) ** 2).sum(1))[:, None]

    @property
    def actions(self) -> np.ndarray:
        return self.interpolated(self.knots)

    def interpolated(self, knots: np.ndarray) -> np.ndarray:
        return knots if self.grid is None else np.clip(self.grid.actions(knots), self.low, self.high)

    def __call__(self, state: torch.Tensor, noises: list[np.ndarray], shift: int = 1) -> None:
        passed = shift
        if self.grid is not None:
            before = self.grid.first()
            self.grid.now += shift
            passed = self.grid.first() - before
        for _ in range(passed):
            last = self.knots[-1] if self.repeat else np.clip(self.fill, self.low, self.high)
            self.knots = np.vstack([self.knots[1:], last])
            self.deviation = np.vstack([self.deviation[1:], np.diag(self.factor)])
        for z in noises:
            self.improve(state, z)

    def improve(self, state: torch.Tensor, z: np.ndarray) -> None:
        if self.update == "cem":
            noise = self.deviation[:, None] * smoothed(z, self.smoothing)
        else:
            noise = smoothed(np.einsum("ij,tkj->tki", self.factor, z), self.smoothing)
        if self.include_plan:
            noise[:, 0] = 0
        drawn = np.clip(self.knots[:, None] + noise, self.low, self.high)
        self.sampled = self.interpolated(drawn)
        rewards, ended, values = self.roll_out(state)
        returns = self.add_up(rewards, ended, values).reshape(-1, self.models)
        self.returns = returns.min(1) if self.risk == "worst" else returns.mean(1)
        best = np.argsort(-self.returns, kind="stable")
        if self.update == "mppi":
            weights = np.exp((self.returns - self.returns.max()) / self.temperature)
        else:
            weights = np.zeros(len(self.returns))
            weights[best[: self.elites if self.update == "cem" else 1]] = 1
        self.weights = weights / weights.sum()
        self.knots = np.einsum("k,tki->ti", self.weights, drawn)
        if self.update == "cem":
            fitted = drawn[:, best[: self.elites]].std(axis=1) / self.spread
            self.deviation = np.maximum(fitted, self.min_noise)

    def add_up(self, rewards: np.ndarray, ended: np.ndarray, values: np.ndarray) -> np.ndarray:
        result = np.zeros(rewards.shape[1])
        for k in range(len(result)):
            weight, going = 1.0, True
            for reward, end in zip(rewards[:, k], ended[:, k], strict=True):
                if going:
                    result[k] += weight * reward
                    weight *= self.discount
                    going = not (self.stop and end)
            if going:
                result[k] += weight * values[k]
        return result

    def roll_out(self, state: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        env = self.env
        states = state.repeat(env.nworld, 1)
        for name, rows in self.fields.items():
            states[:, env.state_space.parts[name]] = torch.as_tensor(np.tile(rows, (env.nworld // len(rows), 1)))
        env.set_state(states)
        rewards, ended = np.zeros((2, len(self.sampled), env.nworld))
        for t, actions in enumerate(np.repeat(self.sampled, self.models, axis=1)):
            env.step(torch.as_tensor(actions, dtype=torch.float32))
            rewards[t], ended[t] = env.reward.numpy(), env.terminated.numpy()
        self.ended = ended
        return rewards, ended, np.zeros(env.nworld) if self.value is None else self.value(env.obs).numpy()
