"""The folder of a training run: configuration, curve, checkpoint, best policy; every write is atomic."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from phase_sumo.config import TrainConfig, from_dict, to_dict
from phase_sumo.errors import PhaseError

CONFIG, CURVE, CHECKPOINT, POLICY = "config.json", "curve.csv", "checkpoint.pt", "policy.safetensors"


class RunFolder:
    """Paths and atomic writes of one run."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def policy(self) -> Path:
        return self.path / POLICY

    def start(self, config: TrainConfig, facts: dict[str, Any]) -> None:
        """Begin a new run; an existing one is never overwritten."""
        if (self.path / CHECKPOINT).exists() or (self.path / CURVE).exists():
            raise PhaseError(
                f"{self.path} already holds a run; continue it with --resume or name another folder"
            )
        self.path.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"train": to_dict(config), **facts}, indent=1)
        self._write(CONFIG, lambda target: target.write_text(text))

    def config(self) -> TrainConfig:
        try:
            return from_dict(TrainConfig, json.loads((self.path / CONFIG).read_text())["train"])
        except FileNotFoundError:
            raise PhaseError(f"{self.path} holds no run to resume; start one without --resume") from None

    def save(self, checkpoint: dict[str, Any], rows: list[dict[str, float]]) -> None:
        """Store a checkpoint and the whole curve up to it."""
        self._write(CHECKPOINT, lambda target: torch.save(checkpoint, target))
        columns = list(dict.fromkeys(key for row in rows for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, restval="")
        writer.writeheader()
        writer.writerows([{k: f"{v:.6g}" for k, v in row.items()} for row in rows])
        self._write(CURVE, lambda target: target.write_text(text.getvalue()))

    def load(self) -> dict[str, Any]:
        file = self.path / CHECKPOINT
        if not file.exists():
            raise PhaseError(f"{file}: no checkpoint to resume from; start the run without --resume")
        return torch.load(file, weights_only=True)

    def _write(self, name: str, write: Callable[[Path], Any]) -> None:
        temporary = self.path / (name + ".part")
        try:
            write(temporary)
            os.replace(temporary, self.path / name)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise PhaseError(
                f"{self.path / name}: cannot be written ({error.strerror}); the last checkpoint is intact, "
                "free some space and continue with --resume"
            ) from error
