"""Values as NAME=VALUE, and signals."""

import signal

import pytest

from lyceum_warp import cli
from lyceum_warp.cli.arguments import Interrupted, parameter, postponed, signals, spelled


def test_a_postponed_signal_raises_at_the_end_and_only_once() -> None:
    """A signal that was not asked for raises at the end of the block; after that, a second one is ignored."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with signals():
            with pytest.raises(Interrupted) as raised, postponed() as noted:
                signal.raise_signal(signal.SIGTERM)
                signal.raise_signal(signal.SIGINT)
                assert noted == [signal.SIGTERM, signal.SIGINT]
            assert raised.value.number == signal.SIGTERM
            signal.raise_signal(signal.SIGTERM)
        with signals():
            with pytest.raises(Interrupted), postponed() as noted:
                signal.raise_signal(signal.SIGTERM)
                raise Interrupted(max(noted))
            signal.raise_signal(signal.SIGTERM)
        with signals():
            with postponed():
                pass
            with pytest.raises(Interrupted), postponed(False) as noted:
                signal.raise_signal(signal.SIGTERM)
            assert noted == []
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_command_restores_the_handlers_of_signals() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    cli.main(["tasks"])
    assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
])  # fmt: skip
def test_a_parameter_is_read_as_it_is_spelled(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)
    assert parameter(f"a={spelled(parsed)}") == ("a", value)
