"""Phases become graphs: the same numbers, the same order, captured where they are made of launches."""

import warp as wp

from lyceum_warp.graphs.capture import Graphs, Phase


@wp.kernel(enable_backward=False)
def append(digit: int, number_inout: wp.array[int]):
    number_inout[0] = 10 * number_inout[0] + digit


class Digits:
    """Phases that append a digit each to a number, and count how often they are called."""

    def __init__(self) -> None:
        self.number = wp.zeros(1, dtype=int, device="cpu")
        self.calls = 0

    def phase(self, digit: int, *, engine: bool = False) -> Phase:
        def run() -> None:
            self.calls += 1
            wp.launch(append, 1, [digit, self.number], device="cpu")

        return Phase(str(digit), run, engine=engine)

    def after(self, calls: tuple) -> int:
        self.number.zero_()
        for call in calls:
            call()
        return int(self.number.numpy()[0])


def graphs(**options: bool) -> Graphs:
    return Graphs(wp.get_device("cpu"), **options)


def test_consecutive_phases_become_one_graph_that_is_replayed_from_the_third_call_on() -> None:
    digits = Digits()
    calls = graphs().sequence([digits.phase(1), digits.phase(2, engine=True), digits.phase(3)])
    assert len(calls) == 1
    assert [digits.after(calls) for _ in range(4)] == [123] * 4
    assert digits.calls == 6  # the first call runs, the second captures


def test_engine_calls_stay_between_graphs_where_they_are_not_made_of_launches() -> None:
    digits = Digits()
    phases = [digits.phase(1), digits.phase(2), digits.phase(3, engine=True), digits.phase(4)]
    calls = graphs(capture_engine=False).sequence(phases)
    assert len(calls) == 3
    assert calls[1] is phases[2].run
    assert [digits.after(calls) for _ in range(4)] == [1234] * 4
    assert digits.calls == 2 * 3 + 4


def test_without_graphs_every_phase_is_called_directly() -> None:
    digits = Digits()
    phases = [digits.phase(1), digits.phase(2)]
    calls = graphs(enabled=False).sequence(phases)
    assert calls == tuple(phase.run for phase in phases)


def test_forget_captures_again_what_the_phases_launch_now() -> None:
    digits, made = Digits(), graphs()
    digit = [1]
    calls = made.sequence([Phase("digit", lambda: wp.launch(append, 1, [digit[0], digits.number], device="cpu"))])
    assert [digits.after(calls) for _ in range(3)] == [1] * 3
    digit[0] = 2
    assert digits.after(calls) == 1  # the graph holds the argument
    made.forget()
    assert [digits.after(calls) for _ in range(3)] == [2] * 3
