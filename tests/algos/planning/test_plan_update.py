import math
from typing import Any

import pytest
import torch
from rail_task import Picky

import lyceum_warp as lw
from lyceum_warp.algos.planning.updates import CrossEntropy, SampleWeights, spread

POINT: dict[str, Any] = dict(task="point_mass", horizon=6, samples=12, noise=1.0, seed=3)


class EliteMean(lw.PlanUpdate):
    """Replace the plan with the mean of the best samples, and leave the noise unchanged."""

    def __init__(self, elites: int) -> None:
        self.elites = elites

    def weigh(self, samples: lw.PlanSamples) -> None:
        best = samples.returns.topk(self.elites)
        good = (best.values > -torch.inf).float()
        samples.weights.zero_().scatter_(1, best.indices, good / good.sum(1, keepdim=True))


class TorchCEM(EliteMean):
    """Implement CEM in torch."""

    adapts_noise = True

    def __init__(self, elites: int, min_noise: float, smoothing: tuple[float, float, float]) -> None:
        super().__init__(elites)
        self.min_noise, self.smoothing = min_noise, smoothing

    def prepare(self, samples: lw.PlanSamples) -> None:
        self._left = torch.as_tensor(spread(self.smoothing, len(samples.plan)))[:, None, None]

    def fit(self, samples: lw.PlanSamples) -> None:
        assert samples.deviation is not None
        distance = samples.actions - samples.plan[:, :, None]
        variance = torch.einsum("ps,tpsa->tpa", samples.weights, distance.square())
        samples.deviation.copy_((variance.sqrt() / self._left).clamp(min=self.min_noise))


class HalfWay(EliteMean):
    """Move the plan halfway to the mean of the best samples."""

    def fit(self, samples: lw.PlanSamples) -> None:
        samples.plan.lerp_(samples.nominal, 0.5)


def compare(one: lw.Planner, other: lw.Planner, calls: int = 4) -> None:
    state = one.state_of(qpos=[0.1, 0.2, -0.5, 0.3])
    states = state if one.plants == 1 else torch.stack([one.state_of(qpos=[0.1 * i] * 4) for i in range(one.plants)])
    for call in range(calls):
        torch.testing.assert_close(one(states, shift=call), other(states, shift=call))
        for name in ("actions", "knot_actions", "sampled", "returns", "weights"):
            torch.testing.assert_close(getattr(one, name), getattr(other, name))
        for name, value in one.summary.items():
            torch.testing.assert_close(torch.as_tensor(value), torch.as_tensor(other.summary[name]))


@pytest.mark.quick("plants-warp", "knots-mujoco", "without graphs-mujoco")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
@pytest.mark.parametrize(
    "more", [{}, {"knots": 3}, {"plants": 2, "iterations": 2}, {"graphs": False}],
    ids=["default", "knots", "plants", "without graphs"],
)  # fmt: skip
def test_cem_written_in_torch_gives_the_same_plans_as_the_class_cem(more: dict[str, Any], engine: str) -> None:
    smoothing = lw.MPPIConfig(knots=more.get("knots")).noise_smoothing
    own = lw.Planner(engine=engine, update=TorchCEM(3, 0.05, smoothing), **POINT, **more)
    compare(own, cem := lw.CEM(engine=engine, elites=3, min_noise=0.05, **POINT, **more))
    assert own.adapted_noise is not None and cem.adapted_noise is not None
    torch.testing.assert_close(own.adapted_noise, cem.adapted_noise)
    assert own.config.include_plan is False
    first = own.adapted_noise.clone()
    own.reset()
    assert (own.adapted_noise == 1.0).all() and not torch.equal(own.adapted_noise, first)


@pytest.mark.parametrize("knots", [None, 3])
def test_custom_update_can_change_the_plan_in_its_fit_method(knots: int | None) -> None:
    half, whole = (lw.Planner(update=kind(3), knots=knots, **POINT) for kind in (HalfWay, EliteMean))
    state = half.state_of(qpos=[0.1, 0.2, -0.5, 0.3])
    torch.testing.assert_close(half(state), 0.5 * whole(state))  # the first plan starts from zero actions
    torch.testing.assert_close(half.actions, 0.5 * whole.actions)


class Wrong(EliteMean):
    """Write weights that are not valid, for the last plant."""

    def __init__(self, how: str) -> None:
        super().__init__(4)
        self.how = how

    def weigh(self, samples: lw.PlanSamples) -> None:
        super().weigh(samples)
        weights = samples.weights[-1]
        if self.how == "nan":
            weights[2] = torch.nan
        elif self.how == "negative":
            weights[:3] = torch.tensor([-0.5, 1.5, 0.0])
            weights[3:] = 0.0
        elif self.how == "sum":
            weights *= 2.0
        else:  # also for samples that failed
            weights.fill_(1 / len(weights))


@pytest.mark.parametrize("plants", [1, 2])
@pytest.mark.parametrize(("how", "reason"), [
    ("nan", "the weight of sample 2{of} is nan"), ("negative", "the weight of sample 0{of} is -0.5"),
    ("sum", "their sum{of} is 2"), ("failed", r"the weight of sample \d+{of}, which failed, is 0.025"),
])  # fmt: skip
def test_invalid_weights_raise_an_error_and_keep_the_plan(how: str, reason: str, plants: int) -> None:
    plan = lw.Planner(Picky, update=Wrong(how), horizon=4, samples=40, noise=0.3, plants=plants)
    states = plan.state_of() if plants == 1 else torch.stack([plan.state_of()] * plants)
    plan.actions.fill_(0.25)
    reason = reason.format(of="" if plants == 1 else " of plant 1")
    with pytest.raises(ValueError, match=rf"^weigh of Wrong .*: {reason}$"):
        plan(states, shift=0)
    actions = plan.actions.view(4, plants)
    assert (actions[:, -1] == 0.25).all()
    if plants == 2:
        assert (actions[:, 0] != 0.25).any()


def test_invalid_weights_of_an_update_in_warp_raise_an_error() -> None:
    plan = lw.Planner(update=SampleWeights(temperature=math.nan), **POINT)
    with pytest.raises(ValueError, match="^weigh of SampleWeights .* sample 0 is nan"):
        plan(plan.state_of())
    assert not plan.actions.any()


class Softmax(TorchCEM):
    """Adapt the noise with weights that are NaN if all samples fail."""

    def weigh(self, samples: lw.PlanSamples) -> None:
        samples.weights.copy_(torch.softmax(samples.returns, 1))


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_plan_and_adapted_noise_stay_valid_if_all_samples_fail(engine: str) -> None:
    plan = lw.Planner(
        Picky, update=Softmax(3, 0.1, (1, 0, 0)), engine=engine, horizon=4, samples=12, noise=0.1, limit=9.0
    )
    state = plan.state_of()
    plan(state)
    actions, noise = plan.actions.clone(), plan.adapted_noise
    assert noise is not None
    before = noise.clone()
    plan.env.set_params(limit=-9.0)
    plan(state, shift=0)
    assert plan.summary["failed_samples"] == 12 and not plan.weights.isfinite().any()
    assert torch.equal(plan.actions, actions) and torch.equal(noise, before)
    plan.env.set_params(limit=9.0)
    plan(state, shift=0)
    assert plan.actions.isfinite().all() and (plan.actions - actions).abs().max() < 0.5


class Exploding(TorchCEM):
    """Adapt the noise to a deviation that is not finite."""

    def fit(self, samples: lw.PlanSamples) -> None:
        assert samples.deviation is not None
        samples.deviation[1] = torch.inf


def test_deviation_that_is_not_finite_raises_an_error_and_is_not_used() -> None:
    plan = lw.Planner(update=Exploding(3, 0.1, (1, 0, 0)), **POINT)
    with pytest.raises(ValueError, match="fit of Exploding .* not finite"):
        plan(plan.state_of())
    assert plan.adapted_noise is not None and (plan.adapted_noise == 1.0).all()


def test_planners_with_the_same_update_object_do_not_share_buffers() -> None:
    update = CrossEntropy(3, 0.05, (1.0, 0.0, 0.0))
    compare(*(lw.Planner(update=update, smoothing=(1, 0, 0), **POINT) for _ in range(2)))
    assert vars(update).keys() == {"temperature", "elites", "min_noise", "smoothing"}


class Returning(EliteMean):
    """Return the weights instead of writing them."""

    def weigh(self, samples: lw.PlanSamples) -> Any:
        return torch.softmax(samples.returns, 1)


def test_update_that_returns_weights_raises_an_error() -> None:
    plan = lw.Planner(update=Returning(3), **POINT)
    with pytest.raises(ValueError, match="weigh of Returning .* samples.weights"):
        plan(plan.state_of())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"update": EliteMean}, "update .* lw.PlanUpdate, not .*EliteMean"),
        ({"update": EliteMean(3), "elites": 4}, r"update='cem', not of .*EliteMean\(elites=3\)"),
        ({"update": TorchCEM(3, 0.1, (1, 0, 0)), "noise": [[1, 0], [0, 1]]}, "noise .* standard deviations"),
    ],
)  # fmt: skip
def test_invalid_user_written_update_raises_an_error(words: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lw.Planner(**(POINT | words))
