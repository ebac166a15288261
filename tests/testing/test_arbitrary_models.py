from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from arbitrary_models import ARM, MODEL_CHECKS, MODELS, PLUGINS, actuated, text
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task

OPTIONS: dict[str, dict[str, Any]] = {
    "mujoco": {
        "nworld": 3, "steps": 20, "frame_skip": 2,
    },
    "warp": {"nworld": 2, "steps": 20, "horizon": 6, "frame_skip": 1, "checks": MODEL_CHECKS},
}  # fmt: skip


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    sensordata: Row[float]


@wp.struct
class Params:
    noise: float = 0.05


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    k = lw.put(obs, k, s.qvel)
    lw.put(obs, k, s.sensordata)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.qvel[0]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(s.qvel.shape[0]):
        s.qvel[i] = lw.uniform(rng, -p.noise, p.noise)


class Made(lw.Task):
    horizon = 15


def task_with(model: str) -> type[lw.Task]:
    spec = mujoco.MjSpec.from_string(model)
    made = spec.copy().compile()
    obs = {"position": made.nq, "velocity": made.nv, "sensors": made.nsensordata}
    return type("Made", (Made,), {"model": spec, "obs": obs})


@pytest.mark.quick(
    "flex-warp", "sleep-mujoco", "mocap-warp", "keyframes-mujoco", "delays-warp", "equalities-mujoco",
    "delayed sensors-warp", "welds and sensors-mujoco",
)  # fmt: skip
@pytest.mark.parametrize("engine", OPTIONS)
@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_task_with_an_arbitrary_model_passes_check_task(model: str, engine: str) -> None:
    check_task(task_with(model), engine=engine, **OPTIONS[engine])


# these models use features that MuJoCo Warp lacks, such as plugins


@pytest.mark.quick("Actuator plugins not supported")
@pytest.mark.parametrize("model", PLUGINS.values(), ids=PLUGINS)
def test_task_that_only_the_mujoco_engine_supports_passes_check_task(model: str) -> None:
    check_task(task_with(model), engine="mujoco", nworld=2, steps=20, frame_skip=2, checks=MODEL_CHECKS)


@pytest.mark.parametrize(("reason", "model"), PLUGINS.items())
def test_model_that_the_warp_engine_does_not_support_raises_a_one_line_error(reason: str, model: str) -> None:
    task = task_with(model)
    with pytest.raises(ValueError, match=f"MuJoCo Warp refuses the model: .*{reason}.*; .* use engine='mujoco'$"):
        lw.make(task, engine="warp")


RICH = task_with(text(
    ARM + '<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" pos="2 0 3" radius=".02" '
    'mass=".1"><contact selfcollide="none"/><edge equality="true"/></flexcomp>',
    '<equality><connect name="hung" active="false" body1="hand" body2="world" anchor="0 0 0"/></equality>'
    + actuated('<motor name="push" joint="hinge" nsample="4" delay=".01"/>'),
))  # fmt: skip
FIELDS = ("eq_active", "history", "plastic", "energy", "flexvert_xpos", "flexedge_length", "flexedge_velocity")


def test_fields_that_only_some_models_have_are_equal_on_both_engines_and_in_mujoco(shared_env: SharedEnv) -> None:
    seen = []
    for engine in ("mujoco", "warp"):
        env = shared_env(RICH, engine=engine, nworld=2, fields=FIELDS)
        for _ in range(3):
            env.action.fill_(0.3)
            env.step()
        data = mujoco.MjData(env.model)
        state = env.get_state()[1, : env.engine.integration_size].numpy()
        mujoco.mj_setState(env.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION.value)
        mujoco.mj_forward(env.model, data)
        for name in ("eq_active", "energy", "flexvert_xpos", "flexedge_length", "flexedge_velocity"):
            found = env.field(name)[1].numpy().reshape(np.shape(getattr(data, name)))
            np.testing.assert_allclose(found, getattr(data, name), rtol=1e-4, atol=1e-4, err_msg=f"{engine} {name}")
        assert env.field("flexvert_xpos", "cloth").shape == (2, 9, 3)
        assert env.field("eq_active", "hung").dtype == torch.bool
        seen.append({name: env.field(name).float() for name in FIELDS})
    for name in FIELDS:
        torch.testing.assert_close(*(fields[name] for fields in seen), rtol=1e-3, atol=1e-3, msg=name)


def test_engines_agree_after_a_reset_activates_an_equality_constraint(shared_env: SharedEnv) -> None:
    ends = []
    for engine in ("mujoco", "warp"):
        env = shared_env(RICH, engine=engine, nworld=2, fields=FIELDS)
        env.reset()
        env.field("eq_active")[1, 0] = True
        env.engine.commit(wp.full(2, True, dtype=bool))
        for _ in range(10):
            env.step(torch.ones_like(env.action))
        assert env.field("eq_active", "hung").tolist() == [[False], [True]]
        ends.append(env.obs[:, :2].clone())
        state = env.get_state()
        env.reset()
        assert not env.field("eq_active", "hung").any()
        env.set_state(state)
        assert env.field("eq_active", "hung").tolist() == [[False], [True]]
    assert (ends[0][0] - ends[0][1]).abs().max() > 1e-3
    torch.testing.assert_close(*ends, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_rollout_accepts_an_empty_field(engine: str) -> None:
    env = lw.make(task_with(text(ARM)), engine=engine, nworld=2, autoreset=False, seed=1)
    rollout = lw.OpenLoop(env, 3)
    rollout.state.copy_(env.get_state()[0])
    rollout.actions.zero_()
    rollout.run()
    env.set_state(rollout.state.expand(2, -1).contiguous())
    for t in range(3):
        env.step(torch.zeros_like(env.action))
        assert torch.equal(rollout.reward[t], env.reward)
    assert rollout.reward.abs().min() > 0


# models without actuators, whose tasks define the actions


@wp.struct
class PushedWorld(World):
    qfrc_applied: Row[float]


@wp.func
def push(s: PushedWorld, action: Row[float], p: Params, ctrl: Row[float]):
    s.qfrc_applied[0] = action[0]


class Pushed(Made):
    World, control = PushedWorld, push
    model = mujoco.MjSpec.from_string(text(ARM, ""))
    obs = {"position": 2, "velocity": 2}
    actions = {"push": 1}
    action_range = (-1.0, 1.0)


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", OPTIONS)
def test_task_without_actuators_passes_check_task(engine: str) -> None:
    check_task(Pushed, engine=engine, **OPTIONS[engine])
