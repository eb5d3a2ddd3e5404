"""The curve of a run: a table that grows by a row per update and can be cut back to a checkpoint."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from phase_sumo.train import disk

Cells = dict[str, str]


class Curve:
    """The CSV file at ``path``, up to ``steps`` agent steps.

    Rows are appended as they come, so after a crash some lie behind the last checkpoint, and the last one
    may be torn. They are cut off here, and the continued run makes them again.

    Attributes:
        last: the latest row, empty before the first.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self._path = path
        rows = [row for row in self._read() if float(row["steps"]) <= steps]
        self._columns = list(rows[0]) if rows else []
        self.last = {name: float(cell) for name, cell in rows[-1].items() if cell} if rows else {}
        if path.exists():
            self._rewrite(rows)

    def add(self, row: dict[str, float]) -> None:
        """Append a row; columns that come for the first time (held-out rates) widen the table."""
        new = [name for name in row if name not in self._columns]
        if new:
            rows = self._read()
            self._columns += new
            self._rewrite(rows)
        disk.append(self._path, self._text([{name: _cell(value) for name, value in row.items()}]))
        self.last = row

    def sync(self) -> None:
        """Wait until all rows are on the disk: a checkpoint must not outlive the curve that leads to it."""
        if self._path.exists():
            disk.sync(self._path)

    def _read(self) -> list[Cells]:
        if not self._path.exists():
            return []
        whole, _, _ = self._path.read_text(encoding="utf-8").rpartition(
            "\n"
        )  # what follows the last line's end is torn
        return list(csv.DictReader(whole.splitlines()))

    def _rewrite(self, rows: list[Cells]) -> None:
        header = {name: name for name in self._columns}
        disk.write(self._path, self._text([header, *rows]) if header else b"")

    def _text(self, rows: list[Cells]) -> bytes:
        text = io.StringIO()
        csv.DictWriter(text, self._columns, restval="", lineterminator="\n").writerows(rows)
        return text.getvalue().encode()


def _cell(value: float) -> str:
    """Counts in full, since a cut goes by them; measurements to six digits."""
    return str(value) if isinstance(value, int) else f"{value:.6g}"
