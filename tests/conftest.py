"""Define shared fixtures, and skip GPU tests on machines without a GPU."""

import functools
import gc
import hashlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.support.warp_log import start_warp

# several threads would only wait for each other on a busy machine
torch.set_num_threads(1)

SharedEnv = Callable[..., lw.Env]
TaskFile = Callable[[str, str], Path]


@pytest.fixture(scope="session", autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Use a temporary list of trusted runs, so that tests and their subprocesses do not change the user's list."""
    with pytest.MonkeyPatch.context() as patched:
        folder = tmp_path_factory.mktemp("state")
        patched.setenv("XDG_STATE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def known_sizes(pytestconfig: pytest.Config) -> Iterator[None]:
    """Cache the probed sizes of contact buffers between test runs, because a probe takes seconds.

    A change of the probe or of MuJoCo's version empties the cache.
    """
    sizes, cache = sys.modules.get("lyceum_warp.engines.warp.sizes"), getattr(pytestconfig, "cache", None)
    if sizes is None or cache is None:
        yield
        return
    source = hashlib.sha256(Path(str(sizes.__file__)).read_bytes()).hexdigest()[:16]
    key = f"lyceum_warp/sizes-{mujoco.__version__}-{source}"
    sizes._cache.update({model: tuple(found) for model, found in cache.get(key, {}).items()})
    yield
    cache.set(key, cache.get(key, {}) | sizes._cache)  # another process may have stored sizes


@pytest.fixture(scope="module")
def shared_env() -> Iterator[SharedEnv]:
    """Make one environment for each set of ``lw.make`` arguments, and share it among the tests of a file.

    Every call resets the worlds. A test that changes parameters or attributes must call ``lw.make`` itself.
    """
    made: dict[tuple[Any, ...], lw.Env] = {}

    def get(task: str | type[lw.Task], *, engine: str = "mujoco", nworld: int = 1, **options: Any) -> lw.Env:
        # lists and arrays are not hashable, so the key contains their repr
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
    """Write a task file to the same path in every test run."""
    cache = getattr(pytestconfig, "cache", None)
    folder = cache.mkdir("tasks") if cache else tmp_path_factory.mktemp("tasks")

    def write(name: str, source: str) -> Path:
        file: Path = folder / name
        if not file.exists() or file.read_text() != source:
            file.write_text(source)
        return file

    return write


def settle() -> None:
    """Exempt all live objects from garbage collection, because scanning a million objects is slow.

    Call this only before the creation of objects that a test must free.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture
def freed() -> Iterator[None]:
    """Collect garbage after the test, because environments contain reference cycles."""
    yield
    gc.collect()


@pytest.fixture(scope="module", autouse=True)
def settled() -> None:
    settle()


@pytest.fixture
def made_envs(monkeypatch: pytest.MonkeyPatch) -> list[lw.Env]:
    made: list[lw.Env] = []
    init = lw.Env.__init__

    def remembered(env: lw.Env, *args: Any, **options: Any) -> None:
        init(env, *args, **options)
        made.append(env)

    monkeypatch.setattr(lw.Env, "__init__", remembered)
    return made


@pytest.hookimpl(tryfirst=True)  # this hook must run before pytest deselects tests by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    _mark_long(items)
    for item in items:
        if (missing := _missing_model(_task(item))) is not None:
            item.add_marker(pytest.mark.skip(reason=missing))
    start_warp()
    if wp.is_cuda_available():
        return
    skip = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(skip)


def _mark_long(items: list[pytest.Item]) -> None:
    """Mark a test's cases as ``long``, except the cases that the arguments of ``pytest.mark.quick`` name."""
    cases: dict[tuple[str, ...], set[str]] = {}
    for item in items:
        if (mark := item.get_closest_marker("quick")) is not None:
            case = item.callspec.id  # type: ignore[attr-defined]
            named = {name for name in mark.args if f"-{name}-" in f"-{case}-"}
            cases.setdefault((item.nodeid.partition("[")[0], *mark.args), set()).update(named or [case])
            if not named:
                item.add_marker(pytest.mark.long)
    for (test, *quick), found in cases.items():
        if len(found) > len(quick) and (unknown := set(quick) - found):
            raise pytest.UsageError(f"{test} has no cases {sorted(unknown)}: name some of {sorted(found)}")


def _task(item: pytest.Item) -> str | None:
    callspec = getattr(item, "callspec", None)
    task = callspec.params.get("task", callspec.params.get("engines")) if callspec else None
    return task if isinstance(task, str) else None


@functools.cache
def _missing_model(task: str | None) -> str | None:
    if task is None:
        return None
    try:
        find_task(task).model.path()
    except (FileNotFoundError, AttributeError, ValueError) as error:
        return str(error) if isinstance(error, FileNotFoundError) else None
    return None
