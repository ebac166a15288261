"""Hyperparameters of rsl_rl's PPO."""

import inspect
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from rsl_rl.algorithms import PPO

from lyceum_warp.adapters.rsl_rl_config import RslRlConfig


@pytest.mark.parametrize("words, message", [
    ({"num_steps_per_env": 0}, "num_steps_per_env must be a whole number from 1 "),
    ({"gamma": 1.5}, "gamma must be a finite number from 0 to 1, not 1.5"),
    ({"learning_rate": float("nan")}, "learning_rate must be a finite number"),
    ({"hidden": (8, 0)}, "hidden must be the widths of the hidden layers"),
    ({"value_hidden": ()}, "value_hidden must be the widths of at least one hidden layer"),
    ({"activation": "sine"}, "activation must be one of 'tanh'"),
    ({"bootstrap": "none"}, "bootstrap must be 'final' or 'before', not 'none'"),
    ({"schedule": "linear"}, "schedule must be 'adaptive' or 'fixed', not 'linear'"),
    ({"normalize": 1}, "normalize must be True or False, not 1"),
    ({"torch_compile_mode": "max-autotune"},
     "torch_compile_mode must be 'default' or 'max-autotune-no-cudagraphs', or None .* not 'max-autotune'"),
    ({"torch_compile_mode": 1}, "torch_compile_mode must be .* not 1"),
    ({"normalize_when": "never"}, "normalize_when must be 'step' or 'before' or 'after', not 'never'"),
    ({"final_entropy_coef": -1.0}, "final_entropy_coef must be a finite number of at least 0, not -1.0"),
    ({"entropy_decay": 7}, r"entropy_decay must be two numbers of iterations, as in \(150, 200\), not 7"),
    ({"entropy_decay": (5, 5)}, r"entropy_decay must end after it begins, not \(5, 5\)"),
    ({"captured_update": "yes"}, "captured_update must be True, False or None, not 'yes'"),
    ({"value_group": 3}, "value_group must be a name, or None, not 3"),
])  # fmt: skip
def test_values_that_are_not_valid_are_refused(words: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RslRlConfig(**words)  # type: ignore[arg-type]


def test_the_weight_of_the_entropy_falls_linearly() -> None:
    config = RslRlConfig(entropy_coef=0.02, final_entropy_coef=0.01, entropy_decay=(10, 20))
    assert [config.entropy_weight(it) for it in (1, 10, 15, 20, 99)] == pytest.approx([0.02, 0.02, 0.015, 0.01, 0.01])
    assert RslRlConfig(entropy_coef=0.02).entropy_weight(500) == 0.02


@pytest.mark.parametrize("words, on_gpu, on_cpu", [
    ({}, True, False),
    ({"optimizer": "adamw"}, True, False),
    ({"optimizer": "sgd"}, False, False),
    ({"torch_compile_mode": "default"}, False, False),
    ({"captured_update": False}, False, False),
    ({"captured_update": True}, True, True),
])  # fmt: skip
def test_the_update_is_captured_on_a_gpu_where_it_can_be(words: dict[str, Any], on_gpu: bool, on_cpu: bool) -> None:
    config = RslRlConfig(**words)
    assert (config.captures(torch.device("cuda:1")), config.captures(torch.device("cpu"))) == (on_gpu, on_cpu)


def test_the_value_function_gets_the_critics_group_where_there_is_one(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=4)
    assert RslRlConfig().runner_config(env)["obs_groups"] == {"actor": ["policy"], "critic": ["critic"]}
    assert RslRlConfig(value_group="policy").runner_config(env)["obs_groups"]["critic"] == ["policy"]
    with pytest.raises(ValueError, match="'metered' has no group 'actor' of observations .* it has policy, critic"):
        RslRlConfig(value_group="actor").runner_config(env)
    message = "200 mini-batches are more than the 96 samples: give more worlds, or make num_mini_batches smaller"
    with pytest.raises(ValueError, match=message):
        RslRlConfig(num_mini_batches=200).runner_config(env)


def test_each_entry_of_the_algorithm_is_an_argument_of_rsl_rls_ppo(shared_env: SharedEnv) -> None:
    entry = RslRlConfig(activation="silu").runner_config(shared_env(Metered, nworld=4))
    known = inspect.signature(PPO).parameters
    assert set(entry["algorithm"]) - {"class_name"} <= set(known)
    assert entry["actor"]["activation"] == "swish"  # its name there
