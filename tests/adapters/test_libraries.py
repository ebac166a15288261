import importlib
import sys
from pathlib import Path

import pytest

from lyceum_warp.adapters.libraries import check_library


def install(folder: Path, package: str, version: str) -> None:
    info = folder / f"{package.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")


def test_error_of_a_missing_library_names_the_install_command() -> None:
    with pytest.raises(ImportError, match=r"needs the package not-there: pip install 'lyceum-warp\[x\]'"):
        check_library("not-there", low="1", below="2", install="lyceum-warp[x]")


@pytest.mark.parametrize("version, fits", [("1.9", False), ("1.10", True), ("1.10rc1", True), ("2.0.0", False)])
def test_library_version_outside_the_range_raises_an_error(
    version: str, fits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "learner", version)
    monkeypatch.syspath_prepend(tmp_path)
    if fits:
        check_library("learner", low="1.10", below="2", install="x")
        return
    with pytest.raises(ImportError, match=f"needs learner from 1.10 to below 2, and {version} is installed: pip"):
        check_library("learner", low="1.10", below="2", install="x")


@pytest.mark.parametrize(
    "package, module, install_hint",
    [
        ("gymnasium", "gymnasium_spaces", "gymnasium>=1.1,<2"),
        ("rsl-rl-lib", "rsl_rl_env", r"lyceum-warp\[rsl-rl\]"),
        ("stable-baselines3", "stable_baselines3", r"lyceum-warp\[stable-baselines3\]"),
    ],
)
def test_adapter_rejects_the_next_major_version_of_its_library(
    package: str, module: str, install_hint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, package, "99.1")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, f"lyceum_warp.adapters.{module}", raising=False)
    with pytest.raises(
        ImportError, match=f"needs {package} from .*, and 99.1 is installed: pip install '{install_hint}'"
    ):
        importlib.import_module(f"lyceum_warp.adapters.{module}")
