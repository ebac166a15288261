import dataclasses
from typing import Any

import pytest
from terms_task import Terms

import lyceum_warp as lw
from lyceum_warp.support.suggestions import _OTHER_WORDS

KNOWN = {
    *dir(lw.Env), *lw.Env.__annotations__, "out",
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


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("num_envs", "did you mean nworld?"),
        ("observation_space", "did you mean obs_space?"),
        ("qpos", "use env.field('qpos')"),
        ("body_mass", "use env.field('body_mass')"),
    ],
)
def test_unknown_attribute_of_an_environment_suggests_a_known_one(name: str, fix: str, shared_env: Any) -> None:
    with pytest.raises(AttributeError) as raised:
        getattr(shared_env("hopper", nworld=2), name)
    assert str(raised.value) == f"an environment has no {name!r}: {fix}"


def test_unknown_metric_suggests_a_known_one(shared_env: Any) -> None:
    with pytest.raises(KeyError, match="there is no metric 'chnge': did you mean change?"):
        shared_env(Terms, nworld=3, horizon=0).metrics["chnge"]
    with pytest.raises(KeyError, match="there is no metric 'speed': there are none"):
        shared_env("hopper", nworld=2).metrics["speed"]
