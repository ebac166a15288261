import dataclasses
import json
import types
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from rail_task import Picky, Rail, rail

import lyceum_warp as lw
from lyceum_warp import MPPI, MPPIConfig, Planning, Row
from lyceum_warp.algos import task_config
from lyceum_warp.algos.planning.arguments import planner_arguments
from lyceum_warp.binding import find_task
from lyceum_warp.engines import placement


@wp.struct
class NoisyParams:
    dt: float
    noise: float = 2.0
    size: float = 1.0


@wp.func
def observe_noisy(s: Rail, p: NoisyParams, obs: Row[float]):
    obs[0] = s.qpos[0] + p.noise


class Noisy(lw.Task):
    model, obs = staticmethod(rail), {"x": 1}
    World, Params, observe = Rail, NoisyParams, observe_noisy


def planned(base: type[lw.Task] = Picky, **parts: Any) -> type[lw.Task]:
    return type("Planned", (base,), {"planning": Planning(**parts)})


def arguments(task: Any, config: MPPIConfig | None = None, value: Any = None, params: Any = None, **words: Any) -> Any:
    return planner_arguments(find_task(task), config, words, params, value)


def test_planning_attribute_of_the_task_applies_to_the_planner() -> None:
    plan = MPPI("hopper", horizon=2, samples=2)
    assert plan.config == MPPIConfig(horizon=2, samples=2, noise=0.1).completed()
    assert plan.env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert plan.env.task.params["healthy_reward"] == 2.0 and plan.env.task.params["forward_reward_weight"] == 0.2
    assert plan.settings["healthy_reward"] == 2.0 and lw.make("hopper").task.params["healthy_reward"] == 1.0


@pytest.mark.parametrize(
    ("planning", "message"),
    [
        ({"horizon": 3}, r"planning of the task 'planned' .*lw.Planning\(.*\{'horizon': 3\}"),
        (Planning(settings={"horizont": 3}), "planning .* 'planned': .*'horizont': did you mean horizon"),
        (Planning(options={"integratr": "rk4"}), "planning .*'integratr': did you mean integrator"),
        (Planning(params={"limt": 3.0}), "'planned' .*'limt': did you mean limit"),
        (Planning(settings={"horizon": 0}), "planning of the task 'planned': horizon .* 0"),
        (Planning(options={"nworld": 3}), "planning of the task 'planned': .*nworld"),
    ],
)  # fmt: skip
def test_invalid_planning_raises_an_error_that_names_the_task_and_the_entry(planning: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MPPI(type("Planned", (Picky,), {"planning": planning}))


REACH = task_config(find_task("reach"))


@pytest.mark.parametrize(
    ("task", "config", "words", "expected"),
    [
        ("point_mass", None, {}, MPPIConfig()),
        ("reach", None, {}, MPPIConfig(horizon=16, samples=30, temperature=0.2, noise=1.0)),
        ("reach", None, {"samples": 7}, dataclasses.replace(REACH, samples=7)),
        ("reach", None, {"samples": None, "discount": None}, REACH),
        ("hopper", MPPIConfig(horizon=3), {}, MPPIConfig(horizon=3)),
        ("reach", MPPIConfig(horizon=3, samples=8), {"samples": 7}, MPPIConfig(horizon=3, samples=7)),
    ],
)
def test_keywords_override_config_and_config_overrides_the_planning_attribute(
    task: str, config: MPPIConfig | None, words: dict[str, Any], expected: MPPIConfig
) -> None:
    assert arguments(task, config, **words)[0] == expected.completed()


def test_arguments_are_sorted_into_settings_options_and_parameters() -> None:
    task = planned(settings={"noise": 0.2}, options={"integrator": "euler", "cone": "elliptic"}, params={"limit": 2.0})
    config, options, params = arguments(task, samples=3, integrator="rk4", nthread=2, wrong=5.0)
    assert config == MPPIConfig(noise=0.2, samples=3).completed()
    assert options.given() == {"integrator": "rk4", "cone": "elliptic", "nthread": 2}
    assert params == {"limit": 2.0, "wrong": 5.0}
    physics = lw.make("point_mass", integrator="implicit").options.physics
    assert arguments(task, physics=physics)[1].physics == physics


def test_ambiguous_argument_name_raises_an_error_that_names_config_and_params() -> None:
    with pytest.raises(ValueError, match=r"config=lw.MPPIConfig\(noise=...\), .* params=\{'noise'"):
        MPPI(Noisy, noise=0.3)
    plan = MPPI(Noisy, MPPIConfig(horizon=2, samples=2, noise=0.25), params={"noise": 3.0}, size=4.0)
    assert plan.config.noise == 0.25
    assert (plan.env.task.params["noise"], plan.env.task.params["size"]) == (3.0, 4.0)
    assert plan.settings["noise"] == 0.25 and plan.settings["size"] == 4.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"sample": 3}, "'reach' .* 'sample': did you mean samples"),
        ({"sucess_distance": 1.0}, "'sucess_distance': did you mean success_distance"),
        ({"integratr": "rk4"}, "'integratr': did you mean integrator"),
        ({"qqqqq": 3}, "'qqqqq': it has .*success_distance"),
        ({"params": {"samples": 3}}, "'samples': .* give it outside params"),
        ({"params": [3]}, r"params .* \[3\]"),
        ({"config": {"samples": 3}}, r"config .* MPPIConfig.* \{'samples': 3\}"),
        ({"nworld": 1}, "no option nworld: samples"),
        ({"elites": 4}, "elites=4 .* update='cem'"),
        ({"update": "predictive_sampling", "min_noise": 0.1}, "min_noise=0.1 .* update='cem'"),
        ({"update": "cem", "noise": np.eye(7)}, "noise of update='cem' .* standard deviations"),
        ({"update": "cem", "min_noise": [0.1, 0.1]}, r"min_noise .* \(0.1, 0.1\)"),
        ({"models": 4}, "models=4 .* 'reach'"),
    ],
)  # fmt: skip
def test_invalid_planner_arguments_raise_an_error(words: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MPPI("reach", **words)


def test_planning_params_are_ignored_if_there_is_a_value_function() -> None:
    plan = MPPI("hopper", horizon=2, samples=2, value=lambda obs: obs[:, 0])
    assert plan.env.task.params["healthy_reward"] == 1.0 and plan.env.task.params["forward_reward_weight"] == 1.0
    assert plan.env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER and plan.settings["noise"] == 0.1


@pytest.mark.parametrize(
    ("words", "fitted", "expected"),
    [
        ({}, 0.9, 0.9),
        ({}, None, 0.8),
        ({"discount": 0.5}, 0.9, 0.5),
        ({"config": MPPIConfig()}, 0.9, 0.9),
        ({"config": MPPIConfig()}, None, 1.0),
        ({"config": MPPIConfig(discount=0.7)}, 0.9, 0.7),
    ],
)
def test_discount_defaults_to_the_discount_of_the_value_function(
    words: dict[str, Any], fitted: float | None, expected: float
) -> None:
    value = lw.ValueFunction(6)
    value.discount = fitted
    assert arguments(planned(settings={"discount": 0.8}), value=value, **words)[0].discount == expected


def test_settings_suggested_for_one_update_do_not_apply_to_another() -> None:
    task = planned(settings={"update": "cem", "elites": 5, "min_noise": 0.1, "samples": 20})
    assert (arguments(task)[0].elites, arguments(task)[0].min_noise) == (5, 0.1)
    other = arguments(task, update="predictive_sampling")[0]
    assert (other.elites, other.min_noise, other.samples, other.include_plan) == (None, None, 20, True)


def test_omitted_settings_get_the_defaults_of_the_update() -> None:
    def chosen(**words: Any) -> tuple[Any, ...]:
        config = arguments("reach", noise=[0.5] * 7, **words)[0]
        return config.include_plan, config.elites, config.min_noise

    assert chosen() == chosen(update="mppi") == chosen(update="predictive_sampling") == (True, None, None)
    assert chosen(samples=1)[0] is False
    assert chosen(update="cem", samples=50) == (False, 5, (0.05,) * 7)
    assert [chosen(update="cem", samples=n)[1] for n in (1, 2, 19, 40)] == [1, 2, 2, 4]


@pytest.mark.parametrize("planner, update", [(lw.CEM, "cem"), (lw.PredictiveSampling, "predictive_sampling")])
def test_cem_and_predictive_sampling_equal_mppi_with_another_update(planner: type[MPPI], update: Any) -> None:
    config = MPPIConfig(horizon=3, samples=6)
    one, other = planner("reach", config, seed=1), MPPI("reach", config, update=update, seed=1)
    assert one.config == other.config and one.config.update == update
    assert torch.equal(one(one.state_of()), other(other.state_of()))
    with pytest.raises(ValueError, match=f"update='mppi' .* '{update}' .* lw.MPPI"):
        planner("reach", update="mppi")


def test_engine_auto_on_a_gpu_counts_the_worlds_of_all_models_and_plants(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = types.SimpleNamespace(is_cuda=True), types.SimpleNamespace(is_cuda=False)
    monkeypatch.setattr(placement, "find_device", lambda name: cuda[not str(name).startswith("cuda")])

    def chosen(task: str, plants: int = 1, **words: Any) -> str:
        words |= {"device": "cuda:0", "nthread": 2}
        return planner_arguments(find_task(task), None, words, None, None, plants)[1].engine

    assert [chosen("reach", samples=79), chosen("reach", samples=20, models=4)] == ["mujoco", "warp"]
    assert chosen("reach", plants=4, samples=20) == "warp"
    # the noslip solver is slow on a GPU
    assert chosen("adroit_pen", samples=160) == "mujoco"
    assert chosen("adroit_pen", samples=160, solver={"noslip_iterations": 0}) == "warp"


def test_settings_are_json_values() -> None:
    plan = MPPI(
        Picky, horizon=2, samples=2, noise=torch.tensor([[0.5]]), fill=[0.1], solver={"iterations": 3}, model=rail(),
        limit=np.array([1.0, 2.0]), wrong=torch.tensor(3.0), fields=["xpos"],
    )  # fmt: skip
    assert json.loads(json.dumps(plan.settings)) == plan.settings
    assert plan.settings == plan.settings | {
        "horizon": 2, "noise": [[0.5]], "fill": [0.1], "elites": None, "solver": {"iterations": 3}, "wrong": 3.0,
        "model": "MjSpec 'MuJoCo Model'", "limit": [1.0, 2.0], "fields": ["xpos"],
    }  # fmt: skip
