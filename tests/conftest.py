"""What all tests share: environments, which are slow to make, and the GPU, which is often not there."""

import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp

import lyceum_warp as lw

# the tests' batches are too small to share out, and on a busy machine torch's threads wait for each other
torch.set_num_threads(1)

SharedEnv = Callable[..., lw.Env]
TaskFile = Callable[[str, str], Path]


@pytest.fixture(scope="module")
def shared_env() -> Iterator[SharedEnv]:
    """``shared_env("hopper", engine="warp", nworld=4, ...)``: ``lw.make``, made once a file for the same arguments.

    Every call starts the worlds afresh with ``rand_reset(0)``, so tests may leave them anywhere. A test that
    asks for another field, changes a parameter or an attribute makes an environment of its own, and so does one
    that wants many worlds for itself alone: they go with the test.
    """
    made: dict[tuple[Any, ...], lw.Env] = {}

    def get(task: str | type[lw.Task], *, engine: str = "mujoco", nworld: int = 1, **options: Any) -> lw.Env:
        # the repr of a value tells lists, arrays and classes apart, and all of them can be looked up by it
        key = (task, engine, nworld, *sorted((name, repr(value)) for name, value in options.items()))
        if key not in made:
            made[key] = lw.make(task, engine=engine, nworld=nworld, **options)
        made[key].rand_reset(0)
        return made[key]

    yield get
    made.clear()
    gc.collect()


@pytest.fixture(scope="session")
def task_file(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> TaskFile:
    """``task_file("mine.py", source)``: a file with a task, in the same place in every run of the tests.

    The kernels of a task are known by its file's path: from the second run on they are in Warp's cache.
    """
    cache = getattr(pytestconfig, "cache", None)
    folder = cache.mkdir("tasks") if cache else tmp_path_factory.mktemp("tasks")

    def write(name: str, source: str) -> Path:
        file: Path = folder / name
        if not file.exists() or file.read_text() != source:
            file.write_text(source)
        return file

    return write


def settle() -> None:
    """Take all that lives on from the garbage collector: imports and kernels are a million objects to look through.

    What is made later is collected, and counted, as ever. Nothing that is to go may be alive.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def freed() -> Iterator[None]:
    """An environment refers to itself: one of many worlds, which is large, is collected at once after its test."""
    yield
    gc.collect()


@pytest.fixture(scope="module", autouse=True)
def settled() -> None:
    """Between two files nothing lives but what stays."""
    settle()


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
