import mujoco
import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw

SIGMOIDS = {sigmoid.name.lower(): sigmoid for sigmoid in lw.Sigmoid}
INF = np.inf


@wp.kernel
def tolerances(x: wp.array[float], bounds: wp.vec2, margin: float, sigmoid: int, v: float, out: wp.array[float]):
    i = wp.tid()
    out[i] = lw.tolerance(x[i], bounds, margin, sigmoid, v)


def tolerance(x: np.ndarray, bounds: tuple[float, float], margin: float, sigmoid: int, v: float) -> np.ndarray:
    out = wp.zeros(len(x), dtype=float, device="cpu")
    args = [wp.array(x, dtype=float, device="cpu"), wp.vec2(*bounds), margin, int(sigmoid), v, out]
    wp.launch(tolerances, len(x), args, device="cpu")
    found: np.ndarray = out.numpy()
    return found


@pytest.mark.parametrize("name", SIGMOIDS)
def test_tolerance_equals_that_of_dm_control(name: str) -> None:
    rewards = pytest.importorskip("dm_control.utils.rewards", reason="dm_control is the oracle of tolerance")
    x = np.linspace(-5.0, 5.0, 201, dtype=np.float32)
    values = (0.05, 0.1, 0.7) + ((0.0,) if name in ("cosine", "linear", "quadratic") else ())
    for bounds in ((0.0, 0.0), (-1.0, 0.5), (1.0, INF), (-INF, -2.0)):
        for margin in (0.3, 2.0):
            for v in values:
                wanted = rewards.tolerance(x, bounds, margin, name, v)
                np.testing.assert_allclose(tolerance(x, bounds, margin, SIGMOIDS[name], v), wanted, atol=2e-6)
    wanted = rewards.tolerance(x, (-1.0, 0.5), 0.0)
    np.testing.assert_array_equal(tolerance(x, (-1.0, 0.5), 0.0, SIGMOIDS[name], 0.1), wanted)


@wp.struct
class Rows:
    numbers: wp.array[float]
    vectors: wp.array[wp.vec3]
    spatial: wp.array[wp.spatial_vector]
    quats: wp.array[wp.vec4]
    matrices: wp.array[wp.mat33]


@wp.kernel
def write_rows(r: Rows, out: wp.array[float], last: wp.array[int]):
    k = lw.put(out, 0, 0.25)
    k = lw.put(out, k, 3)
    k = lw.put(out, k, out[0] > 0.0)
    k = lw.put(out, k, out[0] < 0.0)
    k = lw.put(out, k, r.numbers)
    k = lw.put(out, k, r.numbers, 1, 3)
    k = lw.put(out, k, r.vectors)
    k = lw.put(out, k, r.vectors, 1, 2)
    k = lw.put(out, k, r.vectors[0])
    k = lw.put(out, k, r.spatial, 0, 1)
    k = lw.put(out, k, r.quats[1])
    k = lw.put(out, k, r.matrices[0])
    last[0] = lw.put(out, k, r.matrices)


@wp.kernel
def sum_rows(r: Rows, out: wp.array[float]):
    out[0] = lw.sum_squares(r.numbers)
    out[1] = lw.sum_squares(r.numbers, 1, 3)
    out[2] = lw.sum_squares(r.vectors)
    out[3] = lw.sum_squares(r.spatial, 1, 2)


@pytest.fixture(scope="module")
def rows() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = {"numbers": (4,), "vectors": (2, 3), "spatial": (2, 6), "quats": (2, 4), "matrices": (2, 3, 3)}
    return {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}


@pytest.fixture(scope="module")
def struct(rows: dict[str, np.ndarray]) -> Rows:
    made = Rows()
    for name, values in rows.items():
        setattr(made, name, wp.array(values, dtype=Rows.vars[name].type.dtype, device="cpu"))
    return made


def test_put_writes_numbers_vectors_and_arrays_one_after_another(rows: dict[str, np.ndarray], struct: Rows) -> None:
    out, last = wp.zeros(80, dtype=float, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    wp.launch(write_rows, 1, [struct, out, last], device="cpu")
    parts = [
        [0.25, 3.0, 1.0, 0.0],
        rows["numbers"], rows["numbers"][1:3], rows["vectors"], rows["vectors"][1], rows["vectors"][0],
        rows["spatial"][0], rows["quats"][1], rows["matrices"][0], rows["matrices"],
    ]  # fmt: skip
    wanted = np.concatenate([np.ravel(part) for part in parts])
    assert last.numpy()[0] == len(wanted)
    np.testing.assert_array_equal(out.numpy(), np.concatenate([wanted, np.zeros(80 - len(wanted))]))


def test_sum_of_squares_accepts_numbers_and_vectors(rows: dict[str, np.ndarray], struct: Rows) -> None:
    out = wp.zeros(4, dtype=float, device="cpu")
    wp.launch(sum_rows, 1, [struct, out], device="cpu")
    parts = [rows["numbers"], rows["numbers"][1:3], rows["vectors"], rows["spatial"][1]]
    np.testing.assert_allclose(out.numpy(), [np.square(part).sum() for part in parts], rtol=1e-6)


@wp.kernel
def bound(x: wp.array[float], limits: wp.vec2, one: wp.array[bool], every: wp.array[bool]):
    i = wp.tid()
    one[i] = lw.inside(x[i], limits)
    every[i] = lw.all_inside(x, i, x.shape[0], limits)


def test_number_at_a_bound_and_nan_are_not_inside_the_bounds() -> None:
    x = np.array([np.nan, -1.0, INF, -INF, 2.0, 1.999, 0.0], dtype=np.float32)
    one, every = (wp.zeros(len(x), dtype=bool, device="cpu") for _ in range(2))
    wp.launch(bound, len(x), [wp.array(x, dtype=float, device="cpu"), wp.vec2(-1.0, 2.0), one, every], device="cpu")
    assert one.numpy().tolist() == [False] * 5 + [True] * 2
    assert every.numpy().tolist() == [False] * 5 + [True] * 2


@wp.kernel
def angles(a: wp.array[wp.vec3], b: wp.array[wp.vec3], out: wp.array[float]):
    i = wp.tid()
    out[i] = lw.angle_between(a[i], b[i])


def test_angle_between_two_vectors_is_exact_near_zero_and_pi() -> None:
    """An arc cosine in float32 would return 0 for angles below 2e-4."""
    wanted = np.array([0.0, 1e-5, 1e-3, 0.5, np.pi / 2, 3.0, np.pi - 1e-5, np.pi])
    a = np.tile([2.0, 0.0, 0.0], (len(wanted), 1))
    b = 0.3 * np.stack([np.cos(wanted), np.sin(wanted), 0.0 * wanted], axis=1)
    out = wp.zeros(len(wanted), dtype=float, device="cpu")
    args = [wp.array(values, dtype=wp.vec3, device="cpu") for values in (a, b)]
    wp.launch(angles, len(wanted), [*args, out], device="cpu")
    np.testing.assert_allclose(out.numpy(), wanted, atol=5e-7)


@wp.kernel
def grasps(distance: wp.array[float], finger: wp.array[float], out: wp.array2d[float]):
    i = wp.tid()
    near, reach, grasp = lw.grasp_terms(distance[i], finger[i], 0.01)
    out[i, 0] = near
    out[i, 1] = reach
    out[i, 2] = grasp


def test_grasp_terms_match_the_documented_values() -> None:
    cases = {  # (distance, finger opening): expected (near, reach, grasp)
        (0.0, 0.005): (1.0, 1.0, 1.0),
        (0.0, 0.04): (1.0, 1.0, 0.0),
        (0.02, 0.04): (0.1, 1.0 / 1.6, 0.45),
        (0.105, 0.04): (0.0, 0.2, 0.5),
        (0.105, 0.005): (0.0, 0.2, 0.0),
        (0.105, 0.03): (0.0, 0.2, 0.45),
    }
    distance, finger = (wp.array(x, dtype=float, device="cpu") for x in zip(*cases, strict=True))
    out = wp.zeros((len(cases), 3), dtype=float, device="cpu")
    wp.launch(grasps, len(cases), [distance, finger, out], device="cpu")
    np.testing.assert_allclose(out.numpy(), list(cases.values()), atol=1e-6)


@wp.struct
class Bodies:
    cvel: wp.array[wp.spatial_vector]
    com: wp.array[wp.vec3]
    pos: wp.array[wp.vec3]
    quat: wp.array[wp.vec4]


@wp.kernel
def velocities(b: Bodies, world: wp.array[wp.spatial_vector], local: wp.array[wp.spatial_vector]):
    i = wp.tid()
    world[i] = lw.body_velocity(b.cvel[i], b.com[i], b.pos[i])
    local[i] = lw.local_velocity(b.cvel[i], b.com[i], b.pos[i], b.quat[i])


def test_body_velocities_equal_those_of_mujoco() -> None:
    model = lw.gymnasium_model("humanoid.xml").spec().compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] += rng.uniform(-0.5, 0.5, model.nq)
    data.qvel[:] = rng.uniform(-5.0, 5.0, model.nv)
    mujoco.mj_forward(model, data)
    bodies = Bodies()
    fields = {"cvel": data.cvel, "com": data.subtree_com[model.body_rootid], "pos": data.xpos, "quat": data.xquat}
    for name, values in fields.items():
        setattr(bodies, name, wp.array(values, dtype=Bodies.vars[name].type.dtype, device="cpu"))
    found = [wp.zeros(model.nbody, dtype=wp.spatial_vector, device="cpu") for _ in range(2)]
    wp.launch(velocities, model.nbody, [bodies, *found], device="cpu")
    kind = mujoco.mjtObj.mjOBJ_XBODY
    for local, out in enumerate(found):
        wanted = np.zeros((model.nbody, 6))
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, kind, body, wanted[body], local)
        assert np.abs(wanted).max() > 5.0
        np.testing.assert_allclose(out.numpy(), wanted, atol=2e-5)


@wp.kernel
def stand_up(yaw: wp.array[float], qpos: wp.array2d[float], after: wp.array[int]):
    i = wp.tid()
    after[i] = lw.put_upright(qpos[i], 1, wp.vec3(0.1, -0.2, 0.3), yaw[i])


def test_upright_free_body_is_rotated_about_the_vertical() -> None:
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body><joint type='slide'/><geom size='.1'/></body>"
        "<body name='free'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    model = spec.compile()
    data, yaw = mujoco.MjData(model), np.linspace(-3.0, 3.0, 7, dtype=np.float32)
    qpos, after = wp.full((7, 8), 0.5, dtype=float, device="cpu"), wp.zeros(7, dtype=int, device="cpu")
    wp.launch(stand_up, 7, [wp.array(yaw, dtype=float, device="cpu"), qpos, after], device="cpu")
    assert (after.numpy() == 8).all() and (qpos.numpy()[:, 0] == 0.5).all()
    for row, angle in zip(qpos.numpy(), yaw, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.body("free").xpos, (0.1, -0.2, 0.3), atol=1e-7)
        wanted = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        np.testing.assert_allclose(data.body("free").xmat.reshape(3, 3), wanted, atol=1e-6)
