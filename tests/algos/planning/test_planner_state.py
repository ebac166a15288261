import re

import numpy as np
import pytest
import torch

import lyceum_warp as lw


@pytest.fixture(scope="module")
def reach() -> lw.MPPI:
    return lw.MPPI("reach", horizon=4, samples=4)


@pytest.fixture(scope="module")
def point() -> lw.MPPI:
    return lw.MPPI("point_mass", horizon=3, samples=4)


def reset_state(task: str) -> tuple[torch.Tensor, dict[str, slice]]:
    plant = lw.make(task, autoreset=False)
    plant.reset()
    return plant.get_state()[0], dict(plant.state_space.parts)


def test_missing_parts_of_a_state_get_their_reset_values(reach: lw.MPPI) -> None:
    qpos = np.linspace(-0.5, -0.1, 7)
    state = reach.state_of(qpos=qpos, qvel=[0.1] * 7, time=0.3, mocap_pos=torch.tensor([[0.1, 0.2, 0.3]]), step=15)
    expected, parts = reset_state("reach")
    expected[parts["qpos"]], expected[parts["qvel"]] = torch.from_numpy(qpos), 0.1
    expected[parts["time"]], expected[parts["step"]] = 0.3, 15
    expected[parts["mocap_pos"]] = torch.tensor([0.1, 0.2, 0.3]).double()
    assert torch.equal(state, expected)
    assert torch.equal(reach.state_of(), reset_state("reach")[0]), "one state has changed the next"
    reach(state)


def test_state_of_computes_the_step_count_from_the_time(reach: lw.MPPI) -> None:
    step = reach.env.state_space.parts["step"]
    assert reach.state_of(time=0.2)[step] == 10
    assert reach.state_of(time=0.2, step=3)[step] == 3


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"qpoz": [0.0] * 7}, "'qpoz': it has .*'qpos'"),
        ({"qpos": [0.0] * 6}, "'qpos' .* 7 numbers, not 6"),
        ({"time": "now"}, "'time' .* 'now'"),
    ],
)
def test_making_a_state_from_invalid_parts_raises_an_error(
    parts: dict[str, object], message: str, reach: lw.MPPI
) -> None:
    with pytest.raises(ValueError, match=message):
        reach.state_of(**parts)


def test_planning_from_a_state_of_wrong_shape_or_type_raises_an_error(point: lw.MPPI) -> None:
    state, before = point.state_of(), point.actions.clone()
    size = len(state)
    for wrong, found in (
        (state.float(), f"a float64 tensor of shape ({size},), not a float32 tensor of shape ({size},)"),
        (state[1:], f"not a float64 tensor of shape ({size - 1},)"),
        (state.expand(2, -1), f"not a float64 tensor of shape (2, {size})"),
        (state.numpy(), f"not a ndarray of shape ({size},)"),
        (None, "not NoneType None"),
    ):
        with pytest.raises(ValueError, match=re.escape(found)):
            point(wrong)  # type: ignore[arg-type]
    assert torch.equal(point.actions, before), "a refused state has changed the plan"


@pytest.mark.parametrize(("part", "number"), [("qvel", np.nan), ("qpos", np.inf), ("time", -np.inf)])
def test_error_of_a_non_finite_state_names_the_part(part: str, number: float, point: lw.MPPI) -> None:
    broken, before = point.state_of(), point.actions.clone()
    broken[point.env.state_space.parts[part]] = number
    with pytest.raises(ValueError, match=f"{number} in its '{part}'"):
        point(broken)
    assert torch.equal(point.actions, before)


def test_batch_of_one_state_gives_the_same_plan_as_the_state() -> None:
    row, single = (lw.MPPI("point_mass", horizon=3, samples=4) for _ in range(2))
    state = row.state_of()
    assert torch.equal(row(state[None]), single(state))
