import os
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_task
import warp as wp
from training_runs import refused

from lyceum_warp import cli
from lyceum_warp.binding import find_task
from lyceum_warp.core import EnvOptions
from lyceum_warp.env.worlds import open_worlds
from lyceum_warp.graphs.compilation import rehearse
from lyceum_warp.kernels import rows
from lyceum_warp.support.arrays import WORLDS_A_BLOCK
from lyceum_warp.support.upstream import compile_module, is_compiled


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that has the known kernels, and collects new ones."""
    wp.init()
    known = Path(wp.config.kernel_cache_dir)
    folder = tmp_path / "cache" / known.name  # Warp appends its version to WARP_CACHE_PATH
    folder.mkdir(parents=True)
    for module in known.iterdir():
        (folder / module.name).symlink_to(module)
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    return folder


def test_training_compiles_nothing_after_compile(cache: Path, tmp_path: Path) -> None:
    file = tiny_task.write(tmp_path, tiny_task.changed(("class Tiny", "class Ahead")), "ahead.py")
    before = {*cache.iterdir()}
    assert cli.main(["compile", str(file), "--horizon", "20"]) == 0
    compiled = {*cache.iterdir()}
    assert any("Ahead" in folder.name for folder in compiled - before)
    arguments = ["train", str(file), "--iterations", "1", "--nworld", "2", "--no-plot", "--out", str(tmp_path / "run")]
    command = [sys.executable, "-m", "lyceum_warp.cli", *arguments, "--samples", "40", "--horizon", "20"]
    environment = os.environ | {"WARP_CACHE_PATH": str(cache.parent)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "compiling" not in done.stderr
    assert {*cache.iterdir()} == compiled


def test_kernels_of_a_gpu_are_found_and_compiled_without_one(cache: Path) -> None:
    if 90 not in wp.get_cuda_supported_archs():
        pytest.skip("Warp is built without CUDA")
    options, modules = EnvOptions(nworld=2, engine="warp"), []
    for on_cuda in (False, True):
        with rehearse(on_cuda=on_cuda) as launched:
            open_worlds(find_task("point_mass"), options, {}).rehearsal()
        modules.append({(module.name, block) for module, block in launched})
    names = [{name for name, _ in some} for some in modules]
    (own,) = [name for name in names[1] if name.endswith("PointMass")]
    assert len(names[0]) == len(names[1]) and (own, WORLDS_A_BLOCK) in modules[1] and (own, 1) in modules[0]

    module, block = wp.get_module(rows.__name__), 96  # nobody else compiles it for this block size
    assert not is_compiled(module, block, None, 90)
    compile_module(module, block, None, 90)
    name = module.get_module_identifier(block)
    assert {path.suffix for path in (cache / name).iterdir()} == {".cu", ".meta", ".cubin"}
    assert (cache / name / f"{name}.sm90.cubin").is_file() and is_compiled(module, block, None, 90)


@pytest.mark.parametrize(("flags", "words"), [
    (["--arch", "sm_9"], ["'sm_9'", "sm_90"]),
    (["--arch", "sm_90", "--device", "cpu"], ["--arch", "--device"]),
    (["--arch", "sm_90", "--deterministic"], ["deterministic"]),
])  # fmt: skip
def test_compile_refuses_what_it_cannot_compile(
    flags: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["compile", "point_mass", *flags]) == 2
    refused(capsys, *words)
