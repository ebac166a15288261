import numpy as np
import pytest
from term_calls import N, call


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
