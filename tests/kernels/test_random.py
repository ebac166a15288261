import numpy as np
import pytest
import warp as wp
from checks import check_normal, check_uniform

from lyceum_warp.kernels.random import normal, stream, uniform, world_key


@wp.kernel(enable_backward=False)
def draw(
    seed_in: wp.array[int], world_in: wp.array[int], episode_in: wp.array[int], step_in: wp.array[int],
    rng_inout: wp.array2d[wp.uint32], value_out: wp.array2d[float],
):  # fmt: skip
    """Draw two uniform and two normal numbers from the start of a stream."""
    i = wp.tid()
    rng = rng_inout[i]
    rng[0] = stream(world_key(seed_in[i], world_in[i]), episode_in[i], step_in[i])
    value_out[i, 0] = uniform(rng, -1.0, 1.0)
    value_out[i, 1] = uniform(rng, -1.0, 1.0)
    value_out[i, 2] = normal(rng)
    value_out[i, 3] = normal(rng)


@wp.kernel(enable_backward=False)
def draw_vectors(rng_inout: wp.array2d[wp.uint32], one_out: wp.array2d[float], many_out: wp.array2d[float]):
    """Draw five numbers one by one, and the same numbers as two vectors from a copy of the stream."""
    i = wp.tid()
    for k in range(5):
        one_out[i, k] = uniform(rng_inout[2 * i], float(-k), float(k + 1))
    two = uniform(rng_inout[2 * i + 1], wp.vec2(0.0, -1.0), wp.vec2(1.0, 2.0))
    three = uniform(rng_inout[2 * i + 1], wp.vec3(-2.0, -3.0, -4.0), wp.vec3(3.0, 4.0, 5.0))
    for k in range(2):
        many_out[i, k] = two[k]
    for k in range(3):
        many_out[i, 2 + k] = three[k]


def draws(counters: np.ndarray) -> np.ndarray:
    columns = [wp.array(column, dtype=int, device="cpu") for column in counters.T]
    rng = wp.zeros((len(counters), 1), dtype=wp.uint32, device="cpu")
    values = wp.zeros((len(counters), 4), dtype=float, device="cpu")
    wp.launch(draw, len(counters), [*columns, rng, values], device="cpu")
    return values.numpy()


def test_random_vector_equals_its_elements_drawn_one_by_one() -> None:
    rng = wp.array(np.repeat(np.arange(100), 2)[:, None], dtype=wp.uint32, device="cpu")
    one, many = (wp.zeros((100, 5), dtype=float, device="cpu") for _ in range(2))
    wp.launch(draw_vectors, 100, [rng, one, many], device="cpu")
    np.testing.assert_array_equal(many.numpy(), one.numpy())
    k = np.arange(5)
    check_uniform((one.numpy() - 0.5) / (k + 0.5))
    ends = rng.numpy()[:, 0]
    np.testing.assert_array_equal(ends[::2], ends[1::2])


@pytest.mark.parametrize("counter", ["seed", "world", "episode", "step"])
def test_random_numbers_of_consecutive_counters_are_independent(counter: str) -> None:
    counters = np.zeros((4000, 4), dtype=int)
    counters[:, ["seed", "world", "episode", "step"].index(counter)] = np.arange(4000)
    values = draws(counters)
    check_uniform(values[:, :2])
    check_normal(values[:, 2:])
    check_uniform(np.stack([values[:-1, 0], values[1:, 0]], axis=1))
