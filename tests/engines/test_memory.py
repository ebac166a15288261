import os
import types
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp.engines import memory
from lyceum_warp.engines.memory import check_fit

CPU = wp.get_device("cpu")


def test_error_of_too_many_worlds_contains_the_largest_number_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free_memory", lambda device: 10_000_000)
    check_fit(1000, 9000, CPU)
    message = r"^9001 worlds need about 0.009 GB \(1 kB each\), and cpu has 0.01 GB free: use nworld=9000 at most$"
    with pytest.raises(ValueError, match=message):
        check_fit(1000, 9001, CPU)
    with pytest.raises(ValueError, match="^1 worlds of a whale need .*: not even one world fits$"):
        check_fit(20_000_000, 1, CPU, model="a whale")
    check_fit(1000, 17_000, CPU, held=9_000_000)
    monkeypatch.setattr(memory, "free_memory", lambda device: None)
    check_fit(1000, 10**9, CPU)


def test_memory_check_frees_the_gpu_memory_cached_by_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    free, gpu = [1000], types.SimpleNamespace(is_cuda=True, alias="cuda:0")
    monkeypatch.setattr(memory, "free_memory", lambda device: free[0])
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: free.__setitem__(0, 5000))
    check_fit(100, 45, gpu)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"cuda:0 has 5e-06 GB free: use nworld=45 at most"):
        check_fit(100, 46, gpu)  # type: ignore[arg-type]


def test_memory_estimate_of_the_warp_engine_agrees_with_the_size_of_its_arrays() -> None:
    for task in ("hopper", "ant"):
        env = lw.make(task, engine="warp", nworld=64)
        engine: Any = env.engine
        found = sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays_in(engine.d)) / 64
        pool = engine.spare * 500 / 64  # all worlds share the memory for additional contacts
        estimate = type(engine).bytes_per_world(env.model, engine.fields.values())
        assert found - pool < estimate < 1.6 * found, task
        assert estimate < env.bytes_per_world < 1.3 * estimate


def arrays_in(data: Any) -> list[wp.array]:
    found = []
    for value in vars(data).values():
        if isinstance(value, wp.array):
            found.append(value)
        elif hasattr(value, "__dataclass_fields__"):
            found += arrays_in(value)
    return found


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize("fields", [(), ("xpos",)])
def test_memory_estimate_of_the_c_engine_covers_its_worlds(fields: tuple[str, ...]) -> None:
    env = lw.make("hopper", fields=fields, nthread=2)
    own = 4 * (2 * env.obs_space.size + 2 * env.action_space.size) + 8 * env.state_space.size
    assert own < env.bytes_per_world
    nworld, before = 4_000, resident()
    many = lw.make("hopper", nworld=nworld, fields=fields, nthread=2)
    many.step()
    most = nworld * 1.5 * env.bytes_per_world + 30e6
    assert most < nworld * 100_000
    assert resident() - before < most
