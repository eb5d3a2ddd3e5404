"""Many recorded windows driven on in SUMO by several models."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.evaluate.realism.places import places
from phase_sumo.logs.recording import PERIOD, Recording, Window
from phase_sumo.logs.road_extension import extended
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.studies.log_road import write_road
from phase_sumo.studies.log_rollout import roll_out

BEFORE, ROOM = 60.0, 60.0  # m of road added before the recorded stretch, and after it beyond the farthest way
FASTEST = 45.0  # m/s


def roll_out_all(
    windows: Sequence[Window],
    models: Sequence[str],
    driver: Driver | None,
    seed: int,
    progress: Callable[[float, str], None],
) -> Iterator[tuple[Window, LaneNetwork, dict[str, Recording]]]:
    """Every window, its road with room beyond its ends, and its agents' tracks by model (see `roll_out`).

    Windows come road by road, since each is made once.
    """
    by_road: dict[int, list[Window]] = {}
    for window in windows:
        by_road.setdefault(id(window.recording.network), []).append(window)
    done = 0
    for of_road in by_road.values():
        after = ROOM + FASTEST * max(w.steps for w in of_road) * PERIOD
        road = extended(of_road[0].recording.network, BEFORE, after)
        with tempfile.TemporaryDirectory(prefix="phase_sumo_") as temporary:
            sumo = write_road(road, Path(temporary))
            for window in of_road:
                progress(done / len(windows), f"rollouts, {window.recording.name}")
                done += 1
                where = places(window.recording, road)
                yield window, road, {m: roll_out(window, sumo, where, m, driver, seed) for m in models}
