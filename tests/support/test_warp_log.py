import subprocess
import sys

import pytest
import warp as wp

WITHOUT_GPU = pytest.mark.skipif(wp.is_cuda_available(), reason="needs a machine without a GPU")


def printed(program: str) -> tuple[str, str]:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout, done.stderr


@pytest.mark.long
@WITHOUT_GPU
def test_missing_driver_is_reported_only_if_a_gpu_is_requested() -> None:
    program = """
from lyceum_warp import Row
import lyceum_warp as lw
from lyceum_warp.cli import main
lw.make("point_mass").step()
main(["check", "hopper", "--device", "cuda"])
"""
    out, error = printed(program)
    assert out == "" and error.count("\n") == 1
    assert error.startswith("lyceum-warp: there is no device 'cuda' on this machine; it has 'cpu' (")
    assert "NVIDIA CUDA driver" in error


def test_warp_starts_with_a_closed_stderr() -> None:
    program = "import os; os.close(2); from lyceum_warp.support import warp_log; print(warp_log.start_warp())"
    assert printed(program) == ("[]\n", "")
