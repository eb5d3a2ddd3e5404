"""Who must wait where roads meet, and where the way ahead is not the policy's to drive.

The policy drives on at freeway speeds and was never told to stand. It passes signals that show green and
junctions where it has the right of way. Before anything that may ask for a stop SUMO takes over while there
is still room to brake gently, obeys its own rules, and the policy takes the vehicle back behind. That is so

* before a signal that is not green, and before stop signs and all-way stops;
* where it must give way and somebody is coming whose time at the crossing overlaps with its own, or is there
  already, signs or not;
* before lanes that are closed to it, and lanes where it may not drive as fast as the policy can drive slowly.

Vehicles that merge by a zipper find their order in `merging`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from phase_sumo.arrays import BoolArray
from phase_sumo.bridge.fleet.parameters import TARGET_SPEEDS
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route_views import RouteLanes
from phase_sumo.bridge.sumo.session import bare

STOP_BRAKING, MERGE_BRAKING = 2.5, 3.5  # m/s^2 that the room left to SUMO allows
REACTION, MARGIN = 0.5, 5.0  # s of driving and m more
REACH = 400.0  # m, farther away nothing matters
QUEUE = 60.0  # m before signals and signs in which nobody who stands is taken over
STANDS = 8.0  # m/s, slower vehicles there may be part of one
QUEUE_TIME, QUEUE_ROOM = 4.0, 35.0  # s of driving, at least m, to the tail of one
GO, GIVE_WAY, STOP = "GMOZ", "gmo=", "ryYusw"  # SUMO's states of links, see its documentation of signals
CROSSING_TIME = 1.0  # s between two who cross
MERGING_TIME, EASE = 1.0, 2.0  # s between two who merge, and m/s^2 for the difference in their speeds
CRAWL = 2.0  # m/s at least, of others who may set off


@dataclass(frozen=True)
class Link:
    """A way across a junction.

    Attributes:
        state: SUMO's letter for the rule, where no signal says it.
        signal, index: that controls it, "" for none.
        inside: first lane within the junction, "" in networks without these.
        crosses: other ways lead across it, not only into the same road.
    """

    state: str
    signal: str
    index: int
    inside: str
    crosses: bool


class Foe(NamedTuple):
    """Somebody whose way crosses one's own, as SUMO tells it; m to where the ways meet and part."""

    vehicle: str
    own_way: float
    way: float
    own_exit: float
    exit: float
    own_lane: str
    lane: str
    goes_first: bool
    lets_pass: bool


@dataclass(frozen=True)
class Bar:
    """What a vehicle must not drive into.

    Attributes:
        metres: to it.
        reason: in words.
        edges: on which the vehicle waits for it.
    """

    metres: float
    reason: str
    edges: frozenset[str]


class RightOfWay:
    """Looks ahead along routes.

    Attributes:
        yields: [L] whether vehicles from that lane (a way across a junction, where lanes have one) must give
            way at present where it ends.
    """

    def __init__(self, api: Any, road: Road) -> None:
        self._api, self._road = api, road
        self._signal_state = bare(api, "trafficlight", "getRedYellowGreenState")
        self._shown: dict[str, str] = {}
        lanes = road.network.lanes
        place = {lane.id: i for i, lane in enumerate(lanes)}
        controlled = self._controlled(place)
        self._links: dict[tuple[int, int], Link] = {}
        self._exits: dict[int, list[Link]] = {}  # to roads that are not observed
        self._inside: dict[str, int] = {}  # lane within a junction -> lane behind it
        for i, lane in enumerate(lanes):
            if lane.connector:
                self._inside |= {part: road.following[i][0] for part, _ in lane.parts}
                continue
            for target, _, _, _, inside, state, *_ in api.lane.getLinks(lane.id):
                signal, index = controlled.get((lane.id, target), ("", -1))
                link = Link(state, signal, index, inside, self._crosses(inside, target))
                if target in place:
                    self._links[i, place[target]] = link
                else:
                    self._exits.setdefault(i, []).append(link)
        self._entry = {j: self._links[i, k] for i, j, k in self._ways() if (i, k) in self._links}
        self.yields = np.zeros(len(lanes), bool)
        self._signalled = [(j, link) for j, link in self._entry.items() if link.signal]
        for j, link in self._entry.items():
            self.yields[j] = not link.signal and link.state in GIVE_WAY + STOP
        self._ruled = self._upstream()

    def update(self) -> None:
        """After SUMO's step: signals may have changed."""
        self._shown.clear()
        for j, link in self._signalled:
            self.yields[j] = self._state(link) in GIVE_WAY

    def bar(
        self,
        vehicle: str,
        route: RouteLanes,
        leads_off: bool,
        node: int,
        speed: float,
        factor: float,
        queue: float = np.inf,
        ease: float = 1.0,
    ) -> Bar | None:
        """What SUMO must take over for now, None for nothing.

        Args:
            leads_off: the route goes on behind the observed road.
            node: of the front bumper.
            speed: m/s.
            factor: on speed limits.
            queue: m to one who waits ahead, inf for none.
            ease: on the room that SUMO gets to brake.
        """
        lane = int(self._road.graph.node_lane[node])
        if self._too_slow(route, lane, factor):
            return Bar(0.0, "the speed limit is too low", frozenset())
        if not (self._ruled[lane] or route.rules.barred[lane]):
            return None
        gentle = ease * (speed * speed / (2.0 * STOP_BRAKING) + REACTION * speed + MARGIN)
        firm = ease * (speed * speed / (2.0 * MERGE_BRAKING) + REACTION * speed + MARGIN)
        room = max(gentle, QUEUE_TIME * speed, QUEUE_ROOM)
        part = ease > 1.0 and speed < STANDS  # of a queue, perhaps
        edges: set[str] = set()
        for metres, before, after, link in self._ahead(route, leads_off, node):
            edges.add(self._road.network.lanes[before].edge)
            if link and _may_wait(link) and (queue < min(room, metres) or (part and metres < QUEUE)):
                return Bar(queue, "a queue", frozenset(edges))
            if metres > gentle:
                if queue < room or (part and metres < QUEUE):
                    continue  # as far as the place that they may be waiting for
                return None
            reason = self._reason(vehicle, link, metres, firm, speed) if link else ""
            if not reason and (after < 0 or not route.rules.allowed[after]):
                return Bar(metres, "the lane is closed", frozenset()) if metres < firm else None
            if not reason and self._too_slow(route, after, factor):
                reason = "the speed limit is too low"
            if reason:
                return Bar(metres, reason, frozenset(edges))
        return None

    def _reason(self, vehicle: str, link: Link, metres: float, firm: float, speed: float) -> str:
        """Why a vehicle must not pass a link as it drives, "" if it may."""
        state = self._state(link)
        if state in STOP:
            return "a red signal" if link.signal else "a stop sign"
        if state in GIVE_WAY:
            if link.crosses or metres < firm:
                meets = self._meets(vehicle, link, metres, speed, yields=True)
                return "others have the right of way" if meets else ""
        elif link.crosses and self._meets(vehicle, link, metres, speed, yields=False):
            return "the crossing is not free"
        return ""

    def _meets(self, vehicle: str, link: Link, metres: float, speed: float, yields: bool) -> bool:
        """Whether somebody is on the junction at its time or, if it yields, comes with the right of way."""
        if not link.inside:
            return yields
        own, pace = float(self._api.vehicle.getLength(vehicle)), max(speed, CRAWL)
        for foe in map(Foe._make, self._api.vehicle.getJunctionFoes(vehicle, metres + MARGIN)):
            if not ((yields and foe.goes_first) or (foe.way <= 0.0 and link.crosses)):
                continue
            theirs = max(float(self._api.vehicle.getSpeed(foe.vehicle)), CRAWL)
            length = float(self._api.vehicle.getLength(foe.vehicle))
            mine_in, foe_in = max(foe.own_way, 0.0) / pace, max(foe.way, 0.0) / theirs
            target, other = self._inside.get(foe.own_lane, -1), self._inside.get(foe.lane, -2)
            if target != other and self._edge(target) == self._edge(other) != "":
                continue  # into the lane beside
            if target == other:
                first, second = (own, pace), (length, theirs)
                if foe_in < mine_in:
                    first, second = second, first
                closing = max(second[1] - first[1], 0.0)
                if abs(mine_in - foe_in) < MERGING_TIME + first[0] / first[1] + closing / EASE:
                    return True
            else:
                mine_out = (foe.own_exit + own) / pace
                foe_out = (foe.exit + length) / theirs
                if foe_in < mine_out + CROSSING_TIME and mine_in < foe_out + CROSSING_TIME and foe_out > 0:
                    return True
        return False

    def _ahead(
        self, route: RouteLanes, leads_off: bool, node: int
    ) -> Iterator[tuple[float, int, int, Link | None]]:
        """Links along a route: m to them, the lane before, the lane behind it.

        That is -1 for the last link, behind which no lane is the route's: one at which vehicles wait, or None
        where all is closed.
        """
        road = self._road
        lane = int(road.graph.node_lane[node])
        metres = float(road.count[lane] - 1 - road.offset(node))
        while metres < REACH:
            after = int(route.onward[lane])
            if road.network.lanes[lane].connector:
                link = None
            elif after >= 0:
                link = self._link(lane, after)
            else:
                if leads_off or route.changes[lane] > 0:
                    yield from self._last(route, lane, metres)
                return
            if after < 0:
                return
            yield metres, lane, after, link
            metres += float(road.count[after])
            lane = after

    def _last(
        self, route: RouteLanes, lane: int, metres: float
    ) -> Iterator[tuple[float, int, int, Link | None]]:
        """The end of a lane that leads nowhere on the route's observed part."""
        observed = self._road.following[lane]
        ways = [self._link(lane, j) for j in observed] + self._exits.get(lane, [])
        waits = [way for way in ways if way and self._state(way) not in GO]
        closed = bool(observed) and not self._exits.get(lane) and not route.rules.allowed[observed].any()
        if closed or not route.rules.allowed[lane]:
            yield metres, lane, -1, None
        elif waits and len(waits) == len(ways):
            yield metres, lane, -1, waits[0]

    def _link(self, lane: int, after: int) -> Link | None:
        return self._entry.get(after) if (lane, after) not in self._links else self._links[lane, after]

    def _too_slow(self, route: RouteLanes, lane: int, factor: float) -> bool:
        rules = route.rules
        return bool(min(factor * rules.limit[lane], rules.cap[lane]) < TARGET_SPEEDS[0])

    def _state(self, link: Link) -> str:
        if not link.signal:
            return link.state
        if link.signal not in self._shown:
            self._shown[link.signal] = self._signal_state(link.signal)
        return self._shown[link.signal][link.index]

    def _controlled(self, place: dict[str, int]) -> dict[tuple[str, str], tuple[str, int]]:
        """(lane, lane behind) -> signal and index of its links from observed lanes."""
        found, lights = {}, self._api.trafficlight
        for signal in lights.getIDList():
            for index, links in enumerate(lights.getControlledLinks(signal)):
                found |= {(a, b): (signal, index) for a, b, _ in links if a in place}
        return found

    def _crosses(self, inside: str, target: str) -> bool:
        """Whether ways to other roads conflict with one."""
        if not inside:
            return False
        foes = self._api.lane.getInternalFoes(inside)
        links = [link for foe in foes for link in self._api.lane.getLinks(foe)]
        return any(link[0].rpartition("_")[0] != target.rpartition("_")[0] for link in links)

    def _edge(self, lane: int) -> str:
        return self._road.network.lanes[lane].edge if lane >= 0 else ""

    def _ways(self) -> Iterator[tuple[int, int, int]]:
        """Lane, the lane entered from it, and the next lane outside junctions, which may be the same."""
        road = self._road
        for i, j in road.network.successors:
            if road.network.lanes[j].connector:
                yield i, j, road.following[j][0]
            elif not road.network.lanes[i].connector:
                yield i, i, j

    def _upstream(self) -> BoolArray:
        """[L] lanes from which a link that may ask for a stop is less than `REACH` away."""
        road = self._road
        nearest = np.full(len(road.count), np.inf)
        starts = [i for (i, _), link in self._links.items() if _may_stop(link)]
        starts += [i for i, links in self._exits.items() if any(map(_may_stop, links))]
        waiting = [(i, 0.0) for i in starts]
        while waiting:
            i, metres = waiting.pop()
            if metres < min(REACH, nearest[i]):
                nearest[i] = metres
                waiting += [(j, metres + float(road.metres[i])) for j in road.preceding[i]]
        return nearest < REACH


def _may_wait(link: Link) -> bool:
    return bool(link.signal) or link.state in GIVE_WAY + STOP


def _may_stop(link: Link) -> bool:
    return link.crosses or _may_wait(link)
