import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

import lyceum_warp as lw

Run = Callable[[Path, np.ndarray], np.ndarray]


def run_onnx(path: Path, obs: np.ndarray) -> np.ndarray:
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(str(path))
    (action,) = session.run(["action"], {"obs": obs})
    return action


def run_torch(path: Path, obs: np.ndarray) -> np.ndarray:
    return torch.export.load(path).module()(torch.from_numpy(obs)).numpy()


RUNS = pytest.mark.parametrize(("name", "run"), [("policy.onnx", run_onnx), ("policy.pt2", run_torch)])


def trained(**options: object) -> lw.GaussianPolicy:
    torch.manual_seed(0)
    policy = lw.GaussianPolicy(5, 2, (16, 8), **options)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    policy.observe(10.0 * torch.randn(100, 5) + 3.0)
    return policy


def compare(policy: lw.GaussianPolicy, path: Path, run: Run) -> None:
    for n in (1, 7):
        obs = (40.0 * np.random.default_rng(n).standard_normal((n, 5))).astype(np.float32)
        with torch.no_grad():
            expected = policy(torch.from_numpy(obs)).numpy()
        action = run(path, obs)
        assert action.shape == (n, 2) and action.dtype == np.float32
        np.testing.assert_allclose(action, expected, rtol=1e-5, atol=1e-5)


@RUNS
def test_exported_policy_gives_the_same_actions(
    name: str, run: Run, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    policy = trained(normalize=True)
    path = lw.export_policy(policy, tmp_path / "new" / name)
    assert capfd.readouterr() == ("", "")
    assert path == tmp_path / "new" / name and [file.name for file in path.parent.iterdir()] == [name]
    compare(policy, path, run)


class Own(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.Sequential(nn.Linear(5, 8), nn.LayerNorm(8), nn.GELU(), nn.Dropout(0.5), nn.Linear(8, 2))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.inner(obs)) + obs[..., :2].sin()


@RUNS
@pytest.mark.quick("policy.pt2-run_torch")
def test_user_network_is_exported(name: str, run: Run, tmp_path: Path) -> None:
    policy = trained(network=Own(), normalize=True)
    before, modes = [p.clone() for p in policy.parameters()], [m.training for m in policy.modules()]
    path = lw.export_policy(policy, tmp_path / name)
    assert all(torch.equal(a, b) for a, b in zip(before, policy.parameters(), strict=True))
    assert modes == [m.training for m in policy.modules()] and all(p.requires_grad for p in policy.parameters())
    compare(policy.eval(), path, run)


class Branch(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(5, 2)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return self.linear(obs) if obs.sum() > 0 else -self.linear(obs)


def test_failed_export_raises_a_one_line_error_and_writes_no_file(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    path.write_bytes(b"older")
    with pytest.raises(ValueError, match=r"^the policy's network cannot be exported to \.onnx \(.*\)$") as caught:
        lw.export_policy(lw.GaussianPolicy(5, 2, network=Branch()), path)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == b"older" and len(list(tmp_path.iterdir())) == 1


def test_invalid_export_arguments_and_a_missing_package_raise_one_line_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = lw.GaussianPolicy(5, 2)
    with pytest.raises(ValueError, match=r"policy\.jit must end with \.onnx or \.pt2$"):
        lw.export_policy(policy, tmp_path / "policy.jit")
    with pytest.raises(ValueError, match="policy must be a module with act and nobs, as lw.load"):
        lw.export_policy("runs/mine", tmp_path / "policy.onnx")  # type: ignore[arg-type]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"needs onnx and onnxscript: pip install 'lyceum-warp\[export\]'$"):
        lw.export_policy(policy, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())
