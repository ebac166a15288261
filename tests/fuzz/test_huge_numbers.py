import os
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import lyceum_warp as lw

HUGE = 10**9


@pytest.fixture
def limited() -> Iterator[None]:
    """Limit the address space, so that a failing test does not use up the machine's memory."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + 512 * 2**20, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def point_mass(**options: object) -> lw.Env:
    return lw.make("point_mass", nworld=2, horizon=4, **options)


@pytest.mark.parametrize("call", [
    lambda: lw.make("point_mass", nworld=HUGE),
    lambda: lw.evaluate(point_mass(), lambda obs: obs[:, :2], HUGE),
    lambda: lw.Rollout(point_mass(), HUGE),
    lambda: lw.OpenLoop(point_mass(autoreset=False), HUGE),
    lambda: lw.CEM("point_mass", horizon=2, samples=2, plants=HUGE),
    lambda: lw.CEM("point_mass", horizon=2, samples=2, frame_skip=HUGE),
    lambda: lw.GaussianPolicy(2, 2**31 - 1),
    lambda: lw.ValueFunction(2, time_orders=HUGE),
], ids=["worlds", "episodes", "rollout", "open loop", "plants", "substeps", "policy", "value function"])  # fmt: skip
def test_huge_number_raises_an_error_before_memory_is_allocated(call: Callable[[], object], limited: None) -> None:
    with pytest.raises(ValueError, match=r"000000|e\+09|2147483647"):
        call()
