import pytest

import lyceum_warp as lw

PARTS = {"gravity": slice(0, 3), "foot_height": slice(3, 5)}


def test_mirror_combines_the_reflections_of_several_parts() -> None:
    mirror = lw.Mirror({"gravity": (1, -1, 1), "foot_height": ([1, 0], [1, 1]), "other": (-1,)})
    assert mirror.columns(PARTS, task="walker") == ([0, 1, 2, 4, 3], [1.0, -1.0, 1.0, 1.0, 1.0])
    whole = lw.Mirror({"action": ([1, 0], [-1, -1])})
    motors = {"left": slice(0, 1), "right": slice(1, 2)}
    assert whole.columns(motors, task="walker", whole="action") == ([1, 0], [-1.0, -1.0])


@pytest.mark.parametrize("part", [(1, 2), ([0, 2], [1, 1]), ([1, 2, 0], [1, 1, 1]), ([1, 0], [1, -1])])
def test_reflections_that_are_not_their_own_inverse_raise_an_error(part: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match=r"the reflection 'x' of lw.Mirror must be its own inverse"):
        lw.Mirror({"x": part})


def test_error_of_a_missing_reflection_names_the_part() -> None:
    with pytest.raises(ValueError, match="'walker' has no reflection for 'foot_height', which has 2 columns"):
        lw.Mirror({"gravity": (1, -1, 1)}).columns(PARTS, task="walker")
    with pytest.raises(ValueError, match="has a reflection of 2 columns for 'gravity', which has 3"):
        lw.Mirror({"gravity": (1, -1)}).columns(PARTS, task="walker")
