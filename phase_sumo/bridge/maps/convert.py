"""Networks -> map bundles, and a picture of each for those who want them.

Paths through the lane graph are checked for turns that a tractor with a trailer cannot follow.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.bridge.maps.import_map import read_map
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.bridge.maps.line_geometry import arc_length
from phase_sumo.bridge.maps.net_xml import network_name
from phase_sumo.bridge.maps.road_model import road_model
from phase_sumo.bridge.maps.stretches import cut
from phase_sumo.config import POOLS, ScenarioConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.bundle import MapBundle, bundle_key, load_if_current, load_key, save_bundle
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.sim.pool import build_pool

KINK = 0.3  # m sideways within 1 m of path that nothing on wheels follows
TURN = 0.125  # rad/m, a circle of 8 m: what the rear axle of a tractor with a semitrailer can still drive


def lateral_kinks(graph: LaneGraph) -> IntArray:
    """[k] nodes at which a path leaves the straight continuation of the metre before by more than `KINK`.

    Nodes lie about 1 m apart, so the sine of the turn from one step to the next is that distance in m.
    """
    node, turn, _ = _turns(graph)
    return np.unique(node[(np.sin(np.minimum(turn, 0.5 * np.pi)) > KINK)])


def turn_per_metre(graph: LaneGraph) -> FloatArray:
    """[V] largest heading change per metre of path at every node, rad/m."""
    node, turn, step = _turns(graph)
    result = np.zeros(len(graph.node_xy))
    np.maximum.at(result, node, turn / np.maximum(step, 0.5))
    return result


def _turns(graph: LaneGraph) -> tuple[IntArray, FloatArray, FloatArray]:
    """Every node between two others on a path: its index, the turn there in rad, the mean step in m."""
    before, column = np.nonzero(graph.successor >= 0)
    node = graph.successor[before, column].astype(np.int64)
    row, column = np.nonzero(graph.successor[node] >= 0)
    before, node = before[row], node[row]
    after = graph.successor[node, column]
    xy = graph.node_xy.astype(np.float64)
    one, two = xy[node] - xy[before], xy[after] - xy[node]
    across = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    turn = np.abs(np.arctan2(across, (one * two).sum(1)))
    return node, turn, 0.5 * (np.hypot(*one.T) + np.hypot(*two.T))


STRETCH = 500.0  # m
SHORTEST_STRETCH = 200.0  # m: below, hardly any start finds a goal
LARGEST_AREA = 1.6e9  # m^2 that the grid of one map may cover, 40 km x 40 km
Row = dict[str, Any]
Draw = Callable[[MapBundle, Path], None]


def build_bundle(network: LaneNetwork, scenario: ScenarioConfig | None = None, seed: int = 0) -> MapBundle:
    """Lane graph, road map and one start-goal pool per regime."""
    scenario = scenario or ScenarioConfig(regimes=POOLS)
    road = road_model(network)
    pools = tuple(
        build_pool(road.graph, regime, scenario.max_lane_changes, seed) for regime in scenario.regimes
    )
    return MapBundle(
        network.name, road.map, road.graph, pools, bundle_key(network, scenario, seed), network.geo
    )


def load_or_build(network: LaneNetwork, folder: str | Path, seed: int = 0) -> MapBundle:
    """The bundle in ``folder`` if it was made from this network by this version, else a new one."""
    key = bundle_key(network, ScenarioConfig(regimes=POOLS), seed)
    bundle = load_if_current(Path(folder) / f"{network.name}.npz", key)
    return build_bundle(network, seed=seed) if bundle is None else bundle


def read_stretches(path: str | Path) -> list[LaneNetwork]:
    """The freeways of a map file, cut to stretches of `STRETCH` metres where they are long."""
    return flat_stretches(read_map(path), STRETCH)


def flat_stretches(network: LaneNetwork, stretch: float) -> list[LaneNetwork]:
    """Stretches, see `cut`, of which none holds roads over each other: places of a map are on one level."""
    return [flat for part in cut(network, stretch) for flat in Levels(part).flat()]


def convert(
    paths: Sequence[str | Path],
    out_dir: str | Path,
    progress: Callable[[float, str], None] | None = None,
    keep: Literal["freeway", "all"] = "freeway",
    seed: int = 0,
    stretch: float = STRETCH,
    left_hand: bool = False,
    draw: Draw | None = None,
) -> list[Row]:
    """Write ``<name>.npz`` for every network, or for every stretch of a long one.

    All networks are read before anything is written, and the files appear together at the end. Maps that
    are already there, made from the same lanes by this version, are not made again.

    Args:
        paths: SUMO networks, OpenStreetMap extracts, OpenDRIVE files.
        out_dir: folder to write to; made if missing.
        progress: called with the fraction done and the name of the network that comes next.
        keep, left_hand: see `read_map`.
        seed: of the pools.
        stretch: length in m of the stretches that long networks are cut into, 0 for none.
        draw: writes ``<name>.png`` of a bundle beside it, see `draw_map`; None for no pictures.

    Returns:
        Per network: name, stretches, names, lanes, lane_km, nodes, links, pairs, lane_change_pairs,
        seconds, warnings.

    Raises:
        PhaseError: a network cannot be read, or two would be written to the same file.
    """
    if not (stretch == 0 or SHORTEST_STRETCH <= stretch < np.inf):
        raise PhaseError(
            f"stretch {stretch:g} m: pass at least {SHORTEST_STRETCH:g} m, or 0 to leave networks whole"
        )
    report = progress or (lambda share, name: None)
    paths = [Path(path) for path in paths]
    _check_names([(network_name(path), path) for path in paths])
    maps: list[tuple[LaneNetwork, list[LaneNetwork], float]] = []
    for done, path in enumerate(paths):
        report(0.2 * done / len(paths), path.name)
        begin = time.perf_counter()
        network = read_map(path, keep, left_hand)
        parts = flat_stretches(network, stretch)
        _check_sizes(path, parts)
        maps.append((network, parts, time.perf_counter() - begin))
    named = zip(paths, maps, strict=True)
    _check_names([(part.name, path) for path, (_, parts, _) in named for part in parts])
    rows = []
    total, done = sum(len(parts) for _, parts, _ in maps), 0
    with _all_or_nothing(Path(out_dir)) as folder:
        for network, parts, seconds in maps:
            begin, counts = time.perf_counter(), Counter[str]()
            found = [*network.warnings, *_left_out(network, parts)]
            for part in parts:
                report(0.2 + 0.8 * done / total, part.name)
                part_counts, part_found = _write(part, folder, Path(out_dir), seed, draw)
                counts += part_counts
                found += [w for w in part_found if w not in found]
                done += 1
            seconds += time.perf_counter() - begin
            rows.append(_row(network, parts, counts, seconds, found))
    return rows


def _check_names(names: list[tuple[str, Path]]) -> None:
    first: dict[str, Path] = {}
    for name, path in names:
        if name in first:
            raise PhaseError(
                f"{first[name]} and {path} would both be written to {name}.npz; "
                "rename one or convert them into different folders"
            )
        first[name] = path


def _check_sizes(path: Path, parts: list[LaneNetwork]) -> None:
    for part in parts:
        width, height = np.ptp(np.concatenate([lane.points for lane in part.lanes]), axis=0)
        if width * height > LARGEST_AREA:
            raise PhaseError(
                f"{path}: {part.name} spans {width / 1000:.0f} x {height / 1000:.0f} km, too much for "
                f"one map; cut it (--stretch {STRETCH:g}) or pass a smaller part"
            )


@contextmanager
def _all_or_nothing(out_dir: Path) -> Iterator[Path]:
    """A folder whose files move to ``out_dir`` at the end, and vanish if that end is not reached."""
    new = [folder for folder in (out_dir, *out_dir.parents) if not folder.exists()]
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=out_dir, prefix=".convert-"))
    except OSError as error:
        raise PhaseError(f"{out_dir}: cannot be written ({error.strerror}); choose another --out") from error
    try:
        yield folder
        for file in folder.iterdir():
            file.replace(out_dir / file.name)
        folder.rmdir()
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        for made in new:
            made.rmdir()
        if isinstance(error, OSError):
            raise PhaseError(f"{out_dir}: cannot be written ({error}); choose another --out") from error
        raise


def _write(
    part: LaneNetwork, folder: Path, out_dir: Path, seed: int, draw: Draw | None
) -> tuple[Counter[str], list[str]]:
    """Bundle of one stretch, and its picture, into ``folder``, unless ``out_dir`` has them already.

    Returns:
        what it counts, and warnings.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        bundle = load_or_build(part, out_dir, seed)
    current = load_key(out_dir / f"{part.name}.npz") == bundle.key
    if not current:
        save_bundle(folder / f"{part.name}.npz", bundle)
    if draw and not (current and (out_dir / f"{part.name}.png").exists()):
        draw(bundle, folder / f"{part.name}.png")
    graph, pools = bundle.graph, bundle.pools
    links = (graph.successor >= 0).sum() + (graph.left >= 0).sum() + (graph.right >= 0).sum()
    counts = Counter(
        nodes=len(graph.node_lane),
        links=int(links),
        pairs=sum(len(pool.start) for pool in pools),
        lane_change_pairs=sum(int(np.count_nonzero(pool.lane_changes)) for pool in pools),
    )
    found = [str(warning.message) for warning in caught]
    if kinks := len(lateral_kinks(graph)):
        found.append(f"{part.name}: {kinks} places where a lane turns too sharply to be followed")
    if empty := [r.name for r, pool in zip(POOLS, pools, strict=True) if not len(pool.start)]:
        found.append(f"{part.name}: too short or curved for start-goal pairs in {', '.join(empty)} traffic")
    return counts, found


def _left_out(network: LaneNetwork, parts: list[LaneNetwork]) -> list[str]:
    kept = {lane.id for part in parts for lane in part.lanes}
    lost = sum(lane.id not in kept for lane in network.lanes)
    return [f"{lost} lanes of short roads that meet no other left out"] if lost else []


def _row(
    network: LaneNetwork, parts: list[LaneNetwork], counts: Counter[str], seconds: float, found: list[str]
) -> Row:
    return {
        "name": network.name,
        "stretches": len(parts),
        "names": [part.name for part in parts],
        "lanes": sum(not lane.connector for lane in network.lanes),
        "lane_km": round(sum(float(arc_length(lane.points)[-1]) for lane in network.lanes) / 1000.0, 3),
        "nodes": counts["nodes"],
        "links": counts["links"],
        "pairs": counts["pairs"],
        "lane_change_pairs": counts["lane_change_pairs"],
        "seconds": round(seconds, 2),
        "warnings": found,
    }
