import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw


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
