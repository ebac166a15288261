import pytest
import warp as wp

from lyceum_warp.kernels import state
from lyceum_warp.support.arrays import flat, launch_several_rows


@pytest.mark.parametrize(("dtype", "shape", "columns"), [(float, (2, 3), 3), (wp.vec3, (2, 4), 12), (int, 2, 1)])
def test_flat_view_has_one_row_per_world_in_the_same_memory(dtype: type, shape: tuple[int, ...], columns: int) -> None:
    array = wp.zeros(shape, dtype=dtype, device="cpu")
    alias = flat(array)
    assert alias.shape == (2, columns)
    assert alias.dtype == wp.float32
    assert alias.ptr == array.ptr


@pytest.mark.parametrize("widths", [[1], [3, 2, 1, 4], [2, 0, 1, 3, 2, 1, 5]])
def test_several_arrays_are_copied_to_separate_targets_in_masked_worlds(widths: list[int]) -> None:
    mask = wp.array([True, False, True], dtype=bool, device="cpu")
    rows = [wp.full((3, width), 0.5 + k, dtype=float, device="cpu") for k, width in enumerate(widths)]
    wide = [wp.zeros((3, width), dtype=wp.float64, device="cpu") for width in widths]
    back = [wp.zeros((3, width), dtype=float, device="cpu") for width in widths]
    launch_several_rows(state.widen_four, mask, list(zip(rows, wide, strict=True)))
    launch_several_rows(state.narrow_four, mask, list(zip(wide, back, strict=True)))
    for k, (width, copied) in enumerate(zip(widths, back, strict=True)):
        assert copied.numpy().tolist() == [[0.5 + k] * width, [0.0] * width, [0.5 + k] * width]


def test_flat_view_keeps_the_memory_alive() -> None:
    alias = flat(wp.full((2, 3), 5.0, dtype=float, device="cpu"))
    assert alias.numpy().tolist() == [[5.0] * 3] * 2
