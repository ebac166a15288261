from collections import defaultdict

from term_calls import KERNELS

from lyceum_warp import terms


def test_argument_name_has_one_type_and_one_documented_meaning_in_all_functions() -> None:
    kinds = defaultdict(set)
    for overloads in KERNELS.values():
        for function, _ in overloads:
            for argument, kind in function.input_types.items():
                kinds[argument].add(str(kind))
    assert {argument for argument, found in kinds.items() if len(found) > 1} == {"row"}  # numbers or vectors
    assert {*kinds} == {*terms.ARGUMENTS}
