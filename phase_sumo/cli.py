"""The command line: the only place that knows arguments, progress bars and exit statuses."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import phase_sumo
from phase_sumo.errors import PhaseError

CLONE = Path(phase_sumo.__file__).resolve().parent.parent
DEMO = CLONE / "scenarios" / "merge" / "merge.sumocfg"
HELD_OUT = CLONE / "networks" / "held_out"
Progress = Callable[[float, str], None]


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    arguments, sumo_options = _split(sys.argv[1:] if argv is None else argv)
    args = _parser().parse_args(arguments)
    args.sumo_options = sumo_options
    try:
        result = args.command(args)
        if args.json:
            _write_json(Path(args.json), result)
    except PhaseError as error:
        if args.debug:
            raise
        print(f"phase-sumo: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("phase-sumo: stopped", file=sys.stderr)
        return 130
    return 0


def _split(argv: list[str]) -> tuple[list[str], list[str]]:
    """Our arguments, and SUMO's own behind ``--``."""
    if "--" not in argv:
        return argv, []
    at = argv.index("--")
    return argv[:at], argv[at + 1 :]


# --- commands ------------------------------------------------------------------------------------------


def _convert(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.convert import convert

    with _progress("convert") as progress:
        rows = convert([Path(p) for p in args.networks], Path(args.out), progress)
    for row in rows:
        print(
            f"{row['name']}: {row['lanes']} lanes, {row['lane_km']:.1f} km of lane, {row['nodes']} nodes, "
            f"{row['pairs']} start-goal pairs ({row['lane_change_pairs']} with lane changes), "
            f"{row['seconds']:.1f} s"
        )
        for warning in row["warnings"]:
            print(f"  warning: {warning}")
    return rows


def _train(args: argparse.Namespace) -> Any:
    from dataclasses import replace

    from phase_sumo.config import preset
    from phase_sumo.train.loop import Trainer
    from phase_sumo.train.run_folder import RunFolder

    folder = RunFolder(args.run)
    config = folder.config() if args.resume else replace(preset(args.preset), seed=args.seed)
    if args.steps:
        config = replace(config, total_steps=args.steps)
    maps = _maps(args.networks, folder.path / "maps")
    held_out = _maps(args.held_out, folder.path / "maps") if args.held_out else []
    trainer = Trainer(config, maps, held_out, folder, args.resume)
    stop: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, _: stop.append(number))
    try:
        with _progress("train") as progress:
            trainer.run(
                lambda row: progress(row["steps"] / config.total_steps, _rates(row)), lambda: bool(stop)
            )
    finally:
        signal.signal(signal.SIGINT, previous)
    print(f"{trainer.steps} agent steps, policy in {folder.policy}")
    if stop:
        raise KeyboardInterrupt
    return {**trainer.rows[-1], "agent_steps": trainer.steps, "policy": str(folder.policy)}


def _rates(row: dict[str, float]) -> str:
    shares = f"goal {row['goal_rate']:.2f}  collision {row['collision_rate']:.2f}  "
    speed = row["steps"] / max(row["wall_seconds"], 1e-9)
    return f"{shares}off road {row['road_edge_rate']:.2f}  rho {row['rho']:.2f}  {speed:.0f} steps/s"


def _evaluate(args: argparse.Namespace) -> Any:
    from phase_sumo.config import TrainConfig
    from phase_sumo.evaluate.synthetic import RATES, evaluate_synthetic
    from phase_sumo.policy.checkpoint import load_policy

    sources = []
    for source in args.scenarios:
        kind, _, path = source.partition(":")
        if kind != "synthetic" or not path:
            raise PhaseError(
                f"scenario source {source!r} is not known; use synthetic:PATH of networks or map bundles"
            )
        sources.append(path)
    policy = load_policy(args.policy)
    config = TrainConfig()
    with _progress("evaluate") as progress:
        result = evaluate_synthetic(
            policy,
            _maps(sources, None),
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


def _run(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.run import run_scenario

    with _progress("run") as progress:
        result = run_scenario(
            args.cfg,
            policy=args.policy,
            share=args.share,
            types=args.types,
            alpha=_alpha(args.alpha),
            seed=args.seed,
            end=args.end,
            gui=args.gui,
            sumo_options=args.sumo_options,
            output_dir=args.out,
            progress=progress,
        )
    for name, value in result.items():
        if not isinstance(value, dict):
            print(f"{name}: {f'{value:.4g}' if isinstance(value, float) else value}")
    return result


def _compare(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.compare import compare

    with _progress("compare") as progress:
        result = compare(
            args.cfg,
            args.models,
            out_dir=args.out,
            seeds=args.seeds,
            policy=args.policy,
            share=args.share,
            types=args.types,
            alpha=_alpha(args.alpha),
            end=args.end,
            sumo_options=args.sumo_options,
            progress=progress,
        )
    print(f"report: {result['report']}")
    return result


def _demo(args: argparse.Namespace) -> Any:
    from phase_sumo.bridge.compare import compare

    if not DEMO.exists():
        raise PhaseError(f"{DEMO}: the demo scenario comes with a clone of the project; run it from one")
    print("PHASE against SUMO's IDM on a three-lane motorway with an on-ramp and an off-ramp")
    with _progress("demo") as progress:
        result = compare(DEMO, ("phase", "idm"), out_dir=args.out, seeds=[args.seed], progress=progress)
    for name in ("mean_speed", "travel_time", "flow", "collisions", "lane_changes_per_km"):
        means = {model: summary[name]["mean"] for model, summary in result["summary"].items()}
        print(f"{name:>20}: " + "  ".join(f"{model} {value:.2f}" for model, value in means.items()))
    phase = next(row for row in result["runs"] if row["model"] == "phase")
    arrived, inserted = phase["phase_arrived_under_policy"], phase["phase_vehicles"]
    print(f"{arrived} of {inserted} PHASE vehicles arrived under the policy")
    print(f"report: {Path(result['report']).resolve()}")
    return result


def _bench(args: argparse.Namespace) -> Any:
    import torch

    from phase_sumo import bench
    from phase_sumo.config import TrainConfig

    torch.set_num_threads(args.threads)
    networks = args.networks or [str(HELD_OUT)]
    results = []
    for part in args.parts or ["sim", "train", "bridge", "convert"]:
        with _progress(f"bench {part}") as progress:
            if part == "sim":
                results.append(
                    bench.bench_sim(_maps(networks, None), 16, 64, args.steps, args.seed, progress)
                )
            elif part == "train":
                results.append(bench.bench_train(_maps(networks, None), TrainConfig(), 5, progress))
            elif part == "convert":
                results.append(bench.bench_convert(_files(networks, (".net.xml", ".net.xml.gz")), progress))
            else:
                results.append(bench.bench_bridge(Path(args.cfg), args.seed, progress))
        print("  ".join(f"{k} {f'{v:.4g}' if isinstance(v, float) else v}" for k, v in results[-1].items()))
    return {"machine": bench.machine(), "results": results}


# --- helpers -------------------------------------------------------------------------------------------


def _files(paths: list[str], endings: tuple[str, ...]) -> list[Path]:
    """Files named directly, and those with one of the endings in folders."""
    found: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.name.endswith(endings))
            if not inside:
                raise PhaseError(f"{path}: no file ending in {' or '.join(endings)} in this folder")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise PhaseError(f"{path}: no such file or folder")
    return found


def _maps(paths: list[str], keep: Path | None) -> list[Any]:
    """Map bundles from ``.npz`` files, or from SUMO networks converted now (into ``keep``, if given)."""
    from phase_sumo.sim.bundle import load_bundle

    maps = []
    for path in _files(paths, (".npz", ".net.xml", ".net.xml.gz")):
        if path.suffix == ".npz":
            maps.append(load_bundle(path))
            continue
        from phase_sumo.bridge.convert import build_bundle
        from phase_sumo.bridge.network import read_network
        from phase_sumo.sim.bundle import save_bundle

        maps.append(build_bundle(read_network(path)))
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            save_bundle(keep / f"{maps[-1].name}.npz", maps[-1])
    return maps


def _alpha(values: list[float] | None) -> float | tuple[float, float] | None:
    if not values:
        return None
    if len(values) > 2 or not all(0.1 <= v <= 1.0 for v in values):
        raise PhaseError(f"--alpha {' '.join(map(str, values))}: pass one value or two bounds within 0.1..1")
    return values[0] if len(values) == 1 else (values[0], values[1])


def _write_json(path: Path, result: Any) -> None:
    temporary = path.with_name(path.name + ".part")
    try:
        temporary.write_text(json.dumps(result, indent=1) + "\n")
        os.replace(temporary, path)
    except OSError as error:
        raise PhaseError(
            f"{path}: cannot be written ({error.strerror}); choose another --json file"
        ) from None


@contextmanager
def _progress(title: str) -> Iterator[Progress]:
    """A progress bar on stderr."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.fields[title]}"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("", total=1.0, title=title)
        yield lambda share, text: bar.update(task, completed=share, description=text)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="phase-sumo", description="PHASE self-play highway traffic for SUMO.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"phase-sumo {phase_sumo.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, command: Callable[[argparse.Namespace], Any], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=text,
            description=text,
            allow_abbrev=False,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        sub.set_defaults(command=command)
        sub.add_argument("--json", metavar="FILE", help="write the results there as JSON")
        sub.add_argument("--seed", type=int, default=0, help="fixes every random number")
        sub.add_argument("--debug", action="store_true", help="show tracebacks")
        return sub

    sub = add("convert", _convert, "SUMO networks to training maps (.npz) with a picture of each")
    sub.add_argument("networks", nargs="+", metavar="NET", help=".net.xml or .net.xml.gz")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for bundles and pictures")

    sub = add("train", _train, "train a policy by self-play")
    sub.add_argument(
        "--networks", nargs="+", required=True, metavar="PATH", help=".npz, .net.xml, or folders of them"
    )
    sub.add_argument(
        "--held-out", nargs="+", metavar="PATH", help="networks to evaluate on, never trained on"
    )
    sub.add_argument("--run", required=True, metavar="DIR", help="folder of the run")
    sub.add_argument(
        "--preset", default="phase", help="phase, no-dclamp, no-reweighting, no-curriculum or smoke"
    )
    sub.add_argument("--steps", type=int, help="agent steps of the whole training; the preset's if left out")
    sub.add_argument("--resume", action="store_true", help="continue the run in --run")

    sub = add("evaluate", _evaluate, "goal, collision and road-edge rates of a policy")
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument(
        "--scenarios", nargs="+", required=True, metavar="SRC", help="synthetic:PATH of networks"
    )
    sub.add_argument("--worlds", type=int, default=64, help="worlds side by side")
    sub.add_argument("--episodes", type=int, default=4, help="episodes of 9.1 s per world")
    sub.add_argument("--greedy", action="store_true", help="most probable actions instead of sampled ones")

    for name, command, text in (
        ("run", _run, "run a SUMO scenario with PHASE vehicles; SUMO's own options go behind --"),
        ("compare", _compare, "the same demand under several driver models, with an HTML report"),
    ):
        sub = add(name, command, text)
        sub.add_argument("cfg", metavar="CFG.sumocfg")
        sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
        sub.add_argument("--share", type=float, default=1.0, help="of the vehicles that PHASE drives, 0..1")
        sub.add_argument(
            "--types",
            nargs="+",
            default=[],
            metavar="VTYPE",
            help="vTypes that PHASE drives; all if left out",
        )
        sub.add_argument(
            "--alpha",
            nargs="+",
            type=float,
            metavar="A",
            help="action range, one value or two bounds in 0.1..1",
        )
        sub.add_argument("--end", type=float, metavar="S", help="stop at this simulated time in s")
        if name == "run":
            sub.add_argument("--out", metavar="DIR", help="folder for SUMO's and our outputs")
            sub.add_argument("--gui", action="store_true", help="show SUMO's window")
        else:
            sub.add_argument(
                "--models", nargs="+", default=["phase", "idm"], help="phase, idm, krauss, eidm ..."
            )
            sub.add_argument("--seeds", type=int, default=1, help="how many seeds, counted from 1")
            sub.add_argument("--out", required=True, metavar="DIR", help="folder for the report")

    sub = add("bench", _bench, "throughput of simulator, training, bridge and converter")
    sub.add_argument(
        "parts",
        nargs="*",
        choices=["sim", "train", "bridge", "convert"],
        metavar="PART",
        help="all if left out",
    )
    sub.add_argument(
        "--networks", nargs="+", metavar="PATH", help="the clone's held-out networks if left out"
    )
    sub.add_argument("--cfg", default=str(DEMO), metavar="CFG.sumocfg", help="scenario of the bridge")
    sub.add_argument("--steps", type=int, default=100, help="simulator steps")
    sub.add_argument("--threads", type=int, default=1, help="torch threads")

    sub = add("demo", _demo, "the shipped policy against IDM on the shipped merge scenario")
    sub.add_argument("--out", default="out/demo", metavar="DIR", help="folder for the report")
    sub.set_defaults(seed=1)
    return parser
