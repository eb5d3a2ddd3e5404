"""Scenario windows: pieces of a recording that start with the vehicles then on the road."""

from __future__ import annotations

import numpy as np

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.logs.lane_places import lane_changes, lane_places
from phase_sumo.evaluate.logs.quality import FLAGS
from phase_sumo.evaluate.logs.recording import PERIOD, Recording, Window


def windows(
    recording: Recording,
    seconds: float = 10.0,
    lane_changes_only: bool = True,
    stride: float | None = None,
    shortest: float = 5.0,
    without: frozenset[str] = frozenset(),
) -> list[Window]:
    """Cut a recording into scenario windows.

    Agents are the vehicles that are present when the window begins, with their centre on a lane. What
    appears later is no agent. A vehicle may be lost before the window ends; `Window.last` says when, in the
    extreme at once.

    Args:
        recording: the tracks.
        seconds: length of a window.
        lane_changes_only: leave out windows in which no agent changes lanes (the paper's choice).
        stride: seconds from the begin of one window to the next; by default ``seconds``, so that windows do
            not overlap.
        shortest: what is left at the end of a recording is a window, too, if it has this many seconds.
        without: leave out agents whose track has one of these `FLAGS`.

    Raises:
        PhaseError: a length is not positive, or a flag unknown.
    """
    stride = seconds if stride is None else stride
    for name, value in (("seconds", seconds), ("stride", stride), ("shortest", shortest)):
        if not value >= PERIOD:
            raise PhaseError(f"{name} {value:g}: pass at least {PERIOD:g} s")
    if unknown := without - FLAGS.keys():
        raise PhaseError(f"no flag {', '.join(sorted(unknown))}; there are {', '.join(FLAGS)}")
    places = lane_places(recording)
    changes = lane_changes(recording, places)
    length = recording.present.shape[1]
    # [V, T] the last sample of the piece of track that each sample belongs to
    absent = np.where(recording.present, length, np.arange(length))
    until = np.minimum.accumulate(absent[:, ::-1], axis=1)[:, ::-1] - 1
    sound = np.array([not (flags & without) for flags in recording.flags], np.bool_)
    steps, result = round(seconds / PERIOD), []
    for begin in range(0, length - round(shortest / PERIOD), round(stride / PERIOD)):
        size = min(steps, length - 1 - begin)
        agents = np.flatnonzero((places.lane[:, begin] >= 0) & sound)
        last = np.minimum(until[agents, begin], begin + size)
        row = np.searchsorted(agents, changes.vehicle)
        row = np.minimum(row, len(agents) - 1)
        if not len(agents):
            continue
        within = (agents[row] == changes.vehicle) & (changes.begin >= begin) & (changes.end <= last[row])
        if within.any() or not lane_changes_only:
            result.append(Window(recording, begin, size, agents, last, int(within.sum())))
    return result
