"""Files of a run: whole or not there, whatever happens while they are written; one message if it fails."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from phase_sumo.atomic_files import write_whole
from phase_sumo.errors import PhaseError

FULL = (errno.ENOSPC, errno.EDQUOT)


def write(path: Path, data: bytes) -> None:
    """Write all of ``data`` or nothing, see `atomic_files.whole`.

    Raises:
        PhaseError: it cannot be written; what was at ``path`` is intact.
    """
    guard(path, len(data), lambda: write_whole(path, data))


def append(path: Path, data: bytes) -> None:
    """Add ``data`` to the end of ``path``; the system has all of it when this returns."""

    def add() -> None:
        with path.open("ab") as file:
            file.write(data)

    guard(path, len(data), add)


def sync(path: Path) -> None:
    """Wait until what was appended to ``path`` is on the disk."""

    def flush() -> None:
        with path.open("rb") as file:
            os.fsync(file.fileno())

    guard(path, path.stat().st_size, flush)


def guard(path: Path, needed: int, work: Callable[[], object]) -> None:
    """Do ``work`` that puts ``needed`` bytes into ``path``; what the system refuses becomes one message."""
    try:
        work()
    except OSError as error:
        folder = path.parent
        existing = next(p for p in (folder, *folder.resolve().parents) if p.exists())
        free = shutil.disk_usage(existing).free
        remedy = "free some space there" if error.errno in FULL else "make the folder writable"
        raise PhaseError(
            f"{folder}: {path.name} cannot be written ({error.strerror or error}): {needed:,} bytes needed, "
            f"{free:,} free; the last checkpoint is intact: {remedy} and continue with --resume"
        ) from error
