"""The one exception that stands for bad input."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class PhaseError(Exception):
    """Bad input from a person: the message names the thing, the value and the remedy.

    The command line prints it as one line and exits with status 2; everything else that escapes is a
    defect of ours and keeps its traceback under ``--debug``.
    """


class Diverged(PhaseError):
    """Training left the finite numbers."""


def nearest(name: str, known: Iterable[str], before: str = "") -> str:
    """``"; did you mean --seed or --end?"`` for a mistyped name, nothing when no known one resembles it."""
    by_lower = {each.lower(): each for each in known}
    found = [by_lower[each] for each in get_close_matches(name.lower(), by_lower, n=3, cutoff=0.6)]
    return f"; did you mean {' or '.join(before + each for each in found)}?" if found else ""
