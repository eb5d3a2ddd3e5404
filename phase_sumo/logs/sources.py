"""Recorded traffic by name: ``KIND:PATH`` -> recordings, one at a time: a data set need not fit in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from phase_sumo.errors import PhaseError
from phase_sumo.logs.commonroad import file_reader, read_commonroad
from phase_sumo.logs.levelx import (
    ExidRoads,
    RoadReader,
    check_exid,
    drone_files,
    highd_files,
    read_exid,
    read_highd,
)
from phase_sumo.logs.ngsim import read_ngsim
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.tracks import read_tracks

# path of the log, path of a map or None, what reads maps or None
Reader = Callable[[Path, "Path | None", "RoadReader | None"], Iterator[Recording]]


def open_sources(texts: Sequence[str], road: RoadReader | None = None) -> list[Iterator[Recording]]:
    """Every source by `open_source`, all before the first is read.

    Recordings of two sources may have one name, as files in different folders do; the later one's source is
    put before its own, since results are bootstrapped by recordings, and encoders know theirs, by name.
    """
    source_of: dict[str, int] = {}

    def told_apart(source: int, recording: Recording) -> Recording:
        if source_of.setdefault(recording.name, source) == source:
            return recording
        return replace(recording, name=f"{texts[source]}: {recording.name}")

    return [map(partial(told_apart, k), open_source(text, road)) for k, text in enumerate(texts)]


def open_source(text: str, road: RoadReader | None = None) -> Iterator[Recording]:
    """The recordings of a source, ``KIND:PATH`` or ``KIND:PATH@MAP``, each read when it is asked for.

    Whatever can be known without reading a track (paths, headers, maps) is checked at once.

    Args:
        text: kind, one of `READERS`; file or folder; and for the kinds that take one (tracks, exid) a map
            file. exiD's own maps are found without it.
        road: reads map files, which nothing here can; the bridge's ``maps.lanelet2.read_road`` does.

    Raises:
        PhaseError: no such kind or path, or a column or map is missing; later, a file is damaged.
    """
    kind, colon, rest = text.partition(":")
    if not colon or kind not in READERS:
        raise PhaseError(
            f"{text}: no such source of recordings; pass {', '.join(f'{k}:PATH' for k in READERS)}"
        )
    place, _, map_place = rest.partition("@")
    path, map_path = Path(place), Path(map_place) if map_place else None
    for asked, name in ((path, place), (map_path, map_place)):
        if asked is not None and not (name and asked.exists()):
            raise PhaseError(f"{text}: no such file or folder {name!r}; pass an existing one")
    return map(Recording.near_origin, READERS[kind](path, map_path, road))


def _commonroad(path: Path, map_path: Path | None, road: RoadReader | None) -> Iterator[Recording]:
    _without_map("commonroad", map_path)
    files = [path] if path.is_file() else sorted(p for p in path.iterdir() if p.suffix in (".xml", ".pb"))
    if not files:
        raise PhaseError(
            f"{path}: no CommonRoad scenario (.xml or .pb) in this folder; pass the one that holds them"
        )
    file_reader(path)
    return map(read_commonroad, files)


def _exid(path: Path, map_path: Path | None, road: RoadReader | None) -> Iterator[Recording]:
    if road is None:
        raise PhaseError(f"exid:{path}: the road is in a map file; pass what reads those")
    files = drone_files(path)
    roads = ExidRoads(map_path or (path if path.is_dir() else path.parent), road)
    for file in files:
        check_exid(file, roads)
    return (read_exid(file, roads) for file in files)


def _highd(path: Path, map_path: Path | None, road: RoadReader | None) -> Iterator[Recording]:
    _without_map("highd", map_path)
    files = drone_files(path)
    for file in files:
        highd_files(file)
    return map(read_highd, files)


def _ngsim(path: Path, map_path: Path | None, road: RoadReader | None) -> Iterator[Recording]:
    _without_map("ngsim", map_path)
    return read_ngsim(_one_file(path))


def _tracks(path: Path, map_path: Path | None, road: RoadReader | None) -> Iterator[Recording]:
    if map_path is not None and road is None:
        raise PhaseError(f"tracks:{path}@{map_path}: pass what reads map files")
    return read_tracks(_one_file(path), None if map_path is None or road is None else road(map_path, None))


def _one_file(path: Path) -> Path:
    if path.is_dir():
        raise PhaseError(f"{path}: is a folder; pass one file of tracks")
    return path


def _without_map(kind: str, map_path: Path | None) -> None:
    if map_path is not None:
        raise PhaseError(f"{kind}:…@{map_path}: this kind brings its own road; leave out @{map_path}")


READERS: dict[str, Reader] = {
    "commonroad": _commonroad,
    "exid": _exid,
    "highd": _highd,
    "ngsim": _ngsim,
    "tracks": _tracks,
}
