"""Target speeds: what the driver wants on a free road, and what slower traffic ahead leaves of it.

The wanted speed is the vehicle's own target speed or its speed factor times the lane's limit as it is now,
less where a curve ahead asks for it (`curve_speed`). The policy is told that speed, or less behind a leader
of speed v_l:

    d = s0 + T v_l
    v = v_l + sqrt(2 b (s - d))                   for a gap s >= d
    v = v_l - min((d - s) / tau, v_back)          for s < d

from where closing up with b takes just the room beyond the desired gap d, and a gap that is too short opens
within some tau, slowly behind leaders that are not in the own lane yet: two who give way to one another would
stop. tau and v_back were chosen on the merge scenario and two real stretches. T and s0 are the vType's tau
and minGap, or ``phase.time_gap``; T = 0 turns this off. A vehicle that changes lanes heeds the leaders of
both lanes, and one before a merge the vehicle that will be there first. A vehicle that points well off its
lane's direction is not told to speed up before it is in line again. Not in the paper: its policy alone keeps
too short gaps at freeway speeds (README, "Driving with traffic").

A vehicle that stands is seen from farther away, whoever drives before it:

    v = sqrt(2 b' (s - s0 - lag v_now)).

Where lanes run into one another without an acceleration lane, vehicles follow whom they will merge behind.
Where several lanes lead into one, the vehicles on the way there are put in the order in which they would
arrive at their present speeds. Each follows the one before it as if that were ahead in its own lane, with the
gap they would have there: how much farther the one has to go than the other, less the other's length.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from phase_sumo.arrays import BoolArray, FloatArray, IntArray
from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.parameters import TARGET_SPEEDS
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import curve_speed, limits_ahead
from phase_sumo.bridge.fleet.table import VehicleTable

BEFORE = 100.0  # m before the merge from where on vehicles are put in order
UNDER_WAY = 15.0  # m before the merge, from where on even one who had to give way is let in
GIVEN_WAY = 2.5  # s later at least come those who must give way
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

    def __init__(self, road: Road, table: VehicleTable, yields: BoolArray) -> None:
        """``yields``: see `RightOfWay`."""
        self._road, self._table, self._yields = road, table, yields
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
                if one != other and (ahead < UNDER_WAY or self._yields[one] <= self._yields[other])
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
                later = GIVEN_WAY if self._yields[approach.branch] and way > UNDER_WAY else 0.0
                result.append((way / speed + later, way, row, approach.branch))
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


CLOSING_UP = 1.0  # m/s^2, b
OWN_LANE, OTHER_LANE = (7.0, 2.0), (10.0, 1.0)  # tau in s and v_back in m/s
LAG = 1.5  # s by which the policy is behind a target speed that falls towards a curve
ASKEW = 0.2  # rad, about 11 degrees: behind a kink, or running wide; a lane change takes less
LEAST_ASKEW = 5.0  # m/s that vehicles askew are told at least
LOOK = 150.0  # m, the policy's own range
STANDING_LOOK, STOPPING = 500.0, 1.8  # m from where on a standing vehicle is heeded; m/s^2, b'


class TargetSpeeds:
    """Sets the wanted and the target speed of every PHASE vehicle."""

    def __init__(self, road: Road, table: VehicleTable, yields: BoolArray) -> None:
        """``yields``: see `RightOfWay`."""
        self._road, self._table = road, table
        self._merging = Merging(road, table, yields)

    def update(
        self, node: IntArray, beside: IntArray, occupancy: Occupancy, members: dict[str, Member]
    ) -> None:
        """For the vehicles that are on a lane of their route; others keep what they had.

        Args:
            node: [N] node of each row's front bumper, -1 off the road.
            beside: [N] node abreast in the lane that a row changes to, -1 for none.
        """
        table = self._table
        row_of, lane_of = table.row_of, self._road.graph.node_lane
        on_route = [
            (row, member)
            for row, member in ((row_of[vehicle], member) for vehicle, member in members.items())
            if node[row] >= 0 and member.route.changes[lane_of[node[row]]] < np.inf
        ]
        if not on_route:
            return
        rows, own = np.array([row for row, _ in on_route]), [member for _, member in on_route]
        wanted = np.clip(self._wanted(own, rows, node[rows]), *TARGET_SPEEDS)
        table.wanted_speed[rows] = wanted
        table["goal_speed"][rows] = wanted
        gaps = np.zeros((2, len(table)))  # s and m, 0 for those who take no heed
        gaps[:, rows] = np.array([(member.time_gap, member.min_gap) for member in own]).T
        for at, opening in ((node[rows], OWN_LANE), (beside[rows], OTHER_LANE)):
            k = np.flatnonzero(at >= 0)
            routes = [own[i].route for i in k.tolist()]
            if len(k):
                leader, gap = occupancy.leaders(at[k], rows[k], routes, np.full(len(k), LOOK))
                self._follow(gaps, rows[k], leader, gap, opening)
                far = np.full(len(k), STANDING_LOOK)
                self._stop_behind(gaps, rows[k], *occupancy.standing.leaders(at[k], rows[k], routes, far))
        self._follow(gaps, *self._merging.pairs(occupancy, members), OTHER_LANE)

    def _follow(
        self,
        gaps: FloatArray,
        rows: IntArray,
        leader: IntArray,
        gap: FloatArray,
        opening: tuple[float, float],
    ) -> None:
        """Lower the target speeds of rows [n] behind leaders [n], -1 for none, with gaps [n] in m.

        Args:
            gaps: [2, N] desired time gaps in s and gaps at standstill in m.
            opening: tau and v_back.
        """
        k = np.flatnonzero((leader >= 0) & (gaps[0, rows] > 0))
        rows, speed = rows[k], self._table["speed"][leader[k]].astype(np.float64)
        time_gap, least = gaps[:, rows]
        room = gap[k] - least - time_gap * speed
        closing = np.sqrt(2.0 * CLOSING_UP * np.maximum(room, 0.0))
        behind = speed + np.where(room >= 0, closing, np.maximum(room / opening[0], -opening[1]))
        target = self._table["goal_speed"]
        target[rows] = np.clip(behind, TARGET_SPEEDS[0], target[rows])

    def _stop_behind(self, gaps: FloatArray, rows: IntArray, standing: IntArray, gap: FloatArray) -> None:
        """Lower the target speeds of rows [n] for those who stand ``gap`` [n] m ahead, -1 for none."""
        k = np.flatnonzero((standing >= 0) & (gaps[0, rows] > 0))
        rows = rows[k]
        room = gap[k] - gaps[1, rows] - LAG * self._table["speed"][rows]
        target = self._table["goal_speed"]
        stopping = np.sqrt(2.0 * STOPPING * np.maximum(room, 0.0))
        target[rows] = np.clip(stopping, TARGET_SPEEDS[0], target[rows])

    def _wanted(self, members: list[Member], rows: IntArray, node: IntArray) -> FloatArray:
        """[n] m/s on a free road."""
        factor, highest, own = (
            np.array([getattr(m, name) for m in members])
            for name in ("speed_factor", "max_speed", "target_speed")
        )
        routes = [member.route for member in members]
        now = self._table["speed"][rows].astype(np.float64)
        limit = limits_ahead(self._road, routes, node, factor, LAG * now)
        speed = np.where(own > 0, own, np.minimum(limit, highest))
        speed = np.where(self._askew(rows, node), np.minimum(speed, np.maximum(now, LEAST_ASKEW)), speed)
        truck = self._table["truck"][rows]
        return np.minimum(speed, curve_speed(self._road, routes, node, truck, LAG * now))

    def _askew(self, rows: IntArray, node: IntArray) -> BoolArray:
        """Whether vehicles point so far from their lane's direction that they must not speed up."""
        turn = self._table["yaw"][rows] - self._road.graph.node_yaw[node]
        return np.cos(turn) < np.cos(ASKEW)
