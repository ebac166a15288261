"""The spread that CEM divides by; its plans are compared in test_mppi.py."""

import numpy as np
import pytest
from plain_mppi import smoothed

from lyceum_warp import MPPIConfig
from lyceum_warp.algos.cem import spread


@pytest.mark.parametrize("betas", [(0.25, 0.8, 0.0), (1.0, 0.0, 0.0), (0.5, 0.3, 0.2), (0.5, -0.9, -0.3)])
@pytest.mark.parametrize("count", [1, 2, 12])
def test_spread_is_what_smoothing_leaves_of_standard_normal_noise(
    betas: tuple[float, float, float], count: int
) -> None:
    answers = smoothed(np.eye(count), betas)  # the answer of every step to an impulse at every other
    np.testing.assert_allclose(spread(betas, count), np.sqrt((answers**2).sum(1)))
    assert (spread(MPPIConfig(smoothing=betas, knots=4).noise_smoothing, count) == 1).all()
