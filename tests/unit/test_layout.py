"""What the layout promises beyond the import contracts."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

from tests.helpers.places import ROOT


def imported(path: Path) -> set[str]:
    """Modules that a file imports anywhere."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_no_file_name_occurs_twice_in_the_package():
    names = Counter(path.name for path in (ROOT / "phase_sumo").rglob("*.py") if path.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []


def test_no_test_file_imports_another():
    tests = list((ROOT / "tests").rglob("test_*.py"))
    assert len(tests) > 50
    assert [p for p in tests if any(name.split(".")[-1].startswith("test_") for name in imported(p))] == []


def opens_text(call: ast.Call) -> bool:
    """Whether a call opens a text file without saying how it is encoded."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else ""
    modes = [ast.unparse(each) for each in (*call.args, *(k.value for k in call.keywords))]
    binary = name == "open" and (any("b" in mode for mode in modes) or "str(path)" in ast.unparse(call.func))
    texts = name in ("read_text", "write_text", "open") and "gzip" not in ast.unparse(call.func)
    return texts and not binary and not any(k.arg == "encoding" for k in call.keywords)


def test_text_files_are_utf8_in_any_locale():
    paths = [path for room in ("phase_sumo", "tools") for path in (ROOT / room).rglob("*.py")]
    assert [
        f"{path}:{node.lineno}"
        for path in paths
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and opens_text(node)
    ] == []


def test_tools_need_neither_the_command_line_nor_path_tricks():
    tools = list((ROOT / "tools").rglob("*.py"))
    assert len(tools) > 15
    assert [p for p in tools if any(n.startswith("phase_sumo.cli") for n in imported(p))] == []
    assert [p for p in tools if "sys.path" in p.read_text(encoding="utf-8")] == []
