"""Tells SUMO where a vehicle under the policy will be after its next step."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.fleet.drivers import Member
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.bridge.sumo.conventions import angle_from_yaw
from phase_sumo.bridge.sumo.demand import mentions
from phase_sumo.bridge.sumo.session import bare

MOVE = 2  # moveToXY keepRoute: exact position, any road
MATCH = 10.0  # m within which SUMO looks for the lane
ARRIVAL_PERIOD = 0.5  # s


class PoseWriter:
    """Writes poses with moveToXY and speeds with setSpeed, so that SUMO reports both unchanged.

    SUMO's acceleration is then the change of speed over its step.

    A vehicle that is moved never arrives, and SUMO tells nobody its ``arrivalPos``. Where the demand names
    some, SUMO therefore takes one step in `ARRIVAL_PERIOD` itself on the last edge of a route, at our speed,
    and finds out.
    """

    def __init__(self, api: ModuleType, road: Road, table: VehicleTable, publish_hitch: bool = False) -> None:
        """``publish_hitch`` keeps the hitch angle in rad in each trailer's parameter ``phase.hitch``."""
        self._api, self._road, self._table = api, road, table
        self._publish_hitch = publish_hitch
        self._move = bare(api, "vehicle", "moveToXY")
        self._set_speed = bare(api, "vehicle", "setSpeed")
        files = (api.simulation.getOption(name) for name in ("route-files", "additional-files"))
        given = any(mentions(Path(file), ("arrivalPos",)) for file in ",".join(files).split(",") if file)
        self._asks = 0.0 if given else np.inf
        self._period = max(ARRIVAL_PERIOD, 2.0 * float(api.simulation.getDeltaT()))
        self._shapes: dict[str, np.ndarray] = {}
        self._ids = [lane.id if not lane.parts else lane.parts[0][0] for lane in road.network.lanes]
        self._crosses = road.levels.crossing[road.piece]

    def write(
        self, members: dict[str, Member], rows: IntArray, node: IntArray, front: FloatArray, time: float
    ) -> None:
        """Place vehicles.

        Args:
            members: by vehicle id.
            rows: [n] of the members in the table.
            node: [n] of the front bumpers, -1 off the road.
            front: [n, 2] front bumper centres in m.
        """
        speed = self._table["speed"][rows].tolist()
        angle = angle_from_yaw(self._table["yaw"][rows])
        crosses = ((node >= 0) & self._crosses[node]).tolist()
        move, set_speed, (left, below) = self._move, self._set_speed, self._table.origin.tolist()
        places = zip(members.items(), front.tolist(), angle.tolist(), speed, strict=True)
        arriving = self._arriving(list(members.values()), node, time)
        for k, ((vehicle, member), (x, y), heading, driven) in enumerate(places):
            if arriving[k]:
                set_speed(vehicle, driven)
                continue
            if time < member.off_lane_until:
                x, y = self._towards_lane((x, y), int(rows[k]), int(node[k]))
            edge, index = self._told(int(node[k])) if crosses[k] else ("", -1)
            move(vehicle, edge, index, x + left, y + below, heading, MOVE, MATCH)
            # else SUMO reports the bumper's mean speed along the lane, clamped to the limit
            set_speed(vehicle, driven)
        for row in rows[self._table["trailer_length"][rows] > 0].tolist() if self._publish_hitch else ():
            hitch = f"{self._table['hitch'][row]:.6f}"
            self._api.vehicle.setParameter(self._table.ids[row], "phase.hitch", hitch)

    def _told(self, node: int) -> tuple[str, int]:
        """Edge and index of the lane for SUMO, which might take that of another level."""
        edge, _, index = self._ids[int(self._road.graph.node_lane[node])].rpartition("_")
        return (edge, int(index)) if edge and index.isdigit() else ("", -1)

    def _arriving(self, members: list[Member], node: IntArray, time: float) -> list[bool]:
        """Which vehicles may be past their places of arrival, all of which are asked at the same times."""
        if time < self._asks - 1e-6:
            return [False] * len(members)
        self._asks = time + self._period
        lanes = self._road.network.lanes
        at = self._road.graph.node_lane[np.maximum(node, 0)].tolist()
        return [
            n >= 0 and not m.leads_off and m.edges[-1:] == (lanes[lane].edge,)
            for n, m, lane in zip(node.tolist(), members, at, strict=True)
        ]

    def _towards_lane(self, at: tuple[float, float], row: int, node: int) -> tuple[float, float]:
        """The position nearest to ``at`` that SUMO still counts as on the lane.

        Others do not see a vehicle that is on none of SUMO's lanes. That happens beside the road, but also
        where SUMO's lanes jump sideways at a junction and ours are smooth. Our own pose stays as it is.
        """
        if node < 0:
            return at
        index = int(self._road.graph.node_lane[node])
        lane = self._road.network.lanes[index]
        best = (np.inf, at, 0.0)
        # a connector without internal lanes is on none of SUMO's lanes
        names = [part for part, _ in lane.parts] or [lane.id] * (not lane.connector)
        if not names:
            return at
        for name in names:
            x, y = nearest_on_line(self._sumo_shape(name), at)
            best = min(best, (float(np.hypot(at[0] - x, at[1] - y)), (x, y), lane.width))
        distance, (x, y), width = best
        reach = 0.4 * (width + float(self._table["width"][row]))
        if distance <= reach:
            return at
        return x + (at[0] - x) * reach / distance, y + (at[1] - y) * reach / distance

    def _sumo_shape(self, lane: str) -> np.ndarray:
        if lane not in self._shapes:
            shape = np.array([p[:2] for p in self._api.lane.getShape(lane)], np.float64)
            self._shapes[lane] = shape - self._table.origin
        return self._shapes[lane]


def nearest_on_line(line: np.ndarray, at: tuple[float, float]) -> tuple[float, float]:
    """Point of a polyline [P, 2] nearest to a position."""
    a, b = line[:-1], line[1:]
    along = b - a
    share = ((at - a) * along).sum(1) / np.maximum((along * along).sum(1), 1e-12)
    points = a + np.clip(share, 0.0, 1.0)[:, None] * along
    nearest = points[np.hypot(*(points - at).T).argmin()]
    return float(nearest[0]), float(nearest[1])
