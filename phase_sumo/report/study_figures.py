"""Figures of studies: response curves, asked-for manoeuvres, distances of clusters."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from phase_sumo.evaluate.steering.response import ResponseCurve, Steering
from phase_sumo.report.plots import GRID, INK, colours
from phase_sumo.report.road_pictures import PHASE, SUMO
from phase_sumo.studies.driver_models import label

matplotlib.use("Agg")
WORLD = "#9aa3ad"
PANELS = (
    ("alpha", "rms_accel", "action range α", "acceleration used (rms), m/s²"),
    ("alpha", "mean_speed", "action range α", "mean speed, m/s"),
    ("speed", "final_speed", "target speed / initial speed", "speed reached, m/s"),
    ("speed", "distance", "target speed / initial speed", "distance in 4 s, m"),
    ("kind", "most_accel", "vehicle type", "highest acceleration, m/s²"),
    ("kind", "mean_speed", "vehicle type", "mean speed, m/s"),
    ("lane", "aside", "lane of the goal", "metres to the left at the end"),
)
NAMES = {
    "car": "car",
    "rigid_truck": "rigid",
    "articulated_truck": "tractor-\ntrailer",
    -1: "right",
    0: "own",
    1: "left",
}


def draw_steering(steering: Steering, path: Path) -> None:
    """A panel per response curve, a thin line per world, and one with the manoeuvres."""
    figure = Figure(figsize=(14.0, 6.6), dpi=120, layout="constrained")
    panels = figure.subplots(2, 4).flat
    by_name = {(curve.part, curve.outcome): curve for curve in steering.curves}
    for axes, (part, outcome, x, y) in zip(panels, PANELS, strict=False):
        _style(axes)
        _curve(axes, by_name[part, outcome])
        axes.set_xlabel(x, color=INK)
        axes.set_ylabel(y, color=INK)
    _manoeuvres(list(figure.axes)[-1], steering)
    figure.savefig(path, format="png")


def _curve(axes: Axes, curve: ResponseCurve) -> None:
    """Every world less what it has of its own, so that only the response is left, and their mean."""
    x = np.array([v if isinstance(v, float) else k for k, v in enumerate(curve.levels)], float)
    own = np.nanmean(curve.values, axis=1, keepdims=True)
    centred = curve.values - own + own.mean() if curve.part != "lane" else curve.values
    axes.plot(x, centred.T, color=WORLD, lw=0.7, alpha=0.55)
    means = [float(np.nanmean(column)) for column in centred.T]
    axes.plot(x, means, "o-", color=PHASE, lw=2.4, ms=5)
    if not isinstance(curve.levels[0], float):
        axes.set_xticks(x, [NAMES[level] for level in curve.levels])
        axes.margins(x=0.12)
    tau, monotone = curve.tau(), curve.monotone()
    title = f"τ {tau.mean:.2f} [{tau.low:.2f}, {tau.high:.2f}]   monotone in {100 * monotone.mean:.0f} %"
    axes.set_title(title, fontsize=9.5, color=INK, loc="left")


def _manoeuvres(axes: Axes, steering: Steering) -> None:
    _style(axes)
    y = np.arange(len(steering.asked))[::-1]
    for key, colour, shift in (("asked", PHASE, 0.19), ("opposite", SUMO, -0.19)):
        values = [row[key] for row in steering.asked.values()]
        mean = 100 * np.array([v.mean for v in values])
        error = 100 * np.array([[v.mean - v.low for v in values], [v.high - v.mean for v in values]])
        name = "asked for" if key == "asked" else "the opposite asked for"
        axes.barh(y + shift, mean, 0.36, xerr=error, color=colour, label=name, ecolor=INK, capsize=2)
    axes.set_yticks(y, list(steering.asked))
    axes.set(xlim=(0, 100))
    axes.set_xlabel("it happened, % of worlds", color=INK)
    axes.legend(
        frameon=False, fontsize=8.5, labelcolor=INK, loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=2
    )


def _style(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(INK)
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)


def write_steering(steering: Steering, path: Path) -> None:
    """CSV: one line per context part, outcome, level and world."""
    rows: list[list[Any]] = [["context", "outcome", "level", "world", "value"]]
    for curve in steering.curves:
        for world, values in enumerate(curve.values):
            rows += [
                [curve.part, curve.outcome, level, world, f"{value:.6g}"]
                for level, value in zip(curve.levels, values, strict=True)
                if np.isfinite(value)
            ]
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


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
