"""Search by the cross-entropy method (Rubinstein 1999) over numbers in [0, 1] and choices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from phase_sumo.arrays import FloatArray

POPULATION = 16  # candidates per generation
ELITE = 4  # of them, from which the next generation is drawn
SMOOTHING = 0.7  # weight of the new distribution
LEAST_SPREAD = 0.05  # of a number, lest the search stands still
LEAST_SHARE = 0.05  # of a choice, shared among its options


@dataclass(frozen=True)
class Candidate:
    """A point of the search space: ``numbers`` [n] in [0, 1] and ``choices`` [m], indices of options."""

    numbers: tuple[float, ...]
    choices: tuple[int, ...]


def minimise(
    score: Callable[[Candidate], float],
    numbers: int,
    options: Sequence[int],
    budget: int,
    seed: int,
) -> list[tuple[Candidate, float]]:
    """All candidates that were tried, in order, with their scores; the seed fixes them.

    The first generation is drawn evenly. Each later one is drawn from normal distributions and shares that
    are fitted to the `ELITE` best of all so far.

    Args:
        score: to be made small; inf for what is of no use.
        numbers: how many numbers a candidate has.
        options: how many options each of its choices has.
        budget: candidates in all.
    """
    draw = np.random.default_rng(seed)
    mean, spread = np.full(numbers, 0.5), np.full(numbers, np.inf)
    shares = [np.full(n, 1.0 / n) for n in options]
    tried: list[tuple[Candidate, float]] = []
    while len(tried) < budget:
        for _ in range(min(POPULATION, budget - len(tried))):
            candidate = _drawn(mean, spread, shares, draw)
            tried.append((candidate, score(candidate)))
        useful = sorted((t for t in tried if np.isfinite(t[1])), key=lambda t: t[1])[:ELITE]
        if not useful:
            continue
        best = np.array([c.numbers for c, _ in useful]).reshape(len(useful), numbers)
        first = ~np.isfinite(spread)
        mean = np.where(first, best.mean(0), SMOOTHING * best.mean(0) + (1 - SMOOTHING) * mean)
        new = np.maximum(best.std(0), LEAST_SPREAD)
        spread = np.where(first, new, SMOOTHING * new + (1 - SMOOTHING) * np.where(first, 0.0, spread))
        shares = [_fitted(share, [c.choices[k] for c, _ in useful]) for k, share in enumerate(shares)]
    return tried


def _drawn(
    mean: FloatArray, spread: FloatArray, shares: list[FloatArray], draw: np.random.Generator
) -> Candidate:
    even, normal = draw.random(len(mean)), draw.standard_normal(len(mean))
    first = ~np.isfinite(spread)
    values = np.where(first, even, np.clip(mean + np.where(first, 0.0, spread) * normal, 0.0, 1.0))
    return Candidate(tuple(values.tolist()), tuple(int(draw.choice(len(share), p=share)) for share in shares))


def _fitted(share: FloatArray, chosen: list[int]) -> FloatArray:
    counted = np.bincount(chosen, minlength=len(share)) / len(chosen)
    mixed = SMOOTHING * counted + (1 - SMOOTHING) * share
    return (1 - LEAST_SHARE) * mixed + LEAST_SHARE / len(share)
