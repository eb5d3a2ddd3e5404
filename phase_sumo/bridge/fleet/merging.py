"""Whom to follow into a merge: lanes that run into one another without an acceleration lane.

Where several lanes lead into one, the vehicles on the way there are put in the order in which they would
arrive at their present speeds. Each follows the one before it as if that were ahead in its own lane, with
the gap they would have there: how much farther the one has to go than the other, less the other's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from phase_sumo.bridge.fleet.member import Member
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import FloatArray, IntArray, Road
from phase_sumo.bridge.fleet.table import VehicleTable

BEFORE = 100.0  # m before the merge from where on vehicles are put in order
SLOWEST = 1.0  # m/s at least, for the time of arrival


@dataclass(frozen=True)
class Approach:
    """A lane on the way to a merge.

    Attributes:
        merge: lane that several lead into.
        branch: which of these it is, or leads to.
        lane: this one.
        way: lanes that follow it, up to the merge.
        metres: from its end to the merge.
    """

    merge: int
    branch: int
    lane: int
    way: tuple[int, ...]
    metres: float


class Merging:
    """Pairs of vehicles from different branches of a merge."""

    def __init__(self, road: Road, table: VehicleTable) -> None:
        self._road, self._table = road, table
        self._approaches = [
            approach for merge in range(len(road.count)) for approach in _approaches(road, merge)
        ]
        lanes = np.array([a.lane for a in self._approaches], np.int64)
        self._begin = road.first[lanes]
        self._end = self._begin + road.count[lanes]
        self._merge = np.array([a.merge for a in self._approaches], np.int64)

    def pairs(
        self, occupancy: Occupancy, members: dict[str, Member]
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Followers and whom they follow, both rows [n], and the gaps between them in m."""
        found: list[tuple[int, int, float]] = []
        first, last = occupancy.between(self._begin), occupancy.between(self._end)
        used = np.flatnonzero(last > first)
        merges, count = np.unique(self._merge[used], return_counts=True)
        for merge in merges[count > 1].tolist():
            coming = [
                arrival
                for k in used[self._merge[used] == merge].tolist()
                for arrival in self._arrivals(k, occupancy, slice(first[k], last[k]), members)
            ]
            coming.sort()
            found += [
                (row, before, way - ahead - float(occupancy.length[before]))
                for (_, ahead, before, one), (_, way, row, other) in pairwise(coming)
                if one != other
            ]
        rows, leaders, gaps = zip(*found, strict=True) if found else ((), (), ())
        return np.array(rows, np.int64), np.array(leaders, np.int64), np.array(gaps, np.float64)

    def _arrivals(
        self, k: int, occupancy: Occupancy, places: slice, members: dict[str, Member]
    ) -> list[tuple[float, float, int, int]]:
        """Time to the merge in s, way to it in m, row and branch of the vehicles on an approach."""
        approach, result = self._approaches[k], []
        for row, node in zip(*occupancy.at(places), strict=True):
            way = approach.metres + float(self._end[k] - node)
            member = members.get(self._table.ids[row])
            if way < BEFORE and (member is None or _leads(member, approach)):
                speed = max(float(self._table["speed"][row]), SLOWEST)
                result.append((way / speed, way, row, approach.branch))
        return result


def _leads(member: Member, approach: Approach) -> bool:
    """Whether a vehicle's route goes on to the merge."""
    at = approach.lane
    for lane in approach.way:
        if member.route.onward[at] != lane:
            return False
        at = lane
    return True


def _approaches(road: Road, merge: int) -> list[Approach]:
    """The lanes that lead to a merge within `BEFORE`; none if it is none."""
    into = road.preceding[merge]
    if len(into) < 2:
        return []
    found, open_ends = [], [Approach(merge, branch, branch, (merge,), 0.0) for branch in into]
    while open_ends:
        approach = open_ends.pop()
        found.append(approach)
        metres = approach.metres + float(road.metres[approach.lane])
        if metres < BEFORE:
            way = (approach.lane, *approach.way)
            open_ends += [
                Approach(merge, approach.branch, lane, way, metres)
                for lane in road.preceding[approach.lane]
                if lane not in way
            ]
    return found
