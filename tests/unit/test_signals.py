"""Signals that wait for the end of a step."""

from __future__ import annotations

import signal
import threading

import pytest

from phase_sumo.cli import main
from phase_sumo.signals import SIGNALS, held_signals, stop_signals


@pytest.fixture
def heard():
    """Numbers of the signals that the handlers outside were called for."""
    numbers = []
    before = {n: signal.signal(n, lambda n, _: numbers.append(n)) for n in (signal.SIGINT, signal.SIGTERM)}
    yield numbers
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_to_be_answered(heard, number):
    with held_signals() as answer:
        answer()
        signal.raise_signal(number)
        assert heard == []
        answer()
        assert heard == [number]
        answer()
    assert heard == [number]
    signal.raise_signal(number)
    assert heard == [number, number]  # the handlers are back


def test_a_second_signal_does_not_wait(heard):
    with held_signals() as answer:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        assert heard == [signal.SIGTERM]
        answer()
    assert heard == [signal.SIGTERM, signal.SIGINT]


def test_the_end_answers_also_after_an_error(heard):
    with pytest.raises(ValueError), held_signals():
        signal.raise_signal(signal.SIGINT)
        raise ValueError
    assert heard == [signal.SIGINT]


def test_what_no_python_handles_is_left_alone(heard):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with held_signals():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL


def test_other_threads_hold_nothing(heard):
    handler, inside = signal.getsignal(signal.SIGINT), []

    def work():
        with held_signals():
            inside.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert inside == [handler]


def test_a_command_may_ask_whether_to_stop_and_the_second_signal_ends_it(heard):
    with pytest.raises(KeyboardInterrupt), stop_signals() as stopping:
        assert not stopping()
        signal.raise_signal(signal.SIGTERM)
        assert stopping()
        signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)
    assert heard == [signal.SIGINT]  # the handlers are back


@pytest.mark.parametrize("ends_well", [True, False])
def test_a_command_leaves_the_handlers_as_they_were(heard, monkeypatch, ends_well):
    def command(args):
        inside.append(signal.getsignal(signal.SIGTERM))
        if not ends_well:
            signal.raise_signal(signal.SIGTERM)
        return {}

    inside: list[object] = []
    before = [signal.getsignal(number) for number in SIGNALS]
    monkeypatch.setattr("phase_sumo.cli.commands.bench", command)
    assert main(["bench", "sim"]) == (0 if ends_well else 130)
    assert inside[0] not in before  # SIGTERM meant an orderly end meanwhile
    assert [signal.getsignal(number) for number in SIGNALS] == before
