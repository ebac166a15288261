from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from table_task import Follow

import lyceum_warp as lw
from lyceum_warp.binding.parameters import Parameters
from lyceum_warp.core import OPTIONS

XML = """
<mujoco>
  <worldbody>
    <body name="upper"><joint name="shoulder"/><geom size=".1"/>
      <body name="lower"><joint name="elbow"/><geom size=".1"/><site name="tip"/></body>
    </body>
  </worldbody>
</mujoco>
"""


@wp.struct
class Params:
    dt: float
    gain: float = 1.0
    count: int = 3
    lively: bool = False
    offset: wp.vec3 = wp.vec3(0.0, 0.0, 0.5)
    tip: int = lw.site("tip")
    elbow: int = lw.dof("elbow")


@wp.struct
class Demanding:
    dt: float
    mass: float


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def parameters(model: mujoco.MjModel, struct: Any = Params, nworld: int = 2, **given: Any) -> Parameters:
    terms = SimpleNamespace(weights={})
    source: Any = SimpleNamespace(params=struct, defaults=struct.cls, name="arm", terms=terms)
    return Parameters(source, model, given, nworld=nworld, timestep=0.02)


def test_defaults_come_from_the_struct_and_dt_equals_the_timestep(model: mujoco.MjModel) -> None:
    values = parameters(model).values
    assert {name: values[name] for name in ("dt", "gain", "count", "lively")} == {
        "dt": 0.02, "gain": 1.0, "count": 3, "lively": False
    }  # fmt: skip
    assert list(values["offset"]) == [0.0, 0.0, 0.5]


def test_named_elements_become_model_indices(model: mujoco.MjModel) -> None:
    values = parameters(model).values
    assert (values["tip"], values["elbow"]) == (0, 1)
    for elbow in ("shoulder", lw.dof("shoulder"), 0):
        assert parameters(model, elbow=elbow).values["elbow"] == 0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gian": 2.0}, "there is no parameter 'gian': did you mean gain"),
        ({"dt": 0.1}, "there is no parameter 'dt'"),
        ({"num_envs": 4}, "no parameter 'num_envs': did you mean nworld"),
        ({"gain": "much"}, "the parameter gain='much' must be numbers"),
        ({"gain": np.nan}, "the parameter gain=nan is not a number"),
        ({"gain": [1.0, 2.0, 3.0]}, r"has shape \(3,\): it takes one number, or one per world, \(2,\)"),
        ({"offset": 1.0}, r"has shape \(\): it takes \(3,\), or one per world, \(2, 3\)"),
        ({"count": 2.5}, "count=2.5 must be a whole number"),
        ({"lively": 0.5}, "lively=0.5 must be a whole number"),
        ({"tip": 1}, "tip=1 is not an index of 'site_xpos': give an index from 0 to 0"),
        ({"tip": [0, -1]}, r"tip=\[0, -1\] is not an index of 'site_xpos'"),
        ({"tip": "top"}, "no site 'top'; it has: tip"),
        ({"tip": lw.body("lower")}, "tip=.* can't be an element of 'xpos': it takes site_xpos"),
        ({"gain": lw.body("lower")}, "gain=.* can't be an element of 'xpos'"),
    ],
)
def test_invalid_parameter_value_raises_an_error(given: dict[str, Any], message: str, model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match=message):
        parameters(model, **given)


def test_missing_value_of_a_parameter_without_default_raises_an_error(model: mujoco.MjModel) -> None:
    with pytest.raises(ValueError, match="needs values for mass"):
        parameters(model, Demanding)
    assert parameters(model, Demanding, mass=2).values["mass"] == 2.0


@pytest.mark.parametrize("name", OPTIONS)
def test_parameter_with_the_name_of_an_option_raises_an_error(name: str, model: mujoco.MjModel) -> None:
    struct = wp.struct(type("Params", (), {"__annotations__": {"dt": float, name: int}, name: 3}))
    message = f"the parameter '{name}' has the name of an option of make.*: rename it in Params"
    with pytest.raises(ValueError, match=message):
        parameters(model, struct)


def test_parameter_array_grows_only_if_values_differ_between_worlds(model: mujoco.MjModel) -> None:
    device = wp.get_device("cpu")
    shared = parameters(model, offset=(1, 2, 3), lively=True).array(device)
    assert shared.shape == (1,)
    assert (shared.numpy()["gain"].tolist(), shared.numpy()["offset"].tolist()) == ([1.0], [[1.0, 2.0, 3.0]])
    own = parameters(model, gain=[1.0, 2.0], offset=[(1, 2, 3), (4, 5, 6)], count=7).array(device).numpy()
    assert own["gain"].tolist() == [1.0, 2.0]
    assert own["offset"].tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert own["count"].tolist() == [7, 7]


# tables


@wp.struct
class Tables:
    dt: float
    motion: wp.array2d[float] = [[0.0, 1.0], [2.0, 3.0]]
    points: wp.array[wp.vec3] = np.ones((3, 3))
    order: wp.array[int] = (2, 0, 1)


def test_array_parameter_is_read_from_array_tensor_list_or_file(model: mujoco.MjModel, tmp_path: Path) -> None:
    rows = [[1.0, 2.0], [3.0, 4.0], [5.0, 6.5]]
    np.save(tmp_path / "rows.npy", rows)
    for given in (rows, np.array(rows), torch.tensor(rows, requires_grad=True), wp.array(rows, dtype=float),
                  tmp_path / "rows.npy", str(tmp_path / "rows.npy")):  # fmt: skip
        values = parameters(model, Tables, motion=given).values
        assert values["motion"].dtype == np.float32 and values["order"].dtype == np.int32
        np.testing.assert_array_equal(values["motion"], np.float32(rows))
    assert (values["points"].shape, values["order"].tolist()) == ((3, 3), [2, 0, 1])


def test_array_parameter_is_a_read_only_copy(model: mujoco.MjModel) -> None:
    given = np.zeros((2, 2), dtype=np.float32)
    values = parameters(model, Tables, motion=given).values
    given[0, 0] = 5.0
    assert values["motion"][0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        values["motion"][0, 0] = 1.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"motion": 1.0}, r"the parameter motion has shape \(\): it takes 2 axes, with no axis of length 0"),
        ({"motion": [1.0, 2.0]}, r"has shape \(2,\): it takes 2 axes"),
        ({"motion": np.zeros((0, 2))}, r"has shape \(0, 2\): it takes 2 axes, with no axis of length 0"),
        ({"motion": [[1.0], [2.0, 3.0]]}, "motion must be numbers: "),
        ({"motion": [[1.0, np.nan]]}, r"motion has nan at \[0, 1\]: it must be a finite number of 32 bits"),
        ({"motion": [[1e60, 1.0]]}, r"motion has 1e\+60 at \[0, 0\]: it must be a finite number of 32 bits"),
        ({"motion": "none.npy"}, "motion from 'none.npy' cannot be read, because there is no such file"),
        ({"points": [1.0, 2.0, 3.0]}, r"points has shape \(3,\): it takes 2 axes, the last \(3,\)"),
        ({"points": np.ones((3, 2))}, r"points has shape \(3, 2\): it takes 2 axes, the last \(3,\)"),
        ({"order": [0.5]}, r"order has 0.5 at \[0\]: it must be a whole number of 32 bits"),
        ({"order": [2**40]}, r"order has 1.*at \[0\]: it must be a whole number of 32 bits"),
    ],
)
def test_invalid_array_parameter_raises_an_error(given: dict[str, Any], message: str, model: mujoco.MjModel) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        parameters(model, Tables, **given)


def test_file_without_an_array_raises_an_error(model: mujoco.MjModel, tmp_path: Path) -> None:
    (tmp_path / "text.npy").write_text("1 2 3")
    np.savez(tmp_path / "several.npz", a=1)
    for name in ("text.npy", "several.npz"):
        with pytest.raises(ValueError, match=f"motion from '.*{name}' is not a file of np.save with numbers"):
            parameters(model, Tables, motion=tmp_path / name)


def test_array_of_another_type_raises_an_error(model: mujoco.MjModel) -> None:
    struct = wp.struct(type("Params", (), {"__annotations__": {"t": wp.array(dtype=wp.float64)}, "t": [1.0]}))
    with pytest.raises(ValueError, match="the parameter 't' has the type .*float64.*: a table is"):
        parameters(model, struct)


@wp.struct
class Named:
    dt: float
    joints: wp.array[int] = lw.dofs("elbow", "shoulder")
    chains: wp.array2d[int] = [lw.bodies("upper", "lower"), [lw.body("lower"), 0]]


def test_array_of_named_elements_contains_their_indices(model: mujoco.MjModel) -> None:
    found = parameters(model, Named).values
    assert (found["joints"].tolist(), found["chains"].tolist()) == ([1, 0], [[1, 2], [2, 0]])
    assert parameters(model, Named, joints=["shoulder"]).values["joints"].tolist() == [0]
    assert parameters(model, Named, joints=[1, 1, 0]).values["joints"].tolist() == [1, 1, 0]


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (["knee"], "the model has no joint 'knee'; it has: elbow, shoulder"),
        ([0, 2], "joints is not an index of 'qvel': give an index from 0 to 1, or a name"),
        (lw.sites("tip"), "joints can't be an element of 'site_xpos': it takes qvel"),
    ],
)
def test_array_with_elements_of_another_kind_raises_an_error(
    joints: list[Any], message: str, model: mujoco.MjModel
) -> None:
    with pytest.raises(ValueError, match=message):
        parameters(model, Named, joints=joints)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_functions_read_new_arrays_after_graphs_are_captured(engine: str) -> None:
    env = lw.make(Follow, engine=engine, nworld=2)

    def first_steps() -> torch.Tensor:
        env.reset()
        seen = [env.obs[:, 1:].clone()]
        for _ in range(3):
            env.step()
            seen.append(env.obs[:, 1:].clone())
        return torch.stack(seen)[:, 0]

    assert first_steps().tolist() == [[0, 1, 3], [0.5, 2, 3], [1, 3, 3], [1, 3, 3]]
    first_steps()
    env.set_params(motion=[[4.0, 5.0], [6.0, 7.0], [8.0, 9.0]])
    assert first_steps().tolist() == [[4, 5, 3], [6, 7, 3], [8, 9, 3], [8, 9, 3]]
    env.set_params(motion=[[2.0, 1.0], [3.0, 0.0]], points=[(0.0, 0.0, 7.0), (0.0, 0.0, 1.0)])
    assert first_steps().tolist() == [[2, 1, 7], [3, 0, 7], [3, 0, 7], [3, 0, 7]]
    env.set_params(gain=[1.0, 2.0])
    assert first_steps().tolist() == [[2, 1, 7], [3, 0, 7], [3, 0, 7], [3, 0, 7]]
    torch.testing.assert_close(env.reward[1], 2.0 * env.reward[0])


def test_changed_arrays_reach_replicas_planners_and_evaluations() -> None:
    motion = np.array([[0.25, 0.0]])
    env = lw.make(Follow, motion=motion, gain=[1.0, 2.0], nworld=2)
    motion[:] = 9.0
    more = env.replicate(nworld=3)
    assert more.obs[:, 1].tolist() == [0.25] * 3
    env.set_params(motion=[[0.75, 0.0], [0.5, 0.0]])
    more.follow(env)
    more.reset()
    assert more.obs[:, 1].tolist() == [0.75] * 3
    assert env.get_obs(env.get_state())[0, 1] == 0.75
    env.set_params(motion=[[0.5, 0.0]])
    assert env.get_obs(env.get_state())[0, 1] == 0.5
    planner = lw.MPPI(Follow, samples=4, horizon=2, motion=[[0.125, 0.0]])
    assert planner.env.obs[0, 1] == 0.125
    npg = lw.NPG(env, config=lw.NPGConfig(samples=32, hidden=(4,), value_hidden=(4,), mean_every=1, mean_episodes=2))
    assert next(npg).mean_return is not None


# parameters computed from the model


@wp.struct
class Computed:
    dt: float
    tip: int = lw.site("tip")
    body: int = lw.from_model(lambda model, p: model.site_bodyid[p.tip])
    masses: wp.array[float] = lw.from_model(lambda model, p: model.body_mass[1 : p.body + 1])


def test_parameters_are_computed_from_the_model_and_from_earlier_parameters(model: mujoco.MjModel) -> None:
    found = parameters(model, Computed)
    assert found.values["body"] == 2
    np.testing.assert_allclose(found.values["masses"], model.body_mass[1:3], rtol=1e-6)
    assert found.changed({"tip": 0}).values["masses"] is found.values["masses"], "a table may be on a device already"
    other = found.changed({"body": 1})
    assert len(other.values["masses"]) == 1 and len(found.values["masses"]) == 2
    assert other.changed({"tip": 0}).values["body"] == 1, "a value that was given is not computed again"


def test_error_names_the_parameter_that_cannot_be_computed(model: mujoco.MjModel) -> None:
    broken = lw.from_model(lambda model, p: model.body_mas[0])
    struct = wp.struct(type("Params", (), {"__annotations__": {"dt": float, "body": int}, "body": broken}))
    with pytest.raises(ValueError, match="parameter body can't be computed: Attri.* 'body_mas'"):
        parameters(model, struct)
    assert parameters(model, struct, body=1).values["body"] == 1
