"""Compare go1_velocity with mjlab's Mjlab-Velocity-Flat-Unitree-Go1.

The tests read mjlab's numbers from a file that ``store_go1.py`` wrote. Before each observation, mjlab ran a forward
pass, so the stored poses and contacts are current.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.binding import find_task

STORED = dict(np.load(Path(__file__).parent.parent / "data" / "go1_mjlab.npz"))
MODEL = [name.removeprefix("model/") for name in STORED if name.startswith("model/")]
OPTIONS = [name.removeprefix("option/") for name in STORED if name.startswith("option/")]
TERMS = [name.removeprefix("weight/") for name in STORED if name.startswith("weight/")]
NWORLD = len(STORED["env/qpos"])


def test_model_has_the_bodies_and_geoms_of_mjlab(shared_env: SharedEnv) -> None:
    model = shared_env("go1_velocity").model
    assert [model.body(i).name for i in range(model.nbody)] == STORED["bodies"].tolist()
    assert [model.geom(i).name for i in range(model.ngeom)] == ["floor", *STORED["geoms"][1:].tolist()]
    assert (model.nq, model.nv, model.nu) == (19, 18, 12)
    assert model.body_subtreemass[0] == pytest.approx(12.743, abs=1e-3)


@pytest.mark.parametrize("name", MODEL)
def test_model_fields_equal_those_of_mjlab(shared_env: SharedEnv, name: str) -> None:
    np.testing.assert_allclose(getattr(shared_env("go1_velocity").model, name), STORED[f"model/{name}"], rtol=1e-12)


@pytest.mark.parametrize("name", OPTIONS)
def test_model_has_the_options_of_mjlab(shared_env: SharedEnv, name: str) -> None:
    np.testing.assert_array_equal(getattr(shared_env("go1_velocity").model.opt, name), STORED[f"option/{name}"])


@pytest.mark.parametrize("i", range(4))
def test_trajectories_of_the_model_equal_those_of_mjlab(shared_env: SharedEnv, i: int) -> None:
    model = shared_env("go1_velocity").model
    data, wanted = mujoco.MjData(model), STORED["trajectory/qpos"][i]
    data.qpos, data.qvel = wanted[0], STORED["trajectory/qvel0"][i]
    bodies = model.geom_bodyid
    touching, tangled = 0, 0
    for controls, qpos in zip(STORED["trajectory/controls"][i], wanted[1:], strict=True):
        data.ctrl = controls
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos, qpos, rtol=0, atol=1e-9)
        touching += data.ncon
        tangled += int((bodies[data.contact.geom] > 0).all(axis=1).sum())
    assert touching > 100
    assert tangled > 0 or i < 2


@pytest.fixture(scope="module")
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env("go1_velocity", nworld=NWORLD, autoreset=False, **without_noise())


def without_noise() -> dict[str, float]:
    parts = ("linear_velocity", "angular_velocity", "gravity", "joint_position", "joint_velocity")
    return {f"{part}_noise": 0.0 for part in parts}


def stored(name: str) -> torch.Tensor:
    return torch.from_numpy(STORED[f"env/{name}"].astype(np.float64))


def mjlabs_states(env: lw.Env, *, heading: bool) -> torch.Tensor:
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"].copy_(stored("qpos"))
    parts["qvel"].copy_(stored("qvel"))
    parts["sensordata"].copy_(stored("force").reshape(NWORLD, 12))
    parts["drawn_velocity"].copy_(stored("command"))
    parts["heading_target"][:, 0] = stored("heading")
    parts["heading_controlled"][:], parts["standing"][:] = 0.0, 0.0
    if heading:
        parts["drawn_velocity"][:, 2] = (1.0 - stored("heading_controlled")) * stored("command")[:, 2]
        parts["heading_controlled"][:, 0], parts["standing"][:, 0] = stored("heading_controlled"), stored("standing")
    parts["last_action"].copy_(stored("action"))
    for name in ("contact_time", "air_time", "encoder_bias", "peak_height"):
        parts[name].copy_(stored(name))
    parts["swing_height"].copy_(stored("peak_height"))
    parts["previous_action"].copy_(stored("previous_action"))
    return state


@pytest.mark.parametrize("heading", [False, True])
@pytest.mark.parametrize(("group", "theirs"), [("policy", "actor"), ("critic", "critic")])
def test_observations_equal_those_of_mjlab(env: lw.Env, group: str, theirs: str, heading: bool) -> None:
    found = env.get_obs(mjlabs_states(env, heading=heading), group=group)
    np.testing.assert_allclose(found.numpy(), STORED[f"env/{theirs}"], rtol=2e-5, atol=2e-5)


def test_stored_states_contain_every_kind_of_command_and_contact() -> None:
    assert 0 < stored("standing").sum() < stored("heading_controlled").sum() < NWORLD
    contact = stored("critic")[:, 56:60]
    assert 0.2 < contact.mean() < 0.8
    assert (stored("critic")[:, 60:72] != 0).any()


@pytest.mark.parametrize("term", TERMS)
def test_reward_terms_equal_those_of_mjlab(env: lw.Env, term: str) -> None:
    after = mjlabs_states(env, heading=False)
    before = after.clone()
    if term == "soft_landing":  # mjlab's forces are current, but this package's forces are one substep old
        times = env.state_space.split(after)["contact_time"]
        times += 0.005 * (times > 0)
    weight = float(STORED[f"weight/{term}"])
    try:
        env.set_params(**dict.fromkeys(TERMS, 0.0) | {term: weight})
        found = env.get_reward(before, stored("action").float(), after)
    finally:
        env.set_params(**{name: float(STORED[f"weight/{name}"]) for name in TERMS})
    wanted = 0.02 * weight * STORED[f"env/term/{term}"]
    np.testing.assert_allclose(found.numpy(), wanted, rtol=2e-5, atol=2e-7 * abs(weight))
    assert np.unique(wanted).size > 5


def test_reward_weights_equal_those_of_mjlab() -> None:
    assert find_task("go1_velocity").rewards == {term: STORED[f"weight/{term}"] for term in TERMS}


def test_terminations_equal_those_of_mjlab(env: lw.Env) -> None:
    state = mjlabs_states(env, heading=False)
    assert np.array_equal(env.get_terminated(state).numpy(), STORED["env/fell"])


def test_actions_give_the_servo_targets_of_mjlab(env: lw.Env) -> None:
    env.set_state(mjlabs_states(env, heading=False))
    env.step(stored("action").float())
    np.testing.assert_allclose(env.field("ctrl").numpy(), STORED["env/target"], atol=1e-6)
