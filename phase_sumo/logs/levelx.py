"""What exiD and highD have in common: numbered recordings of three CSV files, 25 frames a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError
from phase_sumo.logs.csv_table import Table

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
