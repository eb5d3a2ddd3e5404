"""The table of SUMO's features names a test for each, and every one of them exists."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
TABLE = ROOT / "docs" / "sumo-features.md"


def rows() -> list[list[str]]:
    lines = [line for line in TABLE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] != "feature" and set(row[0]) != {"-"}]


def test_every_feature_has_a_test_that_exists():
    assert len(rows()) > 50
    for row in rows():
        assert len(row) == 3, row
        path, _, name = row[2].strip("`").partition("::")
        assert re.search(rf"^def {name}\(", (ROOT / path).read_text(encoding="utf-8"), re.M), row


def test_every_feature_is_driven_left_or_refused():
    words = ("driven", "left to SUMO", "refused", "passed", "warned about", "the scenario's", "SUMO drives")
    assert not [row for row in rows() if not any(word in row[1] for word in (*words, "as above"))]
