"""The curve in TensorBoard, where that is installed."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from phase_sumo.train import disk

FOLDER = "tensorboard"
POINT_BYTES = 64  # about what a value takes in the log
GROUPS = ("reward", "held_out")  # columns that begin so get a section of their own


class TensorBoardLog:
    """Every column of the curve over agent steps, in a folder of its own; does nothing if not installed.

    Args:
        run: folder of the run.
        steps: where the run continues; points behind it, left by a crash, are purged.
    """

    def __init__(self, run: Path, steps: int) -> None:
        self._folder = run / FOLDER
        self._steps = steps
        self._writer: Any = None

    def __enter__(self) -> TensorBoardLog:
        make = _summary_writer()
        if make is not None:
            disk.guard(self._folder, POINT_BYTES, lambda: self._open(make))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._writer is not None:
            # nothing is left to write, and what ended the training matters more than a log that is broken too
            with contextlib.suppress(OSError):
                self._writer.close()

    def add(self, row: dict[str, float]) -> None:
        """Log a row; all of it is in the file when this returns, so that a kill leaves no gap."""
        if self._writer is not None:
            needed = POINT_BYTES * len(row)
            disk.guard(self._folder, needed, lambda: self._put(row, needed))

    def _open(self, make: Any) -> None:
        # TensorBoard reads the files by name, and those of one second in no order: points would be lost
        while any(self._folder.glob(f"*.tfevents.{int(time.time())}.*")):
            time.sleep(0.05)
        self._writer = make(str(self._folder), purge_step=self._steps + 1)

    def _put(self, row: dict[str, float], needed: int) -> None:
        if shutil.disk_usage(self._folder).free < needed:
            # the writer's own thread would notice too late and print a traceback
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        for name, value in row.items():
            self._writer.add_scalar(_tag(name), value, row["steps"])
        self._writer.flush()


def installed() -> bool:
    return _summary_writer() is not None


def _summary_writer() -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter


def _tag(column: str) -> str:
    """Section and name in TensorBoard."""
    for group in GROUPS:
        if column.startswith(group + "_"):
            return f"{group}/{column.removeprefix(group + '_')}"
    return f"training/{column}"
