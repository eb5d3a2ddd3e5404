"""Distributional realism: recorded windows rolled out by several models, and all distances from the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.maps.lanelet2 import read_road
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.realism import comparison as compare
from phase_sumo.evaluate.realism.comparison import Comparison, Traffic
from phase_sumo.evaluate.realism.encoder import Encoder, Training, features, train, trajectories
from phase_sumo.evaluate.realism.quantities import (
    HISTOGRAMS,
    Quantities,
    lane_change_rate,
    likelihoods,
    quantities,
)
from phase_sumo.evaluate.realism.selection import Selection, alike, recorded, select
from phase_sumo.logs.recording import Recording
from phase_sumo.logs.sources import open_sources
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.lanes import LaneNetwork
from phase_sumo.studies.driver_models import parse_models
from phase_sumo.studies.log_rollout import roll_out_all

Progress = Callable[[float, str], None]
Draw = Callable[[Mapping[str, Any], Path], None]
SECONDS = 5.0  # length of a window
TRAINING_STEPS = 300
MAX_WINDOWS = 64  # tested, spread evenly over those that there are
LOG = "log"


@dataclass(frozen=True)
class Scene:
    """One window: the log and every model by name, on the same road."""

    recording: str
    road: LaneNetwork
    tracks: dict[str, Recording]


def realism(
    sources: Sequence[str],
    models: Sequence[str],
    out_dir: str | Path,
    *,
    encoder: str | Path | None = None,
    policy: Driver | str | Path | None = None,
    seconds: float = SECONDS,
    most: int = MAX_WINDOWS,
    seed: int = 0,
    draw: Draw | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Compare models with recorded traffic from the same initial states.

    The encoder of the embedding is trained on every second recording of each source and tested on the
    others, and written to ``encoder.safetensors``; a given one is tested on all recordings that it was not
    trained on. Windows do not overlap.

    Args:
        sources: ``tracks:FILE``, ``commonroad:DIR`` ... of recorded traffic.
        models: ``"phase"`` and car-following models of SUMO.
        out_dir: folder for the encoder and, if ``draw`` is given, ``clusters.png``.
        encoder: file of a trained one.
        policy: a loaded policy or its file; None loads the shipped one.
        seconds: length of a window; an encoder that is given has its own.
        most: windows that are tested.
        draw: draws ``result["clusters"]``, see `cluster_figure`.

    Returns:
        The command line's JSON: see `README.md`.

    Raises:
        PhaseError: a source, model or encoder cannot be used, or there is too little to compare.
    """
    chosen = parse_models(models)
    if shares := [m.name for m in chosen if ":" in m.name]:
        raise PhaseError(f"model {shares[0]!r}: all vehicles of a rollout have one model; write phase")
    driver = load_policy(policy) if policy is None or isinstance(policy, str | Path) else policy
    report = progress or (lambda share, text: None)
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    opened = open_sources(sources, read_road)
    given = None if encoder is None else Encoder.load(encoder)
    seconds = given.training.seconds if given else seconds
    known = given.training.recordings if given else None
    found = select(opened, known, seconds, most, lambda name: report(0.0, f"reading, {name}"))
    if not found.tested:
        raise PhaseError(
            f"no window of {seconds:g} s to test on: the encoder was trained on all of these recordings, or "
            "the others are shorter; pass more logs, or an --encoder of others"
        )
    trained = given or _train(found, seconds, seed, lambda share, text: report(0.5 * share, text))
    if given is None:
        trained.save(folder / "encoder.safetensors")
    scenes = []
    for window, road, tracks in roll_out_all(
        found.tested,
        [m.name for m in chosen],
        driver,
        seed,
        lambda share, text: report(0.5 + 0.4 * share, text),
    ):
        log = recorded(window)
        simulated = {name: alike(track, log) for name, track in tracks.items()}
        scenes.append(Scene(window.recording.name, road, {LOG: log} | simulated))
    report(0.9, "distances")
    result = _compared(scenes, [m.name for m in chosen], trained, seed)
    if draw:
        draw(result["clusters"], folder / "clusters.png")
    report(1.0, "")
    return {
        "logs": list(sources),
        "encoder": asdict(trained.training),
        "recordings": sorted({s.recording for s in scenes}),
        "windows": len(scenes),
        "seconds": seconds,
        **result,
    }


def _train(found: Selection, seconds: float, seed: int, progress: Progress) -> Encoder:
    size = sum(map(len, found.learnt))
    return train(found.learnt, Training(seconds, tuple(found.names), size, TRAINING_STEPS, seed), progress)


def _compared(scenes: Sequence[Scene], models: list[str], encoder: Encoder, seed: int) -> dict[str, Any]:
    whole = [[set(trajectories(s.tracks[name]).tolist()) for name in (LOG, *models)] for s in scenes]
    rows = [np.array(sorted(set.intersection(*sets)), np.int64) for sets in whole]
    lost = {name: sum(len(sets[0] - sets[k + 1]) for sets in whole) for k, name in enumerate(models)}
    measured = {name: [quantities(s.tracks[name], s.road) for s in scenes] for name in (LOG, *models)}
    traffic = {
        name: Traffic(
            np.concatenate(
                [encoder.embed(features(s.tracks[name], r)) for s, r in zip(scenes, rows, strict=True)]
            ),
            np.repeat(np.arange(len(scenes)), [len(r) for r in rows]),
            tuple(measured[name]),
        )
        for name in (LOG, *models)
    }
    weights, drawn = compare.resamples([s.recording for s in scenes], seed)
    tables: dict[str, dict[str, Any]] = {}
    spreads: dict[str, dict[str, np.ndarray]] = {}
    unbiased: dict[str, dict[str, float]] = {}
    for name in models:
        comparison = Comparison(traffic[LOG], traffic[name], _likelihoods(measured[LOG], measured[name]))
        tables[name], spreads[name] = compare.with_intervals(comparison, weights)
        unbiased[name] = comparison.unbiased_mmd()
    apart = {
        f"{models[0]} - {name}": compare.differences(
            tables[models[0]], tables[name], spreads[models[0]], spreads[name]
        )
        for name in models[1:]
    }
    shares, distances = compare.cluster_distances(
        traffic[LOG], {name: traffic[name] for name in models}, seed
    )
    once = np.ones(len(scenes))
    return {
        "trajectories": len(traffic[LOG].embedding),
        "lost": lost,
        "bootstrap": {"by": drawn, "resamples": len(weights)},
        "models": tables,
        "unbiased_mmd": unbiased,
        "differences": apart,
        "floor": compare.floor(traffic[LOG], seed),
        "log_likelihoods_of_itself": _of_itself(measured[LOG]),
        "lane_changes_per_km": {name: lane_change_rate(measured[name], once) for name in (LOG, *models)},
        "clusters": {"share": shares, "distance": distances},
    }


def _likelihoods(
    log: Sequence[Quantities], simulated: Sequence[Quantities]
) -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
    found = [likelihoods(a, b) for a, b in zip(log, simulated, strict=True)]
    window = np.repeat(np.arange(len(found)), [len(f["speed"]) for f in found])
    return {name: (np.concatenate([f[name] for f in found]), window) for name in HISTOGRAMS}


def _of_itself(log: Sequence[Quantities]) -> dict[str, float]:
    return {name: float(np.nanmean(values)) for name, (values, _) in _likelihoods(log, log).items()}
