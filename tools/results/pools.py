"""Draws results/pools.png: start-goal pools of one held-out map in all four traffic regimes.

python -m tools.results.pools [NETWORK]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.config import REGIMES
from phase_sumo.report.map_picture import draw_road, turned
from phase_sumo.sim.bundle import MapBundle
from tools.places import HELD_OUT, RESULTS

matplotlib.use("Agg")

NETWORK = HELD_OUT / "h02_exit_drop4.net.xml"
PAIRS = 24  # drawn of each regime
START, GOAL, INK, GRID = "#d62728", "#2ca02c", "#2b2f36", "#e3e6ea"
CHANGES = {
    -2: "#7a3e9d",
    -1: "#b07cc6",
    0: "#7f8791",
    1: "#5fa8dc",
    2: "#1f5fa6",
    3: "#0b2f5e",
    -3: "#4a1466",
}


def draw(bundle: MapBundle) -> Figure:
    """Per regime a sample of pairs on the map, and of all pairs path lengths and lane changes."""
    figure = Figure(figsize=(14.0, 6.6), dpi=120, layout="constrained")
    grid = figure.add_gridspec(len(REGIMES), 3, width_ratios=[4.2, 1.15, 1.15])
    xy = bundle.graph.node_xy.astype(float)
    ends = xy[[xy[:, 0].argmin(), xy[:, 0].argmax()]]
    yaw = float(np.arctan2(*(ends[1] - ends[0])[::-1]))
    lengths = np.arange(0.0, max(r.path_bounds[1] for r in REGIMES) + 10.0, 8.0)
    for row, (regime, pool) in enumerate(zip(REGIMES, bundle.pools[: len(REGIMES)], strict=True)):
        axes, left, right = (figure.add_subplot(grid[row, k]) for k in range(3))
        _pairs(axes, bundle, row, yaw)
        axes.set_title(
            f"{regime.name}: {len(pool.start):,} pairs, {regime.path_bounds[0]:.0f} to "
            f"{regime.path_bounds[1]:.0f} m, {regime.base_speed:g} m/s",
            fontsize=10, color=INK, loc="left", fontweight="bold",
        )  # fmt: skip
        left.hist(pool.path_length, lengths.tolist(), color="#7f8791")
        counts = np.array([(pool.lane_changes == c).sum() for c in range(-3, 4)])
        right.bar(range(-3, 4), counts, color=[CHANGES[c] for c in range(-3, 4)])
        for panel, label in ((left, "path length, m"), (right, "lane changes (left +)")):
            panel.spines[["top", "right"]].set_visible(False)
            panel.grid(color=GRID, lw=0.8)
            panel.set_axisbelow(True)
            panel.tick_params(colors=INK, labelsize=8)
            if row == len(REGIMES) - 1:
                panel.set_xlabel(label, color=INK, fontsize=9)
        left.set_ylabel("pairs", color=INK, fontsize=9)
        right.set_xticks(range(-3, 4))
    return figure


def _pairs(axes: Axes, bundle: MapBundle, regime: int, yaw: float) -> None:
    """The road, starts red and goals green, joined by a line in the colour of its lane changes."""
    axes.axis("off")
    draw_road(axes, bundle, yaw)
    pool, graph = bundle.pools[regime], bundle.graph
    some = np.random.default_rng(0).permutation(len(pool.start))[:PAIRS]
    start, goal = (turned(graph.node_xy[nodes[some]].astype(float), yaw) for nodes in (pool.start, pool.goal))
    colours = [CHANGES[int(c)] for c in pool.lane_changes[some]]
    axes.add_collection(LineCollection(list(np.stack((start, goal), 1)), colors=colours, lw=1.5, zorder=4))
    axes.scatter(*start.T, s=11, color=START, zorder=5)
    axes.scatter(*goal.T, s=11, color=GOAL, zorder=5)
    xy = turned(graph.node_xy.astype(float), yaw)
    axes.set(xlim=(xy[:, 0].min() - 5, xy[:, 0].max() + 5), ylim=(xy[:, 1].min() - 6, xy[:, 1].max() + 6))
    axes.set_aspect("equal")


def main() -> None:
    network = Path(sys.argv[1]) if len(sys.argv) > 1 else NETWORK
    draw(build_bundle(read_network(network))).savefig(RESULTS / "pools.png")


if __name__ == "__main__":
    main()
