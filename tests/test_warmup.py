"""Before the first step: compiling ahead with progress, and whether the worlds fit into memory."""

import contextlib
import itertools
import os
import runpy
import subprocess
import sys
import types
from pathlib import Path

import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp.engines import memory
from lyceum_warp.engines.memory import Footprint, Scratch, bytes_of, check_fit
from lyceum_warp.graphs.rehearsal import rehearse
from lyceum_warp.kernels.state import rank_worlds

SCRIPT = """
import warp as wp
from lyceum_warp.graphs.compile_ahead import compile_ahead

@wp.kernel(module="unique", enable_backward=False)
def one(a: wp.array[float]):
    a[wp.tid()] = 1.0

@wp.kernel(module="unique", enable_backward=False)
def two(a: wp.array[float]):
    a[wp.tid()] = 2.0

@wp.kernel(module="unique", enable_backward=False)
def never(a: wp.array[float]):
    a[wp.tid()] = 3.0

def launches():
    a = wp.zeros(4, dtype=float)
    wp.launch(one, 4, [a])
    wp.launch(two, 4, [a])
    wp.launch(two, 4, [a])
    wp.launch(never, 0, [a])

built = compile_ahead(launches, wp.get_device("cpu"), "a test")
print(built.modules, built.known)
"""


def test_compiling_is_told_of_and_done_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By a program of its own; this process, which has never had these kernels, finds them in the cache."""
    script, cache = tmp_path / "script.py", tmp_path / "cache"
    script.write_text(SCRIPT)
    env = {**os.environ, "WARP_CACHE_PATH": str(cache)}
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, check=True)
    lines = [line for line in done.stderr.splitlines() if "CUDA" not in line]
    assert done.stdout.strip() == "2 0"
    assert lines[0].startswith("compiling kernels of a test for cpu: 2 modules on ")
    assert len(lines) == 3 and all(line.strip().startswith(f"{i}/2 ") for i, line in enumerate(lines[1:], 1))
    assert {line.split()[1].rsplit("_", 1)[0] for line in lines[1:]} == {"one", "two"}
    (folder,) = {path.parent.parent for path in cache.rglob("*.o")}
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    runpy.run_path(str(script))
    said = capsys.readouterr()
    assert (said.out.strip(), said.err) == ("0 2", "")


def test_a_rehearsal_launches_nothing_and_counts_memory() -> None:
    mask, rank = wp.full(3, True, dtype=bool, device="cpu"), wp.zeros(3, dtype=int, device="cpu")
    found = wp.zeros(1, dtype=int, device="cpu")

    def body() -> None:
        wp.launch(rank_worlds, 3, [mask, rank, found], device="cpu")

    launch = wp.launch
    with rehearse() as rehearsal:
        body()
        wp.capture_if(found, on_true=body)  # gone into, whatever the condition is
        first = wp.zeros(100, dtype=float, device="cpu")
        del first
        second = wp.empty(50, dtype=float, device="cpu")
    assert found.numpy()[0] == 0 and len(rehearsal.modules) == 1 and second.size == 50
    assert rehearsal.peak == 400
    assert wp.launch is launch
    body()
    assert found.numpy()[0] == 3


def test_what_does_not_fit_is_refused_before_it_is_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu = wp.get_device("cpu")
    monkeypatch.setattr(memory, "free_memory", lambda device: 10_000_000)
    footprint = Footprint(fixed=1_000_000, each=1000)
    assert footprint.largest(10_000_000) == 8000
    check_fit(footprint, 8000, cpu)
    message = (
        r"8001 worlds do not fit .* of cpu: they need 0.009 GB \(1 kB each\), and 0.01 GB are free: use nworld=8000 "
    )
    with pytest.raises(ValueError, match=message):
        check_fit(footprint, 8001, cpu)
    with pytest.raises(ValueError, match="not even one does"):
        check_fit(Footprint(20_000_000, 1000), 1, cpu)
    monkeypatch.setattr(memory, "free_memory", lambda device: None)
    check_fit(footprint, 10**9, cpu)


def test_footprints_from_two_batches_and_together() -> None:
    footprint = Footprint.of(256, 512, [1000 + 256 * 7, 1000 + 512 * 7])
    assert footprint == Footprint(fixed=1000, each=7)
    limited = footprint + Footprint(fixed=0, each=3, most=50)
    assert limited == Footprint(fixed=1000, each=10, most=50)
    assert limited.largest(1000 + 1200) == 50 and limited.largest(1000 + 200) == 8


class Recording:
    """In the place of a CUDA device that is being recorded: Warp asks for some memory within it, for some beside."""

    is_capturing = True

    def __init__(self) -> None:
        self.stream = types.SimpleNamespace(is_capturing=False)
        self.given_back: list[int] = []

    def get_allocator(self) -> "Recording":
        return self

    def allocate(self, size: int) -> int:
        return -size

    def deallocate(self, address: int, size: int) -> None:
        self.given_back.append(address)


def test_recorded_launches_share_their_scratch(monkeypatch: pytest.MonkeyPatch) -> None:
    device, empty = Recording(), wp.empty
    monkeypatch.setattr(wp, "ScopedAllocator", lambda *args: contextlib.nullcontext())
    monkeypatch.setattr(wp, "empty", lambda shape, dtype, device: empty(shape, dtype=dtype, device="cpu"))
    scratch = Scratch(device)  # type: ignore[arg-type]
    scratch.set_aside(5000)
    launches = []
    for sizes in ([1000, 2000], [512, 1500, 1000], [4000]):
        scratch.open()
        launches.append([range(start := scratch.allocate(size), start + size) for size in sizes])
    for pieces in launches:  # those of one launch lie beside each other, within what was set aside
        for before, after in itertools.pairwise(pieces):
            assert before.stop <= after.start
        assert pieces[0].start == launches[0][0].start and pieces[-1].stop <= pieces[0].start + 5120
    assert (scratch.peak, scratch.largest) == (4096, 4096)
    more = scratch.allocate(2000)  # what was set aside is used up
    assert more not in range(launches[0][0].start, launches[0][0].start + 5120)
    scratch.deallocate(more, 2000)
    assert not device.given_back
    for within in (True, False):
        device.stream.is_capturing, device.is_capturing = within, within  # part of a recording, or none
        assert scratch.allocate(300) == -300
        scratch.deallocate(-300, 300)
    assert device.given_back == [-300, -300] and scratch.peak == 4096 + 2048


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_batch_that_can_not_fit(engine: str) -> None:
    with pytest.raises(ValueError, match=r"2000000000 worlds do not fit .* use nworld=\d+ at most"):
        lw.make("hopper", nworld=2_000_000_000, engine=engine)


def test_the_footprint_is_what_the_arrays_have() -> None:
    env = lw.make("hopper", engine="warp", nworld=64)
    footprint = env.engine.footprint()  # type: ignore[attr-defined]
    arrays = bytes_of(env.engine.d)  # type: ignore[attr-defined]
    assert 0.5 < arrays / (64 * footprint.each) < 1.5
    assert 0.5 * footprint.each < env.bytes_per_world < 2 * footprint.each


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_bytes_per_world(engine: str) -> None:
    few, many = (lw.make("point_mass", engine=engine, nworld=n) for n in (32, 64))
    own = 4 * (2 * few.obs_space.size + 2 * few.action_space.size) + 8 * few.state_space.size
    for env in (few, many):
        assert own < env.bytes_per_world < 100 * own
    total = [env.bytes_per_world * env.nworld for env in (few, many)]
    assert own < (total[1] - total[0]) / 32 < many.bytes_per_world


def test_bytes_are_counted_once() -> None:
    array = wp.zeros((10, 10), dtype=float, device="cpu")
    view = wp.to_torch(array)
    assert bytes_of(array, view, view[2:], {"a": [array[3]]}, array.numpy()) == 400
    assert bytes_of([torch.zeros(4), None, "text", 3]) == 16
