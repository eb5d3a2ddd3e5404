"""Optuna study over the training configuration, judged by the held-out goal rate.

The study is a journal file in its folder. Whoever runs the same command on that folder, now or later, on this
machine or on another that shares it, adds trials to the same study.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phase_sumo.config import TrainConfig
from phase_sumo.errors import Diverged, PhaseError
from phase_sumo.sim.bundle import MapBundle
from phase_sumo.train.loop import Trainer
from phase_sumo.train.run_folder import RunFolder

JOURNAL = "study.journal"
JUDGED = 10  # evaluations of a trial at which it may be pruned; the last one is its result
MEASURE = "held_out_goal_rate"


@dataclass(frozen=True)
class Range:
    """One row of the table: a setting of `TrainConfig`, dotted where nested, and where it may lie."""

    setting: str
    low: float
    high: float
    log: bool


def read_table(path: Path, config: TrainConfig) -> list[Range]:
    """Rows of a table with the columns setting, low, high and scale (linear or log)."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            ranges = [_range(path, row) for row in csv.DictReader(file)]
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror}); name a table of settings") from None
    if not ranges:
        raise PhaseError(f"{path}: no settings to tune; add rows with setting, low, high, scale")
    for r in ranges:
        changed(config, r.setting, r.low)
    return ranges


def _range(path: Path, row: dict[str, str]) -> Range:
    try:
        found = Range(row["setting"], float(row["low"]), float(row["high"]), row["scale"] == "log")
        lowest = 0.0 if found.log else -math.inf
        if row["scale"] not in ("linear", "log") or not lowest < found.low < found.high < math.inf:
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise PhaseError(
            f"{path}: {row} is no range; write setting, low < high, and scale linear or log (then low > 0)"
        ) from None
    return found


def changed(config: Any, setting: str, value: float) -> Any:
    """A copy of a config with one number changed, ``setting`` being dotted where nested."""
    name, _, rest = setting.partition(".")
    old = getattr(config, name, None)
    if rest and dataclasses.is_dataclass(old):
        return dataclasses.replace(config, **{name: changed(old, rest, value)})
    if rest or isinstance(old, bool) or not isinstance(old, int | float):
        raise PhaseError(f"{type(config).__name__} has no number {setting!r} to tune")
    return dataclasses.replace(config, **{name: round(value) if isinstance(old, int) else value})


def tune(
    folder: Path,
    config: TrainConfig,
    maps: list[MapBundle],
    held_out: list[MapBundle],
    trials: int,
    table: Path,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> dict[str, Any]:
    """Add trials to the study in ``folder``; each keeps its run in a folder of its own there.

    A trial is stopped when its held-out goal rate is below the median of those before at the same step.

    Returns:
        JSON types: ``trials`` in the study, of which ``pruned``, and of the best one ``goal_rate``,
        ``settings`` and ``policy``.
    """
    optuna = _optuna()
    ranges = read_table(table, config)
    if not held_out:
        raise PhaseError("tuning needs networks to judge on; name some with --held-out")
    config = dataclasses.replace(config, held_out_every=max(1, config.total_steps // JUDGED))
    study = _study(optuna, folder, config.seed)

    def objective(trial: Any) -> float:
        mine = config
        for r in ranges:
            mine = changed(mine, r.setting, trial.suggest_float(r.setting, r.low, r.high, log=r.log))
        rates: list[float] = []

        def judge(row: dict[str, float]) -> None:
            progress(row["steps"] / config.total_steps, f"trial {trial.number}  {MEASURE} {rates[-1:]}")
            if MEASURE in row:
                rates.append(row[MEASURE])
                trial.report(rates[-1], len(rates))
                if trial.should_prune():
                    raise optuna.TrialPruned

        Trainer(mine, maps, held_out, _run(folder, trial.number)).run(judge)
        return rates[-1]

    study.optimize(objective, n_trials=trials, catch=Diverged)
    pruned = sum(trial.state == optuna.trial.TrialState.PRUNED for trial in study.trials)
    best = study.best_trial
    return {
        "trials": len(study.trials),
        "pruned": pruned,
        "goal_rate": best.value,
        "settings": best.params,
        "policy": str(_run(folder, best.number).policy),
    }


def _run(folder: Path, number: int) -> RunFolder:
    return RunFolder(folder / f"trial_{number:04d}")


def _study(optuna: Any, folder: Path, seed: int) -> Any:
    folder.mkdir(parents=True, exist_ok=True)
    journal = importlib.import_module("optuna.storages.journal")
    storage = optuna.storages.JournalStorage(journal.JournalFileBackend(str(folder / JOURNAL)))
    pruner = optuna.pruners.MedianPruner(n_startup_trials=4, n_warmup_steps=2)
    study = optuna.create_study(
        storage=storage, study_name="tune", direction="maximize", load_if_exists=True, pruner=pruner
    )
    # whoever joins later draws other numbers
    study.sampler = optuna.samplers.TPESampler(seed=seed + len(study.trials))
    return study


def _optuna() -> Any:
    try:
        optuna = importlib.import_module("optuna")
    except ImportError:
        raise PhaseError("tune needs Optuna; install it with: pip install 'phase-sumo[tune]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
