import signal
from collections.abc import Iterator

import pytest

from lyceum_warp.support.interrupts import Interrupted, obeyed, postponed, signals


@pytest.fixture(autouse=True)
def default_handlers() -> Iterator[None]:
    """Set the default handlers, because a shell's background jobs ignore SIGINT."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_first_signal_raises_an_exception_and_later_signals_are_ignored() -> None:
    with signals():
        with pytest.raises(Interrupted) as raised:
            signal.raise_signal(signal.SIGTERM)
        assert raised.value.number == signal.SIGTERM
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_postponed_signal_raises_an_exception_at_the_end_of_the_context() -> None:
    with signals():
        with pytest.raises(Interrupted) as raised, postponed() as noted:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            assert noted == [signal.SIGTERM, signal.SIGINT]
        assert raised.value.number == signal.SIGTERM
        signal.raise_signal(signal.SIGTERM)


def test_signals_are_ignored_once_the_program_is_ending() -> None:
    with signals():
        with pytest.raises(Interrupted), postponed() as noted:
            signal.raise_signal(signal.SIGTERM)
            raise Interrupted(max(noted))
        signal.raise_signal(signal.SIGTERM)


def test_signal_after_a_postponement_raises_an_exception() -> None:
    with signals():
        with postponed():
            pass
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGTERM)


def test_second_signal_is_not_postponed_if_insist_is_true() -> None:
    reached = []
    with signals():
        with pytest.raises(Interrupted) as raised, postponed(insist=True):
            signal.raise_signal(signal.SIGTERM)
            reached.append(1)
            signal.raise_signal(signal.SIGINT)
            reached.append(2)
        assert raised.value.number == signal.SIGINT and reached == [1]
        signal.raise_signal(signal.SIGTERM)  # ignored
    with pytest.raises(KeyboardInterrupt), postponed(insist=True):  # outside a command
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_exactly_one_more_signal_can_raise_an_exception() -> None:
    with signals():
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(Interrupted) as raised, obeyed():
            signal.raise_signal(signal.SIGTERM)
        assert raised.value.number == signal.SIGTERM
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_handlers_of_other_code_are_not_replaced() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with signals():
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGTERM)
        with obeyed():
            signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), obeyed():
        signal.raise_signal(signal.SIGINT)
