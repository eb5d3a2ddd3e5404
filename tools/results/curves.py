"""Thins the curves of training runs into results/curves and draws all that lie there.

python -m tools.results.curves [PRESET-SEED=RUN or PRESET-LENGTH-SEED=RUN ...]
"""

from __future__ import annotations

import csv
import json
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from tools.places import RESULTS

matplotlib.use("Agg")

BIN = 100_000  # agent steps that a row of a thinned curve covers
RATES = ("goal_rate", "collision_rate", "at_fault_rate", "road_edge_rate", "success_rate")
HELD_OUT = (
    "held_out_goal_rate",
    "held_out_agent_collision_rate",
    "held_out_at_fault_rate",
    "held_out_road_collision_rate",
    "held_out_success_rate",
)
PANELS = (
    ("goal reached", "goal_rate", "held_out_goal_rate"),
    ("collision", "collision_rate", "held_out_agent_collision_rate"),
    ("off road", "road_edge_rate", "held_out_road_collision_rate"),
    ("success", "success_rate", "held_out_success_rate"),
)
PRESETS = ("phase", "no-dclamp", "no-reweighting", "no-curriculum", "gpudrive", "gpudrive-same-model")

Row = dict[str, float]


def thinned(run: Path) -> list[Row]:
    """A row per `BIN` agent steps: rates of all agents that finished within it, CPU and wall time so far.

    CPU time is that of rollouts and learning; evaluations and start are left out of both times.
    """
    with (run / "curve.csv").open(encoding="utf-8") as file:
        rows = [{name: float(cell) for name, cell in row.items() if cell} for row in csv.DictReader(file)]
    cpu, parts = 0.0, defaultdict(list)
    for row in rows:
        cpu += 1e-6 * (row["rollout_cpu_us"] + row["learn_cpu_us"]) * row["agent_steps"]
        parts[int(row["steps"]) // BIN].append({**row, "cpu_seconds": cpu})
    return [_joined(part) for part in parts.values()]


def _joined(part: list[Row]) -> Row:
    last = part[-1]
    finished = sum(row["finished"] for row in part)
    joined = {name: last[name] for name in ("steps", "cpu_seconds", "wall_seconds", "rho")}
    for name in RATES:
        joined[name] = sum(row[name] * row["finished"] for row in part) / max(finished, 1.0)
    for row in part:
        joined |= {name: row[name] for name in HELD_OUT if name in row}
    return joined


def keep(name: str, run: Path) -> None:
    """Write the thinned curve of a run and its configuration."""
    rows = thinned(run)
    columns = ["steps", "cpu_seconds", "wall_seconds", "rho", *RATES, *HELD_OUT]
    with (RESULTS / "curves" / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([f"{row[c]:.6g}" if c in row else "" for c in columns] for row in rows)
    config = json.loads((run / "config.json").read_text(encoding="utf-8"))
    (RESULTS / "curves" / f"{name}.json").write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")


def stored() -> dict[str, list[list[Row]]]:
    """The curves in results/curves by preset (and length, where it is named), one list of rows per seed."""
    curves: dict[str, list[list[Row]]] = {preset: [] for preset in PRESETS}
    for path in sorted((RESULTS / "curves").glob("*.csv")):
        with path.open(encoding="utf-8") as file:
            rows = [{n: float(cell) for n, cell in row.items() if cell} for row in csv.DictReader(file)]
        curves.setdefault(path.stem.rpartition("-")[0], []).append(rows)
    return {preset: runs for preset, runs in curves.items() if runs}


def draw(curves: dict[str, list[list[Row]]], path: Path) -> None:
    """Rates while training (thin) and on held-out networks (dots), against steps and against CPU time."""
    figure = Figure(figsize=(15, 7), layout="constrained")
    axes = figure.subplots(2, len(PANELS), sharey="col")
    for line, (unit, column, scale) in enumerate(
        (("million agent steps", "steps", 1e-6), ("CPU minutes (one thread)", "cpu_seconds", 1 / 60))
    ):
        for axis, (title, rate, held_out) in zip(axes[line], PANELS, strict=True):
            for number, (preset, runs) in enumerate(curves.items()):
                for k, rows in enumerate(runs):
                    x = scale * np.array([row[column] for row in rows])
                    y = 100.0 * np.array([row[rate] for row in rows])
                    axis.plot(x, y, color=f"C{number}", lw=0.8, alpha=0.5)
                    measured = [row for row in rows if held_out in row]
                    axis.plot(
                        [scale * row[column] for row in measured],
                        [100.0 * row[held_out] for row in measured],
                        "o-",
                        color=f"C{number}",
                        ms=3,
                        label=preset if k == 0 else None,
                    )
            axis.set_xlabel(unit)
            axis.set_ylabel(f"{title}, % of agents")
            axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def table(curves: dict[str, list[list[Row]]]) -> str:
    """The last held-out rates of every preset as Markdown: mean over seeds, and their range."""
    lines = [
        "| preset | seeds | agent steps, M | goal | collision | at fault | off road | success |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for preset, runs in curves.items():
        last = [next((row for row in reversed(rows) if HELD_OUT[0] in row), {}) for rows in runs]
        last = [row for row in last if row]
        if not last:
            continue
        cells = []
        for name in HELD_OUT:
            values = 100.0 * np.array([row[name] for row in last])
            spread = f" ({values.min():.1f}–{values.max():.1f})" if len(values) > 1 else ""
            cells.append(f"{values.mean():.1f}{spread}")
        steps = " / ".join(f"{1e-6 * row['steps']:.1f}" for row in last)
        lines.append(f"| `{preset}` | {len(last)} | {steps} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    for argument in sys.argv[1:]:
        name, _, run = argument.partition("=")
        keep(name, Path(run))
    curves = stored()
    draw(curves, RESULTS / "curves.png")
    print(table(curves))


if __name__ == "__main__":
    main()
