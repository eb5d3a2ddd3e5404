"""Reading back what a training run has logged."""

from __future__ import annotations

import csv
from pathlib import Path


def read_curve(run: Path) -> list[dict[str, str]]:
    if not (run / "curve.csv").exists():
        return []
    with (run / "curve.csv").open() as file:
        return list(csv.DictReader(file))


def read_tensorboard(run: Path) -> dict[str, list[int]]:
    """The steps of the points of every tag, as TensorBoard shows them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [event.step for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
