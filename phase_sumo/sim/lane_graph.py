"""The lane graph: nodes every metre along every lane, links for lane continuity and adjacency."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from phase_sumo.sim.lanes import Lane, LaneNetwork

MAX_SUCCESSORS = 4
UPSTREAM_CAP = 60.0  # m
COINCIDE = 0.5  # m: the last node of a lane stands for the first of the next one
ABREAST = 1.75  # lane widths: nodes of adjacent lanes further apart are not abreast
CURVATURE_SMOOTHING = 20  # passes of a three-node mean, a Gaussian of about 4 m


@dataclass(frozen=True)
class LaneGraph:
    """Nodes and links of one map (paper: Synthetic Scenario Generation, lane graph G).

    Attributes:
        node_xy: [V, 2] float32, m.
        node_yaw: [V] float32, driving direction in rad.
        node_curvature: [V] float32, 1/m, positive to the left.
        node_lane: [V] int32, index of the lane in the source `LaneNetwork`.
        node_position: [V] float32, SUMO lane position in m (0 at the lane's start, `length` at its end).
        node_truck: [V] bool, trucks are allowed.
        node_upstream: [V] float32, m of road behind the node along its lane chain, capped at 60.
        successor: [V, 4] int32, next nodes about 1 m ahead, -1 padded; the straightest one first.
        left, right: [V] int32, node abreast in the lane to which a change is allowed, or -1.
    """

    node_xy: np.ndarray
    node_yaw: np.ndarray
    node_curvature: np.ndarray
    node_lane: np.ndarray
    node_position: np.ndarray
    node_truck: np.ndarray
    node_upstream: np.ndarray
    successor: np.ndarray
    left: np.ndarray
    right: np.ndarray

    def arrays(self) -> dict[str, np.ndarray]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def step(self) -> np.ndarray:
        """[V, 4] distance in m to each successor, 0 where there is none."""
        delta = self.node_xy[self.successor] - self.node_xy[:, None]
        return np.where(self.successor >= 0, np.hypot(delta[..., 0], delta[..., 1]), 0.0)


@dataclass(frozen=True)
class _LaneNodes:
    """Nodes of one lane: xy [n, 2], yaw [n], share of its length [n] in 0..1, lane position [n] in m."""

    xy: np.ndarray
    yaw: np.ndarray
    share: np.ndarray
    position: np.ndarray

    def from_second(self) -> _LaneNodes:
        return _LaneNodes(self.xy[1:], self.yaw[1:], self.share[1:], self.position[1:])


def build_lane_graph(network: LaneNetwork) -> LaneGraph:
    """Nodes every metre along every lane, linked as the lanes are."""
    lanes = network.lanes
    nodes = _nodes(network)
    counts = np.array([len(n.share) for n in nodes])
    first = np.concatenate(([0], np.cumsum(counts)[:-1]))
    xy, yaw = np.concatenate([n.xy for n in nodes]), np.concatenate([n.yaw for n in nodes])
    successor = _successors(network, first, counts, xy, yaw)
    curvature = _curvature(xy, yaw, successor)
    return LaneGraph(
        node_xy=xy.astype(np.float32),
        node_yaw=yaw.astype(np.float32),
        node_curvature=curvature.astype(np.float32),
        node_lane=np.repeat(np.arange(len(lanes), dtype=np.int32), counts),
        node_position=np.concatenate([n.position for n in nodes]).astype(np.float32),
        node_truck=np.repeat(np.array([lane.allows_truck for lane in lanes]), counts),
        node_upstream=_upstream(xy, successor).astype(np.float32),
        successor=successor,
        left=_abreast(lanes, nodes, first, counts, "left"),
        right=_abreast(lanes, nodes, first, counts, "right"),
    )


def _nodes(network: LaneNetwork) -> list[_LaneNodes]:
    """Nodes of every lane; the first one is left out where every predecessor ends on it."""
    ends: dict[int, list[np.ndarray]] = {}
    for a, b in network.successors:
        ends.setdefault(b, []).append(network.lanes[a].points[-1])
    result = []
    for i, lane in enumerate(network.lanes):
        nodes = _lane_nodes(lane)
        gaps = [np.hypot(*(end - lane.points[0])) for end in ends.get(i, [])]
        if gaps and max(gaps) < COINCIDE:
            nodes = nodes.from_second()
        result.append(nodes)
    return result


def _lane_nodes(lane: Lane) -> _LaneNodes:
    """Points about 1 m apart and the line's direction there."""
    s = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(lane.points, axis=0).T))))
    wanted = np.linspace(0.0, s[-1], max(1, round(s[-1])) + 1)
    xy = np.stack([np.interp(wanted, s, lane.points[:, k]) for k in (0, 1)], axis=-1)
    tangent = np.gradient(xy, axis=0)
    share = wanted / s[-1]
    position = share * lane.length if lane.positions is None else np.interp(wanted, s, lane.positions)
    return _LaneNodes(xy, np.arctan2(tangent[:, 1], tangent[:, 0]), share, position)


def _successors(
    network: LaneNetwork, first: np.ndarray, counts: np.ndarray, xy: np.ndarray, yaw: np.ndarray
) -> np.ndarray:
    successor = np.full((len(xy), MAX_SUCCESSORS), -1, np.int32)
    inner = np.ones(len(xy), bool)
    last = first + counts - 1
    inner[last] = False
    successor[inner, 0] = np.flatnonzero(inner) + 1
    following: dict[int, list[int]] = {}
    for a, b in network.successors:
        following.setdefault(a, []).append(b)
    for a, targets in following.items():
        # a fork's straight branch comes first: the one that turns least over its own length
        turn = [abs(_wrap(yaw[last[b]] - yaw[last[a]])) for b in targets]
        ordered = [targets[k] for k in np.argsort(turn, kind="stable")][:MAX_SUCCESSORS]
        successor[last[a], : len(ordered)] = first[ordered]
    return successor


def _abreast(
    lanes: tuple[Lane, ...], nodes: list[_LaneNodes], first: np.ndarray, counts: np.ndarray, side: str
) -> np.ndarray:
    """[V] node of the lane on ``side`` at the same share of its length, -1 where none is abreast."""
    found = [np.full(count, -1, np.int32) for count in counts]
    for i, lane in enumerate(lanes):
        j = getattr(lane, side)
        if j < 0:
            continue
        mine, other = nodes[i], nodes[j]
        k = np.rint(np.interp(mine.share, other.share, np.arange(len(other.share)))).astype(int)
        distance = np.hypot(*(mine.xy - other.xy[k]).T)
        close = distance < ABREAST * 0.5 * (lane.width + lanes[j].width)
        found[i] = np.where(close, first[j] + k, -1).astype(np.int32)
    return np.concatenate(found)


def _curvature(xy: np.ndarray, yaw: np.ndarray, successor: np.ndarray) -> np.ndarray:
    """[V] heading change per metre to the next node, smoothed along the lanes."""
    ahead = successor[:, 0]
    has = ahead >= 0
    ahead = np.where(has, ahead, np.arange(len(xy)))
    behind = np.arange(len(xy))
    behind[ahead[has]] = np.flatnonzero(has)
    chord = np.maximum(np.hypot(*(xy[ahead] - xy[behind]).T), 0.5)
    curvature = np.where(ahead != behind, _wrap(yaw[ahead] - yaw[behind]) / chord, 0.0)
    for _ in range(CURVATURE_SMOOTHING):
        curvature = (curvature[ahead] + curvature + curvature[behind]) / 3.0
    return curvature


def _upstream(xy: np.ndarray, successor: np.ndarray) -> np.ndarray:
    """[V] longest way back in m, capped: what a trailer needs behind its tractor."""
    a, column = np.nonzero(successor >= 0)
    b = successor[a, column]
    step = np.hypot(*(xy[b] - xy[a]).T)
    upstream = np.zeros(len(xy))
    while True:
        longer = upstream.copy()
        np.maximum.at(longer, b, np.minimum(upstream[a] + step, UPSTREAM_CAP))
        if np.array_equal(longer, upstream):
            return upstream
        upstream = longer


def _wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi
