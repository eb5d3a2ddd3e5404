"""Networks -> map bundles with a picture each."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phase_sumo.bridge.lines import arc_length
from phase_sumo.bridge.map_picture import draw_map
from phase_sumo.bridge.net_xml import network_name
from phase_sumo.bridge.network import read_network
from phase_sumo.bridge.road_lines import road_lines
from phase_sumo.config import ScenarioConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import MapBundle, save_bundle
from phase_sumo.sim.lane_graph import build_lane_graph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import build_pool
from phase_sumo.sim.road_build import build_road_map


def build_bundle(network: LaneNetwork, scenario: ScenarioConfig | None = None, seed: int = 0) -> MapBundle:
    """Lane graph, road map and one start-goal pool per regime."""
    scenario = scenario or ScenarioConfig()
    graph = build_lane_graph(network)
    road_map = build_road_map(road_lines(network), graph)
    pools = tuple(build_pool(graph, regime, scenario.max_lane_changes, seed) for regime in scenario.regimes)
    return MapBundle(network.name, road_map, graph, pools)


def convert(
    paths: Sequence[str | Path],
    out_dir: str | Path,
    progress: Callable[[float, str], None] | None = None,
    keep: Literal["freeway", "all"] = "freeway",
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Write ``<name>.npz`` and ``<name>.png`` for every network.

    Args:
        paths: SUMO networks.
        out_dir: folder to write to; made if missing.
        progress: called with the fraction done and the name of the network that comes next.
        keep: see `read_network`.
        seed: of the pools.

    Returns:
        Per network: name, lanes, lane_km, nodes, links, pairs, lane_change_pairs, seconds, warnings.

    Raises:
        PhaseError: a network cannot be read, or two would be written to the same file.
    """
    _check_names(paths)
    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    results = []
    for done, path in enumerate(paths):
        begin = time.perf_counter()
        if progress is not None:
            progress(done / len(paths), Path(path).name)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            network = read_network(path, keep)
            bundle = build_bundle(network, seed=seed)
        save_bundle(out_dir / f"{network.name}.npz", bundle)
        draw_map(bundle, out_dir / f"{network.name}.png")
        found = [*network.warnings, *(str(w.message) for w in caught)]
        results.append(_summary(network, bundle, time.perf_counter() - begin, found))
    return results


def _check_names(paths: Sequence[str | Path]) -> None:
    first: dict[str, Path] = {}
    for path in map(Path, paths):
        name = network_name(path)
        if name in first:
            raise PhaseError(
                f"{first[name]} and {path} would both be written to {name}.npz; "
                "rename one or convert them into different folders"
            )
        first[name] = path


def _summary(network: LaneNetwork, bundle: MapBundle, seconds: float, found: list[str]) -> dict[str, Any]:
    graph = bundle.graph
    links = (graph.successor >= 0).sum() + (graph.left >= 0).sum() + (graph.right >= 0).sum()
    return {
        "name": network.name,
        "lanes": sum(not lane.connector for lane in network.lanes),
        "lane_km": round(sum(float(arc_length(lane.points)[-1]) for lane in network.lanes) / 1000.0, 3),
        "nodes": len(graph.node_lane),
        "links": int(links),
        "pairs": sum(len(pool.start) for pool in bundle.pools),
        "lane_change_pairs": sum(int(np.count_nonzero(pool.lane_changes)) for pool in bundle.pools),
        "seconds": round(seconds, 2),
        "warnings": found,
    }
