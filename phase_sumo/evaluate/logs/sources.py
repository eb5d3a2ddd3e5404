"""Recorded traffic by name: ``KIND:PATH`` -> recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.logs.commonroad import read_commonroad
from phase_sumo.evaluate.logs.recording import Recording
from phase_sumo.evaluate.logs.tracks import read_tracks
from phase_sumo.sim.lanes import LaneNetwork

Reader = Callable[[Path, "LaneNetwork | None"], list[Recording]]


def open_source(text: str, network: LaneNetwork | None = None) -> list[Recording]:
    """All recordings of a source such as ``tracks:FILE`` or ``commonroad:DIR``.

    Args:
        text: kind, colon, file or folder.
        network: the road, for kinds that come without one; others use their own.

    Raises:
        PhaseError: no such kind or path, or a file in it is damaged.
    """
    kind, colon, place = text.partition(":")
    if not colon or kind not in READERS:
        raise PhaseError(
            f"{text}: no such source of recordings; pass {', '.join(f'{k}:PATH' for k in READERS)}"
        )
    path = Path(place)
    if not place or not path.exists():
        raise PhaseError(f"{text}: no such file or folder {place!r}; pass an existing one")
    return READERS[kind](path, network)


def _commonroad(path: Path, network: LaneNetwork | None) -> list[Recording]:
    if not path.is_dir():
        return [read_commonroad(path)]
    files = sorted(p for p in path.iterdir() if p.suffix in (".xml", ".pb"))
    if not files:
        raise PhaseError(f"{path}: no CommonRoad scenario (.xml or .pb) in this folder")
    return [read_commonroad(file) for file in files]


def _tracks(path: Path, network: LaneNetwork | None) -> list[Recording]:
    if path.is_dir():
        raise PhaseError(f"{path}: is a folder; pass one CSV file of tracks")
    return read_tracks(path, network)


READERS: dict[str, Reader] = {"commonroad": _commonroad, "tracks": _tracks}
