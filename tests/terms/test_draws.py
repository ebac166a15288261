import numpy as np
from checks import check_uniform
from term_calls import N, call

RNG = np.random.default_rng(0)


def centred(x: np.ndarray, low: float, high: float) -> np.ndarray:
    scaled = (x - (low + high) / 2) / ((high - low) / 2)
    assert np.abs(scaled).max() < 1.0 + 1e-4
    return np.clip(scaled, -1.0, 1.0)


def test_random_numbers_have_the_expected_distributions() -> None:
    check_uniform(centred(np.log(call("log_uniform", low=1e-4, high=2.0).result[:, None]), np.log(1e-4), np.log(2.0)))
    counts = np.bincount(call("uniform_int", least=2, most=5).result)
    assert counts[:2].sum() == 0 and len(counts) == 6 and np.abs(counts[2:] - N / 4).max() < 5 * np.sqrt(N * 3 / 16)
    assert abs(call("chosen", share=0.3).result.mean() - 0.3) < 5 * np.sqrt(0.21 / N)
    row = call("draw_row", row=np.zeros(4), low=-0.1, high=0.3).after["row"]
    check_uniform(centred(row, -0.1, 0.3))


def test_only_the_listed_elements_are_scaled() -> None:
    row = RNG.uniform(1.0, 2.0, (N, 5))
    ratio = call("scale_elements", row=row, indices=[3, 1], scale=[0.5, 2.0]).after["row"] / row
    check_uniform(centred(ratio[:, [1, 3]], 0.5, 2.0))
    np.testing.assert_allclose(ratio[:, [0, 2, 4]], 1.0, rtol=1e-6)


def test_randomized_mass_and_inertia_are_scaled_by_the_same_factor() -> None:
    mass, inertia = RNG.uniform(1.0, 2.0, (N, 4)), RNG.uniform(1.0, 2.0, (N, 4, 3))
    after = call("scale_mass", body_mass=mass, body_inertia=inertia, bodies=[1, 3], scale=[0.8, 1.2]).after
    factor = after["body_mass"] / mass
    check_uniform(centred(factor[:, [1, 3]], 0.8, 1.2))
    np.testing.assert_allclose(after["body_inertia"] / inertia, np.repeat(factor[..., None], 3, axis=2), rtol=1e-6)
    np.testing.assert_allclose(factor[:, [0, 2]], 1.0, rtol=1e-6)


def test_randomized_gains_are_consistent_in_gainprm_and_biasprm() -> None:
    gain, bias = np.zeros((N, 3, 10)), np.zeros((N, 3, 10))
    gain[..., 0], bias[..., 1], bias[..., 2], bias[..., 0] = 30.0, -30.0, -2.0, 0.5
    after = call(
        "scale_gains", actuator_gainprm=gain, actuator_biasprm=bias, actuators=[2, 0], kp_scale=[0.8, 1.3],
        kd_scale=[0.5, 1.5],
    ).after  # fmt: skip
    gain, bias = after["actuator_gainprm"], after["actuator_biasprm"]
    np.testing.assert_allclose(gain[..., 0], -bias[..., 1], rtol=1e-6)
    check_uniform(np.hstack([centred(gain[:, [0, 2], 0] / 30, 0.8, 1.3), centred(bias[:, [0, 2], 2] / -2, 0.5, 1.5)]))
    assert (gain[:, 1, 0] == 30).all() and (bias[:, 1, 2] == -2).all() and (bias[..., 0] == 0.5).all()
    assert (gain[..., 1:] == 0).all() and (bias[..., 3:] == 0).all()
