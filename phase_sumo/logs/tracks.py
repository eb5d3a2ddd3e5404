"""Plain track CSV: one line per vehicle and time, columns found by name.

Required: ``id``, ``t`` (s), ``y_m``, ``length_m``, and ``x_rear_m`` (rear bumper, centre) or ``x_m`` (box
centre). Without a road given also ``lane``, whole numbers. Optional: ``scene`` and ``direction``, which
together name a recording; ``v_mps``; ``width_m``; ``yaw_rad`` (counter-clockwise from the x axis);
``class``, a word such as car or truck, or ``coarse_class``, the code of I-24 MOTION.

Without a road, x runs downstream and lanes are straight, `LANE_WIDTH` wide and numbered across the road. In
a mirrored frame (x downstream, y to the right of the driver, as in I-24's direction -1 whose x is turned but
whose y is not) lanes further along y are further right: y is turned round, so that left is left. Which side
is which follows from ``direction``: negative ones are mirrored.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.errors import PhaseError
from phase_sumo.logs.csv_table import Table
from phase_sumo.logs.recorded_roads import Carriageway, straight_road
from phase_sumo.logs.recording import Recording, kind_of
from phase_sumo.logs.sampling import on_grid, path_speed, path_yaw
from phase_sumo.logs.windows import finished
from phase_sumo.sim.dimensions import Kind
from phase_sumo.sim.lanes import LaneNetwork

REQUIRED = ("id", "t", "y_m", "length_m")
OPTIONAL = (
    "scene",
    "direction",
    "lane",
    "x_m",
    "x_rear_m",
    "v_mps",
    "width_m",
    "yaw_rad",
    "class",
    "coarse_class",
)
LANE_WIDTH = 3.66  # m, 12 ft
LANE_SHARE = 0.01  # of the samples: a lane used more rarely is a shoulder
CAR_WIDTH, TRUCK_WIDTH = 1.9, 2.55  # m, where a log gives none
I24_CLASSES = {
    "0": "sedan",
    "1": "midsize",
    "2": "van",
    "3": "pickup",
    "4": "semi",
    "5": "truck",
    "6": "motorcycle",
}


def read_tracks(path: str | Path, network: LaneNetwork | None = None) -> Iterator[Recording]:
    """A recording for every scene and direction in the file, one by one; its header is looked at before.

    Args:
        path: the CSV file.
        network: the road, in the coordinates of the file; by default straight lanes.

    Raises:
        PhaseError: the file cannot be read as described above.
    """
    path = Path(path)
    table = Table(path, REQUIRED, OPTIONAL)
    if "x_m" not in table and "x_rear_m" not in table:
        raise PhaseError(f"{path}: no column x_m (box centre) or x_rear_m (rear bumper); name one of them so")
    if network is None and "lane" not in table:
        raise PhaseError(f"{path}: no column lane, from which the road is made; add it or pass a road")
    return _recordings(path, table, network)


def _recordings(path: Path, table: Table, network: LaneNetwork | None) -> Iterator[Recording]:
    source = np.full(len(table), path.name.partition(".")[0])
    if "scene" in table:
        source = np.char.add(np.char.add(source, "/"), table.text("scene"))
    group = np.char.add(np.char.add(source, "/"), table.text("direction")) if "direction" in table else source
    for name, first in zip(*np.unique(group, return_index=True), strict=True):
        yield _recording(path, table, group == name, str(name), str(source[first]), network)


def _recording(
    path: Path,
    table: Table,
    mask: NDArray[np.bool_],
    name: str,
    source: str,
    network: LaneNetwork | None,
) -> Recording:
    def column(key: str) -> FloatArray:
        return table.floats(key)[mask]

    rear = "x_rear_m" in table and "x_m" not in table
    mirrored = network is None and "direction" in table and bool((column("direction") < 0).all())
    count, vehicle = _numbered(table.text("id")[mask])
    x, y, sizes = column("x_rear_m" if rear else "x_m"), column("y_m"), column("length_m")
    y = -y if mirrored else y
    if network is None:
        lane = table.integers("lane")[mask]
        back = x if rear else x - 0.5 * sizes
        network = _road(name, -lane if mirrored else lane, y, back.min(), (back + sizes).max())
    columns = [x, y]
    if "yaw_rad" in table:
        yaw = column("yaw_rad")
        columns += [np.cos(yaw), np.sin(-yaw if mirrored else yaw)]
    if "v_mps" in table:
        columns.append(column("v_mps"))
    grid = on_grid(path, vehicle, column("t"), np.stack(columns), count)
    first = np.unique(vehicle, return_index=True)[1]
    length = sizes[first]
    kinds: tuple[Kind, ...] = tuple(
        kind_of(a, b) for a, b in zip(length, _classes(table, mask)[first], strict=True)
    )
    default = np.where(np.array(kinds) == "car", CAR_WIDTH, TRUCK_WIDTH)
    xs, ys = grid.values[0], grid.values[1]
    if "yaw_rad" in table:
        yaw = np.arctan2(grid.values[3], grid.values[2])
    else:
        yaw = path_yaw(xs, ys, grid.present, 0.0)
    if rear:
        xs = xs + 0.5 * length[:, None] * np.cos(yaw)
        ys = ys + 0.5 * length[:, None] * np.sin(yaw)
    return finished(
        Recording(
            name=name,
            source=source,
            network=network,
            present=grid.present,
            x=xs,
            y=ys,
            yaw=yaw,
            speed=np.maximum(grid.values[-1], 0.0) if "v_mps" in table else path_speed(xs, ys, grid.present),
            length=length,
            width=column("width_m")[first] if "width_m" in table else default,
            kind=kinds,
            flags=(frozenset(),) * count,
        ),
        path,
    )


def _numbered(names: NDArray[np.str_]) -> tuple[int, NDArray[np.int64]]:
    """How many different names there are, and [rows] numbers for them in the order in which they appear."""
    _, first, index = np.unique(names, return_index=True, return_inverse=True)
    return len(first), np.argsort(np.argsort(first))[index]


def _classes(table: Table, mask: NDArray[np.bool_]) -> NDArray[np.str_]:
    """[rows] class words, empty where the log has none."""
    if "class" in table:
        return table.text("class")[mask]
    if "coarse_class" in table:
        return np.array([I24_CLASSES.get(code, "") for code in table.text("coarse_class")[mask]])
    return np.full(int(mask.sum()), "")


def _road(name: str, lane: NDArray[np.int64], y: FloatArray, begin: float, end: float) -> LaneNetwork:
    """Straight lanes `LANE_WIDTH` wide under the samples, ``lane`` [S] counted to the left."""
    numbers, counts = np.unique(lane, return_counts=True)
    used = numbers[counts >= LANE_SHARE * len(lane)]
    numbers = np.arange(used.min(), used.max() + 1)
    # the marking between two lanes is where as many samples of the right one lie beyond it as of the left
    # one before it
    offsets = []
    for k in numbers[:-1]:
        both = np.sort(y[(lane == k) | (lane == k + 1)])
        at = int((lane == k).sum())
        if 0 < at < len(both):
            offsets.append(0.5 * (both[at - 1] + both[at]) - (k + 0.5) * LANE_WIDTH)
    offset = np.median(offsets) if offsets else np.median(y) - numbers[0] * LANE_WIDTH
    centres = numbers * LANE_WIDTH + float(offset)
    way = Carriageway("road", begin, end, centres, np.full(len(centres), LANE_WIDTH))
    return straight_road(name, [way])
