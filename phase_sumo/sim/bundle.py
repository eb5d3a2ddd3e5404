"""Map bundles: one converted map with its lane graph and start-goal pools in one ``.npz`` file."""

from __future__ import annotations

import os
import tempfile
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.npyio import NpzFile

from phase_sumo.errors import PhaseError
from phase_sumo.sim.lane_graph import LaneGraph
from phase_sumo.sim.pool import StartGoalPool
from phase_sumo.sim.road_map import CELL_SIZE, POINTS_PER_CELL, SEGMENTS_PER_CELL, RoadMap

FORMAT = "phase_sumo map bundle 1"
LAYOUT = (CELL_SIZE, POINTS_PER_CELL, SEGMENTS_PER_CELL)  # a file with another grid does not fit the code


@dataclass(frozen=True)
class MapBundle:
    """What training needs of one map.

    Attributes:
        name: of the network.
        road_map: a single map (M = 1).
        graph: lane graph.
        pools: one per `config.REGIMES`, in that order.
    """

    name: str
    road_map: RoadMap
    graph: LaneGraph
    pools: tuple[StartGoalPool, ...]


def save_bundle(path: str | Path, bundle: MapBundle) -> None:
    """Write a bundle; the file appears complete or not at all."""
    path = Path(path)
    arrays: dict[str, np.ndarray] = {
        "format": np.array(FORMAT),
        "layout": np.array(LAYOUT),
        "name": np.array(bundle.name),
        "pools": np.array(len(bundle.pools)),
    }
    arrays |= {f"road.{key}": value for key, value in bundle.road_map.arrays().items()}
    arrays |= {f"graph.{key}": value for key, value in bundle.graph.arrays().items()}
    for i, pool in enumerate(bundle.pools):
        arrays |= {f"pool{i}.{key}": value for key, value in pool.arrays().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        Path(temporary).chmod(0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


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
        )
    except (KeyError, TypeError) as error:
        raise PhaseError(f"{path}: the map bundle lacks {error}; {remedy}") from error


def _group(arrays: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {key[len(name) + 1 :]: value for key, value in arrays.items() if key.startswith(f"{name}.")}
