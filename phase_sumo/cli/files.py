"""Files named on the command line, JSON results, and the progress bar."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import phase_sumo
from phase_sumo.atomic_files import write_whole
from phase_sumo.errors import PhaseError

CLONE = Path(phase_sumo.__file__).resolve().parent.parent
DEMO = CLONE / "scenarios" / "merge" / "merge.sumocfg"
HELD_OUT = CLONE / "networks" / "held_out"
TUNE_TABLE = Path(phase_sumo.__file__).parent / "train" / "tune.csv"
NETWORKS = (".net.xml", ".net.xml.gz", ".osm", ".osm.gz", ".xodr", ".xodr.gz")
Progress = Callable[[float, str], None]


def find_files(paths: list[str], endings: tuple[str, ...]) -> list[Path]:
    """Files named directly, and those with one of the endings in folders."""
    found: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.endswith(endings))
            if not inside:
                raise PhaseError(f"{path}: no file ending in {' or '.join(endings)} in this folder")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise PhaseError(f"{path}: no such file or folder")
    return found


def load_maps(paths: list[str], keep: Path | None) -> list[Any]:
    """Map bundles from ``.npz`` files, or from road networks converted now (into ``keep``, if given)."""
    from phase_sumo.sim.bundle import load_bundle

    maps = []
    for path in find_files(paths, (".npz", *NETWORKS)):
        if path.suffix == ".npz":
            maps.append(load_bundle(path))
            continue
        from phase_sumo.bridge.maps.convert import read_stretches

        maps += [_converted(network, keep) for network in read_stretches(path)]
    return maps


def _converted(network: Any, keep: Path | None) -> Any:
    from phase_sumo.bridge.maps.convert import build_bundle, load_or_build
    from phase_sumo.sim.bundle import load_key, save_bundle

    if keep is None:
        return build_bundle(network)
    bundle, path = load_or_build(network, keep), keep / f"{network.name}.npz"
    if load_key(path) != bundle.key:
        save_bundle(path, bundle)
    return bundle


def write_json(path: Path, result: Any) -> None:
    try:
        write_whole(path, (json.dumps(result, indent=1) + "\n").encode())
    except OSError as error:
        raise PhaseError(
            f"{path}: cannot be written ({error.strerror}); choose another --json file"
        ) from None


def held_out_maps() -> list[Any]:
    """The maps of the public benchmark, converted now."""
    if not HELD_OUT.is_dir():
        raise PhaseError(
            f"{HELD_OUT}: the benchmark's networks come with a clone of the project; run it from one"
        )
    return load_maps([str(HELD_OUT)], None)


@contextmanager
def progress_bar(title: str, show: bool = True) -> Iterator[Progress]:
    """A progress bar on stderr, gone when done; nothing where there is no terminal to draw on."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[title]}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not (show and console.is_terminal)
    ) as bar:
        task = bar.add_task("", total=1.0, title=title)
        yield lambda share, text: bar.update(task, completed=share, description=text)
