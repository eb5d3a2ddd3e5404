"""Behaviour clusters of the recorded embeddings, and how far each model's centroid is from the recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phase_sumo.errors import PhaseError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ROUNDS = 100
STARTS = 8


def k_means(points: FloatArray, clusters: int, seed: int = 0) -> FloatArray:
    """[clusters, D] centroids by Lloyd's algorithm from k-means++ starts, the best of `STARTS`.

    The largest cluster comes first.

    Raises:
        PhaseError: there are fewer points than clusters.
    """
    if len(points) < clusters:
        raise PhaseError(f"{len(points)} trajectories cannot make {clusters} clusters; pass more logs")
    rng = np.random.default_rng(seed)
    found = [_lloyd(points, _plus_plus(points, clusters, rng)) for _ in range(STARTS)]
    best = min(found, key=lambda centres: _squared(points, centres).min(1).sum())
    size = np.bincount(assigned(points, best), minlength=clusters)
    return best[np.argsort(-size, kind="stable")]


def assigned(points: FloatArray, centroids: FloatArray) -> IntArray:
    """[n] the nearest centroid of each point."""
    return _squared(points, centroids).argmin(1)


def centroid_distances(points: FloatArray, centroids: FloatArray) -> FloatArray:
    """[clusters] distance of each centroid from the mean of the points nearest to it; NaN where none is."""
    nearest = assigned(points, centroids)
    distance = np.full(len(centroids), np.nan)
    for k in np.unique(nearest).tolist():
        distance[k] = np.linalg.norm(points[nearest == k].mean(0) - centroids[k])
    return distance


def _squared(points: FloatArray, centroids: FloatArray) -> FloatArray:
    """[n, clusters] squared distances."""
    cross = points @ centroids.T
    return np.maximum((points**2).sum(1)[:, None] + (centroids**2).sum(1) - 2.0 * cross, 0.0)


def _plus_plus(points: FloatArray, clusters: int, rng: np.random.Generator) -> FloatArray:
    """Starts drawn with probability in proportion to the squared distance from the nearest one before."""
    chosen = [points[rng.integers(len(points))]]
    for _ in range(clusters - 1):
        weight = _squared(points, np.array(chosen)).min(1)
        total = weight.sum()
        chosen.append(points[rng.choice(len(points), p=weight / total if total > 0 else None)])
    return np.array(chosen)


def _lloyd(points: FloatArray, centroids: FloatArray) -> FloatArray:
    for _ in range(ROUNDS):
        nearest = assigned(points, centroids)
        moved = centroids.copy()
        for k in np.unique(nearest).tolist():
            moved[k] = points[nearest == k].mean(0)
        if np.array_equal(moved, centroids):
            break
        centroids = moved
    return centroids
