"""A live view of a training run: progress, rates and their course, on ten lines of a terminal.

What there is to tell about a training run while it goes on, and telling it line by line.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
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


REDRAWS = 2  # per second
BLOCKS = " ▁▂▃▄▅▆▇█"
COURSE = 20  # characters at most


def train_view(
    title: str, steps: int, total: int, stopping: Callable[[], bool]
) -> AbstractContextManager[Show]:
    """The live view, or lines where there is no terminal or no rich to draw it with.

    Args:
        steps, total: agent steps done and to be done.
        stopping: whether the person has asked for the end.
    """
    try:
        from rich.console import Console
    except ImportError:
        return lines(steps, total)
    console = Console(stderr=True)
    if not console.is_terminal or console.is_dumb_terminal:
        return lines(steps, total)
    return _live(console, Screen(title, steps, total, stopping))


@contextmanager
def _live(console, screen: Screen) -> Iterator[Show]:
    from rich.live import Live

    with Live(console=console, get_renderable=screen.draw, refresh_per_second=REDRAWS):
        yield screen.add


class Course:
    """The course of a rate since the view began, in a bounded number of means over equally many updates."""

    def __init__(self) -> None:
        self._means: list[float] = []
        self._sum, self._count, self._each = 0.0, 0, 1

    def add(self, value: float) -> None:
        self._sum, self._count = self._sum + value, self._count + 1
        if self._count == self._each:
            self._means.append(self._sum / self._count)
            self._sum, self._count = 0.0, 0
        if len(self._means) == COURSE:
            pairs = zip(self._means[::2], self._means[1::2], strict=True)
            self._means, self._each = [(a + b) / 2 for a, b in pairs], 2 * self._each

    def __str__(self) -> str:
        """Blocks of a height from 0 to the largest mean."""
        top = max(self._means, default=0.0) or 1.0
        return "".join(BLOCKS[round(value / top * (len(BLOCKS) - 1))] for value in self._means)


class Screen:
    """All that is drawn."""

    def __init__(
        self,
        title: str,
        steps: int,
        total: int,
        stopping: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._title, self._stopping, self._clock = title, stopping, clock
        self._progress = Progress(steps, total, clock)
        self._courses = {label: Course() for label in RATES}
        self._began = clock()

    def add(self, row: Row) -> None:
        for label, name in RATES.items():
            self._courses[label].add(row[name])
        self._progress.add(row)

    def draw(self):
        from rich.console import Group
        from rich.panel import Panel

        parts = [self._bar(), self._figures() if self._progress.row else "the first update ..."]
        if self._progress.held_out:
            parts.append(self._held_out())
        note = "Ctrl-C stops after this update and keeps a checkpoint"
        if self._stopping():
            note = "[yellow]stopping after this update; Ctrl-C again drops it"
        return Panel(Group(*parts), title=f"[bold]{self._title}", title_align="left", subtitle=f"[dim]{note}")

    def _bar(self):
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        progress = self._progress
        row = Table.grid(padding=(0, 1), expand=True)
        row.add_column(ratio=1)
        for _ in range(4):
            row.add_column(justify="right", no_wrap=True)
        row.add_row(
            ProgressBar(total=1.0, completed=progress.share),
            f"{100 * progress.share:.0f}%",
            f"{millions(progress.steps)} of {millions(progress.total)}",
            duration(self._clock() - self._began),
            f"[cyan]{progress.left} left",
        )
        return row

    def _figures(self):
        from rich.table import Table

        row = self._progress.row
        right = [
            ("speed", f"{self._progress.speed:,.0f} steps/s"),
            ("rho", f"{row['rho']:.2f}"),
            ("prior KL", f"{row['prior_kl']:.3f}"),
            ("learning rate", f"{row['learning_rate']:.1e}"),
            ("peak memory", f"{row['peak_memory_mb']:,.0f} MB"),
        ]
        if "peak_gpu_memory_mb" in row:
            right.append(("peak GPU memory", f"{row['peak_gpu_memory_mb']:,.0f} MB"))
        left = [
            (label, f"{100 * row[name]:.1f}%", str(self._courses[label])) for label, name in RATES.items()
        ]
        left += [("", "", "")] * (len(right) - len(left))
        table = Table.grid(padding=(0, 2))
        table.add_column(style="dim")
        table.add_column(justify="right", min_width=6)
        table.add_column(style="green", min_width=COURSE)
        table.add_column(style="dim")
        table.add_column(justify="right", no_wrap=True)
        for here, there in zip(left, right, strict=True):
            table.add_row(*here, *there)
        return table

    def _held_out(self) -> str:
        row = self._progress.held_out
        # some thousand agents are evaluated: tenths of a percent would be noise, and too wide
        rates = "  ".join(f"[dim]{label}[/] {100 * row[name]:.0f}%" for label, name in HELD_OUT.items())
        return f"[dim]held out at {millions(row['steps'])}:[/]  {rates}"
