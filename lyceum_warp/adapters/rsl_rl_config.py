"""Convert a PPO configuration to rsl_rl's runner configuration."""

import math
from typing import Any

from lyceum_warp.algos import PPOConfig, value_group
from lyceum_warp.env import Env

_ACTIVATIONS = {"leaky_relu": "lrelu", "silu": "swish"}
"""Activations whose names in rsl_rl and torch differ."""

_PPO = {
    "epochs": "num_learning_epochs", "minibatches": "num_mini_batches", "clip": "clip_param", "gamma": "gamma",
    "lam": "lam", "value_coef": "value_loss_coef", "entropy_coef": "entropy_coef", "learning_rate": "learning_rate",
    "max_grad_norm": "max_grad_norm", "clip_value_loss": "use_clipped_value_loss", "schedule": "schedule",
    "desired_kl": "desired_kl", "whiten_minibatches": "normalize_advantage_per_mini_batch",
}  # fmt: skip
"""Maps each hyperparameter of ``PPOConfig`` to its name in rsl_rl."""


def runner_config(env: Env, config: PPOConfig | None = None) -> dict[str, Any]:
    """Make the configuration of rsl_rl's own runner.

    Example:
        >>> runner = OnPolicyRunner(RslRlVecEnv(env), runner_config(env))

    rsl_rl's PPO ignores ``final_entropy_coef``, ``stagger``, ``tf32`` and ``symmetry``, and it does not evaluate the
    mean policy.

    Args:
        env: The environment whose observations are the networks' inputs.
        config: Hyperparameters; by default ``PPOConfig()``.

    Returns:
        A new dict, because rsl_rl modifies it.

    Raises:
        ValueError: The task has no observation group for the value function.
    """
    config = config or PPOConfig()
    group = value_group(env, config.value_group)
    network = {"class_name": "rsl_rl.models.MLPModel", "obs_normalization": config.normalize}
    memory = {"class_name": "rsl_rl.models.RNNModel", "rnn_type": "gru", "rnn_hidden_dim": config.recurrent}
    actor = network | memory if config.recurrent else network
    distribution = {
        "class_name": "rsl_rl.modules.GaussianDistribution", "std_type": config.std_type,
        "init_std": math.exp(config.log_std),
    }  # fmt: skip
    return {
        "num_steps_per_env": config.num_steps,
        "save_interval": 50,
        # rsl_rl's NaN check would wait for the device, and the environment already reports NaN as a fault
        "check_for_nan": False,
        "obs_groups": {"actor": ["policy"], "critic": [group]},
        "actor": actor | _layers(config.hidden, config.activation) | {"distribution_cfg": distribution},
        "critic": (actor if group == "policy" else network) | _layers(config.value_hidden, config.value_activation),
        "algorithm": {theirs: getattr(config, ours) for ours, theirs in _PPO.items()} | {
            "class_name": "rsl_rl.algorithms.PPO", "optimizer": "adam", "rnd_cfg": None,
        },
        "multi_gpu": None,
    }  # fmt: skip


def _layers(hidden: tuple[int, ...], activation: str) -> dict[str, Any]:
    return {"hidden_dims": list(hidden), "activation": _ACTIVATIONS.get(activation, activation)}
