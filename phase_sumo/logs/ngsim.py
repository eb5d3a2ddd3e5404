"""NGSIM as published: feet, position of the front's centre, ten samples a second.

Both the comma-separated download with a header (all places and periods in one file) and the text files
without one. Raw positions jitter (second differences of 6 to 11 m/s²): they are smoothed with a
Savitzky-Golay filter of 21 samples and degree 3, from which speed and heading follow, too.

Local_Y runs downstream and Local_X from the left border to the right, so that x = Local_Y, y = -Local_X.
Lanes are straight and as long as the road, where their vehicles drive in the median.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray
from phase_sumo.logs.csv_table import Table
from phase_sumo.logs.recorded_roads import Carriageway, straight_road
from phase_sumo.logs.recording import PERIOD, Recording, kind_of
from phase_sumo.logs.sampling import on_grid, path_yaw, runs
from phase_sumo.logs.windows import finished
from phase_sumo.sim.lanes import LaneNetwork

FOOT = 0.3048  # m
WINDOW, DEGREE = 21, 3
LANE_SHARE = 0.01  # of the samples: a lane used more rarely is left out
LANE_WIDTHS = 3.0, 4.0  # m
CLASSES = {1: "motorcycle", 2: "car", 3: "truck"}
NAMES = (
    "Vehicle_ID",
    "Frame_ID",
    "Total_Frames",
    "Global_Time",
    "Local_X",
    "Local_Y",
    "Global_X",
    "Global_Y",
    "v_Length",
    "v_Width",
    "v_Class",
    "v_Vel",
    "v_Acc",
    "Lane_ID",
    "Preceding",
    "Following",
    "Space_Headway",
    "Time_Headway",
)
REQUIRED = (
    "Vehicle_ID",
    "Frame_ID",
    "Global_Time",
    "Local_X",
    "Local_Y",
    "v_Length",
    "v_Width",
    "v_Class",
    "Lane_ID",
)


def read_ngsim(path: str | Path) -> Iterator[Recording]:
    """A recording for every place and period in the file, one by one; its header is looked at before.

    Frames count from the begin of a period, so that Global_Time less Frame_ID tells periods apart, in which
    ids repeat.

    Raises:
        PhaseError: the file cannot be read as described above.
    """
    path = Path(path)
    return _recordings(path, Table(path, REQUIRED, ("Location",), names=NAMES))


def _recordings(path: Path, table: Table) -> Iterator[Recording]:
    begin = table.floats("Global_Time") - 100.0 * table.floats("Frame_ID")
    minute = np.rint(begin / 60_000.0).astype(np.int64)
    minute -= minute.min()
    place = (
        table.text("Location") if "Location" in table else np.full(len(table), path.name.partition(".")[0])
    )
    group = np.char.add(np.char.add(place, "/"), minute.astype(np.str_))
    for name in np.unique(group):
        yield _recording(path, table, group == name, str(name))


def _recording(path: Path, table: Table, mask: NDArray[np.bool_], name: str) -> Recording:
    ids, vehicle = np.unique(table.integers("Vehicle_ID")[mask], return_inverse=True)
    x, y = FOOT * table.floats("Local_Y")[mask], -FOOT * table.floats("Local_X")[mask]
    grid = on_grid(path, vehicle, PERIOD * table.floats("Frame_ID")[mask], np.stack((x, y)), len(ids))
    first = np.unique(vehicle, return_index=True)[1]
    sizes = FOOT * table.floats("v_Length")[mask]
    length = sizes[first]
    classes = [CLASSES.get(code, "") for code in table.integers("v_Class")[mask][first]]
    (xs, ys), speed = _smoothed(np.stack(grid.values), grid.present)
    yaw = path_yaw(xs, ys, grid.present, 0.0)
    return finished(
        Recording(
            name=f"ngsim/{name}",
            source=f"ngsim/{name.partition('/')[0]}",
            network=_road(name, table.integers("Lane_ID")[mask], y, (x - sizes).min(), x.max()),
            present=grid.present,
            x=xs - 0.5 * length[:, None] * np.cos(yaw),
            y=ys - 0.5 * length[:, None] * np.sin(yaw),
            yaw=yaw,
            speed=speed,
            length=length,
            width=FOOT * table.floats("v_Width")[mask][first],
            kind=tuple(kind_of(a, b) for a, b in zip(length, classes, strict=True)),
            flags=(frozenset(),) * len(ids),
        ),
        path,
    )


def savitzky_golay(values: FloatArray, derivative: int = 0) -> FloatArray:
    """[..., S] polynomial of `DEGREE` through `WINDOW` samples around each, or its ``derivative`` per sample.

    At the ends the polynomial of the first or last window is evaluated off its middle. Fewer samples than a
    window are one window.
    """
    size = values.shape[-1]
    window = min(WINDOW, size)
    degree = min(DEGREE, window - 1)
    half = window // 2
    offset = np.arange(window) - half
    # [degree + 1, window] coefficients of the polynomial per sample
    fit = np.linalg.pinv(np.vander(offset, degree + 1, increasing=True).astype(np.float64))

    def at(where: FloatArray) -> FloatArray:
        """[len(where), window] weights of the polynomial's value or derivative there."""
        powers = np.vander(where, degree + 1, increasing=True)
        for _ in range(derivative):
            powers = np.concatenate((np.zeros((len(where), 1)), powers[:, :-1] * np.arange(1, degree + 1)), 1)
        return powers @ fit

    windows = np.lib.stride_tricks.sliding_window_view(values, window, axis=-1)
    return np.concatenate(
        (
            values[..., :window] @ at(offset[:half].astype(np.float64)).T,
            windows @ at(np.zeros(1))[0],
            values[..., -window:] @ at(offset[half + 1 :].astype(np.float64)).T,
        ),
        axis=-1,
    )


def _smoothed(xy: FloatArray, present: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """[2, V, T] positions, each uninterrupted piece of a track smoothed, and [V, T] speed in m/s."""
    result, speed = np.full(xy.shape, np.nan), np.full(present.shape, np.nan)
    for v, a, b in zip(*runs(present), strict=True):
        piece = xy[:, v, a : b + 1]
        result[:, v, a : b + 1] = savitzky_golay(piece)
        speed[v, a : b + 1] = np.hypot(*savitzky_golay(piece, 1)) / PERIOD if b > a else 0.0
    return result, speed


def _road(name: str, lane: NDArray[np.int64], y: FloatArray, begin: float, end: float) -> LaneNetwork:
    """Straight lanes at the median y of the samples of each Lane_ID."""
    numbers, counts = np.unique(lane, return_counts=True)
    numbers = numbers[counts >= LANE_SHARE * len(lane)]
    centres = np.array([np.median(y[lane == k]) for k in numbers])
    order = np.argsort(centres)
    centres = centres[order]
    gaps = np.diff(centres)
    # a lane reaches to the middle between it and its neighbours
    beside = np.stack((np.append(gaps, np.nan), np.insert(gaps, 0, np.nan)))
    widths = np.nanmean(beside, 0) if len(centres) > 1 else np.full(1, LANE_WIDTHS[1])
    way = Carriageway("road", begin, end, centres, np.clip(widths, *LANE_WIDTHS))
    return straight_road(name.replace("/", "_"), [way])
