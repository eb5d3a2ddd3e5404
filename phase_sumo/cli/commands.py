"""What each command does with its arguments: call the library, print a summary, return JSON types."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phase_sumo.cli.files import DEMO, HELD_OUT, find_files, load_maps, progress_bar
from phase_sumo.cli.train_view import train_view
from phase_sumo.errors import PhaseError
from phase_sumo.signals import stop_signals

if TYPE_CHECKING:
    from phase_sumo.bridge.drive_options import DriveOptions

PARTS = ("sim", "train", "bridge", "convert")  # of the benchmark
DEMO_MEASURES = ("mean_speed", "travel_time", "flow", "collisions_per_1000km", "lane_changes_per_km")


def convert(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.maps import convert as converter
    from phase_sumo.report.map_picture import draw_map

    with progress_bar("convert") as progress:
        rows = converter.convert(
            args.networks, args.out, progress, args.keep, args.seed, args.stretch, args.left_hand, draw_map
        )
    for row in rows:
        cut = f" in {row['stretches']} stretches" if row["stretches"] > 1 else ""
        print(
            f"{row['name']}: {row['lanes']} lanes, {row['lane_km']:.1f} km of lane{cut}, "
            f"{row['nodes']} nodes, {row['pairs']} start-goal pairs "
            f"({row['lane_change_pairs']} with lane changes), {row['seconds']:.1f} s"
        )
        for warning in row["warnings"]:
            print(f"  warning: {warning}")
    return rows


def train(args: argparse.Namespace) -> Any:
    from dataclasses import replace

    import torch

    from phase_sumo.policy.checkpoint import load_policy
    from phase_sumo.train import distributed, tensorboard
    from phase_sumo.train.loop import Trainer
    from phase_sumo.train.presets import preset
    from phase_sumo.train.run_folder import RunFolder
    from phase_sumo.train.settings import with_settings

    if args.threads:
        torch.set_num_threads(args.threads)
    device = distributed.start(args.device)
    first = distributed.rank() == 0
    folder = RunFolder(args.run)
    config = folder.config() if args.resume else replace(preset(args.preset), seed=args.seed)
    config = with_settings(config, args.set)
    given = {"total_steps": args.steps, "worlds": args.worlds}
    config = replace(config, **{name: value for name, value in given.items() if value})
    with distributed.first_before_others():  # converts, and the others read
        maps = load_maps(args.networks, folder.path / "maps")
        held_out = load_maps(args.held_out, folder.path / "maps") if args.held_out else []
    start = load_policy(args.start_from) if args.start_from else None
    trainer = Trainer(config, maps, held_out, folder, args.resume, start, device)
    if first and not tensorboard.installed():
        print("curves in TensorBoard: pip install 'phase-sumo[tensorboard]'", file=sys.stderr)
    try:
        with stop_signals() as stopping, ExitStack() as stack:
            view = train_view(str(folder.path), trainer.steps, config.total_steps, stopping)
            trainer.run(stack.enter_context(view) if first else None, stopping)
            stopped = stopping()
    finally:
        distributed.stop()
    last = trainer.last
    if first:
        memory = f", peak memory {last['peak_memory_mb']:,.0f} MB" if "peak_memory_mb" in last else ""
        print(f"{trainer.steps} agent steps{memory}, policy in {folder.policy}")
    else:
        args.json = None  # the first process writes it
    if stopped:
        raise KeyboardInterrupt
    return {**last, "agent_steps": trainer.steps, "policy": str(folder.policy)}


def tune(args: argparse.Namespace) -> Any:
    from dataclasses import replace

    from phase_sumo.train import tune as study
    from phase_sumo.train.presets import preset

    folder, config = Path(args.run), replace(preset(args.preset), seed=args.seed, total_steps=args.steps)
    table = Path(args.table)
    study.read_table(table, config)  # a bad one is found before networks are converted
    maps, held_out = (load_maps(paths, folder / "maps") for paths in (args.networks, args.held_out))
    with progress_bar("tune") as progress:
        result = study.tune(folder, config, maps, held_out, args.trials, table, progress)
    print(
        f"{result['trials']} trials, {result['pruned']} of them pruned; goal rate {result['goal_rate']:.3f}:"
    )
    for setting, value in result["settings"].items():
        print(f"{setting:>30}: {value:.4g}")
    print(f"policy in {result['policy']}")
    return result


def check(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.check import check_scenario

    found = check_scenario(scenario_of(args), drive_options(args))
    print("\n".join(found.lines()))
    say_changes(found.changed)
    return found.to_json()


def run(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.check import Check
    from phase_sumo.bridge.run import run_scenario

    with progress_bar("run") as progress:
        result = run_scenario(
            scenario_of(args),
            drive_options(args),
            output_dir=args.out,
            record=False,  # they would fill the memory in an hour of traffic; fcd-output is there for it
            gui=args.gui,
            over_traci=args.traci,
            progress=progress,
        )
    print("\n".join(Check(**result["check"]).lines()))
    say_changes(result["check"]["changed"])
    for name, value in result.items():
        if not isinstance(value, dict):
            print(f"{name}: {f'{value:.4g}' if isinstance(value, float) else value}")
    return result


def compare(args: argparse.Namespace) -> Any:
    from phase_sumo.report.comparison_page import write_report
    from phase_sumo.studies import compare as comparison

    with progress_bar("compare") as progress:
        result = comparison.compare(
            scenario_of(args),
            args.models,
            out_dir=args.out,
            seeds=seeds_of(args.seeds, args.seed),
            options=drive_options(args),
            jobs=args.jobs,
            write_report=write_report,
            progress=progress,
        )
    say_changes(result["check"]["changed"])
    print(f"report: {result['report']}")
    return result


def say_changes(changed: list[str]) -> None:
    """What was not as the scenario says, one line each."""
    for text in changed:
        print(f"phase-sumo: changed: {text}", file=sys.stderr)


def seeds_of(numbers: list[int], first: int) -> list[int]:
    """Several numbers are the seeds themselves, one is how many there are from the first on."""
    return numbers if len(numbers) > 1 else list(range(first, first + numbers[0]))


def scenario_of(args: argparse.Namespace) -> str | None:
    """The ``.sumocfg`` in either spelling; None when SUMO's options name the network instead."""
    from phase_sumo.bridge.sumo.option_names import parse_options

    for option in ("types", "models"):
        for name in getattr(args, option, ()):
            if name.endswith(".sumocfg"):
                raise PhaseError(
                    f"{name}: read as one of --{option}; put the scenario before it, or behind -c"
                )
    if args.cfg and args.config:
        raise PhaseError(f"two scenarios, {args.cfg} and {args.config}: pass one")
    if not args.cfg and not args.config and "net-file" not in parse_options(args.sumo_options):
        raise PhaseError("no scenario: pass CFG.sumocfg, -c CFG.sumocfg, or -n NET with -r ROUTES")
    return args.cfg or args.config


def drive_options(args: argparse.Namespace) -> DriveOptions:
    """What `run`, `compare` and `check` say about driving."""
    from phase_sumo.bridge.drive_options import DriveOptions

    return DriveOptions(
        policy=args.policy,
        share=args.share,
        types=tuple(args.types),
        explicit=tuple(args.explicit),
        deterministic=args.deterministic,
        alpha=alpha_bounds(args.alpha),
        time_gap=args.time_gap,
        guard=args.guard,
        seed=args.seed,
        end=args.end,
        sumo_options=tuple(args.sumo_options),
    )


def demo(args: argparse.Namespace) -> Any:
    from phase_sumo.report.comparison_page import write_report
    from phase_sumo.studies import compare as comparison

    if not DEMO.exists():
        raise PhaseError(f"{DEMO}: the demo scenario comes with a clone of the project; run it from one")
    print("PHASE against SUMO's IDM on a three-lane motorway with an on-ramp and an off-ramp")
    with progress_bar("demo") as progress:
        result = comparison.compare(
            DEMO,
            ("phase", "idm"),
            out_dir=args.out,
            seeds=[args.seed],
            write_report=write_report,
            progress=progress,
        )
    for name in DEMO_MEASURES:
        means = {model: summary[name]["mean"] for model, summary in result["summary"].items()}
        print(f"{name:>20}: " + "  ".join(f"{model} {value:.2f}" for model, value in means.items()))
    phase = next(row for row in result["runs"] if row["model"] == "phase")
    arrived, inserted = phase["phase_arrived_under_policy"], phase["phase_vehicles"]
    print(f"{arrived} of {inserted} PHASE vehicles arrived under the policy")
    print(f"report: {Path(result['report']).resolve()}")
    return result


def bench(args: argparse.Namespace) -> Any:
    import torch

    from phase_sumo.config import TrainConfig
    from phase_sumo.studies import bench as measure

    torch.set_num_threads(args.threads)
    networks = args.networks or [str(HELD_OUT)]
    results = []
    for part in args.parts or PARTS:
        with progress_bar(f"bench {part}") as progress:
            if part == "sim":
                maps = load_maps(networks, None)
                rows = [
                    measure.bench_sim(maps, *size, args.steps, args.seed, progress) for size in measure.SIZES
                ]
            elif part == "train":
                rows = [measure.bench_train(load_maps(networks, None), TrainConfig(), 5, progress)]
            elif part == "convert":
                files = find_files(networks, (".net.xml", ".net.xml.gz"))
                rows = [measure.bench_convert(files, progress)]
            elif args.cfg:
                rows = [measure.bench_bridge(Path(args.cfg), None, args.seed, progress)]
            else:
                rows = [
                    measure.bench_full_freeway(vehicles, args.steps, args.seed, progress)
                    for vehicles in args.vehicles
                ]
        for row in rows:
            print("  ".join(f"{k} {f'{v:.4g}' if isinstance(v, float) else v}" for k, v in row.items()))
        results += rows
    return {"machine": measure.machine(), "results": results}


def alpha_bounds(values: list[float] | None) -> float | tuple[float, float] | None:
    if not values:
        return None
    if len(values) > 2 or not all(0.1 <= v <= 1.0 for v in values):
        raise PhaseError(f"--alpha {' '.join(map(str, values))}: pass one value or two bounds within 0.1..1")
    return values[0] if len(values) == 1 else (values[0], values[1])
