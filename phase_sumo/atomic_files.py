"""Files that are whole or not there, whatever happens while they are written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO


@contextmanager
def whole(path: Path) -> Iterator[IO[bytes]]:
    """A file to write into: what is in it is at ``path`` when the block ends, all of it and on the disk.

    Until then, and if the block or the disk fails, what was at ``path`` is as it was.
    """
    # several processes may write the same file, e.g. the same map into one folder
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write all of a file or nothing, see `whole`."""
    with whole(path) as file:
        file.write(content)
