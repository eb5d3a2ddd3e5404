"""Map bundles: one converted map with its lane graph and start-goal pools in one ``.npz`` file."""

from __future__ import annotations

import dataclasses
import hashlib
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

from phase_sumo.atomic_files import whole
from phase_sumo.config import ScenarioConfig
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.lanes import GeoReference, LaneNetwork
from phase_sumo.sim.pool import StartGoalPool
from phase_sumo.sim.road_map import CELL_SIZE, POINTS_PER_CELL, SEGMENTS_PER_CELL, RoadMap

FORMAT = "phase_sumo map bundle 8"  # count up whenever conversion writes something else
LAYOUT = (CELL_SIZE, POINTS_PER_CELL, SEGMENTS_PER_CELL)  # a file with another grid does not fit the code


@dataclass(frozen=True)
class MapBundle:
    """What training needs of one map.

    Attributes:
        name: of the network.
        road_map: a single map (M = 1).
        graph: lane graph.
        pools: one per `config.POOLS`, in that order.
        key: `bundle_key` of what it was made from, "" if unknown.
        geo: geographic reference of the coordinates, None if the map has none.
    """

    name: str
    road_map: RoadMap
    graph: LaneGraph
    pools: tuple[StartGoalPool, ...]
    key: str = ""
    geo: GeoReference | None = None


def bundle_key(network: LaneNetwork, scenario: ScenarioConfig, seed: int) -> str:
    """Hash of everything that a bundle depends on.

    Args:
        network: its lanes, as they were read.
        scenario: its regimes' path lengths and speeds and the lane-change budget shape the pools.
        seed: of the pools.
    """
    regimes = [(regime.path_bounds, regime.base_speed) for regime in scenario.regimes]
    digest = hashlib.sha256()
    for part in (FORMAT, LAYOUT, regimes, scenario.max_lane_changes, seed):
        digest.update(repr(part).encode() + b"\n")
    for part in _content(network):
        digest.update(part)
    return digest.hexdigest()


def _content(network: LaneNetwork) -> Iterator[bytes]:
    yield repr((network.name, network.successors, network.left_hand, len(network.lanes))).encode()
    for lane in network.lanes:
        for f in fields(lane):
            value = getattr(lane, f.name)
            yield value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            yield b"\n"


def save_bundle(path: str | Path, bundle: MapBundle) -> None:
    """Write a bundle; the file appears complete or not at all."""
    path = Path(path)
    arrays: dict[str, np.ndarray] = {
        "format": np.array(FORMAT),
        "layout": np.array(LAYOUT),
        "name": np.array(bundle.name),
        "key": np.array(bundle.key),
        "pools": np.array(len(bundle.pools)),
        "geo": np.array([] if bundle.geo is None else dataclasses.astuple(bundle.geo), str),
    }
    arrays |= {f"road.{key}": value for key, value in bundle.road_map.arrays().items()}
    arrays |= {f"graph.{key}": value for key, value in bundle.graph.arrays().items()}
    for i, pool in enumerate(bundle.pools):
        arrays |= {f"pool{i}.{key}": value for key, value in pool.arrays().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # compressing would cost more than all the rest


def load_if_current(path: str | Path, key: str) -> MapBundle | None:
    """The bundle at ``path`` if it was made from what ``key`` stands for; None if it must be made again."""
    if load_key(path) != key:
        return None
    try:
        return load_bundle(path)
    except PhaseError:
        return None


def load_key(path: str | Path) -> str:
    """The key of the bundle at ``path``, "" if there is none to be read."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return str(data["key"])
    except (OSError, ValueError, KeyError, EOFError, zlib.error, zipfile.BadZipFile):
        return ""


def load_bundle(path: str | Path) -> MapBundle:
    """Read a bundle.

    Raises:
        PhaseError: the file is missing, damaged, or was written by another version.
    """
    path = Path(path)
    remedy = "convert the network again with `phase-sumo convert`"
    if not path.is_file():
        raise PhaseError(f"{path}: no such map bundle; {remedy}")
    try:
        data = np.load(path, allow_pickle=False)
        if not isinstance(data, NpzFile):
            raise ValueError("a single array")
        with data:
            arrays = {key: data[key] for key in data.files}
    except (OSError, ValueError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise PhaseError(f"{path}: not a readable map bundle ({error}); {remedy}") from error
    found = str(arrays["format"]) if "format" in arrays else "none"
    if found != FORMAT or tuple(arrays.get("layout", ())) != LAYOUT:
        raise PhaseError(f"{path}: bundle format {found!r} does not fit this version ({FORMAT!r}); {remedy}")
    try:
        return MapBundle(
            name=str(arrays["name"]),
            road_map=RoadMap.from_arrays(_group(arrays, "road")),
            graph=LaneGraph(**_group(arrays, "graph")),
            pools=tuple(StartGoalPool(**_group(arrays, f"pool{i}")) for i in range(int(arrays["pools"]))),
            key=str(arrays["key"]),
            geo=GeoReference(*arrays["geo"].tolist()) if len(arrays["geo"]) else None,
        )
    except (KeyError, TypeError) as error:
        raise PhaseError(f"{path}: the map bundle lacks {error}; {remedy}") from error


def _group(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key[len(name) + 1 :]: value for key, value in arrays.items() if key.startswith(f"{name}.")}
