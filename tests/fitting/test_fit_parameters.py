import mujoco
import numpy as np
import pytest
from hidden_robots import ARM

import lyceum_warp as lw
from lyceum_warp.fitting.parameters import Parameters

MODEL = mujoco.MjSpec.from_string(ARM).compile()


def test_parameter_is_shared_or_one_for_each_element() -> None:
    assert Parameters(["dof_damping.*"], MODEL).names == ["dof_damping.*"]
    assert Parameters([lw.Parameter(name="dof_damping.*", each=True)], MODEL).names == [
        "dof_damping.shoulder", "dof_damping.elbow",
    ]  # fmt: skip
    model = Parameters(["dof_damping.*"], MODEL).model(np.array([np.log(2.0)]))
    assert np.allclose(model.dof_damping, 2 * MODEL.dof_damping)


def test_gains_scale_servos_and_masses_scale_inertias() -> None:
    bound = Parameters(["kp.elbow", "kd.elbow", "body_mass.lower"], MODEL)
    model = bound.model(np.log([2.0, 3.0, 0.5]))
    assert model.actuator_gainprm[1, 0] == pytest.approx(30.0)
    assert model.actuator_biasprm[1, 1:3] == pytest.approx([-30.0, -1.5])
    assert model.body_inertia[2] == pytest.approx(0.5 * MODEL.body_inertia[2])
    assert model.body_subtreemass[1] == pytest.approx(MODEL.body_mass[1] + 0.5 * MODEL.body_mass[2])


def test_any_inertia_is_physical_and_zero_is_the_nominal_one() -> None:
    bound = Parameters(["inertia.lower"], MODEL)
    assert bound.size == 10
    near = bound.model(np.full(10, 1e-12))
    assert near.body_mass[2] == pytest.approx(MODEL.body_mass[2])
    assert near.body_ipos[2] == pytest.approx(MODEL.body_ipos[2], abs=1e-9)
    assert np.sort(near.body_inertia[2]) == pytest.approx(np.sort(MODEL.body_inertia[2]))
    for seed in range(20):
        model = bound.model(np.random.default_rng(seed).normal(size=10))
        a, b, c = np.sort(model.body_inertia[2])
        assert model.body_mass[2] > 0.0 and a > 0.0 and a + b >= c


def test_a_field_that_is_zero_grows_from_zero() -> None:
    bound = Parameters(["dof_frictionloss.*"], MODEL)
    assert bound.low[0] == 0.0 and np.allclose(bound.model(np.array([0.2])).dof_frictionloss, 0.2)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dof_damping", "must be FIELD.ELEMENTS"),
        ("dof_dampin.*", "did you mean dof_damping"),
        ("dof_damping.elbo", "did you mean elbow"),
        ("geom_friction.rod[3]", "has 3 columns"),
        ("delay.ctrl.wrist", "fits no element"),
        ("opt.timestep", "can't be fitted"),
    ],
)
def test_invalid_parameter_is_refused_with_a_hint(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Parameters([name], MODEL)


def test_bounds_must_contain_the_nominal_value() -> None:
    with pytest.raises(ValueError, match="must lie around the nominal value"):
        Parameters([lw.Parameter(name="kp.*", low=1.2)], MODEL)
    with pytest.raises(ValueError, match="is given twice"):
        Parameters(["kp.*", "kp.*"], MODEL)


def test_excitations_stay_within_limits_and_start_in_the_middle() -> None:
    for kind in ("chirp", "steps", "walk"):
        u = lw.excitation([-1.0, 0.0], [1.0, 3.0], kind, seconds=4.0, rate=50, seed=3)
        assert u.shape == (200, 2) and (u >= [-1.0, 0.0]).all() and (u <= [1.0, 3.0]).all()
        assert np.allclose(u[0], [0.0, 1.5]) and u.std(axis=0).min() > 0.2
        assert abs(np.corrcoef(u.T)[0, 1]) < 0.5
    with pytest.raises(ValueError, match="low below high"):
        lw.excitation([1.0], [0.0])
