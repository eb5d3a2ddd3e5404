"""The lane graph: nodes every metre along every lane, links for lane continuity and adjacency."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.near import abeam
from phase_sumo.sim.polylines import Polylines

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

MAX_SUCCESSORS = 4
UPSTREAM_CAP = 60.0  # m
COINCIDE = 0.5  # m: the last node of a lane stands for the first of the next one
ABREAST = 1.75  # lane widths: nodes of adjacent lanes further apart are not abreast
BEYOND = 1.1  # m along the lane, likewise: beside a lane's end, or its first node where that is left out
ABREAST_ROUNDS = 4  # of sliding along the other lane
BEND = 12  # m either way, more than the longest usual segment of a lane's polyline
STEERED = 4  # m either way over which wheels follow the road


@dataclass(frozen=True)
class LaneGraph:
    """Nodes and links of one map (paper: Synthetic Scenario Generation, lane graph G).

    Attributes:
        node_xy: [V, 2] float32, m.
        node_yaw: [V] float32, driving direction in rad.
        node_lane: [V] int32, index of the lane in the source `LaneNetwork`.
        node_position: [V] float32, SUMO lane position in m (0 at the lane's start, `length` at its end).
        node_truck: [V] bool, trucks are allowed.
        node_upstream: [V] float32, m of road behind the node along its lane chain, capped at 60.
        successor: [V, 4] int32, next nodes about 1 m ahead, -1 padded; the straightest one first.
        left, right: [V] int32, node abreast in the lane to which a change is allowed, or -1.
    """

    node_xy: np.ndarray
    node_yaw: np.ndarray
    node_lane: np.ndarray
    node_position: np.ndarray
    node_truck: np.ndarray
    node_upstream: np.ndarray
    successor: np.ndarray
    left: np.ndarray
    right: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def step(self) -> np.ndarray:
        """[V, 4] distance in m to each successor, 0 where there is none."""
        node, column = np.nonzero(self.successor >= 0)
        delta = self.node_xy[self.successor[node, column]] - self.node_xy[node]
        step = np.zeros(self.successor.shape)
        step[node, column] = np.hypot(*delta.astype(np.float64).T)
        return step

    @cached_property
    def lane_end(self) -> np.ndarray:
        """[V] last node of each node's lane; the nodes of a lane are numbered in driving direction."""
        last = np.append(np.flatnonzero(np.diff(self.node_lane)), len(self.node_lane) - 1)
        return np.repeat(last, np.diff(last, prepend=-1))

    @cached_property
    def bend(self) -> np.ndarray:
        """[V] size of the curvature over `BEND` m either way, 1/m."""
        return np.abs(self.curvature(BEND))

    @cached_property
    def node_curvature(self) -> np.ndarray:
        """[V] curvature that a vehicle at each node steers along, 1/m."""
        return self.curvature(STEERED)

    def curvature(self, window: int) -> FloatArray:
        """[V] heading change per metre of road over ``window`` m either way, 1/m, positive to the left.

        Lanes are polylines, whose curvature sits in their corners; a vehicle drives the curve they stand for.
        Where the road begins or ends within the window, the rest of it counts.
        """
        ahead = self.successor[:, 0].astype(np.int64)
        behind = np.full(len(ahead), -1)
        for successor in self.successor.T[::-1]:
            behind[successor[successor >= 0]] = np.flatnonzero(successor >= 0)
        (first, before), (last, after) = _walked(behind, window), _walked(ahead, window)
        turn = _wrap((self.node_yaw[last] - self.node_yaw[first]).astype(np.float64))
        return turn / np.maximum(before + after, window)

    @cached_property
    def lane_start(self) -> np.ndarray:
        """[V] first node of each node's lane."""
        first = np.append(0, np.flatnonzero(np.diff(self.node_lane)) + 1)
        return np.repeat(first, np.diff(first, append=len(self.node_lane)))

    @cached_property
    def along(self) -> np.ndarray:
        """[V] metres along the lanes; only differences within a lane mean something."""
        return np.concatenate(([0.0], np.cumsum(self.step[:-1, 0])))

    @cached_property
    def spacing(self) -> np.ndarray:
        """[V] mean distance in m between the nodes of each node's lane, 1 for a single node."""
        pieces = self.lane_end - self.lane_start
        length = self.along[self.lane_end] - self.along[self.lane_start]
        return np.where(pieces > 0, length / np.maximum(pieces, 1), 1.0)

    def restricted(self, keep: np.ndarray) -> LaneGraph:
        """The graph of the nodes where ``keep`` [V] bool holds, in their order.

        What is left of a lane on either side of a gap are two lanes, so ``node_lane`` counts anew.
        """
        if keep.all():
            return self
        kept = np.flatnonzero(keep)
        number = np.full(len(keep) + 1, -1, np.int32)  # the last entry serves the index -1
        number[kept] = np.arange(len(kept))
        apart = (np.diff(kept) > 1) | (np.diff(self.node_lane[kept]) != 0)
        links = {name: number[getattr(self, name)[kept]] for name in ("successor", "left", "right")}
        rest = {name: array[kept] for name, array in self.arrays().items()}
        return LaneGraph(**(rest | links | {"node_lane": np.append(0, np.cumsum(apart)).astype(np.int32)}))


def build_lane_graph(network: LaneNetwork) -> LaneGraph:
    """Nodes every metre along every lane, linked as the lanes are."""
    nodes = _nodes(network)
    successor = _successors(network, nodes)
    truck = np.array([lane.allows_truck for lane in network.lanes])
    return LaneGraph(
        node_xy=nodes.xy.astype(np.float32),
        node_yaw=nodes.yaw.astype(np.float32),
        node_lane=nodes.lane.astype(np.int32),
        node_position=nodes.position.astype(np.float32),
        node_truck=truck[nodes.lane],
        node_upstream=_upstream(nodes, successor).astype(np.float32),
        successor=successor,
        left=_abreast(network, nodes, np.array([lane.left for lane in network.lanes])),
        right=_abreast(network, nodes, np.array([lane.right for lane in network.lanes])),
    )


@dataclass(frozen=True)
class _Nodes:
    """Nodes: xy [V, 2], yaw, lane position and lane [V]; first and last node of each lane [L]."""

    xy: FloatArray
    yaw: FloatArray
    position: FloatArray
    lane: IntArray
    first: IntArray
    last: IntArray


def _nodes(network: LaneNetwork) -> _Nodes:
    """Points about 1 m apart; a lane's first one is left out where every predecessor ends on it."""
    lanes = Polylines.of([lane.points for lane in network.lanes])
    samples = lanes.samples(1.0)
    xy = lanes.at(samples)
    position = lanes.at(samples, _positions(network, lanes))
    lane = np.repeat(np.arange(len(samples.counts)), samples.counts)
    last = np.cumsum(samples.counts) - 1
    first = last - samples.counts + 1
    node = np.arange(len(xy))
    tangent = xy[np.minimum(node + 1, last[lane])] - xy[np.maximum(node - 1, first[lane])]
    yaw = np.arctan2(tangent[:, 1], tangent[:, 0])

    before, after = _links(network)
    gap = np.hypot(*(xy[last[before]] - xy[first[after]]).T)
    widest = np.full(len(first), -1.0)
    np.maximum.at(widest, after, gap)
    doubled = (widest >= 0) & (widest < COINCIDE)
    keep = np.ones(len(xy), bool)
    keep[first[doubled]] = False
    counts = samples.counts - doubled
    last = np.cumsum(counts) - 1
    return _Nodes(xy[keep], yaw[keep], position[keep], lane[keep], last - counts + 1, last)


def _positions(network: LaneNetwork, lanes: Polylines) -> FloatArray:
    """[P] SUMO's lane position of each point of the centre lines."""
    share = (lanes.s - np.repeat(lanes.s[lanes.first], lanes.counts)) / np.repeat(lanes.length, lanes.counts)
    position = share * np.repeat([lane.length for lane in network.lanes], lanes.counts)
    for lane, first, count in zip(network.lanes, lanes.first, lanes.counts, strict=True):
        if lane.positions is not None:
            position[first : first + count] = lane.positions
    return position


def _links(network: LaneNetwork) -> tuple[IntArray, IntArray]:
    """Lanes before and after each link."""
    links = np.array(network.successors, np.int64).reshape(-1, 2)
    return links[:, 0], links[:, 1]


def _successors(network: LaneNetwork, nodes: _Nodes) -> NDArray[np.int32]:
    successor = np.full((len(nodes.xy), MAX_SUCCESSORS), -1, np.int32)
    successor[:-1, 0] = np.arange(1, len(nodes.xy))
    successor[nodes.last, 0] = -1
    before, after = _links(network)
    # a fork's straight branch comes first: the one that turns least over its own length
    turn = np.abs(_wrap(nodes.yaw[nodes.last[after]] - nodes.yaw[nodes.last[before]]))
    order = np.lexsort((turn, before))
    before, after = before[order], after[order]
    rank = np.arange(len(before)) - np.searchsorted(before, before)
    fits = rank < MAX_SUCCESSORS
    successor[nodes.last[before[fits]], rank[fits]] = nodes.first[after[fits]]
    return successor


def _abreast(network: LaneNetwork, nodes: _Nodes, beside: IntArray) -> NDArray[np.int32]:
    """[V] nearest node of the lane ``beside`` [L] each lane (or -1), -1 where that lane is not abreast."""
    node = np.flatnonzero(beside[nodes.lane] >= 0)
    mine, other = nodes.lane[node], beside[nodes.lane[node]]
    first, last = nodes.first[other], nodes.last[other]
    share = (node - nodes.first[mine]) / np.maximum(nodes.last[mine] - nodes.first[mine], 1)
    found = first + np.rint(share * (last - first)).astype(np.int64)
    along = np.stack((np.cos(nodes.yaw), np.sin(nodes.yaw)), -1)
    found = abeam(nodes.xy[node], found, nodes.xy, along, (first, last), 1.0, ABREAST_ROUNDS)
    (x, y), (cos, sin) = (nodes.xy[node] - nodes.xy[found]).T, along[found].T
    ahead, aside = x * cos + y * sin, y * cos - x * sin
    width = np.array([lane.width for lane in network.lanes])
    close = (np.abs(aside) < ABREAST * 0.5 * (width[mine] + width[other])) & (np.abs(ahead) <= BEYOND)
    result = np.full(len(nodes.xy), -1, np.int32)
    result[node[close]] = found[close]
    return result


def _walked(following: IntArray, steps: int) -> tuple[IntArray, IntArray]:
    """[V] where ``steps`` steps lead from every node, or the road's end before, and how many they are."""
    at, count = np.arange(len(following)), np.zeros(len(following), np.int64)
    for _ in range(steps):
        onward = following[at] >= 0
        at, count = np.where(onward, following[at], at), count + onward
    return at, count


def _upstream(nodes: _Nodes, successor: NDArray[np.int32]) -> FloatArray:
    """[V] longest way back in m, capped: what a trailer needs behind its tractor."""
    step = np.hypot(*np.diff(nodes.xy, axis=0, prepend=nodes.xy[:1]).T)
    along = np.cumsum(step)
    along -= along[nodes.first][nodes.lane]
    lane, column = np.nonzero(successor[nodes.last] >= 0)
    head = successor[nodes.last[lane], column]
    after, link = nodes.lane[head], np.hypot(*(nodes.xy[head] - nodes.xy[nodes.last[lane]]).T)
    at_start = np.zeros(len(nodes.first))
    while True:
        longer = at_start.copy()
        np.maximum.at(
            longer, after, np.minimum(at_start[lane] + along[nodes.last[lane]] + link, UPSTREAM_CAP)
        )
        if np.array_equal(longer, at_start):
            return np.minimum(at_start[nodes.lane] + along, UPSTREAM_CAP)
        at_start = longer


def _wrap(angle: FloatArray) -> FloatArray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
