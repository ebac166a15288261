import os

import pytest
import warp as wp

from lyceum_warp.support.machine import cpu_cores, free_memory


def test_cpu_cores_counts_the_cores_of_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3, 5}, raising=False)
    assert cpu_cores() == 3


def test_cpu_cores_counts_all_cores_if_the_affinity_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert cpu_cores() == (os.cpu_count() or 1)


def test_free_memory_is_a_number_of_bytes_or_unknown() -> None:
    free = free_memory(wp.get_device("cpu"))
    assert free is None or 2**20 < free < 2**50
