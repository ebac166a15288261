from pathlib import Path

import torch

import lyceum_warp as lw
from lyceum_warp.training import Run
from lyceum_warp.training.runs.checkpoints import policy_content


def test_value_function_has_the_discount_factor_of_its_training(tmp_path: Path) -> None:
    env = lw.make("point_mass", nworld=2, horizon=12)
    config = lw.NPGConfig(samples=24, gamma=0.9)
    value = lw.ValueFunction(env.obs_space.size, (4,))
    assert value.discount is None
    npg = lw.NPG(env, value=value, config=config)
    assert value.discount == lw.NPG(env, config=config).value.discount == 0.9
    run = Run.create(tmp_path, {})
    run.save(policy_content(0, npg.policy, value), {})
    assert lw.load_value(run).discount == 0.9
    content = torch.load(run.policy)
    del content["value"]["shape"]["discount"]  # earlier releases did not save the discount
    torch.save(content, run.policy)
    assert lw.load_value(run).discount is None
    run.save(policy_content(0, npg.policy, lw.ValueFunction(3, (4,), group="critic")), {})
    assert lw.load_value(run).group == "critic"


def test_time_features_are_powers_of_the_step() -> None:
    value = lw.ValueFunction(2, (4,), time_orders=3)
    features = value.features(torch.zeros(1, 2), torch.tensor([500.0]))
    torch.testing.assert_close(features, torch.tensor([[0.0, 0.0, 0.5, 0.25, 0.125]]))
