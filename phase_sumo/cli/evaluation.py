"""What the commands about the quality of driving do with the parsed arguments."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from phase_sumo.cli.commands import scenario_of
from phase_sumo.cli.files import held_out_maps, load_maps, progress_bar
from phase_sumo.errors import PhaseError

COLUMNS = {
    "goal_rate": "GR %",
    "agent_collision_rate": "CR_a %",
    "road_collision_rate": "CR_r %",
    "success_rate": "SR %",
    "ade_5s": "ADE_5s m",
    "fde_5s": "FDE_5s m",
}
SUMMARY = ("mean", "std", "low", "high")


def evaluate(args: argparse.Namespace) -> Any:
    """One family of sources at a time: worlds of our own, or recorded traffic."""
    from phase_sumo.logs.sources import READERS

    kinds = {source.partition(":")[0] for source in args.scenarios}
    for source in args.scenarios:
        if source.partition(":")[0] not in ("synthetic", *READERS):
            known = ", ".join(f"{kind}:PATH" for kind in ("synthetic", *READERS))
            raise PhaseError(f"{source}: no such source of scenarios; pass synthetic:benchmark, {known}")
    if "synthetic" not in kinds:
        return _logs(args)
    if kinds != {"synthetic"}:
        raise PhaseError("evaluate synthetic worlds and recorded traffic apart: they have other measures")
    if "synthetic:benchmark" in args.scenarios:
        return _benchmark(args)
    return _synthetic(args)


def _synthetic(args: argparse.Namespace) -> Any:
    from phase_sumo.config import TrainConfig
    from phase_sumo.evaluate.synthetic import RATES, evaluate_synthetic
    from phase_sumo.policy.checkpoint import load_policy

    sources = [source.partition(":")[2] for source in args.scenarios]
    if "" in sources:
        raise PhaseError("synthetic: names no networks; use synthetic:PATH or synthetic:benchmark")
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
            sampled=args.sampled,
            progress=lambda share: progress(share, "worlds"),
        )
    print(f"{result['agents']} agents in {result['scenarios']} scenarios")
    groups = {"all": result, **result["by_regime"], **result["by_type"]}
    print(f"{'':>18}" + "".join(f"{name.removesuffix('_rate'):>17}" for name in RATES))
    for name, rates in groups.items():
        print(f"{name:>18}" + "".join(f"{100 * rates[rate]:>16.1f}%" for rate in RATES))
    return result


def _logs(args: argparse.Namespace) -> Any:
    from phase_sumo.policy.checkpoint import load_policy
    from phase_sumo.studies.log_protocol import evaluate_logs

    with progress_bar("evaluate") as progress:
        result = evaluate_logs(
            args.scenarios,
            load_policy(args.policy),
            most=args.windows,
            all_windows=args.all_windows,
            references=args.references,
            seed=args.seed,
            sampled=args.sampled,
            progress=progress,
        )
    print(f"{result['agents']} agents in {result['scenarios']} windows of {result['recordings']} recordings")
    print("mean±standard deviation over windows (95 % interval of the mean, drawn by recording)")
    rows = {"policy": result, **result["by_source"], **result["by_type"], **result["references"]}
    width = max(map(len, rows))
    counts = {"scenarios": "windows", "agents": "agents"}
    print(
        " " * width
        + "".join(f"{t:>9}" for t in counts.values())
        + "".join(f"{t:>28}" for t in COLUMNS.values())
    )
    for name, row in rows.items():
        print(
            f"{name:>{width}}"
            + "".join(f"{row[c]:>9}" for c in counts)
            + "".join(f"{_cell(column, row[column]):>28}" for column in COLUMNS)
        )
    return result


def _cell(column: str, value: dict[str, float | None]) -> str:
    """mean±std (95 % interval of the mean), in % or m, as far as they are known."""
    scale, digits = (1.0, 2) if column.endswith("5s") else (100.0, 1)
    mean, std, low, high = (
        "" if v is None else f"{scale * v:.{digits}f}" for v in (value[k] for k in SUMMARY)
    )
    return (mean or "-") + (f"±{std}" if std else "") + (f" ({low}..{high})" if low else "")


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
                args.sampled,
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
    from phase_sumo.evaluate.benchmark import load_benchmark
    from phase_sumo.evaluate.fixed_worlds import policy_driver
    from phase_sumo.evaluate.steering.egos import choose_egos
    from phase_sumo.evaluate.steering.outcomes import Stage
    from phase_sumo.evaluate.steering.response import measure_steering
    from phase_sumo.policy.checkpoint import load_policy
    from phase_sumo.report.study_figures import draw_steering, write_steering

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

    from phase_sumo.bridge.drive_options import DriveOptions
    from phase_sumo.policy.checkpoint import load_policy, policy_bytes
    from phase_sumo.studies import search as encounters

    policy, out = load_policy(args.policy), Path(args.out)
    options = DriveOptions(policy=policy, guard=False, sumo_options=args.sumo_options)
    scene = encounters.read_scene(scenario_of(args), options, args.time, args.around, args.radius)
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


def realism(args: argparse.Namespace) -> Any:
    from phase_sumo.report.study_figures import cluster_figure
    from phase_sumo.studies.realism import realism as compare

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
            draw=cluster_figure,
            progress=progress,
        )
    print(
        f"{result['trajectories']} trajectories in {result['windows']} windows of {result['seconds']:g} s; "
        f"95 % intervals over resampled {result['bootstrap']['by']}s"
    )
    lost = ", ".join(f"{name} {count}" for name, count in result["lost"].items())
    print(f"whole trajectories of the log that a rollout has not, left out on all sides: {lost}")
    models = result["models"]
    print(f"{'':>28}" + "".join(f"{name:>34}" for name in models) + f"{'real halves':>14}")
    for name in models[args.models[0]]:
        cells = (models[model][name] for model in models)
        texts = (f"{c['value']:.3g} ({c['low']:.3g} .. {c['high']:.3g})" for c in cells)
        halves = f"{result['floor'][name]:>14.3g}" if name in result["floor"] else ""
        print(f"{name:>28}" + "".join(f"{text:>34}" for text in texts) + halves)
    return result
