import dataclasses
import math
from typing import Any

import pytest

import lyceum_warp as lw
from lyceum_warp.algos.npg import enough_samples


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("gamma", 1.5, "a finite number from 0 to 1"),
        ("samples", 0, "a whole number from 1"),
        ("value_rate", None, "a finite number of at least 0"),
        ("log_std", math.nan, "a finite number"),
        ("log_std", -5.0, "be at least min_log_std=-3.0, not -5.0"),
        ("fisher_fraction", 0, "be greater than 0"),
        ("rollout", "foo", "be 'auto', 'episodes' or 'segments'"),
        ("whiten", 1, "be True or False"),
        ("value_hidden", (8, 0), r"the widths of the hidden layers, as in \(64, 64\)"),
        ("activation", "swish", "be 'tanh', 'relu', .* or 'softplus', not 'swish'"),
    ],
)
def test_error_of_an_invalid_value_names_the_setting(name: str, value: object, wanted: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must .*{wanted}"):
        lw.NPGConfig(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("config", [lw.NPGConfig, lw.PPOConfig, lw.SACConfig])
def test_every_config_field_is_checked(config: Any) -> None:
    for field in dataclasses.fields(config):
        with pytest.raises(ValueError, match=f"^{field.name} must "):
            config(**{field.name: object()})


def test_lists_and_numbers_of_other_types_are_converted() -> None:
    config = lw.NPGConfig(samples=1e4, gamma=1, hidden=[8.0, 8])  # type: ignore[arg-type]
    assert config == lw.NPGConfig(samples=10_000, gamma=1.0, hidden=(8, 8))
    assert (type(config.samples), type(config.gamma)) == (int, float)


def test_default_number_of_samples_is_16_per_world_but_at_least_10000() -> None:
    assert [enough_samples(lw.NPGConfig(), n) for n in (10, 64, 1000)] == [10_000, 10_000, 16_000]
    assert enough_samples(lw.NPGConfig(samples=5), 1000) == 5
