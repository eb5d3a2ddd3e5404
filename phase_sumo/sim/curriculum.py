"""Curriculum progress rho, which drives the reward and the scenario curriculum (paper: Curricula)."""

from __future__ import annotations


def curriculum_progress(steps: float, total: float, start: float, end: float) -> float:
    """rho in [0, 1]: 0 until the share ``start`` of training, then linear, 1 from the share ``end`` on.

    Args:
        steps: agent steps so far.
        total: agent steps of the whole training.
        start, end: shares of ``total``, start < end; infinite for a rho that stays 0.
    """
    if total <= 0 or steps < start * total:
        return 0.0
    return min(max((steps / total - start) / (end - start), 0.0), 1.0)
