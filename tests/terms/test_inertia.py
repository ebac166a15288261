import mujoco
import numpy as np
import pytest
from term_calls import N, call

RNG = np.random.default_rng(0)


def of_points(mass: np.ndarray, points: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Compute the mass, centre and inertia of k point masses (k,) at positions (k, 3).

    The inertia is about the centre of mass, in the body's axes.
    """
    centre = mass @ points / mass.sum()
    x = points - centre
    second = np.einsum("k,ki,kj->ij", mass, x, x)
    return mass.sum(), centre, np.trace(second) * np.eye(3) - second


def fields(mass: np.ndarray, points: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    total, centre, inertia = of_points(mass, points)
    moments, axes = np.linalg.eigh(inertia)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (axes * np.linalg.det(axes)).ravel())
    return total, centre, moments, quat


def tensor(moments: np.ndarray, quat: np.ndarray) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, quat.astype(float))
    axes = axes.reshape(3, 3)
    return np.asarray(axes @ np.diag(moments) @ axes.T)


def bodies(thickness: float) -> tuple[list[tuple[np.ndarray, np.ndarray]], dict[str, np.ndarray]]:
    """Draw a flat cloud of six point masses per world."""
    clouds = [
        (RNG.uniform(0.1, 2.0, 6), RNG.standard_normal((6, 3)) * [1.0, 0.3, thickness] + RNG.standard_normal(3))
        for _ in range(N)
    ]
    mass, ipos, inertia, iquat = (np.stack(each) for each in zip(*(fields(*cloud) for cloud in clouds), strict=True))
    names = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    return clouds, {
        name: np.stack([np.ones_like(rows), rows], axis=1)
        for name, rows in zip(names, (mass, ipos, inertia, iquat), strict=True)
    }


@pytest.mark.parametrize("size", [0.1, 0.8])
@pytest.mark.parametrize("thickness", [0.5, 1e-3])
def test_changed_inertia_equals_the_inertia_of_changed_point_masses(size: float, thickness: float) -> None:
    clouds, before = bodies(thickness)
    changes = {name: RNG.uniform(-size, size, (N, 3)) for name in ("stretch", "shear", "shift")}
    density = RNG.uniform(-size, size, N)
    after = call("change_inertia", body=1, density=density, **changes, **before).after
    for world, (mass, points) in enumerate(clouds):
        stretch, shear, shift = (changes[name][world] for name in changes)
        linear = np.diag(np.exp(stretch))
        linear[0, 1], linear[0, 2], linear[1, 2] = shear
        total, centre, inertia = of_points(mass * np.exp(2 * density[world]), points @ linear.T + shift)
        np.testing.assert_allclose(after["body_mass"][world, 1], total, rtol=1e-5)
        np.testing.assert_allclose(after["body_ipos"][world, 1], centre, atol=1e-5)
        quat, moments = after["body_iquat"][world, 1], after["body_inertia"][world, 1]
        assert abs(np.linalg.norm(quat) - 1.0) < 1e-5
        np.testing.assert_allclose(tensor(moments, quat), inertia, atol=2e-5 * np.abs(inertia).max())
        assert moments.min() > 0.0 and 2 * moments.max() < moments.sum() * (1 + 1e-5)  # MuJoCo's triangle inequality
    for name, rows in before.items():
        np.testing.assert_array_equal(after[name][:, 0], rows[:, 0].astype(np.float32))


def test_a_change_of_density_keeps_the_principal_axes() -> None:
    _, before = bodies(0.5)
    zeros = {name: np.zeros(3) for name in ("stretch", "shear", "shift")}
    after = call("change_inertia", body=1, density=0.2, **zeros, **before).after
    np.testing.assert_allclose(after["body_inertia"][:, 1], np.exp(0.4) * before["body_inertia"][:, 1], rtol=1e-5)
    for name in ("body_ipos", "body_iquat"):
        np.testing.assert_allclose(after[name], before[name], atol=2e-6)


def test_randomized_inertias_differ_between_worlds_within_their_bounds() -> None:
    _, before = bodies(0.5)
    still = {name: np.zeros(3) for name in ("stretch", "shear")}
    after = call("draw_inertia", body=1, density=0.2, shift=[0.1, 0.2, 0.0], **still, **before).after
    density = np.log(after["body_mass"][:, 1] / before["body_mass"][:, 1]) / 2
    shift = (after["body_ipos"] - before["body_ipos"])[:, 1]
    assert 0.19 < np.abs(density).max() < 0.2001 and np.abs(density.mean()) < 0.05
    assert (np.abs(shift).max(axis=0) < [0.1001, 0.2001, 1e-5]).all() and (
        np.abs(shift).max(axis=0) > [0.09, 0.19, -1]
    ).all()
    sheared = call("draw_inertia", body=1, density=0.0, stretch=[0.1] * 3, shear=[0.1] * 3, shift=[0.0] * 3, **before)
    assert len(np.unique(sheared.after["body_iquat"][:, 1, 0])) > N - 5
    assert np.ptp(sheared.after["body_mass"][:, 1] / before["body_mass"][:, 1]) < 1e-5
    assert np.ptp(sheared.after["body_inertia"][:, 1] / before["body_inertia"][:, 1]) > 0.1


def test_eigenvectors_diagonalise_a_matrix_of_any_rank_by_a_rotation() -> None:
    factors = RNG.standard_normal((N, 3, 3)) * np.exp(RNG.uniform(-6.0, 2.0, (N, 1, 3)))
    factors[:20, :, 0] = 0.0
    factors[:10, :, 1] = 0.0
    factors[20:30] = np.eye(3)
    matrices = factors @ np.moveaxis(factors, 1, 2)
    axes = call("symmetric_eigenvectors", matrix=matrices).result.astype(float)
    np.testing.assert_allclose(axes @ np.moveaxis(axes, 1, 2), np.broadcast_to(np.eye(3), axes.shape), atol=5e-6)
    assert (np.linalg.det(axes) > 0).all()
    turned = np.moveaxis(axes, 1, 2) @ matrices @ axes
    rest = turned * (1 - np.eye(3))
    assert (np.abs(rest).max(axis=(1, 2)) <= 2e-6 * np.abs(matrices).max(axis=(1, 2))).all()
