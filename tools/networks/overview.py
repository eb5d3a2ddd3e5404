"""A contact sheet of all networks, drawn from the converted maps, and their table in README.md.

python -m tools.networks.overview
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from phase_sumo.bridge.maps.line_geometry import normals
from phase_sumo.bridge.maps.road_lines import lane_boundaries, road_edges
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.sim.lanes import Lane, LaneNetwork
from phase_sumo.sim.road_map import RoadKind
from tools.networks.readme import fill, network_table
from tools.networks.specs import SPECS
from tools.places import NETWORKS

matplotlib.use("Agg")
FILE = "overview.png"
COLUMNS = 3
MARGIN = 45.0  # m above and below a road, with its title
SURFACE, ROAD_EDGE, RESTRICTED = "#e4e7eb", "#d62728", "#f6d9a8"
LINES = {RoadKind.LANE_BOUNDARY: "#6aaed6", RoadKind.SOLID_BOUNDARY: "#1f4ed8"}


def draw_overview(networks: list[Path], output: Path) -> None:
    """One panel per network, turned so that it runs from left to right, all at one scale."""
    roads = [_Road.of(read_network(path)) for path in networks]
    rows = [roads[i : i + COLUMNS] for i in range(0, len(roads), COLUMNS)]
    heights = [max(road.size[1] for road in row) + MARGIN for row in rows]
    width = max(road.size[0] for road in roads) + 20.0
    inches = 16.0 / (COLUMNS * width)  # per metre
    figure = Figure((16.0, inches * sum(heights)), dpi=100)
    grid = {"height_ratios": heights, "left": 0, "right": 1, "bottom": 0, "top": 1, "wspace": 0, "hspace": 0}
    panels = figure.subplots(len(rows), COLUMNS, gridspec_kw=grid, squeeze=False)
    for row, line, height in zip(panels, rows, heights, strict=True):
        for axes, road in zip(row, line, strict=False):
            _draw(axes, road)
            (x, y), (w, h) = road.low, road.size
            y += h - height + 0.6 * MARGIN
            x -= 0.5 * (width - w)
            axes.set(xlim=(x, x + width), ylim=(y, y + height), aspect="equal")
        for axes in row:
            axes.set_axis_off()
    figure.savefig(output, format="png", pil_kwargs={"optimize": True})


@dataclass(frozen=True)
class _Road:
    """A network with the frame [2, 2] that lays it from left to right, and its extent there in m."""

    network: LaneNetwork
    turn: NDArray[np.float64]
    surface: list[NDArray[np.float64]]
    low: NDArray[np.float64]
    size: NDArray[np.float64]

    @staticmethod
    def of(network: LaneNetwork) -> _Road:
        turn = _turn(network)
        surface = [_outline(lane) @ turn for lane in network.lanes]
        low, high = (f([f(part, axis=0) for part in surface], axis=0) for f in (np.min, np.max))
        return _Road(network, turn, surface, low, high - low)


def _draw(axes: Axes, road: _Road) -> None:
    network = road.network
    colours = [SURFACE if lane.allows_truck else RESTRICTED for lane in network.lanes]
    axes.add_collection(PolyCollection(road.surface, facecolors=colours, edgecolors="none"))
    for line in lane_boundaries(network):
        colour = LINES[line.kind]
        axes.add_collection(LineCollection([line.points @ road.turn], colors=colour, linewidths=0.5))
    edges = [line.points @ road.turn for line in road_edges(network)]
    axes.add_collection(LineCollection(edges, colors=ROAD_EDGE, linewidths=0.6))
    axes.text(0.03, 0.97, network.name, fontsize=10, va="top", transform=axes.transAxes)


def _turn(network: LaneNetwork) -> NDArray[np.float64]:
    """[2, 2] from map axes to the main direction of the main road."""
    lanes = [lane.points for lane in network.lanes if lane.edge.startswith("main")]
    points = np.concatenate(lanes)
    x, y = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][0]
    forward = np.sign((lanes[0][-1] - lanes[0][0]) @ (x, y))
    return forward * np.array([[x, -y], [y, x]])


def _outline(lane: Lane) -> NDArray[np.float64]:
    side = 0.5 * lane.width * normals(lane.points)
    return np.concatenate((lane.points + side, (lane.points - side)[::-1]))


def main() -> None:
    networks = [*sorted(NETWORKS.glob("*.net.xml")), *sorted((NETWORKS / "held_out").glob("*.net.xml"))]
    draw_overview(networks, NETWORKS / FILE)
    fill("networks", network_table(SPECS))
    print(NETWORKS / FILE)


if __name__ == "__main__":
    main()
