"""The folder of a training run: configuration, curve, checkpoint, policy."""

from __future__ import annotations

import io
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from phase_sumo.config import TrainConfig, from_dict, to_dict
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import Policy, policy_bytes
from phase_sumo.train import disk
from phase_sumo.train.curve import Curve

CONFIG, CURVE, CHECKPOINT, POLICY = "config.json", "curve.csv", "checkpoint.pt", "policy.safetensors"
LOCK = "run.lock"


class RunFolder:
    """Paths and atomic writes of one run.

    A run exists from the moment that its ``config.json`` does: then there is a checkpoint, and ``--resume``
    works, however the run is ended.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._lock = FileLock(self.path / LOCK, timeout=0)

    @property
    def policy(self) -> Path:
        return self.path / POLICY

    def claim(self, resume: bool) -> None:
        """Keep others from writing here until `release` or the end of the process, however it ends.

        Raises:
            PhaseError: another process trains here, or there is nothing to ``resume``.
        """
        if not resume:
            disk.guard(self.path / LOCK, 0, lambda: self.path.mkdir(parents=True, exist_ok=True))
        elif not self.path.is_dir():
            raise PhaseError(f"{self.path} holds no run to resume; start one without --resume")

        def take() -> None:
            try:
                self._lock.acquire()
            except Timeout:
                raise PhaseError(
                    f"{self.path}: another process trains in this folder; wait for it or name another one"
                ) from None

        disk.guard(self.path / LOCK, 0, take)
        for left in self.path.glob("*.part"):  # by a process that was killed
            left.unlink(missing_ok=True)

    def release(self) -> None:
        """Others may write here again."""
        self._lock.release()

    def start(self, config: TrainConfig, facts: dict[str, Any], checkpoint: dict[str, Any]) -> None:
        """Begin a new run at its first checkpoint; an existing run is never overwritten."""
        if (self.path / CONFIG).exists():
            raise PhaseError(
                f"{self.path} already holds a run; continue it with --resume or name another folder"
            )
        disk.write(self.path / CHECKPOINT, _checkpoint_bytes(checkpoint))
        self.configure(config, facts)

    def configure(self, config: TrainConfig, facts: dict[str, Any]) -> None:
        """Store what the run is from now on."""
        text = json.dumps({"train": to_dict(config), **facts}, indent=1)
        disk.write(self.path / CONFIG, text.encode())

    def config(self) -> TrainConfig:
        return from_dict(TrainConfig, self._described()["train"])

    def networks(self) -> list[str]:
        """Names of the maps that the run trains on."""
        return self._described()["networks"]

    def curve(self, steps: int) -> Curve:
        """The curve, cut back to ``steps``."""
        return Curve(self.path / CURVE, steps)

    def save(self, checkpoint: dict[str, Any], policy: Policy) -> None:
        disk.write(self.path / CHECKPOINT, _checkpoint_bytes(checkpoint))
        disk.write(self.policy, policy_bytes(policy))

    def load(self, adopt: Callable[[dict[str, Any]], None] = lambda stored: None) -> dict[str, Any]:
        """The checkpoint, after ``adopt`` has taken it over."""
        file = self.path / CHECKPOINT
        if not file.exists():
            raise PhaseError(f"{file}: no checkpoint to resume from; name another folder with --run")
        try:
            stored = torch.load(file, weights_only=True)
            adopt(stored)
        except (RuntimeError, OSError, EOFError, KeyError, ValueError, pickle.UnpicklingError) as error:
            reason = str(error).partition("\n")[0]
            raise PhaseError(
                f"{file}: broken, or of another version of phase_sumo ({reason}); train in another "
                f"folder, with --start-from {self.policy} to go on from its policy"
            ) from error
        return stored

    def _described(self) -> dict[str, Any]:
        try:
            return json.loads((self.path / CONFIG).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise PhaseError(f"{self.path} holds no run to resume; start one without --resume") from None


def _checkpoint_bytes(checkpoint: dict[str, Any]) -> bytes:
    # through memory: only then is its size known before the disk is touched
    buffer = io.BytesIO()
    torch.save(checkpoint, buffer)
    return buffer.getvalue()
