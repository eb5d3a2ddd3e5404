"""Compare the generated training networks with real freeways: a picture and a table in README.md.

    python -m tools.networks.compare_with_real --real FOLDER

FOLDER holds ``.net.xml`` files of real freeways, for instance cut out of OpenStreetMap and converted by
netconvert; none are shipped.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tools.networks.measure import Measures, Sample, measure
from tools.networks.readme import fill, table
from tools.places import NETWORKS

matplotlib.use("Agg")
PICTURE = NETWORKS / "comparison.png"
OURS, REAL = "#1f4ed8", "#e07b00"


@dataclass(frozen=True)
class Quantity:
    """How a field of `Measures` is shown: ``steps`` are the bars' places, else curves up to ``most``."""

    title: str
    unit: str
    most: float = 0.0
    steps: tuple[float, ...] = ()
    digits: int = 0


QUANTITIES = {
    "curvature": Quantity("Curvature of main lanes", "1/km", most=7.0, digits=2),
    "ramp_curvature": Quantity("Curvature of ramps", "1/km", most=30.0, digits=1),
    "lane_count": Quantity("Lanes of a carriageway", "lanes", steps=(1, 2, 3, 4, 5, 6), digits=0),
    "lane_width": Quantity("Width of main lanes", "m", steps=(3.2, 3.3, 3.4, 3.5, 3.6, 3.7), digits=2),
    "ramp_length": Quantity("Length of ramps", "m", most=600.0),
    "auxiliary_length": Quantity("Length of auxiliary lanes", "m", most=350.0),
}


def load(folder: Path) -> tuple[Measures, int]:
    """Dimensions of all networks in a folder, and how many there are."""
    paths = sorted(folder.glob("*.net.xml"))
    if not paths:
        raise SystemExit(f"{folder}: no .net.xml file; name a folder of networks")
    return Measures.joined(measure(path) for path in paths), len(paths)


def draw(ours: Measures, real: Measures, labels: tuple[str, str], path: Path) -> None:
    """One panel per quantity: bars where values are few, else the share of values up to x."""
    figure = Figure((11.0, 6.0), dpi=100, layout="constrained")
    for axes, (name, quantity) in zip(figure.subplots(2, 3).ravel(), QUANTITIES.items(), strict=True):
        for k, (measures, colour) in enumerate(((ours, OURS), (real, REAL))):
            sample = getattr(measures, name)
            if quantity.steps:
                _bars(axes, sample, quantity, k, colour, labels[k])
            else:
                _curve(axes, sample, quantity, colour, labels[k])
        axes.set_title(quantity.title, fontsize=11)
        axes.set_xlabel(quantity.unit)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path, format="png", pil_kwargs={"optimize": True})


def _bars(axes: Axes, sample: Sample, quantity: Quantity, k: int, colour: str, label: str) -> None:
    steps = np.array(quantity.steps)
    nearest = np.abs(sample.value[:, None] - steps).argmin(1)
    share = np.bincount(nearest, sample.weight, len(steps)) / sample.weight.sum()
    apart = steps[1] - steps[0]
    axes.bar(steps + (k - 0.5) * 0.4 * apart, share, 0.38 * apart, color=colour, label=label)
    axes.set_xticks(steps)
    axes.set_ylabel("share")


def _curve(axes: Axes, sample: Sample, quantity: Quantity, colour: str, label: str) -> None:
    order = np.argsort(sample.value)
    share = np.cumsum(sample.weight[order]) / sample.weight.sum()
    value = np.concatenate(([0.0], sample.value[order], [quantity.most]))
    share = np.concatenate(([0.0], share, [1.0]))
    if len(value) > 2000:  # the picture has no more pixels
        keep = np.linspace(0, len(value) - 1, 2000).astype(int)
        value, share = value[keep], share[keep]
    axes.step(value, share, where="post", color=colour, label=label)
    axes.set(xlim=(0.0, quantity.most), ylim=(0.0, 1.02), ylabel="share up to x")


def comparison_table(ours: Measures, real: Measures) -> str:
    """Median, 5-95 % and number of values on both sides, and the Wasserstein distance between them."""
    rows = []
    for field in fields(Measures):
        quantity = QUANTITIES[field.name]
        samples = getattr(ours, field.name), getattr(real, field.name)
        cells = []
        for sample in samples:
            low, middle, high = (f"{sample.quantile(q):.{quantity.digits}f}" for q in (0.05, 0.5, 0.95))
            cells += [middle, f"{low}–{high}"]
        distance = f"{samples[0].distance(samples[1]):.{max(quantity.digits, 2)}f}"
        rows.append([f"{quantity.title}, {quantity.unit}", *cells, distance])
    head = ("", "generated: median", "5–95 %", "real: median", "5–95 %", "Wasserstein distance")
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare the generated networks with real freeways.")
    parser.add_argument("--real", type=Path, required=True, help="folder with .net.xml of real freeways")
    parser.add_argument(
        "--ours", type=Path, default=NETWORKS, help="folder of networks (default: the shipped ones)"
    )
    args = parser.parse_args()
    (ours, count), (real, real_count) = load(args.ours), load(args.real)
    draw(ours, real, (f"{count} generated", f"{real_count} real US stretches"), PICTURE)
    fill("comparison", comparison_table(ours, real))
    print(PICTURE)


if __name__ == "__main__":
    main()
