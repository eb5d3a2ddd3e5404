"""highD: ``NN_tracks.csv`` with its two meta files; the road is made from its lane markings.

x and y are the upper left corner of the box in the image, whose y axis points down; "width" is the vehicle's
length and "height" its width. The upper carriageway drives to the left. There are no headings: they follow
from the path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError
from phase_sumo.logs.kinds import kind_of
from phase_sumo.logs.levelx import Drone, open_drone
from phase_sumo.logs.quality import finished
from phase_sumo.logs.recorded_roads import SPEED_LIMIT, Carriageway, straight_road
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.sampling import on_grid, path_yaw
from phase_sumo.sim.lanes import LaneNetwork

FloatArray = NDArray[np.float64]
COLUMNS = ("x", "y", "width", "height", "xVelocity", "yVelocity")
UPPER, LOWER = "upperLaneMarkings", "lowerLaneMarkings"


def highd_files(path: Path) -> Drone:
    """The files of one recording, of which the headers are read.

    Raises:
        PhaseError: a file or column is missing.
    """
    meta = "width", "height", "class", "drivingDirection"
    return open_drone(path, "id", COLUMNS, meta, (UPPER, LOWER), ("speedLimit", "locationId"))


def read_highd(path: str | Path) -> Recording:
    """One recording, both directions of it.

    Raises:
        PhaseError: a file or column is missing.
    """
    path = Path(path)
    return finished(_recording(path, highd_files(path)), path)


def _recording(path: Path, drone: Drone) -> Recording:
    x, y, length, width, vx, vy = (drone.tracks.floats(name) for name in COLUMNS)
    x, y = x + 0.5 * length, -(y + 0.5 * width)
    grid = on_grid(path, drone.rows(), drone.times(), np.stack((x, y, np.hypot(vx, vy))), len(drone.meta))
    upper = drone.meta.integers("drivingDirection") == 1
    sizes, classes = drone.meta.floats("width"), drone.meta.text("class")
    xs, ys, speed = grid.values
    about = drone.recording
    return Recording(
        name=f"highd/{drone.number}",
        source=f"highd/location {about.integers('locationId')[0]}" if "locationId" in about else "highd",
        network=_road(drone, float((x - 0.5 * length).min()), float((x + 0.5 * length).max())),
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


def _road(drone: Drone, west: float, east: float) -> LaneNetwork:
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
