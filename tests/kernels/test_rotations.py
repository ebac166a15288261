from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import warp as wp
from checks import check_uniform

import lyceum_warp as lw

N = 2000


@wp.kernel(enable_backward=False)
def compute(
    a_in: wp.array[wp.vec4], b_in: wp.array[wp.vec4], v_in: wp.array[wp.vec3], angle_in: wp.array[float],
    mul_out: wp.array[wp.vec4], inverse_out: wp.array[wp.vec4], rotate_out: wp.array[wp.vec3],
    rotate_inverse_out: wp.array[wp.vec3], from_axis_angle_out: wp.array[wp.vec4], from_rotvec_out: wp.array[wp.vec4],
    to_rotvec_out: wp.array[wp.vec3], difference_out: wp.array[wp.vec3], angle_out: wp.array[float],
    to_mat_out: wp.array[wp.mat33], from_euler_out: wp.array[wp.vec4],
    to_euler_out: wp.array[wp.vec3],
):  # fmt: skip
    """Call every function on a pair of quaternions, a vector and an angle; launched over (n,)."""
    i = wp.tid()
    a, b, v = a_in[i], b_in[i], v_in[i]
    mul_out[i] = lw.quat_mul(a, b)
    inverse_out[i] = lw.quat_inverse(a)
    rotate_out[i] = lw.quat_rotate(a, v)
    rotate_inverse_out[i] = lw.quat_rotate_inverse(a, v)
    from_axis_angle_out[i] = lw.quat_from_axis_angle(wp.normalize(v), angle_in[i])
    from_rotvec_out[i] = lw.quat_from_rotvec(v)
    to_rotvec_out[i] = lw.quat_to_rotvec(a)
    difference_out[i] = lw.quat_difference(a, b)
    angle_out[i] = lw.quat_angle(a, b)
    to_mat_out[i] = lw.quat_to_mat(a)
    from_euler_out[i] = lw.quat_from_euler(v)
    to_euler_out[i] = lw.quat_to_euler(a)


@wp.kernel(enable_backward=False)
def draw(rng_inout: wp.array2d[wp.uint32], quat_out: wp.array2d[wp.vec4]):
    """Draw two quaternions from each stream; launched over (n,)."""
    i = wp.tid()
    rng_inout[i, 0] = wp.rand_init(3, i)
    for k in range(2):
        quat_out[i, k] = lw.quat_random(rng_inout[i])


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def inputs() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The first rows are edge cases."""
    rng = np.random.default_rng(0)
    a, b = (unit(rng.normal(size=(N, 4))) for _ in range(2))
    v, angle = rng.normal(size=(N, 3)), rng.uniform(-7, 7, N)
    a[:8] = np.vstack([np.eye(4), -np.eye(4)])
    a[8:12] = unit(np.array([[1, 1e-4, -2e-4, 0], [-1, 1e-4, 0, 1e-4], [1e-5, 1, 0, 0], [1, 1e-25, 0, 0]]))
    b[12], b[13] = a[12], -a[13]
    a[14:16] = unit(np.array([[1, 0, 1, 0], [1, 1, -1, -1]]))
    v[:2], angle[0] = [[0, 0, 0], [1e-6, 0, 0]], 0.0
    return a.astype(np.float32), b.astype(np.float32), v.astype(np.float32), angle.astype(np.float32)


@pytest.fixture(scope="module")
def found() -> dict[str, np.ndarray]:
    types = (wp.vec4, wp.vec4, wp.vec3, float)
    arguments = [wp.array(x, dtype=t, device="cpu") for x, t in zip(inputs(), types, strict=True)]
    outputs = {arg.label.removesuffix("_out"): arg.type for arg in compute.adj.args[4:]}
    arrays = {name: wp.zeros(N, dtype=kind.dtype, device="cpu") for name, kind in outputs.items()}
    wp.launch(compute, N, [*arguments, *arrays.values()], device="cpu")
    return {name: array.numpy().astype(float) for name, array in arrays.items()}


def mju(function: Callable[..., None], size: int, *columns: np.ndarray) -> np.ndarray:
    results = np.zeros((N, size))
    for row, *values in zip(results, *(column.astype(float) for column in columns), strict=True):
        function(row, *values)
    return results


def check(found: np.ndarray, expected: np.ndarray, tolerance: float = 2e-6) -> None:
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=tolerance, rtol=tolerance)


def test_quaternion_products_and_inverses_equal_those_of_mujoco(found: dict[str, np.ndarray]) -> None:
    a, b, _, _ = inputs()
    check(found["mul"], mju(mujoco.mju_mulQuat, 4, a, b))
    check(found["inverse"], mju(mujoco.mju_negQuat, 4, a))
    check(found["to_mat"].reshape(N, 9), mju(mujoco.mju_quat2Mat, 9, a))


def test_rotated_vectors_equal_those_of_mujoco(found: dict[str, np.ndarray]) -> None:
    a, _, v, _ = inputs()
    check(found["rotate"], mju(mujoco.mju_rotVecQuat, 3, v, a), 5e-6)
    check(found["rotate_inverse"], mju(mujoco.mju_rotVecQuat, 3, v, mju(mujoco.mju_negQuat, 4, a)), 5e-6)


def test_quaternions_from_axis_and_angle_equal_those_of_mujoco(found: dict[str, np.ndarray]) -> None:
    _, _, v, angle = inputs()
    length = np.linalg.norm(v.astype(float), axis=1)
    axis = v / np.maximum(length, 1e-30)[:, None]
    check(found["from_axis_angle"][1:], mju(mujoco.mju_axisAngle2Quat, 4, axis, angle)[1:])
    check(found["from_rotvec"], mju(mujoco.mju_axisAngle2Quat, 4, axis, length))
    assert found["from_axis_angle"][0].tolist() == found["from_rotvec"][0].tolist() == [1, 0, 0, 0]


def test_rotation_vectors_equal_those_of_mujoco(found: dict[str, np.ndarray]) -> None:
    a, b, _, _ = inputs()
    check(found["to_rotvec"], mju(lambda row, q: mujoco.mju_quat2Vel(row, q, 1.0), 3, a), 1e-5)
    difference = mju(mujoco.mju_subQuat, 3, a, b)
    close = np.linalg.norm(difference, axis=1) < 3.1  # near pi, both signs of the rotation vector are correct
    assert close.mean() > 0.95
    check(found["difference"][close], difference[close], 1e-5)
    check(found["angle"], np.linalg.norm(difference, axis=1), 1e-5)
    assert found["angle"][12] == 0 and found["angle"].max() <= 3.1415928


def test_small_rotations_do_not_lose_precision(found: dict[str, np.ndarray]) -> None:
    a, _, _, _ = inputs()
    np.testing.assert_allclose(found["to_rotvec"][8], 2 * a[8, 1:].astype(float), rtol=1e-6)
    np.testing.assert_allclose(found["to_rotvec"][9], -2 * a[9, 1:].astype(float), rtol=1e-6)
    np.testing.assert_allclose(found["to_rotvec"][11], [2e-25, 0, 0], rtol=1e-6)
    np.testing.assert_allclose(found["from_rotvec"][1], [1, 0.5e-6, 0, 0], rtol=1e-6)


def test_euler_angles_equal_those_of_mujoco(found: dict[str, np.ndarray]) -> None:
    a, _, v, _ = inputs()

    def from_euler(angles: np.ndarray) -> np.ndarray:
        return mju(lambda row, angles: mujoco.mju_euler2Quat(row, angles, "xyz"), 4, angles)

    check(found["from_euler"], from_euler(v))
    back = from_euler(found["to_euler"])
    sign = np.sign(np.sum(a * back, axis=1))[:, None]
    check(sign * back, a.astype(float), 5e-6)
    assert np.abs(found["to_euler"][:, 1]).max() <= np.pi / 2 + 1e-6
    right = np.abs(found["to_euler"][:, 1]) > np.pi / 2 - 1e-6
    assert right[[14, 15]].all() and not found["to_euler"][[14, 15], 0].any()


def test_random_rotations_are_uniform_and_independent() -> None:
    n = 4000
    rng, quats = (wp.zeros((n, k), dtype=t, device="cpu") for k, t in ((1, wp.uint32), (2, wp.vec4)))
    wp.launch(draw, n, [rng, quats], device="cpu")
    draws = quats.numpy().astype(float)
    np.testing.assert_allclose(np.linalg.norm(draws, axis=2), 1, atol=1e-6)
    for first, second, third, fourth in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2)):
        columns = []
        for q in draws.transpose(1, 0, 2):
            columns += [
                2 * (q[:, first] ** 2 + q[:, second] ** 2) - 1,
                np.arctan2(q[:, first], q[:, second]) / np.pi,
                np.arctan2(q[:, third], q[:, fourth]) / np.pi,
            ]
        check_uniform(np.stack(columns, axis=1))


@wp.struct
class Bodies:
    cvel: wp.array[wp.spatial_vector]
    com: wp.array[wp.vec3]
    pos: wp.array[wp.vec3]


@wp.kernel
def velocities(b: Bodies, out: wp.array[wp.spatial_vector]):
    i = wp.tid()
    out[i] = lw.body_velocity(b.cvel[i], b.com[i], b.pos[i])


def test_body_velocities_equal_those_of_mujoco() -> None:
    model = lw.gymnasium_model("humanoid.xml").spec().compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] += rng.uniform(-0.5, 0.5, model.nq)
    data.qvel[:] = rng.uniform(-5.0, 5.0, model.nv)
    mujoco.mj_forward(model, data)
    bodies = Bodies()
    fields = {"cvel": data.cvel, "com": data.subtree_com[model.body_rootid], "pos": data.xpos}
    for name, values in fields.items():
        setattr(bodies, name, wp.array(values, dtype=Bodies.vars[name].type.dtype, device="cpu"))
    out, wanted = wp.zeros(model.nbody, dtype=wp.spatial_vector, device="cpu"), np.zeros((model.nbody, 6))
    wp.launch(velocities, model.nbody, [bodies, out], device="cpu")
    for body in range(model.nbody):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, wanted[body], 0)
    assert np.abs(wanted).max() > 5.0
    np.testing.assert_allclose(out.numpy(), wanted, atol=2e-5)
