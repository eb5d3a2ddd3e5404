"""The road of a map from above: surface, kerbs and lane markings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import chain

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.road_map import RoadKind, RoadMap

ASPHALT, KERB, MARKING = "#d5d9df", "#59616d", "#ffffff"
STYLES = {
    RoadKind.LANE_BOUNDARY: (MARKING, (0, (6, 5))),
    RoadKind.SOLID_BOUNDARY: (MARKING, "solid"),
    RoadKind.ROAD_EDGE: (KERB, "solid"),
}
HALF_LANE = 1.8  # m, where a lane has no border within reach


def draw_road(axes: Axes, bundle: MapBundle, yaw: float) -> None:
    """Draw the whole map, turned so that the direction ``yaw`` in rad points to the right."""
    borders = border_lines(bundle.road_map)
    lanes = lane_surfaces(bundle.graph, chain.from_iterable(borders.values()))
    surface = [turned(outline, yaw) for outline in lanes]
    axes.add_collection(PolyCollection(surface, facecolors=ASPHALT, edgecolors=ASPHALT, zorder=1))
    for kind, (colour, style) in STYLES.items():
        lines = [turned(line, yaw) for line in borders[kind]]
        axes.add_collection(
            LineCollection(lines, colors=colour, linewidths=1.3, linestyles=[style], zorder=2)
        )


def turned(points: np.ndarray, yaw: float) -> np.ndarray:
    """Points [..., 2] in axes along and to the left of a direction."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[cos, -sin], [sin, cos]])


def border_lines(road: RoadMap) -> dict[RoadKind, list[np.ndarray]]:
    """Polylines [p, 2] in m of every kind of border: segments joined where one begins at another's end."""
    segments, kinds = (values.cpu().numpy() for values in road.segments())
    lines: dict[RoadKind, list[np.ndarray]] = {}
    for kind in STYLES:
        following: dict[tuple[float, ...], list[tuple[float, ...]]] = defaultdict(list)
        for ax, ay, bx, by in segments[kinds == kind].tolist():
            following[ax, ay].append((bx, by))
        ends = {end for onward in following.values() for end in onward}
        starts = [p for p in following if p not in ends] + list(following)
        lines[kind] = []
        for start in starts:
            while following[start]:  # several lines may begin at one point
                line = [start]
                while following.get(line[-1]):
                    line.append(following[line[-1]].pop())
                lines[kind].append(np.array(line))
    return lines


def lane_surfaces(graph: LaneGraph, borders: Iterable[np.ndarray]) -> list[np.ndarray]:
    """One polygon [p, 2] in m per lane, as wide as its borders are apart."""
    xy, yaw = graph.node_xy.astype(np.float64), graph.node_yaw
    normal = np.stack((-np.sin(yaw), np.cos(yaw)), -1)
    sampled = np.concatenate([_metre_by_metre(line) for line in borders])
    node, k = pairs_within(xy, sampled, 2 * HALF_LANE)
    nearest = np.full(len(xy), np.inf)
    np.minimum.at(nearest, node, np.abs(((sampled[k] - xy[node]) * normal[node]).sum(-1)))
    surfaces = []
    for lane in np.split(np.arange(len(xy)), np.flatnonzero(np.diff(graph.node_lane)) + 1):
        found = nearest[lane][np.isfinite(nearest[lane])]
        half = np.median(found) if len(found) else HALF_LANE
        onward = graph.successor[lane[-1]]
        for end in onward[onward >= 0][:, None] if onward.max() >= 0 else [lane[-1:]]:
            nodes = np.append(lane, end)
            aside = half * normal[nodes]
            surfaces.append(np.concatenate((xy[nodes] - aside, (xy[nodes] + aside)[::-1])))
    return surfaces


def _metre_by_metre(line: np.ndarray) -> np.ndarray:
    s = np.append(0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T)))
    at = np.linspace(0.0, s[-1], round(s[-1]) + 2)
    return np.stack((np.interp(at, s, line[:, 0]), np.interp(at, s, line[:, 1])), -1)
