"""Scenario windows: pieces of a recording that start with the vehicles then on the road."""

from __future__ import annotations

import numpy as np

from phase_sumo.errors import PhaseError
from phase_sumo.logs.lane_matching import lane_changes, lane_places
from phase_sumo.logs.quality import FLAGS
from phase_sumo.logs.recorded_vehicles import HISTORY
from phase_sumo.logs.recording import PERIOD, Recording, Window
from phase_sumo.logs.sampling import runs

SHARE = 85.0  # percentile of the speeds recorded in a lane that its drivers like to drive


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
    used = np.unique(places.lane[places.lane >= 0]).tolist()
    speed = {k: float(np.percentile(recording.speed[places.lane == k], SHARE)) for k in used}
    vehicle, first, until = runs(recording.present)
    sound = np.array([not (flags & without) for flags in recording.flags], np.bool_)
    length, steps, result = recording.present.shape[1], round(seconds / PERIOD), []
    for begin in range(0, length - round(shortest / PERIOD), round(stride / PERIOD)):
        size = min(steps, length - 1 - begin)
        there = np.flatnonzero((first <= begin) & (begin <= until) & sound[vehicle])
        there = there[places.lane[vehicle[there], begin] >= 0]
        if not len(there):
            continue
        agents, last = vehicle[there], np.minimum(until[there], begin + size)
        row = np.minimum(np.searchsorted(agents, changes.vehicle), len(agents) - 1)
        within = (agents[row] == changes.vehicle) & (changes.begin >= begin) & (changes.end <= last[row])
        if within.any() or not lane_changes_only:
            past = min(begin, round(HISTORY / PERIOD))
            result.append(
                Window(
                    recording.cut(agents, begin - past, begin + size + 1),
                    agents,
                    past,
                    size,
                    last - (begin - past),
                    int(within.sum()),
                    np.array([speed[k] for k in places.lane[agents, begin].tolist()]),
                )
            )
    return result
