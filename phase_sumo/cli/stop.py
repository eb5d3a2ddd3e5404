"""Ending long work cleanly when the person or the machine asks for it."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from phase_sumo.bridge.signals import SIGNALS


def interrupt(number: int, _: FrameType | None) -> None:
    """Handler that ends the work in hand as Ctrl-C does, so that files are closed on the way out."""
    raise KeyboardInterrupt


@contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Whether SIGINT or SIGTERM has come; the second one ends the work at once."""
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
