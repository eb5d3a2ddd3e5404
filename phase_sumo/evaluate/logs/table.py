"""CSV files as columns, read in pieces: logs are hundreds of megabytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError

PIECE = 1 << 24  # bytes read at a time
COMMA, NEWLINE = ord(","), ord("\n")


class Table:
    """Chosen columns of a CSV file with a header line; no quoted fields.

    Args:
        path: the file.
        required: names of columns that must be there.
        optional: names of columns that are read where they are there.

    Raises:
        PhaseError: there is no such file, it is empty, a column is missing or a line has too many or too few
            fields.
    """

    def __init__(self, path: str | Path, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        self.path = Path(path)
        self.header = _header(self.path)
        missing = [name for name in required if name not in self.header]
        if missing:
            raise PhaseError(
                f"{path}: no column {', '.join(missing)}; it needs {', '.join(required)} and has "
                f"{', '.join(self.header)}"
            )
        wanted = [name for name in (*required, *optional) if name in self.header]
        pieces = list(_pieces(self.path, len(self.header), [self.header.index(name) for name in wanted]))
        if not pieces:
            raise PhaseError(f"{path}: no line below its header; pass a file with tracks")
        self._columns = {name: np.concatenate([p[k] for p in pieces]) for k, name in enumerate(wanted)}

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def __len__(self) -> int:
        return len(next(iter(self._columns.values())))

    def text(self, name: str) -> NDArray[np.str_]:
        """[rows] a column as it is written."""
        return np.char.strip(self._columns[name].astype(np.str_))

    def floats(self, name: str) -> NDArray[np.float64]:
        """[rows] a column of numbers.

        Raises:
            PhaseError: one is not a finite number.
        """
        column = self._columns[name]
        try:
            values = column.astype(np.float64)
        except ValueError:
            values = np.array([_number(v) for v in column])
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise PhaseError(
                f"{self.path}: line {row + 2}: {name} = {column[row].decode(errors='replace')!r}, expected a "
                "number; mend or remove the line"
            )
        return values

    def integers(self, name: str) -> NDArray[np.int64]:
        """[rows] a column of whole numbers, also where they are written as 7.0."""
        return np.rint(self.floats(name)).astype(np.int64)


def _number(value: bytes) -> float:
    try:
        return float(value)
    except ValueError:
        return np.nan


def _header(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            line = file.readline(1 << 16)
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror}); pass an existing file") from None
    if not line.strip():
        raise PhaseError(f"{path}: empty file; pass a file with a header line and tracks")
    return [name.strip().strip('"') for name in line.decode("utf-8-sig", errors="replace").split(",")]


def _pieces(path: Path, width: int, columns: list[int]) -> Iterator[list[NDArray[np.bytes_]]]:
    """Columns of some thousands of lines at a time, as bytes."""
    with path.open("rb") as file:
        file.readline()
        rest, line = b"", 2
        while block := file.read(PIECE):
            whole, newline, rest = (rest + block).rpartition(b"\n")
            if newline:
                piece = _columns(path, whole + b"\n", width, columns, line)
                line += len(piece[0])
                yield piece
        if rest.strip():
            yield _columns(path, rest + b"\n", width, columns, line)


def _columns(path: Path, text: bytes, width: int, columns: list[int], line: int) -> list[NDArray[np.bytes_]]:
    """Whole lines cut at the separators, all of which are found at once."""
    if b"\r" in text:
        text = text.replace(b"\r", b"")
    text = text.strip(b"\n") + b"\n"
    raw = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero((raw == COMMA) | (raw == NEWLINE))
    lines = np.flatnonzero(raw[ends] == NEWLINE)
    fields = np.diff(lines, prepend=-1)
    if (fields != width).any():
        wrong = int(np.flatnonzero(fields != width)[0])
        raise PhaseError(
            f"{path}: line {line + wrong} has {fields[wrong]} fields, its header {width}; "
            "mend or remove the line"
        )
    begins = np.concatenate(([0], ends[:-1] + 1)).reshape(-1, width)
    ends = ends.reshape(-1, width)
    return [_field(raw, begins[:, k], ends[:, k]) for k in columns]


def _field(raw: NDArray[np.uint8], begin: NDArray[np.int64], end: NDArray[np.int64]) -> NDArray[np.bytes_]:
    size = end - begin
    longest = max(int(size.max()), 1)
    place = np.arange(longest)
    characters = raw[np.minimum(begin[:, None] + place, len(raw) - 1)]
    characters[place >= size[:, None]] = 0
    return np.ascontiguousarray(characters).view(f"S{longest}")[:, 0]
