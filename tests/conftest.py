"""What all tests share: environments, which are slow to make, and the GPU, which is often not there."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import warp as wp

import lyceum_warp as lw

# the tests' batches are too small to share out, and on a busy machine torch's threads wait for each other
torch.set_num_threads(1)

SharedEnv = Callable[..., lw.Env]


@pytest.fixture(scope="session")
def shared_env() -> SharedEnv:
    """``shared_env("hopper", engine="warp", nworld=4, ...)``: ``lw.make``, made once for the same arguments.

    Every call starts the worlds afresh with ``rand_reset(0)``, so tests may leave them anywhere. A test that
    asks for another field, changes a parameter or an attribute makes an environment of its own.
    """
    made: dict[tuple[Any, ...], lw.Env] = {}

    def get(task: str | type[lw.Task], *, engine: str = "mujoco", nworld: int = 1, **options: Any) -> lw.Env:
        # the repr of a value tells lists, arrays and classes apart, and all of them can be looked up by it
        key = (task, engine, nworld, *sorted((name, repr(value)) for name, value in options.items()))
        if key not in made:
            made[key] = lw.make(task, engine=engine, nworld=nworld, **options)
        made[key].rand_reset(0)
        return made[key]

    return get


@pytest.fixture
def made_envs(monkeypatch: pytest.MonkeyPatch) -> list[lw.Env]:
    """Every environment that the test makes, in turn."""
    made: list[lw.Env] = []
    init = lw.Env.__init__

    def remembered(env: lw.Env, *args: Any, **options: Any) -> None:
        init(env, *args, **options)
        made.append(env)

    monkeypatch.setattr(lw.Env, "__init__", remembered)
    return made


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what is marked ``gpu`` on machines without one."""
    if wp.is_cuda_available():
        return
    skip = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)
