"""Dimensions of a freeway network as it is converted, so that all networks are measured alike.

Main lanes belong to edges of the class motorway or trunk, ramp lanes to their ``_link`` classes. Main lanes
that run side by side towards the same end are one carriageway.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.bridge.maps.net_xml import parse_net
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork

CHORD = 30  # m: curvature is the angle between the chords of 30 m before and after a point
SHORTEST_RAMP = 30.0  # m: a shorter piece of ramp only says where the map was cut


@dataclass(frozen=True)
class Sample:
    """Values [n] with weights [n]."""

    value: NDArray[np.float64]
    weight: NDArray[np.float64]

    @staticmethod
    def of(rows: Iterable[tuple[float, float]]) -> Sample:
        table = np.array(list(rows), float).reshape(-1, 2)
        return Sample(table[:, 0], table[:, 1])

    @staticmethod
    def joined(samples: Iterable[Sample]) -> Sample:
        parts = list(samples)
        return Sample(np.concatenate([s.value for s in parts]), np.concatenate([s.weight for s in parts]))

    def quantile(self, share: float) -> float:
        order = np.argsort(self.value, kind="stable")
        reached = np.cumsum(self.weight[order])
        return float(self.value[order][np.searchsorted(reached, share * reached[-1])])

    def distance(self, other: Sample) -> float:
        """Wasserstein distance: the area between the two distribution functions, in the values' unit."""
        at = np.sort(np.concatenate((self.value, other.value)))
        between = np.abs(self._below(at[:-1]) - other._below(at[:-1]))
        return float((between * np.diff(at)).sum())

    def _below(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Share of the weight at values up to ``at``."""
        order = np.argsort(self.value, kind="stable")
        reached = np.concatenate(([0.0], np.cumsum(self.weight[order])))
        return reached[np.searchsorted(self.value[order], at, side="right")] / reached[-1]


@dataclass(frozen=True)
class Measures:
    """What is compared.

    Attributes:
        curvature: |1/radius| of main lanes in 1/km, per metre of lane.
        ramp_curvature: the same of ramps.
        lane_count: lanes of a carriageway, per metre of road.
        lane_width: m, per metre of main lane.
        ramp_length: m within the network, one value per ramp.
        auxiliary_length: m of lanes that begin or end at a ramp and lie within the network, one per lane:
            acceleration, deceleration and weaving lanes.
    """

    curvature: Sample
    ramp_curvature: Sample
    lane_count: Sample
    lane_width: Sample
    ramp_length: Sample
    auxiliary_length: Sample

    @staticmethod
    def joined(parts: Iterable[Measures]) -> Measures:
        rows = list(parts)
        return Measures(*(Sample.joined(getattr(m, f.name) for m in rows) for f in fields(Measures)))


def measure(path: Path) -> Measures:
    """All dimensions of one network."""
    network = read_network(path)
    graph = build_lane_graph(network)
    kinds = {lane.edge: lane.kind for lane in parse_net(path).lanes.values()}
    ramp = np.array(["_link" in kinds.get(lane.edge, "") for lane in network.lanes])
    main = np.array([not lane.connector for lane in network.lanes]) & ~ramp
    ramp &= np.array([not lane.connector for lane in network.lanes])
    curvature = _curvature(graph)
    return Measures(
        curvature=_per_node(curvature, main[graph.node_lane]),
        ramp_curvature=_per_node(curvature, ramp[graph.node_lane]),
        lane_count=_lane_count(network, main),
        lane_width=Sample.of((lane.width, lane.length) for lane in _of(network, main)),
        ramp_length=_ramp_length(network, ramp),
        auxiliary_length=_auxiliary_length(network, main, ramp),
    )


def _of(network: LaneNetwork, chosen: NDArray[np.bool_]):
    return (lane for lane, take in zip(network.lanes, chosen, strict=True) if take)


def _per_node(values: NDArray[np.float64], chosen: NDArray[np.bool_]) -> Sample:
    found = values[chosen & np.isfinite(values)]
    return Sample(found, np.ones(len(found)))


def _curvature(graph: LaneGraph) -> NDArray[np.float64]:
    """[V] 1/km, nan within `CHORD` of the map's border: long chords see the road, not its polyline."""
    ahead = graph.successor[:, 0].astype(int)
    has = np.flatnonzero(ahead >= 0)
    behind = np.full(len(ahead), -1)
    behind[ahead[has][::-1]] = has[::-1]
    before = after = np.arange(len(ahead))
    for _ in range(CHORD):
        after = np.where(after >= 0, ahead[after], -1)
        before = np.where(before >= 0, behind[before], -1)
    xy = graph.node_xy.astype(float)
    first, second = xy - xy[before], xy[after] - xy
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    turn = np.arctan2(cross, (first * second).sum(1))
    length = 0.5 * (np.hypot(*first.T) + np.hypot(*second.T))
    return np.where((before >= 0) & (after >= 0), 1000.0 * np.abs(turn) / np.maximum(length, 1.0), np.nan)


def _lane_count(network: LaneNetwork, main: NDArray[np.bool_]) -> Sample:
    edges: dict[str, list[float]] = {}
    for lane in _of(network, main):
        edges.setdefault(lane.edge, []).append(lane.length)
    return Sample.of((len(lengths), lengths[0]) for lengths in edges.values())


def _onward(network: LaneNetwork) -> list[list[int]]:
    """Per lane the lanes it leads to, connectors skipped."""
    following: list[list[int]] = [[] for _ in network.lanes]
    for a, b in network.successors:
        following[a].append(b)
    return [
        [c for b in targets for c in (following[b] if network.lanes[b].connector else [b])]
        for targets in following
    ]


def _ramp_length(network: LaneNetwork, ramp: NDArray[np.bool_]) -> Sample:
    """The longest way along ramp lanes from every place where a ramp begins."""
    onward = _onward(network)
    follows = {b for a in np.flatnonzero(ramp) for b in onward[a]}

    def longest(lane: int, seen: frozenset[int]) -> float:
        ahead = [longest(b, seen | {b}) for b in onward[lane] if ramp[b] and b not in seen]
        return network.lanes[lane].length + max(ahead, default=0.0)

    begins: dict[str, float] = {}
    for lane in np.flatnonzero(ramp):
        if lane not in follows:
            edge = network.lanes[lane].edge
            begins[edge] = max(begins.get(edge, 0.0), longest(int(lane), frozenset({int(lane)})))
    return Sample.of((length, 1.0) for length in begins.values() if length >= SHORTEST_RAMP)


def _auxiliary_length(network: LaneNetwork, main: NDArray[np.bool_], ramp: NDArray[np.bool_]) -> Sample:
    onward = _onward(network)
    backward: list[list[int]] = [[] for _ in network.lanes]
    for a, targets in enumerate(onward):
        for b in targets:
            backward[b].append(a)

    def through(lanes: list[int]) -> int | None:
        """The main lane that goes straight on: the innermost, as lanes are added and end outside."""
        found = [i for i in lanes if main[i]]
        return max(found, key=lambda i: network.lanes[i].id.rsplit("_", 1)[1].zfill(3), default=None)

    ahead = {i: through(onward[i]) for i in np.flatnonzero(main).tolist()}
    ahead = {a: b for a, b in ahead.items() if b is not None and through(backward[b]) == a}
    firsts = [i for i in np.flatnonzero(main).tolist() if i not in set(ahead.values())]
    rows = []
    for first in firsts:
        chain = [first]
        while (following := ahead.get(chain[-1])) is not None:
            chain.append(following)
        begins, ends = backward[first], onward[chain[-1]]
        from_ramp, to_ramp = bool(ramp[begins].any()), bool(ramp[ends].any())
        begins_within = bool(begins) or network.lanes[first].dead_start
        ends_within = bool(ends) or network.lanes[chain[-1]].dead_end
        if (from_ramp or to_ramp) and begins_within and ends_within:
            rows.append((sum(network.lanes[i].length for i in chain), 1.0))
    return Sample.of(rows)
