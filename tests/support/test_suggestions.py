import dataclasses
from typing import Any

import pytest

import lyceum_warp as lw
from lyceum_warp.support.suggestions import _OTHER_WORDS

KNOWN = {
    "out",
    *(field.name for kind in (lw.EnvOptions, lw.MPPIConfig, lw.NPGConfig, lw.PPOConfig, lw.SACConfig)
      for field in dataclasses.fields(kind)), "iterations",
}  # fmt: skip


def test_every_suggested_name_exists_and_no_other_word_does() -> None:
    assert set(_OTHER_WORDS.values()) <= KNOWN and not KNOWN & {*_OTHER_WORDS}


@pytest.mark.parametrize(
    ("kind", "word", "name"),
    [
        (lw.PPOConfig, "lr", "learning_rate"),
        (lw.NPGConfig, "gae_lambda", "lam"),
        (lw.SACConfig, "buffer_size", "replay"),
        (lw.MPPIConfig, "num_samples", "samples"),
        (lw.EnvOptions, "n_envs", "nworld"),
        (lw.PhysicsOptions, "integratr", "integrator"),
    ],
)
def test_unknown_field_of_a_configuration_suggests_a_known_one(kind: Any, word: str, name: str) -> None:
    with pytest.raises(TypeError, match=f"{kind.__name__} has no field '{word}': did you mean {name}\\?"):
        kind(**{word: 1})
