"""The vehicle of each world whose context is varied, and what is around it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import FloatArray
from phase_sumo.evaluate.fixed_worlds import Start
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.lane_graph import LaneGraph

GOAL_TIME = 6.0  # s of driving at the initial speed to the goal
CHANGE_SHARE = 0.5  # of the way after which the goal's path is in the other lane
FREE_BEHIND = 28.0  # m behind the rear axle without anybody: room to become a truck with a trailer
BESIDE = 2.0  # m to the side up to which another vehicle is in the same lane
ABREAST = 5.5  # m likewise in the same or the next lane
PARTNER_RANGE = 5.0, 60.0  # m ahead or behind of the one to overtake or to be overtaken by


@dataclass(frozen=True)
class Ego:
    """One vehicle and the choices that its place leaves.

    Attributes:
        world, slot: who it is.
        lane: [P, 2] centre line of its own lane from its start on, a point per metre.
        goals: x, y in m and yaw in rad by the lane they are in: 0 its own, 1 the left one, -1 the right one.
        ahead, behind: slots of the nearest vehicles to overtake and to be overtaken by, -1 where none is.
    """

    world: int
    slot: int
    lane: FloatArray
    goals: dict[int, tuple[float, float, float]]
    ahead: int
    behind: int

    def aside(self, xy: FloatArray) -> float:
        """m to the left of its own lane's centre line of a point [2]."""
        k = int(np.hypot(*(self.lane - xy).T).argmin())
        k = min(max(k, 1), len(self.lane) - 1)
        along, offset = self.lane[k] - self.lane[k - 1], xy - self.lane[k]
        return float((along[0] * offset[1] - along[1] * offset[0]) / np.hypot(*along))


def choose_egos(start: Start, maps: Sequence[MapBundle]) -> list[Ego]:
    """In every world that has one, the first car with a lane ahead, one beside it, and room behind."""
    egos = []
    for world in range(len(start.number)):
        graph = maps[int(start.map_index[world])].graph
        around = _Around(start, world)
        found = (_ego(graph, around, world, slot) for slot in around.cars)
        ego = next((e for e in found if e is not None), None)
        if ego is not None:
            egos.append(ego)
    return egos


class _Around:
    """One world's vehicles as arrays."""

    def __init__(self, start: Start, world: int) -> None:
        state, active = start.state, start.active[world].numpy()
        self.x, self.y, self.yaw, self.speed = (
            getattr(state, name)[world].numpy().astype(np.float64) for name in ("x", "y", "yaw", "speed")
        )
        self.active = active
        self.cars = np.flatnonzero(active & ~start.shape.truck[world].numpy()).tolist()

    def relative(self, slot: int) -> tuple[FloatArray, FloatArray]:
        """m ahead of and to the left of one vehicle; the others' nan where they are not there."""
        cos, sin = np.cos(self.yaw[slot]), np.sin(self.yaw[slot])
        dx, dy = self.x - self.x[slot], self.y - self.y[slot]
        same_way = self.active & (np.cos(self.yaw - self.yaw[slot]) > 0.9)
        same_way[slot] = False
        return np.where(same_way, cos * dx + sin * dy, np.nan), np.where(
            same_way, cos * dy - sin * dx, np.nan
        )


def _ego(graph: LaneGraph, around: _Around, world: int, slot: int) -> Ego | None:
    xy, yaw, speed = (around.x[slot], around.y[slot]), around.yaw[slot], around.speed[slot]
    ahead, left = around.relative(slot)
    with np.errstate(invalid="ignore"):
        if ((np.abs(left) < BESIDE) & (ahead < 0) & (ahead > -FREE_BEHIND)).any():
            return None
        near = np.abs(left) < ABREAST
        partner = [
            _nearest(np.where(near & (side * ahead > PARTNER_RANGE[0]), side * ahead, np.inf))
            for side in (1, -1)
        ]
    node = _node_at(graph, xy, yaw)
    lane = _along(graph, node, GOAL_TIME * speed)
    if lane is None:
        return None
    goals = {0: _pose(graph, lane[-1])}
    half = int(CHANGE_SHARE * len(lane))
    for side, beside in ((1, graph.left), (-1, graph.right)):
        there = int(beside[lane[half]])
        # the change must be allowed on the way, not only at one place
        if there >= 0 and (beside[lane[half // 2 : half]] >= 0).all():
            rest = _along(graph, there, GOAL_TIME * speed - half)
            if rest is not None:
                goals[side] = _pose(graph, rest[-1])
    if len(goals) < 2:
        return None
    return Ego(world, slot, graph.node_xy[lane].astype(np.float64), goals, *partner)


def _nearest(distance: FloatArray) -> int:
    slot = int(distance.argmin())
    return slot if distance[slot] < PARTNER_RANGE[1] else -1


def _node_at(graph: LaneGraph, xy: tuple[float, float], yaw: float) -> int:
    """The node nearest to a vehicle among those in its direction."""
    distance = np.hypot(*(graph.node_xy - np.array(xy)).T)
    return int(np.where(np.cos(graph.node_yaw - yaw) > 0.9, distance, np.inf).argmin())


def _along(graph: LaneGraph, node: int, metres: float) -> list[int] | None:
    """Nodes straight on from ``node``; None if the road ends before."""
    nodes, left = [node], metres
    while left > 0:
        node, step = int(graph.successor[nodes[-1], 0]), float(graph.step[nodes[-1], 0])
        if node < 0:
            return None
        nodes.append(node)
        left -= step
    return nodes


def _pose(graph: LaneGraph, node: int) -> tuple[float, float, float]:
    x, y = graph.node_xy[node].tolist()
    return x, y, float(graph.node_yaw[node])
