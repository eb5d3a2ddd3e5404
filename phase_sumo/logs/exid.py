"""exiD: ``NN_tracks.csv`` with its two meta files, and the location's map.

Positions are box centres in a local UTM frame; the map is brought into it by whoever can read maps.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from phase_sumo.errors import PhaseError
from phase_sumo.logs.kinds import kind_of
from phase_sumo.logs.levelx import Drone, open_drone
from phase_sumo.logs.quality import finished
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.sampling import on_grid
from phase_sumo.sim.lanes import LaneNetwork

COLUMNS = ("xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
ORIGIN = ("xUtmOrigin", "yUtmOrigin")
FOLDERS = ("maps/lanelet2", "maps/lanelets", "maps/opendrive", "maps")  # the first that has a map is taken
MAPS = (".osm", ".xodr")
# a map file and the UTM coordinates (east, north in m) of the origin that its road shall have
RoadReader = Callable[[Path, "tuple[float, float] | None"], LaneNetwork]


class ExidRoads:
    """Maps of the locations, each read once.

    Args:
        folder: the data set's, or that of its tracks; or a map file for all recordings.
        read: reads a map.
    """

    def __init__(self, folder: Path, read: RoadReader) -> None:
        self._folder, self._read = folder, read
        self._roads: dict[tuple[Path, tuple[float, float]], LaneNetwork] = {}

    def at(self, location: int, origin: tuple[float, float]) -> LaneNetwork:
        key = self._file(location), origin
        if key not in self._roads:
            self._roads[key] = self._read(*key)
        return self._roads[key]

    def _file(self, location: int) -> Path:
        """The map whose name begins with the location's number, or has it as its only one."""
        if self._folder.is_file():
            return self._folder
        for base in (self._folder, self._folder.parent):
            for folder in (base / name for name in FOLDERS):
                found = sorted(
                    p for p in folder.rglob("*") if p.suffix in MAPS and _number(p.name) == location
                )
                if found:
                    return found[0]
        raise PhaseError(
            f"{self._folder}: no map of location {location} in {' or '.join(FOLDERS[:3])} here or one folder "
            f"up (a file such as {location}_name.osm); add the maps of the data set"
        )


def _number(name: str) -> int:
    found = re.search(r"\d+", name)
    return int(found[0]) if found else -1


def check_exid(path: Path, roads: ExidRoads) -> None:
    """Look at the headers of a recording, and at its map.

    Raises:
        PhaseError: a file, column or map is missing.
    """
    _road(_files(path), roads)


def read_exid(path: str | Path, roads: ExidRoads) -> Recording:
    """One recording.

    Raises:
        PhaseError: a file or column is missing, or vehicles are not on the map's road.
    """
    path = Path(path)
    return finished(_recording(path, _files(path), roads), path)


def _files(path: Path) -> Drone:
    return open_drone(path, "trackId", COLUMNS, ("width", "length", "class"), ("locationId", *ORIGIN))


def _road(drone: Drone, roads: ExidRoads) -> LaneNetwork:
    east, north = (float(drone.recording.floats(name)[0]) for name in ORIGIN)
    return roads.at(_location(drone), (east, north))


def _location(drone: Drone) -> int:
    return int(drone.recording.integers("locationId")[0])


def _recording(path: Path, drone: Drone, roads: ExidRoads) -> Recording:
    x, y, heading, vx, vy = (drone.tracks.floats(name) for name in COLUMNS)
    yaw = np.deg2rad(heading)
    columns = np.stack((x, y, np.cos(yaw), np.sin(yaw), np.hypot(vx, vy)))
    grid = on_grid(path, drone.rows(), drone.times(), columns, len(drone.meta))
    length = drone.meta.floats("length")
    classes = drone.meta.text("class")
    return Recording(
        name=f"exid/{drone.number}",
        source=f"exid/location {_location(drone)}",
        network=_road(drone, roads),
        present=grid.present,
        x=grid.values[0],
        y=grid.values[1],
        yaw=np.arctan2(grid.values[3], grid.values[2]),
        speed=grid.values[4],
        length=length,
        width=drone.meta.floats("width"),
        kind=tuple(kind_of(a, b) for a, b in zip(length, classes, strict=True)),
        flags=(frozenset(),) * len(length),
    )
