"""SIGINT and SIGTERM end work where it can be ended; afterwards the handlers are as before."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
Handler = Callable[[int, FrameType | None], Any]


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handler that ends the work in hand as Ctrl-C does, so that files are closed on the way out."""
    raise KeyboardInterrupt


@contextmanager
def handled(numbers: Sequence[int], handler: Handler) -> Iterator[None]:
    """Signals go to ``handler`` meanwhile; outside of the main thread, where none can, nothing happens."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, signal.SIG_DFL if previous is None else previous)


@contextmanager
def held_signals() -> Iterator[Callable[[], None]]:
    """SIGINT and SIGTERM wait for a call of the function given here, or for the end; a second one does not.

    Only Python's handlers are held; signals that are ignored, or end the process at once, still do.
    """
    outside: dict[int, Handler] = {}
    for each in SIGNALS:
        if callable(handler := signal.getsignal(each)):
            outside[each] = handler
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            outside[number](number, frame)

    def answer() -> None:
        if received:
            number = received[0]
            received.clear()
            outside[number](number, None)

    try:
        with handled(list(outside), note):
            yield answer
    finally:
        answer()


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Whether SIGINT or SIGTERM has come; the second one ends the work at once."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if received:
            interrupt(number, frame)
        received.append(number)

    with handled(SIGNALS, note):
        yield lambda: bool(received)
