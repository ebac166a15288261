"""A run whose last iterations are under exact physics."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from training_runs import QUIET, metrics

import lyceum_warp as lw
from lyceum_warp import cli

TASK = f"{Path(__file__).parent / 'gated_tasks.py'}:Coarse"
SIZES: dict[str, Any] = {"hidden": (4,), "value_hidden": (4,), "mean_every": 0}
LEARNERS: dict[str, Any] = {
    "ppo": (lw.PPO, lw.PPOConfig(num_steps=8, **SIZES)),
    "npg": (lw.NPG, lw.NPGConfig(samples=16, **SIZES)),
    "sac": (lw.SAC, lw.SACConfig(num_steps=8, warmup=8, batch=4, replay=64, **SIZES)),
}


def learner(kind: str, physics: str = "coarse") -> lw.Learner:
    make, config = LEARNERS[kind]
    made: lw.Learner = make(lw.make(TASK, nworld=2, seed=3, physics=physics), config=config, seed=3)
    return made


@pytest.mark.parametrize("kind", LEARNERS)
def test_state_goes_on_in_exact_physics_and_resume_is_exact(kind: str, tmp_path: Path) -> None:
    whole = learner(kind)
    run = lw.train(whole, tmp_path / "whole", 4, exact_from=2)
    assert whole.env.options.physics == lw.PhysicsOptions()

    # the same by hand: iterations 3 and 4 of a learner in exact physics, from the state after iteration 2
    coarse, exact = learner(kind), learner(kind, "exact")
    for _ in range(2):
        next(coarse)
    if exact.replay is not None:
        exact.replay, coarse.replay.env = coarse.replay, exact.env  # type: ignore[union-attr]
    exact.load_state_dict(coarse.state_dict())
    for _ in range(2):
        next(exact)
    for name, tensor in whole.policy.state_dict().items():
        torch.testing.assert_close(tensor, exact.policy.state_dict()[name], rtol=0.0, atol=0.0)

    parts = lw.train(learner(kind), tmp_path / "parts", 1, exact_from=2)
    for iterations in (2, 3, 4):
        lw.train(learner(kind), lw.Run.open(parts.folder), iterations)
    assert metrics(parts.folder) == metrics(run.folder)
    lw.train(whole, run, 5)  # the same learner, which is already in exact physics
    assert len(run.rows()) == 5


def test_learner_with_another_constructor_is_refused_before_the_run(tmp_path: Path) -> None:
    class Narrow(lw.NPG):
        def __init__(self, env: lw.Env) -> None:
            super().__init__(env, config=LEARNERS["npg"][1])

    with pytest.raises(TypeError, match="Narrow can't change to exact physics .* or override enter"):
        lw.train(Narrow(learner("npg").env), tmp_path / "run", 3, exact_from=2)
    assert not (tmp_path / "run").exists()


def test_command_follows_the_task_and_names_the_physics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--iterations", "3", "--nworld", "2", *QUIET]
    assert cli.main(["train", TASK, "--out", str(tmp_path / "run"), *words]) == 0
    output = capsys.readouterr().out
    assert "C engine, coarse physics (cone elliptic, integrator discrete)" in output
    assert "from iteration 3 on: C engine, exact physics" in output
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["exact_from"] == 2 and config["physics"] == {"cone": "elliptic", "integrator": "discrete"}
    assert cli.main(["train", TASK, "--out", str(tmp_path / "exact"), "--physics", "exact", *words]) == 0
    assert "coarse physics" not in capsys.readouterr().out
    assert cli.main(["train", TASK, "--out", str(tmp_path / "short"), *words, "--iterations", "1"]) == 0
    runtime, coarse = pytest.importorskip("onnxruntime"), "coarse physics (cone elliptic, integrator discrete)"
    for name, text in (("run", f"{coarse} for 2 iterations, then exact physics for 1"), ("short", coarse)):
        assert cli.main(["export", str(tmp_path / name), "--which", "last"]) == 0
        session = runtime.InferenceSession(str(tmp_path / name / "policy.onnx"))
        assert json.loads(session.get_modelmeta().custom_metadata_map["physics"]) == text
    for name, physics in (("run", "exact"), ("short", "coarse")):
        capsys.readouterr()
        assert cli.main(["eval", str(tmp_path / name), "--episodes", "1"]) == 0
        assert f"on the C engine, {physics} physics" in capsys.readouterr().out
