"""What each command does with its arguments: call the library, print a summary, return JSON types."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from phase_sumo.cli.files import DEMO, HELD_OUT, find_files, held_out_maps, load_maps, progress_bar
from phase_sumo.cli.stop import stop_signals
from phase_sumo.cli.train_view import train_view
from phase_sumo.errors import PhaseError

DEMO_MEASURES = ("mean_speed", "travel_time", "flow", "collisions_per_1000km", "lane_changes_per_km")


def convert(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.maps import convert as converter

    with progress_bar("convert") as progress:
        rows = converter.convert(
            args.networks, args.out, progress, args.keep, args.seed, args.stretch, args.left_hand
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

    from phase_sumo.config import preset
    from phase_sumo.policy.checkpoint import load_policy
    from phase_sumo.train import distributed, tensorboard
    from phase_sumo.train.loop import Trainer
    from phase_sumo.train.run_folder import RunFolder

    device = distributed.start()
    first = distributed.rank() == 0
    folder = RunFolder(args.run)
    config = folder.config() if args.resume else replace(preset(args.preset), seed=args.seed)
    if args.steps:
        config = replace(config, total_steps=args.steps)
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

    from phase_sumo.config import preset
    from phase_sumo.train import tune as study

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


def evaluate(args: argparse.Namespace) -> Any:
    from phase_sumo.config import TrainConfig
    from phase_sumo.evaluate.synthetic import RATES, evaluate_synthetic
    from phase_sumo.policy.checkpoint import load_policy

    if "synthetic:benchmark" in args.scenarios:
        return _benchmark(args)
    sources = []
    for source in args.scenarios:
        kind, _, path = source.partition(":")
        if kind != "synthetic" or not path:
            raise PhaseError(
                f"scenario source {source!r} is not known; use synthetic:benchmark, or synthetic:PATH of "
                "networks or map bundles"
            )
        sources.append(path)
    policy = load_policy(args.policy)
    config = TrainConfig()
    with progress_bar("evaluate") as progress:
        result = evaluate_synthetic(
            policy,
            load_maps(sources, None),
            config.scenarios,
            args.worlds,
            config.slots,
            episodes=args.episodes,
            seed=args.seed,
            greedy=args.greedy,
            progress=lambda share: progress(share, "worlds"),
        )
    print(f"{result['agents']} agents in {result['scenarios']} scenarios")
    groups = {"all": result, **result["by_regime"], **result["by_type"]}
    print(f"{'':>18}" + "".join(f"{name.removesuffix('_rate'):>17}" for name in RATES))
    for name, rates in groups.items():
        print(f"{name:>18}" + "".join(f"{100 * rates[rate]:>16.1f}%" for rate in RATES))
    return result


def _benchmark(args: argparse.Namespace) -> Any:
    from phase_sumo.config import ActionConfig
    from phase_sumo.evaluate.benchmark import load_benchmark, run_benchmark
    from phase_sumo.evaluate.fixed_worlds import idle_driver, policy_driver, prior_driver
    from phase_sumo.evaluate.synthetic import RATES
    from phase_sumo.policy.checkpoint import load_policy

    if len(args.scenarios) > 1:
        raise PhaseError("synthetic:benchmark is a result of its own; evaluate the other sources apart")
    benchmark, policy = load_benchmark(held_out_maps()), load_policy(args.policy)
    drivers = {"policy": (policy_driver(policy), policy.actions)}
    if args.references:
        actions = ActionConfig()
        drivers |= {
            "constant-velocity": (idle_driver(actions), actions),
            "prior": (prior_driver(actions), actions),
        }
    results = {}
    for name, (driver, actions) in drivers.items():
        with progress_bar("evaluate") as progress:
            results[name] = run_benchmark(
                benchmark,
                driver,
                actions,
                args.seed,
                args.greedy,
                args.worlds,
                lambda share, name=name, progress=progress: progress(share, name),
            )
        result = results[name]
        print(f"{name}: {result['agents']} agents in {result['scenarios']} scenarios")
        print(f"{'':>18}" + "".join(f"{rate.removesuffix('_rate'):>24}" for rate in RATES))
        for group, values in {"all": result, **result["by_regime"], **result["by_type"]}.items():
            cells = [values[rate] for rate in RATES]
            texts = [f"{100 * c['mean']:.1f}% ({100 * c['low']:.1f}..{100 * c['high']:.1f})" for c in cells]
            print(f"{group:>18}" + "".join(f"{text:>24}" for text in texts))
    return {**results.pop("policy"), "references": results}


def steer(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.steering_figure import draw_steering, write_steering
    from phase_sumo.evaluate.benchmark import load_benchmark
    from phase_sumo.evaluate.fixed_worlds import policy_driver
    from phase_sumo.evaluate.steering.egos import choose_egos
    from phase_sumo.evaluate.steering.outcomes import Stage
    from phase_sumo.evaluate.steering.response import measure_steering
    from phase_sumo.policy.checkpoint import load_policy

    policy, maps, out = load_policy(args.policy), held_out_maps(), Path(args.out)
    benchmark = load_benchmark(maps)
    start = benchmark.of_regime(args.regime)
    egos = choose_egos(start, maps)[: args.worlds]
    stage = Stage(start, egos, benchmark.road_map, policy_driver(policy), policy.actions, args.seed)
    with progress_bar("steer") as progress:
        steering = measure_steering(stage, lambda share: progress(share, "contexts"))
    out.mkdir(parents=True, exist_ok=True)
    write_steering(steering, out / "steering.csv")
    draw_steering(steering, out / "steering.png")
    print(f"{len(egos)} worlds, {args.regime} traffic")
    for curve in steering.curves:
        tau, monotone = curve.tau(), curve.monotone()
        print(
            f"{curve.part:>6} -> {curve.outcome:<12} tau {tau.mean:5.2f} ({tau.low:.2f}..{tau.high:.2f}), "
            f"monotone in {100 * monotone.mean:3.0f} % of the worlds"
        )
    for name, row in steering.asked.items():
        asked, opposite, hit = (100 * row[key].mean for key in ("asked", "opposite", "collision"))
        print(f"{name:>13}: asked {asked:.0f} %, opposite asked {opposite:.0f} %, collided {hit:.0f} %")
    return {"regime": args.regime, "worlds": len(egos), **steering.to_json()}


def search(args: argparse.Namespace) -> Any:
    from dataclasses import asdict
    from hashlib import sha256

    from phase_sumo.bridge import search as encounters
    from phase_sumo.policy.checkpoint import load_policy, policy_bytes

    policy, out = load_policy(args.policy), Path(args.out)
    scene = encounters.read_scene(args.cfg, policy, args.time, args.around, args.radius, args.seed)
    print(f"{len(scene.vehicles)} vehicles around {scene.vehicles[0].id}")
    before = encounters.drive_scene(scene.net, scene.vehicles, args.seconds, policy, args.criterion)
    hunt = encounters.Search(scene, policy, args.criterion, args.vary, args.seconds, args.contact)
    with progress_bar("search") as progress:
        vehicles, found = hunt.run(args.budget, args.seed, progress)
    facts = {
        "criterion": args.criterion,
        "seed": args.seed,
        "budget": args.budget,
        "policy_sha256": sha256(policy_bytes(policy)).hexdigest(),  # another one drives otherwise
        "before": asdict(before) if before.follower else None,
        "found": asdict(found),
    }
    cfg = encounters.export(out, hunt, vehicles, facts)
    again = encounters.replay(cfg, policy, args.criterion, out / "replay")
    for name, e in (("as it was", before), ("found", found), ("replayed", again)):
        print(
            f"{name:>10}: {e.value:.2f} s, {e.follower} behind {e.leader} at {e.time:.1f} s, "
            f"{e.contacts} contacts"
        )
    print(f"scenario: {cfg}")
    return {**facts, "replayed": asdict(again), "same": again == found, "scenario": str(cfg)}


def run(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.run import run_scenario

    with progress_bar("run") as progress:
        result = run_scenario(
            args.cfg,
            policy=args.policy,
            share=args.share,
            explicit=args.explicit,
            deterministic=args.deterministic,
            types=args.types,
            alpha=alpha_bounds(args.alpha),
            seed=args.seed,
            end=args.end,
            gui=args.gui,
            over_traci=args.traci,
            sumo_options=args.sumo_options,
            output_dir=args.out,
            progress=progress,
        )
    for name, value in result.items():
        if not isinstance(value, dict):
            print(f"{name}: {f'{value:.4g}' if isinstance(value, float) else value}")
    return result


def compare(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.comparison import compare as comparison

    with progress_bar("compare") as progress:
        result = comparison.compare(
            args.cfg,
            args.models,
            out_dir=args.out,
            seeds=args.seeds,
            policy=args.policy,
            share=args.share,
            explicit=args.explicit,
            deterministic=args.deterministic,
            types=args.types,
            alpha=alpha_bounds(args.alpha),
            end=args.end,
            sumo_options=args.sumo_options,
            jobs=args.jobs,
            progress=progress,
        )
    print(f"report: {result['report']}")
    return result


def demo(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.comparison import compare as comparison

    if not DEMO.exists():
        raise PhaseError(f"{DEMO}: the demo scenario comes with a clone of the project; run it from one")
    print("PHASE against SUMO's IDM on a three-lane motorway with an on-ramp and an off-ramp")
    with progress_bar("demo") as progress:
        result = comparison.compare(
            DEMO, ("phase", "idm"), out_dir=args.out, seeds=[args.seed], progress=progress
        )
    for name in DEMO_MEASURES:
        means = {model: summary[name]["mean"] for model, summary in result["summary"].items()}
        print(f"{name:>20}: " + "  ".join(f"{model} {value:.2f}" for model, value in means.items()))
    phase = next(row for row in result["runs"] if row["model"] == "phase")
    arrived, inserted = phase["phase_arrived_under_policy"], phase["phase_vehicles"]
    print(f"{arrived} of {inserted} PHASE vehicles arrived under the policy")
    print(f"report: {Path(result['report']).resolve()}")
    return result


def realism(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.rollout.realism import realism as compare

    with progress_bar("realism") as progress:
        result = compare(
            args.logs,
            args.models,
            args.out,
            encoder=args.encoder,
            policy=args.policy,
            seconds=args.seconds,
            most=args.windows,
            seed=args.seed,
            progress=progress,
        )
    print(
        f"{result['trajectories']} trajectories in {result['windows']} windows of {result['seconds']:g} s; "
        f"95 % intervals over resampled {result['bootstrap']['by']}s"
    )
    models = result["models"]
    print(f"{'':>28}" + "".join(f"{name:>34}" for name in models) + f"{'real halves':>14}")
    for name in models[args.models[0]]:
        cells = (models[model][name] for model in models)
        texts = (f"{c['value']:.3g} ({c['low']:.3g} .. {c['high']:.3g})" for c in cells)
        halves = f"{result['floor'][name]:>14.3g}" if name in result["floor"] else ""
        print(f"{name:>28}" + "".join(f"{text:>34}" for text in texts) + halves)
    return result


def bench(args: argparse.Namespace) -> Any:
    import torch

    from phase_sumo import bench as measure
    from phase_sumo.config import TrainConfig

    torch.set_num_threads(args.threads)
    networks = args.networks or [str(HELD_OUT)]
    results = []
    for part in args.parts or ["sim", "train", "bridge", "convert"]:
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
