"""A picture of a converted map in the paper's colours."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from phase_sumo.sim.bundle import MapBundle
from phase_sumo.sim.road_map import RoadKind

matplotlib.use("Agg")
COLOURS = {
    RoadKind.ROAD_EDGE: "#d62728",
    RoadKind.LANE_BOUNDARY: "#9fd3f2",
    RoadKind.SOLID_BOUNDARY: "#3f9bd1",
}


def draw_map(
    bundle: MapBundle,
    path: str | Path,
    pairs: int = 60,
    regime: int = 1,
    view: tuple[float, float, float, float] | None = None,
    seed: int = 0,
) -> None:
    """Write a PNG: road edges red, lane boundaries light blue, centres gray, starts red, goals green.

    Args:
        bundle: the map.
        path: file to write.
        pairs: start-goal pairs shown, joined by blue lines.
        regime: pool to take them from.
        view: x0, x1, y0, y1 in m to zoom on; the whole map by default.
        seed: of the choice of pairs.
    """
    low, high = bundle.graph.node_xy.min(0) - 15.0, bundle.graph.node_xy.max(0) + 15.0
    x0, x1, y0, y1 = view if view is not None else (low[0], high[0], low[1], high[1])
    scale = 16.0 / max(x1 - x0, y1 - y0)
    figure = Figure(figsize=(max(4.0, scale * (x1 - x0)), max(4.0, scale * (y1 - y0))), dpi=110)
    axes = figure.add_axes((0.05, 0.05, 0.93, 0.9))
    _draw_road(axes, bundle)
    _draw_pairs(axes, bundle, pairs, regime, seed)
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", title=bundle.name, xlabel="x in m", ylabel="y in m")
    figure.savefig(path)


def _draw_road(axes, bundle: MapBundle) -> None:
    road = bundle.road_map
    centre = road.point_xy[road.point_kind == RoadKind.LANE_CENTRE].numpy()
    axes.plot(centre[:, 0], centre[:, 1], ".", color="#8c8c8c", markersize=1.5)
    kinds = road.segment_kind.numpy()[:-1]
    segments = road.segment.numpy()[:-1].reshape(-1, 2, 2)
    for kind, colour in COLOURS.items():
        axes.add_collection(LineCollection(list(segments[kinds == kind]), colors=colour, linewidths=1.2))


def _draw_pairs(axes, bundle: MapBundle, pairs: int, regime: int, seed: int) -> None:
    pool = bundle.pools[regime]
    if pairs == 0 or len(pool.start) == 0:
        return
    chosen = np.random.default_rng(seed).choice(len(pool.start), min(pairs, len(pool.start)), replace=False)
    start, goal = bundle.graph.node_xy[pool.start[chosen]], bundle.graph.node_xy[pool.goal[chosen]]
    links = list(np.stack((start, goal), axis=1))
    axes.add_collection(LineCollection(links, colors="#1f4ed8", linewidths=0.5, alpha=0.6))
    axes.plot(start[:, 0], start[:, 1], ".", color="#d62728", markersize=5)
    axes.plot(goal[:, 0], goal[:, 1], ".", color="#2ca02c", markersize=5)
