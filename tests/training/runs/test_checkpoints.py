from pathlib import Path

import pytest
import torch

from lyceum_warp.algos import GaussianPolicy, ValueFunction
from lyceum_warp.training import Run, load, load_value, read_checkpoint
from lyceum_warp.training.runs.checkpoints import FORMAT, policy_content


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", {})
    run.save(policy_content(0, GaussianPolicy(3, 2, (8, 4), normalize=True)), {"counter": 5})
    return run


class Mine(torch.nn.Module):
    """A user's policy without a shape attribute."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(2))

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return self.gain * obs


@pytest.mark.parametrize("kind", ["truncated", "foreign", "code", "list", "newer", "partial", "shape"])
def test_damaged_and_invalid_checkpoints_raise_a_one_line_error(run: Run, kind: str) -> None:
    path, data = run.policy, run.policy.read_bytes()
    content = read_checkpoint(path, parts=("iteration", "policy"))
    fix = ""
    match kind:
        case "truncated":
            path.write_bytes(data[: len(data) // 2])
        case "foreign":
            torch.save({"model": torch.zeros(2)}, path)
            fix = "'model'"
        case "code":
            torch.save({"lyceum_warp": FORMAT, "policy": path}, path)
        case "list":
            torch.save([1, 2], path)
        case "newer":
            torch.save(content | {"lyceum_warp": FORMAT + 1}, path)
            fix = "--upgrade"
        case "partial":
            del content["policy"]
            torch.save(content, path)
        case "shape":
            content["policy"]["shape"]["nobs"] = 4
            torch.save(content, path)
    with pytest.raises(ValueError, match=rf"{path}.*{fix}") as caught:
        load(run)
    assert "\n" not in str(caught.value)


@pytest.mark.quick("61")
@pytest.mark.parametrize("every", [61, 7])
def test_flipped_bit_in_a_checkpoint_raises_an_error_or_changes_nothing(run: Run, every: int) -> None:
    data = run.checkpoint.read_bytes()
    saved = read_checkpoint(run.checkpoint)
    weights = saved["policy"].pop("state")
    for bit in range(0, 8 * len(data), every):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        run.checkpoint.write_bytes(damaged)
        try:
            content = read_checkpoint(run.checkpoint)
        except ValueError as error:
            assert str(run.checkpoint) in str(error)
            continue
        state = content["policy"].pop("state")
        assert content == saved and state.keys() == weights.keys()
        assert all(torch.equal(state[name], tensor) for name, tensor in weights.items())


def test_policy_of_a_custom_class_is_loaded_into_a_given_policy(tmp_path: Path) -> None:
    policy, run = Mine(), Run.create(tmp_path / "run", {})
    torch.nn.init.constant_(policy.gain, 3.0)
    run.save(policy_content(1, policy), {})
    assert load(run, policy=Mine()).act(torch.ones(2)).tolist() == [3.0, 3.0]
    with pytest.raises(ValueError, match=r"has a custom class, test_checkpoints.Mine: .* policy=Mine\(...\)\)$"):
        load(run)
    with pytest.raises(ValueError, match="has no value function"):
        load_value(run)


def test_network_of_the_package_is_recreated_from_its_class_and_shape(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", {})
    run.save(policy_content(1, ValueFunction(3, (4,))), {})
    loaded = load(run)
    assert isinstance(loaded, ValueFunction) and list(loaded.shape["hidden"]) == [4]


@pytest.mark.parametrize("name", ["os.system", "lyceum_warp.cli.__main__.main", "lyceum_warp.algos.npg.NPG"])
def test_checkpoint_can_only_create_networks_of_the_package(name: str, run: Run) -> None:
    content = read_checkpoint(run.policy, parts=("iteration", "policy"))
    content["policy"]["class"] = name
    torch.save(content, run.policy)
    with pytest.raises(ValueError, match=f"has a custom class, {name}"):
        load(run)
