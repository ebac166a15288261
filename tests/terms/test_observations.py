from collections import defaultdict

import numpy as np
import pytest
from checks import check_normal, check_uniform
from term_calls import KERNELS, N, call

from lyceum_warp import terms

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


def test_argument_name_has_one_type_and_one_documented_meaning_in_all_functions() -> None:
    kinds = defaultdict(set)
    for overloads in KERNELS.values():
        for function, _ in overloads:
            for argument, kind in function.input_types.items():
                kinds[argument].add(str(kind))
    assert {argument for argument, found in kinds.items() if len(found) > 1} == {"row"}  # numbers or vectors
    assert {*kinds} == {*terms.ARGUMENTS}


def test_timer_expires_after_the_given_seconds() -> None:
    timer, due = np.array([0.1]), []
    for _ in range(6):
        due.append(bool(call("is_due", timer=timer).result[0]))
        timer = call("run_timer", timer=timer, dt=0.02).after["timer"][0]
    assert due == [False] * 5 + [True]


@pytest.mark.parametrize(("standing", "controlled"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_command_is_zero_or_turns_the_robot_towards_its_heading(standing: int, controlled: int) -> None:
    rng = np.random.default_rng(0)
    drawn, target, heading = rng.uniform(-1, 1, (N, 1, 3)), rng.uniform(-3, 3, (N, 1)), rng.uniform(-3, 3, N)
    found = call(
        "velocity_command", drawn_velocity=drawn, heading_target=target, heading_controlled=[controlled],
        standing=[standing], heading=heading, heading_gain=0.5, fastest_yaw_rate=0.6,
    ).result  # fmt: skip
    wanted = drawn[:, 0].copy()
    if controlled:
        error = (target[:, 0] - heading + np.pi) % (2 * np.pi) - np.pi
        wanted[:, 2] = np.clip(0.5 * error, -0.6, 0.6)
    np.testing.assert_allclose(found, 0.0 * wanted if standing else wanted, atol=2e-6)
