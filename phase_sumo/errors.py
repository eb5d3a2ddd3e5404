"""The one exception that stands for bad input."""

from __future__ import annotations


class PhaseError(Exception):
    """Bad input from a person: the message names the thing, the value and the remedy.

    The command line prints it as one line and exits with status 2; everything else that escapes is a
    defect of ours and keeps its traceback under ``--debug``.
    """


class Diverged(PhaseError):
    """Training left the finite numbers."""
