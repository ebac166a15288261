import throughput


def test_dm_control_tasks_are_measured_with_equal_numbers_of_worlds_by_every_library() -> None:
    options = throughput.Options(parts=("suite",), tasks=("dm/cheetah_run", "dm/quadruped_walk"), threads=2, repeats=1)
    cases = [(case.task, case.worlds, case.contestant) for case in throughput.cases(options)]
    assert cases.count(("dm/cheetah_run", 16, "envpool")) == 1 and len(cases) == 3 * (3 + 2)
    assert ("dm/quadruped_walk", 16, "envpool") not in cases
    assert {case.threads for case in throughput.cases(options)} == {2}
