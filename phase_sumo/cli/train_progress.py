"""What there is to tell about a training run while it goes on, and telling it line by line."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

Row = dict[str, float]
Show = Callable[[Row], None]
RECENT = 20  # updates that the speed is measured over
LINE_EVERY = 30.0  # s between lines where there is no terminal
RATES = {"goal": "goal_rate", "collision": "collision_rate", "off road": "road_edge_rate"}
HELD_OUT = {
    "goal": "held_out_goal_rate",
    "collision": "held_out_agent_collision_rate",
    "off road": "held_out_road_collision_rate",
    "success": "held_out_success_rate",
}


class Progress:
    """Where a run of ``total`` agent steps stands that began, or goes on, at ``steps``.

    Attributes:
        row: the latest row of the curve, empty before the first.
        held_out: the latest row with held-out rates.
    """

    def __init__(self, steps: int, total: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.total, self.row, self.held_out = total, Row(), Row()
        self._clock = clock
        self._marks = deque([(clock(), float(steps))], maxlen=RECENT + 1)

    def add(self, row: Row) -> None:
        self.row = row
        if HELD_OUT["goal"] in row:
            self.held_out = row
        self._marks.append((self._clock(), row["steps"]))

    @property
    def steps(self) -> float:
        return self._marks[-1][1]

    @property
    def share(self) -> float:
        return min(self.steps / max(self.total, 1), 1.0)

    @property
    def speed(self) -> float:
        """Agent steps per second of wall time lately, 0 before the first update."""
        (began, first), (ended, last) = self._marks[0], self._marks[-1]
        return (last - first) / max(ended - began, 1e-9)

    @property
    def left(self) -> str:
        """Time to go as H:MM:SS."""
        if self.speed == 0.0:
            return "-:--:--"
        since = self._clock() - self._marks[-1][0]
        return duration((self.total - self.steps) / self.speed - since)


@contextmanager
def lines(steps: int, total: int) -> Iterator[Show]:
    """Report on stderr now and then, and whenever held-out rates come."""
    progress, due = Progress(steps, total), 0.0

    def show(row: Row) -> None:
        nonlocal due
        progress.add(row)
        if time.monotonic() >= due or row is progress.held_out:
            due = time.monotonic() + LINE_EVERY
            print(line(progress), file=sys.stderr, flush=True)

    yield show


def line(progress: Progress) -> str:
    row = progress.row
    rates = "  ".join(f"{label} {100 * row[name]:.1f}%" for label, name in RATES.items())
    text = (
        f"{100 * progress.share:3.0f}% {millions(progress.steps)} steps  {progress.left} left  "
        f"{progress.speed:,.0f} steps/s  {rates}  rho {row['rho']:.2f}  KL {row['prior_kl']:.3f}  "
        f"{row['peak_memory_mb']:.0f} MB"
    )
    return f"{text}  {held_out(row)}" if row is progress.held_out else text


def held_out(row: Row) -> str:
    rates = "  ".join(f"{label} {100 * row[name]:.1f}%" for label, name in HELD_OUT.items())
    return f"held out: {rates}"


def millions(steps: float) -> str:
    return f"{steps / 1e6:.2f} M"


def duration(seconds: float) -> str:
    return str(timedelta(seconds=max(round(seconds), 0)))
