"""Check the hidden robots of bench/fits.py."""

import fits


def test_servos_of_a_hidden_robot_are_stable() -> None:
    """The first draws of seed 4 are not."""
    plant = fits.Plant("g1", 4, ground=False)
    low, high = plant.model.jnt_range.T
    positions = plant.log(12.0, 4)["qpos"]
    assert ((low - 0.3 < positions) & (positions < high + 0.3)).all()
