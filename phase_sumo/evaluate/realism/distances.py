"""Distances between two sets of points: Fréchet, energy, MMD, precision and recall.

A trajectory counts once in every mean unless weights say otherwise. All sums run in blocks, so that sets of
some 30,000 points of 128 dimensions fit into memory.

Behaviour clusters of the recorded embeddings, and how far each model's centroid is from the recorded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.errors import PhaseError

GAMMAS = (7e-5, 1e-4, 5e-4, 1e-3, 5e-3)  # of the RBF kernel, the paper's
NEIGHBOURS = 3  # of the balls of precision and recall
BLOCK = 512  # rows whose distances are held at a time


def frechet(
    x: ArrayLike, y: ArrayLike, x_weight: ArrayLike | None = None, y_weight: ArrayLike | None = None
) -> float:
    """Squared Fréchet (2-Wasserstein) distance of the Gaussians with the moments of x [n, D] and y [m, D].

    d^2 = |mu_x - mu_y|^2 + tr(S_x + S_y - 2 (S_x^1/2 S_y S_x^1/2)^1/2), covariances with n - 1 (Heusel et
    al. 2017, the FID). The last trace is the sum of the singular values of S_x^1/2 S_y^1/2: so no root of a
    root amplifies rounding, and nothing need be added to covariances of fewer points than dimensions.

    Args:
        x_weight, y_weight: [n], [m] how often each point counts; 1 if left out.
    """
    (x_mean, x_cov), (y_mean, y_cov) = _moments(x, x_weight), _moments(y, y_weight)
    cross = np.linalg.svd(_root(x_cov) @ _root(y_cov), compute_uv=False).sum()
    apart = ((x_mean - y_mean) ** 2).sum()
    return float(max(apart + np.trace(x_cov) + np.trace(y_cov) - 2.0 * cross, 0.0))


def _moments(points: ArrayLike, weight: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    values = _points(points).numpy()
    counts = np.ones(len(values)) if weight is None else np.asarray(weight, np.float64)
    if counts.sum() < 2:
        raise PhaseError(f"a Fréchet distance needs two points of each set, got {counts.sum():g}")
    mean = counts @ values / counts.sum()
    centred = values - mean
    return mean, (centred * counts[:, None]).T @ centred / (counts.sum() - 1.0)


def _root(matrix: FloatArray) -> FloatArray:
    """Square root of a symmetric positive semidefinite matrix; eigenvalues that are rounding become 0."""
    values, vectors = np.linalg.eigh(matrix)
    rounding = len(values) * np.finfo(np.float64).eps * max(values[-1], 0.0)
    return (vectors * np.sqrt(np.where(values > rounding, values, 0.0))) @ vectors.T


@dataclass(frozen=True)
class PairSums:
    """Sums over all pairs of points of two sets, by groups of points.

    Attributes:
        count: [G, H] pairs of a point of the first set's group g and one of the second's group h.
        distance: [G, H] sum of their Euclidean distances.
        kernel: [5, G, H] sums of exp(-gamma d^2) for `GAMMAS`.
    """

    count: FloatArray
    distance: FloatArray
    kernel: FloatArray

    def weighted(self, x_weight: ArrayLike, y_weight: ArrayLike) -> PairSums:
        """The sums when the points of each group count [G] and [H] times: a resample by groups."""
        times = np.outer(np.asarray(x_weight, np.float64), np.asarray(y_weight, np.float64))
        return PairSums(self.count * times, self.distance * times, self.kernel * times)


def pair_sums(
    x: ArrayLike,
    y: ArrayLike,
    x_group: ArrayLike | None = None,
    y_group: ArrayLike | None = None,
    groups: tuple[int, int] = (-1, -1),
) -> PairSums:
    """`PairSums` of x [n, D] and y [m, D] with group numbers [n], [m] from 0; one group each if left out.

    Args:
        groups: G and H, where not all of them may have a point.
    """
    a = _points(x)
    b = a if y is x else _points(y)
    in_a, in_b = _membership(x_group, len(a), groups[0]), _membership(y_group, len(b), groups[1])
    distance = torch.zeros(in_a.shape[1], in_b.shape[1], dtype=torch.float64)
    kernel = torch.zeros(len(GAMMAS), *distance.shape, dtype=torch.float64)
    for rows, d in _blocks(a, b):
        mine = in_a[rows].T
        distance += mine @ d @ in_b
        squared = d * d
        for k, gamma in enumerate(GAMMAS):
            kernel[k] += mine @ torch.exp(-gamma * squared) @ in_b
    count = torch.outer(in_a.sum(0), in_b.sum(0))
    return PairSums(count.numpy(), distance.numpy(), kernel.numpy())


def energy_distance(xx: PairSums, yy: PairSums, xy: PairSums) -> float:
    """2 E|X - Y| - E|X - X'| - E|Y - Y'|, no root taken, a point's distance to itself included.

    Székely & Rizzo 2013; this V-statistic is never negative and 0 for equal sets.
    """
    total = 2.0 * _mean(xy.distance, xy) - _mean(xx.distance, xx) - _mean(yy.distance, yy)
    return float(max(total, 0.0))


def mmd(xx: PairSums, yy: PairSums, xy: PairSums, unbiased: bool = False) -> FloatArray:
    """[5] squared maximum mean discrepancies with the kernels exp(-gamma |x - y|^2) of `GAMMAS`.

    MMD^2 = E k(X, X') + E k(Y, Y') - 2 E k(X, Y) (Gretton et al. 2012): the biased one counts each point
    with itself and is never negative, the unbiased one leaves that out. One group per set only.
    """
    n, m = np.sqrt(xx.count.sum()), np.sqrt(yy.count.sum())
    within_x, within_y = xx.kernel.sum((1, 2)), yy.kernel.sum((1, 2))
    if unbiased:
        mean_x, mean_y = (within_x - n) / (n * (n - 1.0)), (within_y - m) / (m * (m - 1.0))
    else:
        mean_x, mean_y = within_x / n**2, within_y / m**2
    value = mean_x + mean_y - 2.0 * xy.kernel.sum((1, 2)) / xy.count.sum()
    return value if unbiased else np.maximum(value, 0.0)


def _mean(sums: FloatArray, pairs: PairSums) -> float:
    return float(sums.sum() / pairs.count.sum())


@dataclass(frozen=True)
class Coverage:
    """Which points lie where the other set lies (Kynkäänniemi et al. 2019).

    Attributes:
        precise: [m] bool, the simulated point lies in the ball of a real one.
        recalled: [n] bool, the real point lies in the ball of a simulated one.

    A ball reaches to the `NEIGHBOURS`-th nearest other point of its own set. Precision and recall are means.
    """

    precise: NDArray[np.bool_]
    recalled: NDArray[np.bool_]


def coverage(real: ArrayLike, simulated: ArrayLike) -> Coverage:
    """`Coverage` of real [n, D] and simulated [m, D] points."""
    x, y = _points(real), _points(simulated)
    if min(len(x), len(y)) <= NEIGHBOURS:
        raise PhaseError(
            f"precision and recall need more than {NEIGHBOURS} points of each set, got {len(x)} and {len(y)}"
        )
    x_radius, y_radius = _radii(x), _radii(y)
    precise, recalled = torch.zeros(len(y), dtype=torch.bool), torch.zeros(len(x), dtype=torch.bool)
    for rows, d in _blocks(x, y):
        precise |= (d < x_radius[rows, None]).any(0)
        recalled[rows] = (d < y_radius).any(1)
    return Coverage(precise.numpy(), recalled.numpy())


def _radii(points: Tensor) -> Tensor:
    """[n] distance to the k-th nearest other point: the point itself is the nearest one."""
    return torch.cat([d.kthvalue(NEIGHBOURS + 1, 1).values for _, d in _blocks(points, points)])


def _blocks(x: Tensor, y: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Rows of x and their distances to all of y."""
    same = x is y
    for first in range(0, len(x), BLOCK):
        rows = slice(first, min(first + BLOCK, len(x)))
        d = torch.cdist(x[rows], y)
        if same:  # else rounding of the matrix product is left there
            d.diagonal(first).zero_()
        yield rows, d


def _membership(group: ArrayLike | None, size: int, groups: int) -> Tensor:
    """[size, groups] 1 where a point belongs to a group."""
    numbers = np.zeros(size, np.int64) if group is None else np.asarray(group, np.int64)
    return torch.nn.functional.one_hot(torch.from_numpy(numbers), groups).double()


def _points(values: ArrayLike) -> Tensor:
    points = torch.as_tensor(np.asarray(values, np.float64))
    if points.ndim != 2 or not len(points) or not bool(torch.isfinite(points).all()):
        raise PhaseError(
            f"distances between sets of points need finite points [n, D], got shape {list(points.shape)}"
        )
    return points


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
