"""Which windows of recorded traffic an encoder learns from, and on which models are tested.

The same vehicles over the same samples: as recorded, and as a model drove them on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
from torch import Tensor

from phase_sumo.evaluate.realism.encoder import features, trajectories
from phase_sumo.logs.recording import PERIOD, Recording, Window
from phase_sumo.logs.windows import windows


def recorded(window: Window) -> Recording:
    """The window's agents [N] over its steps + 1 samples, each up to where it is first lost."""
    r = window.recording
    span = slice(window.begin, window.begin + window.steps + 1)
    there = np.arange(window.steps + 1) <= (window.last - window.begin)[:, None]
    x, y, yaw, speed = (np.where(there, a[:, span], np.nan) for a in (r.x, r.y, r.yaw, r.speed))
    return replace(r, present=there, x=x, y=y, yaw=yaw, speed=speed)


def alike(simulated: Recording, log: Recording) -> Recording:
    """The simulated samples of which the log has one, too: cameras see a stretch of road only."""
    there = simulated.present & log.present
    x, y, yaw, speed = (
        np.where(there, a, np.nan) for a in (simulated.x, simulated.y, simulated.yaw, simulated.speed)
    )
    return replace(simulated, present=there, x=x, y=y, yaw=yaw, speed=speed)


TRAINING_STRIDE = 1.0  # s from one window that the encoder learns from to the next
TRAINING_WINDOWS = 128  # of one recording at most: the encoder takes 19,200 trajectories in all


@dataclass
class Selection:
    """What is kept of the recordings.

    Attributes:
        names: of the recordings that are learnt from.
        learnt: features of their trajectories, window by window.
        tested: windows of the others.
    """

    names: list[str] = field(default_factory=list)
    learnt: list[Tensor] = field(default_factory=list)
    tested: list[Window] = field(default_factory=list)


def select(
    opened: Sequence[Iterator[Recording]],
    known: Sequence[str] | None,
    seconds: float,
    most: int,
    report: Callable[[str], None],
) -> Selection:
    """Read the recordings, one at a time.

    Args:
        opened: those of each source.
        known: names of recordings that an encoder has learnt from, which are left out; None where there is no
            encoder yet: it learns from every second recording of a source.
        seconds: length of a window; there are whole ones only, and those of the test do not overlap.
        most: windows tested, spread evenly over those that there are.
        report: is told which recording was read.
    """
    found = Selection()

    def take(number: int, recording: Recording) -> None:
        report(recording.name)
        if known is None and number % 2 == 0:
            stride = max(TRAINING_STRIDE, recording.present.shape[1] * PERIOD / TRAINING_WINDOWS)
            scenes = [recorded(w) for w in windows(recording, seconds, False, stride, shortest=seconds)]
            found.names.append(recording.name)
            found.learnt.extend(features(scene, trajectories(scene)) for scene in scenes)
        elif known is None or recording.name not in known:
            # more of one recording are never kept in the end
            found.tested.extend(spread(windows(recording, seconds, False, shortest=seconds), most))

    for source in opened:
        deque(map(take, count(), source), maxlen=0)  # a loop would hold a recording while the next is read
    found.tested = spread(found.tested, most)
    return found


def spread(found: list[Window], most: int) -> list[Window]:
    """``most`` of them at most, evenly."""
    if len(found) <= most:
        return found
    return [found[k] for k in np.linspace(0, len(found) - 1, most).round().astype(int)]
