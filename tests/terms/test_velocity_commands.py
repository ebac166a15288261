"""Check the distributions, timers and headings of velocity commands."""

import numpy as np
import pytest
from checks import check_uniform
from term_calls import N, call


def near(share: np.ndarray, wanted: float) -> bool:
    """Return whether a share of N random draws is within five standard errors of its probability."""
    return bool(abs(share.mean() - wanted) < 5.0 * np.sqrt(wanted * (1.0 - wanted) / len(share)))


def test_velocity_commands_are_uniform_within_their_ranges() -> None:
    low, high = np.array([-1.0, -0.5, -2.0]), np.array([3.0, 0.5, 0.0])
    velocity = call("draw_velocity", drawn_velocity=np.zeros((1, 3)), command_low=low, command_high=high)
    check_uniform((velocity.after["drawn_velocity"][:, 0] - (low + high) / 2) / ((high - low) / 2))
    timer = call("draw_timer", timer=[0.0], seconds=[3.0, 8.0]).after["timer"]
    check_uniform((timer - 5.5) / 2.5)
    heading = call("draw_heading", heading_target=[0.0], heading_controlled=[0.0], heading_share=0.3).after
    check_uniform(heading["heading_target"] / np.float32(np.pi))
    assert {*heading["heading_controlled"].ravel()} == {0.0, 1.0} and near(heading["heading_controlled"], 0.3)
    standing = call("draw_flag", flag=[0.5], share=0.1).after["flag"]
    assert {*standing.ravel()} == {0.0, 1.0} and near(standing, 0.1)


def test_the_given_share_of_commands_has_only_a_forward_velocity() -> None:
    before = np.random.default_rng(0).uniform(-1.0, 1.0, (N, 1, 3))
    drawn = call("draw_forward_only", drawn_velocity=before, forward_share=0.2, least_forward_velocity=0.3)
    after = drawn.after["drawn_velocity"][:, 0]
    forward = (after[:, 1:] == 0).all(axis=1)
    assert near(forward, 0.2)
    np.testing.assert_allclose(after[forward, 0], np.maximum(np.abs(before[forward, 0, 0]), 0.3), rtol=1e-6)
    np.testing.assert_allclose(after[~forward], before[~forward, 0], rtol=1e-6)


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
