"""Samples of all vehicles on the observed road, in the form that the traffic measures take."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.table import SHAPE, VehicleTable
from phase_sumo.bridge.sumo.session import bare
from phase_sumo.evaluate.trajectories import SAMPLES, Trajectories

SHAPE_COLUMNS = SHAPE[:8]  # all but the truck indicator
READ = ("LaneID", "LanePosition", "LateralLanePosition", "AllowedSpeed")
KINDS = {"controlled": bool, "vehicle": np.int64, "lane": np.int64}


class Recorder:
    """Collects a frame every ``period`` s; lane and position come from SUMO for every vehicle alike."""

    def __init__(self, api: ModuleType, period: float) -> None:
        self._api = api
        self._getters = [bare(api, "vehicle", f"get{name}") for name in READ]
        self.period = period
        self._next = -np.inf
        self._frames: list[tuple[np.ndarray, ...]] = []
        self._vehicles: dict[str, int] = {}
        self._types: list[str] = []
        self._emissions: list[str] = []
        self._shapes: list[np.ndarray] = []
        self._lanes: dict[str, int] = {}

    def due(self, time: float) -> bool:
        return time >= self._next - 1e-6

    def sample(self, time: float, table: VehicleTable, types: dict[str, str]) -> None:
        """Record all active rows."""
        self._next = time + self.period
        rows = np.flatnonzero(table.active)
        if not len(rows):
            return
        lane_of, position_of, lateral_of, allowed_of = self._getters
        number, lane, position, lateral, target = [], [], [], [], []
        for row in rows.tolist():
            name = table.ids[row]
            number.append(self._number(name, table, row, types))
            lane_id = lane_of(name)
            lane.append(self._lanes.setdefault(lane_id, len(self._lanes)) if lane_id else -1)
            position.append(position_of(name))
            lateral.append(lateral_of(name))
            target.append(float(table["goal_speed"][row]) if table.controlled[row] else allowed_of(name))
        self._frames.append(
            (
                np.full(len(rows), time),
                np.array(number, np.int64),
                *(table[name][rows] + at for name, at in zip(("x", "y"), table.origin, strict=True)),
                *(table[name][rows].astype(np.float64) for name in ("yaw", "hitch", "speed", "accel")),
                np.array(lane, np.int64),
                np.array(position),
                np.array(lateral),
                table.controlled[rows].copy(),
                np.array(target),
                np.where(table.controlled[rows], table["alpha"][rows], np.nan),
            )
        )

    def _number(self, name: str, table: VehicleTable, row: int, types: dict[str, str]) -> int:
        number = self._vehicles.get(name)
        if number is None:
            number = self._vehicles[name] = len(self._vehicles)
            self._types.append(types.get(name, ""))
            self._emissions.append(self._api.vehicle.getEmissionClass(name))
            self._shapes.append(np.array([table[c][row] for c in SHAPE_COLUMNS], np.float64))
        return number

    def finish(self) -> Trajectories:
        """All samples; call it before the session closes, the lane tables are read from SUMO."""
        following = self._lane_closure()
        lane = self._api.lane
        ids = tuple(self._lanes)
        empty = tuple(np.zeros(0, KINDS.get(name, float)) for name in SAMPLES)
        columns = [np.concatenate(c) for c in zip(empty, *self._frames, strict=True)]
        samples: dict[str, Any] = dict(zip(SAMPLES, columns, strict=True))
        shape = np.array(self._shapes).reshape(-1, 8)
        front = shape[:, 0] - shape[:, 3]
        return Trajectories(
            **samples,
            vehicle_ids=tuple(self._vehicles),
            vehicle_types=tuple(self._types),
            emission_classes=tuple(self._emissions),
            shape=shape,
            length=front + np.maximum(shape[:, 3], shape[:, 4] - shape[:, 7]),
            lane_ids=ids,
            lane_edges=tuple(lane.getEdgeID(i) for i in ids),
            lane_length=np.array([lane.getLength(i) for i in ids], np.float64),
            lane_speed=np.array([lane.getMaxSpeed(i) for i in ids], np.float64),
            lane_next=tuple(tuple(self._lanes[n] for n in following[i]) for i in ids),
            period=self.period,
        )

    def _lane_closure(self) -> dict[str, list[str]]:
        """Lanes after each seen lane, through junctions; lanes met on the way join the table."""
        following: dict[str, list[str]] = {}
        waiting = list(self._lanes)
        seen_edges = {self._api.lane.getEdgeID(i) for i in waiting}
        while waiting:
            lane = waiting.pop()
            if lane in following:
                continue
            targets = []
            for link in self._api.lane.getLinks(lane):
                target = link[4] or link[0]
                inside = target.startswith(":")
                if target and (inside or self._api.lane.getEdgeID(target) in seen_edges):
                    targets.append(target)
                    self._lanes.setdefault(target, len(self._lanes))
                    waiting.append(target)
            following[lane] = targets
        return following
