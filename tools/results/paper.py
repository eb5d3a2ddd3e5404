"""Every table and figure of the paper for our policies, from what lies in this repository and recorded logs.

python -m tools.results.paper [--logs tracks:FILE commonroad:DIR exid:DIR ...]

Writes tables.md, tables.json, curves.png, context.png, pools.png, steering.csv, steering.png and, with logs,
clusters.png into results/. Without logs the tables that need them are left out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from phase_sumo.bridge.maps.convert import build_bundle, read_stretches
from phase_sumo.config import REGIMES
from phase_sumo.evaluate.benchmark import load_benchmark, run_benchmark
from phase_sumo.evaluate.fixed_worlds import policy_driver
from phase_sumo.policy.checkpoint import SHIPPED, load_policy
from phase_sumo.report.study_figures import cluster_figure
from phase_sumo.studies.log_protocol import evaluate_logs
from phase_sumo.studies.realism import realism
from tools.places import HELD_OUT, RESULTS, ROOT

MODELS = ("phase", "idm")
PERCENT = ("goal_rate", "agent_collision_rate", "road_collision_rate", "success_rate")
METRES = ("ade_5s", "fde_5s")
TITLES = ("GR %", "CR_a %", "CR_r %", "SR %", "ADE_5s m", "FDE_5s m")


def policies() -> dict[str, Path]:
    """The shipped policy and those in results/policies, by name."""
    return {"shipped": SHIPPED} | {p.stem: p for p in sorted((RESULTS / "policies").glob("*.safetensors"))}


def measure(logs: list[str], out: Path) -> dict[str, Any]:
    """All numbers: zero-shot by policy and reference, benchmark by policy, realism of the shipped policy."""
    names = [file_name(log) for log in logs]
    found: dict[str, Any] = {"logs": names, "agent_steps": {}, "zero_shot": {}, "benchmark": {}}
    benchmark = load_benchmark(
        [build_bundle(part) for path in sorted(HELD_OUT.glob("*.net.xml")) for part in read_stretches(path)]
    )
    for name, path in policies().items():
        policy = load_policy(path)
        found["agent_steps"][name] = policy.info.get("agent_steps")
        print(name, file=sys.stderr)
        found["benchmark"][name] = run_benchmark(benchmark, policy_driver(policy), policy.actions)
        if logs:
            result = evaluate_logs(logs, policy, references=name == "shipped")
            references = result.pop("references")
            found["zero_shot"] |= {name: result} | references
    if logs:
        print("realism", file=sys.stderr)
        found["realism"] = realism(logs, MODELS, out, draw=cluster_figure) | {"logs": names}
    return found


def file_name(log: str) -> str:
    """A source without the folder that it lies in, which is nobody else's business."""
    kind, _, place = log.partition(":")
    return f"{kind}:{Path(place).name}"


def tables(found: dict[str, Any]) -> str:
    """Markdown, in the paper's order."""
    parts = [
        "# Tables",
        "",
        "Written by `python -m tools.results.paper`; what they mean is in the README.",
        "",
    ]
    if found["zero_shot"]:
        parts += _zero_shot(found)
    if "realism" in found:
        parts += _realism(found["realism"])
    return "\n".join(parts + _benchmark(found)) + "\n"


def _zero_shot(found: dict[str, Any]) -> list[str]:
    rows = found["zero_shot"]
    about = rows["shipped"]
    lines = [
        "## Zero-shot on recorded traffic (Table main_ablation)",
        "",
        f"{about['agents']} vehicles in {about['scenarios']} windows of {about['recordings']} recordings; "
        "mean ± standard deviation over the windows.",
        "",
        "| driver | agent steps, M | " + " | ".join(TITLES) + " |",
        "|---" * (2 + len(TITLES)) + "|",
    ]
    for name, row in rows.items():
        lines.append(f"| {name} | {_millions(found, name)} | " + " | ".join(_scores(row)) + " |")
    return [*lines, "", *_by_source(about["by_source"])]


def _by_source(rows: dict[str, Any]) -> list[str]:
    """The shipped policy, by place or scene."""
    lines = [
        "| shipped policy on | recordings | windows | vehicles | " + " | ".join(TITLES) + " |",
        "|---" * (4 + len(TITLES)) + "|",
    ]
    for name, row in rows.items():
        sizes = [str(row[count]) for count in ("recordings", "scenarios", "agents")]
        lines.append(f"| {name} | " + " | ".join(sizes + _scores(row)) + " |")
    return [*lines, ""]


def _scores(row: dict[str, Any]) -> list[str]:
    return [_spread(row[m], 100.0, 1) for m in PERCENT] + [_spread(row[m], 1.0, 2) for m in METRES]


def _realism(found: dict[str, Any]) -> list[str]:
    lines = [
        "## Distance to recorded traffic in SUMO (Table distributional)",
        "",
        f"{found['trajectories']} trajectories in {found['windows']} windows of {found['seconds']:g} s; 95 % "
        f"intervals over resampled {found['bootstrap']['by']}s.",
        "",
        "| | " + " | ".join((*found["models"], "real halves")) + " |",
        "|---" * (2 + len(found["models"])) + "|",
    ]
    for name in found["models"][MODELS[0]]:
        values = [model[name] for model in found["models"].values()]
        cells = [f"{v['value']:.3g} ({v['low']:.3g} – {v['high']:.3g})" for v in values]
        halves = f"{found['floor'][name]:.3g}" if name in found["floor"] else ""
        lines.append(f"| {name} | " + " | ".join((*cells, halves)) + " |")
    changes = ", ".join(f"{n} {v:.2f}" for n, v in found["lane_changes_per_km"].items())
    return [*lines, "", f"Lane changes per km: {changes}.", ""]


def _benchmark(found: dict[str, Any]) -> list[str]:
    regimes = [regime.name for regime in REGIMES]
    lines = [
        "## Synthetic benchmark",
        "",
        "Goal rate, collision rate at fault and success rate of all worlds, success rate by regime, in %.",
        "",
        "| policy | agent steps, M | goal | at fault | success | " + " | ".join(regimes) + " |",
        "|---" * (5 + len(regimes)) + "|",
    ]
    for name, row in found["benchmark"].items():
        cells = [row[m]["mean"] for m in ("goal_rate", "at_fault_rate", "success_rate")]
        cells += [row["by_regime"][regime]["success_rate"]["mean"] for regime in regimes]
        texts = " | ".join(f"{100 * cell:.1f}" for cell in cells)
        lines.append(f"| {name} | {_millions(found, name)} | {texts} |")
    return [*lines, ""]


def _millions(found: dict[str, Any], name: str) -> str:
    steps = found["agent_steps"].get(name)
    return f"{1e-6 * steps:.1f}" if steps else ""


def _spread(value: dict[str, float | None], scale: float, digits: int) -> str:
    mean, std = value["mean"], value["std"]
    return "" if mean is None else f"{scale * mean:.{digits}f} ± {scale * (std or 0.0):.{digits}f}"


def figures() -> None:
    for script in ("curves", "context", "pools"):
        command = [sys.executable, "-m", f"tools.results.{script}"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    subprocess.run([sys.executable, "-m", "phase_sumo", "steer", "--out", str(RESULTS)], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Tables and figures of the paper for our policies.")
    parser.add_argument("--logs", nargs="*", default=[], metavar="SRC", help="as for phase-sumo evaluate")
    args = parser.parse_args()
    found = measure(args.logs, RESULTS)
    (RESULTS / "encoder.safetensors").unlink(missing_ok=True)  # learnt from logs that are not ours to pass on
    (RESULTS / "tables.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "tables.md").write_text(tables(found), encoding="utf-8")
    figures()


if __name__ == "__main__":
    main()
