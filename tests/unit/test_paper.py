"""PAPER.md names files, functions and tests that exist."""

from __future__ import annotations

import ast
import re

import pytest

from phase_sumo import config
from tests.helpers.places import ROOT

TEXT = (ROOT / "PAPER.md").read_text(encoding="utf-8")
QUOTED = sorted(set(re.findall(r"`([^`\n]+)`", TEXT)))
FILE = re.compile(r"[\w./-]+\.(py|cpp|csv|md|json|npz)")


def defined(text: str) -> set[str]:
    """Names of functions, classes and constants of a module."""
    names: set[str] = set()
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


@pytest.mark.parametrize("quoted", [q for q in QUOTED if FILE.match(q) or q.endswith("/")])
def test_files_and_what_is_named_in_them_exist(quoted):
    name, _, member = quoted.partition(": ")
    found = [place / name for place in (ROOT, ROOT / "phase_sumo") if (place / name).exists()]
    assert found, f"{name} is neither in the clone nor in phase_sumo/"
    if member:
        assert member in defined(found[0].read_text(encoding="utf-8"))


def test_tests_are_named_in_full():
    known = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    tests = [q for q in QUOTED if q.startswith("test_")]
    assert len(tests) > 10
    assert [t for t in tests if f"def {t}(" not in known] == []


def test_configurations_exist():
    names = [q.removeprefix("config.").partition("(")[0] for q in QUOTED if q.startswith("config.")]
    assert len(names) > 3
    assert [n for n in names if not hasattr(config, n)] == []
