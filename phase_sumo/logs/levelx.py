"""exiD and highD: numbered recordings of three CSV files, 25 frames a second.

exiD: positions are box centres in a local UTM frame; the map is brought into it by whoever can read maps.

highD: x and y are the upper left corner of the box in the image, whose y axis points down; "width" is the
vehicle's length and "height" its width. The upper carriageway drives to the left. There are no headings: they
follow from the path. The road is made from the lane markings.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.errors import PhaseError
from phase_sumo.logs.csv_table import Table
from phase_sumo.logs.recorded_roads import SPEED_LIMIT, Carriageway, straight_road
from phase_sumo.logs.recording import Recording, kind_of
from phase_sumo.logs.sampling import on_grid, path_yaw
from phase_sumo.logs.windows import finished
from phase_sumo.sim.lanes import LaneNetwork

TRACKS, META, RECORDING = "_tracks.csv", "_tracksMeta.csv", "_recordingMeta.csv"


@dataclass(frozen=True)
class Drone:
    """Files of one recording.

    Attributes:
        number: how their names begin, e.g. "07".
        identity: column that names the vehicle, in tracks and meta.
        tracks, meta: samples of all vehicles, and the vehicles.
        recording: one line about the place and the time.
    """

    number: str
    identity: str
    tracks: Table
    meta: Table
    recording: Table

    def rows(self) -> NDArray[np.int64]:
        """[S] line of ``meta`` of each sample."""
        known, own = self.meta.integers(self.identity), self.tracks.integers(self.identity)
        order = np.argsort(known)
        row = order[np.minimum(np.searchsorted(known, own, sorter=order), len(known) - 1)]
        if (known[row] != own).any():
            missing = own[known[row] != own][0]
            raise PhaseError(
                f"{self.meta.path}: no line for {self.identity} {missing}, which {self.tracks.path.name} "
                "has; download both again"
            )
        return row

    def times(self) -> NDArray[np.float64]:
        """[S] s of each sample."""
        rate = float(self.recording.floats("frameRate")[0])
        if not rate > 0:
            raise PhaseError(
                f"{self.recording.path}: frameRate {rate:g}: expected frames per second, such as 25"
            )
        return self.tracks.floats("frame") / rate


def drone_files(path: Path) -> list[Path]:
    """The track files in a folder, or in its ``data`` folder, or the one that was named."""
    if path.is_file():
        if not path.name.endswith(TRACKS):
            raise PhaseError(f"{path}: pass a file NN{TRACKS}, or the folder of such files")
        return [path]
    for folder in (path, path / "data"):
        if found := sorted(folder.glob(f"*{TRACKS}")):
            return found
    raise PhaseError(
        f"{path}: no file NN{TRACKS} in this folder or its data folder; pass the folder of the recordings"
    )


def open_drone(
    path: Path,
    identity: str,
    columns: Sequence[str],
    meta: Sequence[str],
    recording: Sequence[str],
    optional: Sequence[str] = (),
) -> Drone:
    """The three files of a recording, of which the headers are read.

    Args:
        path: ``NN_tracks.csv``.
        identity: column that names the vehicle, in tracks and meta.
        columns, meta, recording: further columns needed of the three.
        optional: of the last, taken where it has them.
    """
    number = path.name.removesuffix(TRACKS)
    return Drone(
        number,
        identity,
        Table(path, (identity, "frame", *columns)),
        Table(path.with_name(number + META), (identity, *meta)),
        Table(path.with_name(number + RECORDING), ("frameRate", *recording), optional),
    )


EXID_COLUMNS = ("xCenter", "yCenter", "heading", "xVelocity", "yVelocity")
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
    _exid_road(_files(path), roads)


def read_exid(path: str | Path, roads: ExidRoads) -> Recording:
    """One recording.

    Raises:
        PhaseError: a file or column is missing, or vehicles are not on the map's road.
    """
    path = Path(path)
    return finished(_exid_recording(path, _files(path), roads), path)


def _files(path: Path) -> Drone:
    return open_drone(path, "trackId", EXID_COLUMNS, ("width", "length", "class"), ("locationId", *ORIGIN))


def _exid_road(drone: Drone, roads: ExidRoads) -> LaneNetwork:
    east, north = (float(drone.recording.floats(name)[0]) for name in ORIGIN)
    return roads.at(_location(drone), (east, north))


def _location(drone: Drone) -> int:
    return int(drone.recording.integers("locationId")[0])


def _exid_recording(path: Path, drone: Drone, roads: ExidRoads) -> Recording:
    x, y, heading, vx, vy = (drone.tracks.floats(name) for name in EXID_COLUMNS)
    yaw = np.deg2rad(heading)
    columns = np.stack((x, y, np.cos(yaw), np.sin(yaw), np.hypot(vx, vy)))
    grid = on_grid(path, drone.rows(), drone.times(), columns, len(drone.meta))
    length = drone.meta.floats("length")
    classes = drone.meta.text("class")
    return Recording(
        name=f"exid/{drone.number}",
        source=f"exid/location {_location(drone)}",
        network=_exid_road(drone, roads),
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


HIGHD_COLUMNS = ("x", "y", "width", "height", "xVelocity", "yVelocity")
UPPER, LOWER = "upperLaneMarkings", "lowerLaneMarkings"


def highd_files(path: Path) -> Drone:
    """The files of one recording, of which the headers are read.

    Raises:
        PhaseError: a file or column is missing.
    """
    meta = "width", "height", "class", "drivingDirection"
    return open_drone(path, "id", HIGHD_COLUMNS, meta, (UPPER, LOWER), ("speedLimit", "locationId"))


def read_highd(path: str | Path) -> Recording:
    """One recording, both directions of it.

    Raises:
        PhaseError: a file or column is missing.
    """
    path = Path(path)
    return finished(_highd_recording(path, highd_files(path)), path)


def _highd_recording(path: Path, drone: Drone) -> Recording:
    x, y, length, width, vx, vy = (drone.tracks.floats(name) for name in HIGHD_COLUMNS)
    x, y = x + 0.5 * length, -(y + 0.5 * width)
    grid = on_grid(path, drone.rows(), drone.times(), np.stack((x, y, np.hypot(vx, vy))), len(drone.meta))
    upper = drone.meta.integers("drivingDirection") == 1
    sizes, classes = drone.meta.floats("width"), drone.meta.text("class")
    xs, ys, speed = grid.values
    about = drone.recording
    return Recording(
        name=f"highd/{drone.number}",
        source=f"highd/location {about.integers('locationId')[0]}" if "locationId" in about else "highd",
        network=_highd_road(drone, float((x - 0.5 * length).min()), float((x + 0.5 * length).max())),
        present=grid.present,
        x=xs,
        y=ys,
        yaw=path_yaw(xs, ys, grid.present, np.where(upper, np.pi, 0.0)[:, None]),
        speed=speed,
        length=sizes,
        width=drone.meta.floats("height"),
        kind=tuple(kind_of(a, b) for a, b in zip(sizes, classes, strict=True)),
        flags=(frozenset(),) * len(sizes),
    )


def _highd_road(drone: Drone, west: float, east: float) -> LaneNetwork:
    limit = float(drone.recording.floats("speedLimit")[0]) if "speedLimit" in drone.recording else -1.0
    ways = []
    for name, begin, end in ((UPPER, east, west), (LOWER, west, east)):
        # from the image's top to its bottom, lanes go from the driver's right to his left on the upper
        # carriageway and the other way round on the lower one
        markings = -_markings(drone, name)
        markings = markings[::-1] if name == LOWER else markings
        centres, widths = 0.5 * (markings[1:] + markings[:-1]), np.abs(np.diff(markings))
        speed = limit if limit > 0 else SPEED_LIMIT
        ways.append(Carriageway(name.removesuffix("LaneMarkings"), begin, end, centres, widths, speed))
    return straight_road(f"highd_{drone.number}", ways)


def _markings(drone: Drone, name: str) -> FloatArray:
    """y of the markings in the image, from top to bottom, in m."""
    text = str(drone.recording.text(name)[0])
    try:
        values = np.sort(np.array([float(value) for value in text.split(";") if value.strip()]))
    except ValueError:
        values = np.zeros(0)
    if len(values) < 2:
        raise PhaseError(f"{drone.recording.path}: {name} = {text!r}, expected metres such as 8.5;12.6;16.3")
    return values
