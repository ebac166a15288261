import numpy as np
import pytest
from checks import check_normal, check_uniform
from term_calls import N, call

RNG = np.random.default_rng(0)
QPOS, BIAS, POSE = RNG.standard_normal((N, 12)), RNG.standard_normal((N, 4)), [0.1, 0.2, 0.3, 0.4]
JOINTS = [7, 11, 8, 10]


def test_listed_elements_are_gathered_into_a_row() -> None:
    found = call("gather", target=np.full(4, 9.0), source=QPOS, indices=[3, 0, 5]).after["target"]
    np.testing.assert_array_equal(found, np.hstack([QPOS[:, [3, 0, 5]], np.full((N, 1), 9.0)]).astype(np.float32))


def test_positions_are_relative_to_the_default_pose_with_or_without_a_bias() -> None:
    joints = {"target": np.zeros(4), "qpos": QPOS, "joint_qpos": JOINTS, "default_pose": POSE}
    plain = call("gather_positions", **joints).after["target"]
    np.testing.assert_allclose(plain, QPOS[:, JOINTS] - POSE, atol=1e-6)
    biased = call("gather_positions", encoder_bias=BIAS, **joints).after["target"]
    np.testing.assert_allclose(biased, QPOS[:, JOINTS] + BIAS - POSE, atol=1e-6)


@pytest.mark.parametrize("overload", [0, 1], ids=["numbers", "vectors"])
def test_noise_of_every_number_is_independent(overload: int) -> None:
    row = np.arange(6.0).reshape((6,) if overload == 0 else (2, 3))
    uniform = call("add_uniform_noise", overload, row=row, noise=0.3).after["row"]
    check_uniform(np.clip((uniform - row).reshape(N, 6) / 0.3, -1.0, 1.0))
    normal = call("add_normal_noise", overload, row=row, noise=0.3).after["row"]
    check_normal((normal - row).reshape(N, 6) / 0.3)
