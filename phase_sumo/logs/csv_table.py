"""CSV files as columns, read in pieces: logs are hundreds of megabytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError

PIECE = 1 << 24  # bytes read at a time
COMMA, NEWLINE = ord(","), ord("\n")


class Table:
    """Chosen columns of a CSV file with a header line; no quoted fields. Capitals in names do not matter.

    The header is looked at at once; the lines are read when a column is first asked for.

    Args:
        path: the file.
        required: names of columns that must be there.
        optional: names of columns that are read where they are there.
        names: columns of a file without header whose fields are separated by blanks, if it is one.

    Raises:
        PhaseError: there is no such file, it is empty or a column is missing; later, it has no lines, or one
            with too many or too few fields.
    """

    def __init__(
        self,
        path: str | Path,
        required: Sequence[str],
        optional: Sequence[str] = (),
        names: Sequence[str] = (),
    ) -> None:
        self.path = Path(path)
        first = _first_line(self.path)
        self._blanks = bool(names) and "," not in first
        header = list(names) if self._blanks else [name.strip().strip('"') for name in first.split(",")]
        place = {name.lower(): k for k, name in enumerate(header)}
        missing = [name for name in required if name.lower() not in place]
        if missing:
            raise PhaseError(
                f"{path}: no column {', '.join(missing)}; it needs {', '.join(required)} and has "
                f"{', '.join(header)}"
            )
        self._place = {n: place[n.lower()] for n in (*required, *optional) if n.lower() in place}
        self._width, self._first = len(header), 1 if self._blanks else 2

    @cached_property
    def _columns(self) -> dict[str, NDArray[np.bytes_]]:
        places = list(self._place.values())
        pieces = list(_pieces(self.path, self._width, places, self._first, self._blanks))
        if not pieces:
            raise PhaseError(f"{self.path}: no line below its header; pass a file with tracks")
        return {name: np.concatenate([p[k] for p in pieces]) for k, name in enumerate(self._place)}

    def __contains__(self, name: str) -> bool:
        return name in self._place

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
            found = column[row].decode(errors="replace")
            raise PhaseError(
                f"{self.path}: line {row + self._first}: {name} = {found!r}, expected a number; mend or "
                "remove the line"
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


def _first_line(path: Path) -> str:
    try:
        with path.open("rb") as file:
            line = file.readline(1 << 16)
    except OSError as error:
        raise PhaseError(f"{path}: cannot be read ({error.strerror}); pass an existing file") from None
    if not line.strip():
        raise PhaseError(f"{path}: empty file; pass a file with a header line and tracks")
    return line.decode("utf-8-sig", errors="replace").strip()


def _pieces(
    path: Path, width: int, columns: list[int], line: int, blanks: bool
) -> Iterator[list[NDArray[np.bytes_]]]:
    """Columns of some thousands of lines at a time, as bytes; ``line`` is the number of the first."""
    with path.open("rb") as file:
        for _ in range(1, line):
            file.readline()
        rest = b""
        while True:
            block = file.read(PIECE)
            whole, _, rest = (rest + block).rpartition(b"\n") if block else (rest, b"", b"")
            if whole.strip():
                text = whole.replace(b"\r", b"").strip(b"\n") + b"\n"
                if blanks:
                    text = b"".join(b",".join(row.split()) + b"\n" for row in text.splitlines())
                piece = _columns(path, text, width, columns, line)
                line += len(piece[0])
                yield piece
            if not block:
                return


def _columns(path: Path, text: bytes, width: int, columns: list[int], line: int) -> list[NDArray[np.bytes_]]:
    """Whole lines cut at the separators, all of which are found at once."""
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
