"""What lanes allow a class of vehicles at present: driving in them, changing between them, and how fast.

Rerouters that close lanes, variable speed signs and the user's own calls change that while SUMO runs, so the
lanes are asked from time to time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.class_rules import ClassRules
from phase_sumo.bridge.fleet.parameters import TARGET_SPEEDS
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.sumo.session import bare

PERIOD = 1.0  # s between two looks
HOPS = 8  # lanes ahead, ways across junctions counted, on which lower limits are looked for
SLOW = 2.0 * TARGET_SPEEDS[0]  # m/s, limit that a low speed factor may bring below the policy's least
SUMO_LEFT = {False: (1, -1), True: (-1, 1)}  # SUMO's directions to the left and right; it counts lanes


class LaneRules:
    """The present rules of every lane, read from SUMO."""

    def __init__(
        self, api: Any, road: Road, restrictions: Mapping[str, Mapping[str, float]] | None = None
    ) -> None:
        """``restrictions``: edge -> vehicle class -> m/s, beside those that the network holds."""
        self._road = road
        lanes = road.network.lanes
        more = restrictions or {}
        self._class_limits = [{**dict(lane.class_limits), **more.get(lane.edge, {})} for lane in lanes]
        self._limit = bare(api, "lane", "getMaxSpeed")
        self._closed = bare(api, "lane", "getDisallowed")
        self._changes = bare(api, "lane", "getChangePermissions")
        self._lanes = [(i, lane.id) for i, lane in enumerate(lanes) if not lane.connector]
        self._ways = SUMO_LEFT[road.network.left_hand]
        self._written = np.array([lane.speed_limit for lane in lanes], np.float64)
        self._now = self._written.copy()
        self._disallowed: list[tuple[str, ...]] = [()] * len(lanes)
        self._may_change: list[tuple[tuple[str, ...], ...]] = [((), ())] * len(lanes)
        self._source = np.array(
            [(road.preceding[i] or [i])[0] if c.connector else i for i, c in enumerate(lanes)]
        )
        self._target = np.array(
            [(road.following[i] or [i])[0] if c.connector else i for i, c in enumerate(lanes)]
        )
        self._links = np.array(road.network.successors, np.int64).reshape(-1, 2)
        self._classes: dict[str, ClassRules] = {}
        self._next = -np.inf
        for i, lane in enumerate(lanes):
            if lane.parts:
                self._disallowed[i] = self._closed(lane.parts[0][0])
        self._read(self._lanes)
        self._read_changes([i for i, _ in self._lanes])

    def of(self, vehicle_class: str) -> ClassRules:
        """The rules of a class; the arrays stay the same and are kept current."""
        if vehicle_class not in self._classes:
            self._classes[vehicle_class] = ClassRules.of_size(len(self._now))
            self._fill(vehicle_class)
        return self._classes[vehicle_class]

    def update(self, time: float, edges: Collection[str]) -> set[str]:
        """Read them again from time to time.

        Args:
            edges: where permissions to change lanes matter now, which take long to ask for.

        Returns:
            edges on which permissions changed.
        """
        if time < self._next - 1e-6:
            return set()
        self._next = time + PERIOD
        faster = self._now.copy()
        changed = self._read(self._lanes)
        changed |= self._read_changes([i for i, lane in self._lanes_of(edges)])
        if changed or not np.array_equal(faster, self._now):
            for vehicle_class in self._classes:
                self._fill(vehicle_class)
        return {self._road.network.lanes[i].edge for i in changed}

    def _lanes_of(self, edges: Collection[str]) -> list[tuple[int, str]]:
        lanes = self._road.network.lanes
        return [(i, name) for i, name in self._lanes if lanes[i].edge in edges]

    def _read(self, lanes: list[tuple[int, str]]) -> set[int]:
        changed = set()
        for i, name in lanes:
            self._now[i] = self._limit(name)
            closed = self._closed(name)
            if closed != self._disallowed[i]:
                self._disallowed[i] = closed
                changed.add(i)
        return changed

    def _read_changes(self, lanes: list[int]) -> set[int]:
        changed, names = set(), self._road.network.lanes
        for i in lanes:
            may = tuple(
                tuple(self._changes(names[i].id, way)) if self._road.abreast[k, i] >= 0 else ()
                for k, way in enumerate(self._ways)
            )
            if may != self._may_change[i]:
                self._may_change[i] = may
                changed.add(i)
        return changed

    def _fill(self, vehicle_class: str) -> None:
        """The arrays of a class from what was read; a connector allows what both its ends allow."""
        rules, abreast = self._classes[vehicle_class], self._road.abreast
        open_lanes = np.array([vehicle_class not in closed for closed in self._disallowed])
        rules.allowed[:] = open_lanes & open_lanes[self._source] & open_lanes[self._target]
        for k, flags in enumerate((rules.left, rules.right)):
            may = np.array([vehicle_class in ways[k] for ways in self._may_change])
            flags[:] = may[self._source] & (abreast[k] >= 0)
        own = np.array([limits.get(vehicle_class, np.inf) for limits in self._class_limits])
        restricted = np.isfinite(own)
        changed = np.abs(self._now - self._written) > 1e-3
        rules.limit[:] = np.where(restricted, own, self._now)
        rules.cap[:] = np.where(restricted & changed, self._now, np.inf)
        rules.least[:] = np.minimum(rules.limit, rules.cap)
        rules.barred[:] = ~rules.allowed | (rules.least < SLOW)
        before, after = self._links.T
        for _ in range(HOPS):
            np.minimum.at(rules.least, before, rules.least[after])
            np.logical_or.at(rules.barred, before, rules.barred[after])
