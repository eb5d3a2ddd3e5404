"""Ctrl-C and SIGTERM between two steps of a simulation, never within one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def held_signals() -> Iterator[Callable[[], None]]:
    """SIGINT and SIGTERM wait for a call of the function given here, or for the end; a second one does not.

    Only Python's handlers are held (signals that are ignored, or end the process at once, still do), and only
    in the main thread, where they run.
    """
    handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) > 1:
            handlers[number](number, frame)

    def answer() -> None:
        if received:
            number = received[0]
            received.clear()
            handlers[number](number, None)

    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            handler = signal.getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, note)
    try:
        yield answer
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        answer()
