"""A lane network as the world model sees it: lane graph, borders, road map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from phase_sumo.arrays import IntArray
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.bridge.maps.road_lines import road_lines
from phase_sumo.sim.lane_graph import LaneGraph, build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.road_build import RoadLine, build_road_map
from phase_sumo.sim.road_map import RoadMap


@dataclass(frozen=True)
class RoadModel:
    """What is built of a network.

    Attributes:
        graph, lines, map: lane graph, borders, and a road map for every layer.
        layer: [V] map of each node; all 0 where roads that lie over each other were not told apart.
    """

    graph: LaneGraph
    lines: list[RoadLine]
    map: RoadMap
    layer: IntArray


def road_model(network: LaneNetwork, levels: Levels | None = None) -> RoadModel:
    """Build a network; with its ``levels`` roads that cross over each other get maps of their own."""
    graph = build_lane_graph(network)
    layer, lines = np.zeros(len(graph.node_lane), np.int64), []
    if levels is None or len(levels.layers[1]) == 1:
        lines = road_lines(network)
    else:
        of_piece, drawn = levels.layers
        layer = of_piece[levels.of_nodes(graph)]
        for k, pieces in enumerate(drawn):
            lines += [replace(line, layer=k) for line in road_lines(levels.drawn(pieces))]
    return RoadModel(graph, lines, build_road_map(lines, graph, layer), layer)
