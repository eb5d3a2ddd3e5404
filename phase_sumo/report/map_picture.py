"""Roads of maps from above: surface, kerbs and lane markings, and a whole map with its links."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import chain, pairwise
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

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


matplotlib.use("Agg")
COLOURS = {
    RoadKind.ROAD_EDGE: "#d62728",
    RoadKind.LANE_BOUNDARY: "#9fd3f2",
    RoadKind.SOLID_BOUNDARY: "#3f9bd1",
}
WIDTH = 16.0  # inches
HEIGHTS = 1.2, 16.0  # inches, of one panel
LABELS = 0.6  # inches of height for ticks and labels of a panel
LEFT, RIGHT, BELOW, ABOVE = 0.7, 0.2, 0.5, 0.35  # inches around the panels
TALLEST = 32.0  # inches, of the picture
MARGIN = 15.0  # m around the lanes
PANEL = 600.0  # m of road per panel: a lane is then about ten pixels wide
MOST_PANELS = 8
FLAT = 0.5  # a long map is cut into panels where it is at most this high for its width
View = tuple[float, float, float, float]  # x0, x1, y0, y1 in m


def draw_map(
    bundle: MapBundle,
    path: str | Path,
    pairs: int = 60,
    regime: int = 1,
    view: View | None = None,
    seed: int = 0,
) -> None:
    """Write a PNG: road edges red, lane boundaries light blue, centres gray, starts red, goals green.

    A map longer than `PANEL` gets a panel per stretch below the overview, or lanes could not be told apart.

    Args:
        bundle: the map.
        path: file to write.
        pairs: start-goal pairs shown per stretch, joined by blue lines.
        regime: pool to take them from.
        view: x0, x1, y0, y1 in m to zoom on; the whole map by default.
        seed: of the choice of pairs.
    """
    views = [view] if view is not None else _views(bundle.graph.node_xy)
    size, heights = _sizes(views)
    figure = Figure(size, dpi=110)
    panels = np.atleast_1d(figure.subplots(len(views), 1, height_ratios=heights))
    # fixed margins: letting matplotlib find them draws everything twice
    figure.subplots_adjust(
        LEFT / size[0],
        BELOW / size[1],
        1 - RIGHT / size[0],
        1 - ABOVE / size[1],
        hspace=LABELS / float(np.mean(heights)),
    )
    links = _links(bundle, pairs * max(1, len(views) - 1), regime, seed)
    for i, (axes, (x0, x1, y0, y1)) in enumerate(zip(panels, views, strict=True)):
        _draw_road(axes, bundle)
        if i > 0 or len(views) == 1:  # the overview of a long map would only show a band of dots
            _draw_links(axes, links)
        axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", ylabel="y in m")
    panels[0].set_title(bundle.name)
    panels[-1].set_xlabel("x in m")
    _save(figure, Path(path))


def _save(figure: Figure, path: Path) -> None:
    """The file appears complete or not at all."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": 2})
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _views(xy: np.ndarray) -> list[View]:
    """The whole map, followed by stretches of a long and flat one."""
    x0, y0 = (float(v) for v in xy.min(0) - MARGIN)
    x1, y1 = (float(v) for v in xy.max(0) + MARGIN)
    views = [(x0, x1, y0, y1)]
    count = int(np.ceil((x1 - x0) / PANEL))
    if count > 1 and y1 - y0 <= FLAT * (x1 - x0) and count <= MOST_PANELS:
        borders = np.linspace(x0, x1, count + 1)
        for left, right in pairwise(borders):
            inside = xy[(xy[:, 0] >= left) & (xy[:, 0] <= right), 1]
            if len(inside):
                low, high = float(inside.min()) - MARGIN, float(inside.max()) + MARGIN
                views.append((float(left), float(right), low, high))
    return views


def _sizes(views: list[View]) -> tuple[tuple[float, float], list[float]]:
    """Width and height of the picture and height of each panel, in inches: as much as its road needs."""
    shapes = [(y1 - y0) / (x1 - x0) for x0, x1, y0, y1 in views]
    width = WIDTH if len(views) > 1 else float(np.clip(HEIGHTS[1] / shapes[0], 0.3 * WIDTH, WIDTH))
    heights = [float(np.clip(width * shape, *HEIGHTS)) + LABELS for shape in shapes]
    shrink = min(1.0, TALLEST / sum(heights))
    return (width * shrink, sum(heights) * shrink), heights


def _draw_road(axes: Axes, bundle: MapBundle) -> None:
    road = bundle.road_map
    centre = bundle.graph.node_xy[::4]
    axes.plot(centre[:, 0], centre[:, 1], ".", color="#8c8c8c", markersize=2.0)
    border, kinds = (values.numpy() for values in road.segments())
    segments = border.reshape(-1, 2, 2)
    for kind, colour in COLOURS.items():
        axes.add_collection(LineCollection(list(segments[kinds == kind]), colors=colour, linewidths=1.2))


def _links(bundle: MapBundle, count: int, regime: int, seed: int) -> np.ndarray:
    """[n, 2, 2] start and goal of randomly chosen pairs, in m."""
    pool = bundle.pools[regime]
    chosen = np.random.default_rng(seed).permutation(len(pool.start))[:count]
    xy = bundle.graph.node_xy
    return np.stack((xy[pool.start[chosen]], xy[pool.goal[chosen]]), axis=1)


def _draw_links(axes: Axes, links: np.ndarray) -> None:
    axes.add_collection(LineCollection(list(links), colors="#1f4ed8", linewidths=0.5, alpha=0.6))
    for end, colour in ((0, "#d62728"), (1, "#2ca02c")):
        axes.plot(links[:, end, 0], links[:, end, 1], ".", color=colour, markersize=5)
