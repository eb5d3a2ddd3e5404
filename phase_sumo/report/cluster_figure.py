"""The figure of cluster distances: how far each model's centroids are from the recorded ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from phase_sumo.report.plots import GRID, INK, colours
from phase_sumo.studies.driver_models import label

matplotlib.use("Agg")
MARKERS = "osD^vP"


def cluster_figure(clusters: Mapping[str, Any], path: Path) -> None:
    """Write a picture with a row per cluster, the largest on top, and a marker per model."""
    shares, distances = clusters["share"], clusters["distance"]
    figure = Figure(figsize=(6.3, 1.2 + 0.32 * len(shares)), dpi=160, layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    rows = range(len(shares))
    for row, values in enumerate(zip(*distances.values(), strict=True)):
        known = [v for v in values if v == v]
        if known:
            axes.plot([min(known), max(known)], [row, row], color=INK, lw=0.8, alpha=0.5)
    for (model, colour), marker in zip(colours(list(distances)).items(), MARKERS, strict=False):
        axes.plot(distances[model], rows, marker, color=colour, ms=7, label=label(model))
    axes.set_yticks(list(rows), [f"{k + 1}  ({100 * share:.0f} %)" for k, share in enumerate(shares)])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("distance of the model's centroid from the recorded one, in the embedding", color=INK)
    axes.set_ylabel("cluster (share of recorded trajectories)", color=INK)
    axes.legend(frameon=False, fontsize=9, labelcolor=INK)
    temporary = path.with_name(f".{path.name}")
    figure.savefig(temporary, format="png")
    temporary.replace(path)
