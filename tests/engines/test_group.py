import numpy as np
import warp as wp

from lyceum_warp.engines.warp.group import Turns


def test_host_code_of_a_turn_runs_twice_for_any_number_of_groups() -> None:
    """The second turn is captured and replayed; otherwise, constants of thousands of worlds would take seconds."""
    mask: wp.array = wp.array(np.arange(9) != 4, dtype=bool, device="cpu")
    source: wp.array = wp.array(np.arange(18.0).reshape(9, 2), dtype=float, device="cpu")
    target, group = wp.zeros_like(source), wp.zeros((2, 2), dtype=float, device="cpu")
    turns, calls = Turns(9, 2, mask.device), []

    def turn() -> None:
        calls.append(wp.empty(3, dtype=float, device="cpu"))
        turns.take(source, group)
        turns.give(group, target)

    for _ in range(2):
        target.zero_()
        calls.clear()
        turns.run(mask, turn)
        assert len(calls) == 2
        np.testing.assert_array_equal(target.numpy(), source.numpy() * mask.numpy()[:, None])
    with wp.ScopedCapture("cpu") as capture:
        turns.run(mask, turn)
    target.zero_()
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(target.numpy(), source.numpy() * mask.numpy()[:, None])
