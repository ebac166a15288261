"""Mini-batches of a rollout."""

import pytest
import torch

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.minibatches import Minibatches

STEPS, WORLDS = 4, 512


def shuffled(rank: int, size: int) -> Minibatches:
    """Mini-batches of samples that are their own numbers, for one of several processes."""
    n = WORLDS // size
    whole = torch.arange(float(STEPS * WORLDS)).view(STEPS, WORLDS)
    made = Minibatches(
        lambda *_: None, steps=STEPS, nworld=n, count=3, team=Team(rank, size), device=torch.device("cpu")
    )
    made.shuffle({"number": whole[:, rank * n : (rank + 1) * n]}, torch.Generator().manual_seed(0))
    return made


@pytest.mark.parametrize("size", [2, 4])
def test_processes_share_the_mini_batches_of_one_process(size: int) -> None:
    (number, weight), parts = taken(shuffled(0, 1)), [taken(shuffled(rank, size)) for rank in range(size)]
    assert number.shape == (3, 682) and torch.equal(weight, torch.full((3, 682), 1 / 682))
    assert all(part.shape[1] < 0.8 * 682 for part, _ in parts)  # each computes its share
    for i in range(3):
        found = torch.cat([part[i][weights[i] > 0] for part, weights in parts])
        assert torch.equal(found.sort().values, number[i].sort().values)
    assert torch.unique(number).numel() == 3 * 682


def taken(made: Minibatches) -> tuple[torch.Tensor, torch.Tensor]:
    batches: list[tuple[torch.Tensor, torch.Tensor]] = []
    made.learn = lambda samples, weight: batches.append((samples["number"], weight))
    made.run(1)
    numbers, weights = zip(*batches, strict=True)
    return torch.stack(numbers), torch.stack(weights)


def test_every_epoch_has_the_same_mini_batches() -> None:
    made = shuffled(0, 1)
    first, second = taken(made), taken(made)
    assert torch.equal(first[0], second[0])
