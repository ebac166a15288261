import json
from pathlib import Path
from typing import Any

import pytest
import torch
from training_runs import algorithm

import lyceum_warp as lw
from lyceum_warp.algos import Team
from lyceum_warp.core import EnvOptions, PhysicsOptions
from lyceum_warp.training import ALGORITHMS, Configuration, Run
from lyceum_warp.training.runs.configuration import describe

BASE = {
    "algorithm": "npg", "task": "hopper", "engine": "auto", "device": "cpu", "nworld": 3, "seed": 2, "threads": 1,
    "params": {"ctrl_cost_weight": 2}, "physics": {}, "options": {}, "npg": {"hidden": [8]},
}  # fmt: skip


def read(config: dict[str, Any]) -> Configuration:
    return Configuration.of(Run(Path("run"), config))


@pytest.mark.parametrize("kind", ["npg", "ppo"])
def test_learner_is_recreated_from_its_configuration(kind: str) -> None:
    learner_class, config_class = ALGORITHMS[kind]
    env = lw.make(
        "hopper", nworld=2, seed=3, horizon=20, integrator="euler", solver={"iterations": 7}, fields=["xpos"],
        dynamics=["body_mass"], graphs=False, ctrl_cost_weight=0.5,
    )  # fmt: skip
    learner = learner_class(env, config=config_class(hidden=(8,), gamma=0.5), seed=4)
    config = describe(learner)
    again = read(json.loads(json.dumps(config))).learner(Team())
    assert describe(again) == config and type(again) is learner_class
    weights, other = learner.policy.state_dict(), again.policy.state_dict()
    assert all(torch.equal(other[name], weight) for name, weight in weights.items())
    assert torch.equal(again.env.obs, env.obs)


@pytest.mark.parametrize(
    ("saved", "options"),
    [
        ({"integrator": None, "solver": {}, "deterministic": False}, PhysicsOptions()),
        (
            {"integrator": "euler", "solver": {"iterations": 7}, "deterministic": True},
            PhysicsOptions(integrator="euler", solver={"iterations": 7}, deterministic=True),
        ),
        ({"solver": None, "njmax": 30}, PhysicsOptions(njmax=30)),
    ],
)
def test_physics_of_a_run_are_read_from_its_configuration(saved: dict[str, object], options: PhysicsOptions) -> None:
    for physics in (saved, options.given()):
        configuration = read(BASE | {"physics": physics})
        assert configuration.options == EnvOptions(device="cpu", nworld=3, seed=2, physics=options)
        assert configuration.params == {"ctrl_cost_weight": 2}
        assert configuration.hyperparameters == lw.NPGConfig(hidden=(8,))


def test_processes_on_one_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lyceum_warp.training.runs.configuration.cpu_cores", lambda: 6)
    learner = read(BASE | {"nworld": 4}).learner(Team(1, 2, "cpu", neighbours=2))
    assert (learner.env.options.nthread, learner.env.nworld, learner.env.first_world) == (3, 2, 2)
    assert describe(learner)["nworld"] == 4 and describe(learner)["options"] == {}


def test_separate_seed_of_the_algorithm_is_saved() -> None:
    env = lw.make("point_mass", nworld=2)
    assert "npg_seed" not in describe(algorithm(env))
    config = describe(algorithm(env, seed=3))
    assert (config["seed"], config["npg_seed"]) == (0, 3) and read(config).learner(Team()).seed == 3
