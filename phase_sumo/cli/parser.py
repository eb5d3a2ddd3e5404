"""Arguments of every command."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import phase_sumo
from phase_sumo.cli import commands, evaluation, scenario_arguments
from phase_sumo.cli.files import TUNE_TABLE
from phase_sumo.cli.words import CommandParser, count

RUN_SUMO = ("check", "run", "compare", "search")

SUMOS = "Every option of SUMO passes through, also behind --; sumo --help lists them."


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="phase-sumo", description="PHASE self-play highway traffic for SUMO.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"phase-sumo {phase_sumo.__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=CommandParser)

    def add(name: str, command: Callable[[argparse.Namespace], Any], text: str) -> CommandParser:
        runs_sumo = name in RUN_SUMO
        sub = subparsers.add_parser(
            name, help=text, description=text, runs_sumo=runs_sumo, epilog=SUMOS if runs_sumo else None
        )
        sub.set_defaults(command=command)
        sub.add_argument("--json", metavar="FILE", help="write the results there as JSON")
        sub.add_argument("--debug", action="store_true", help="show tracebacks")
        if runs_sumo:
            sub.add_argument("cfg", nargs="?", metavar="CFG.sumocfg")
            sub.add_argument(
                "-c", "--configuration-file", dest="config", metavar="FILE", help="the same, as for SUMO"
            )
        if name not in ("run", "compare", "check"):
            sub.add_argument("--seed", type=int, default=0, help="fixes every random number")
        return sub

    sub = add("convert", commands.convert, "road networks to training maps (.npz) with a picture of each")
    sub.add_argument(
        "networks",
        nargs="+",
        metavar="NET",
        help=".net.xml, .osm (OpenStreetMap) or .xodr (OpenDRIVE), or .gz",
    )
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for bundles and pictures")
    sub.add_argument(
        "--keep",
        choices=["freeway", "all"],
        default="freeway",
        help="motorways and trunk roads with their ramps, or every lane for cars or trucks",
    )
    sub.add_argument(
        "--stretch",
        type=float,
        default=500.0,
        metavar="METRES",
        help="cut long networks into stretches of about this driving distance; 0 leaves them whole",
    )
    sub.add_argument(
        "--left-hand", action="store_true", help="an .osm file is from where traffic drives on the left"
    )

    sub = add("train", commands.train, "train a policy by self-play")
    sub.add_argument(
        "--networks", nargs="+", required=True, metavar="PATH", help=".npz, .net.xml, or folders of them"
    )
    sub.add_argument(
        "--held-out", nargs="+", metavar="PATH", help="networks to evaluate on, never trained on"
    )
    sub.add_argument("--run", required=True, metavar="DIR", help="folder of the run")
    sub.add_argument(
        "--preset",
        default="phase",
        help="phase, paper, no-dclamp, no-reweighting, no-curriculum, gpudrive, gpudrive-same-model or smoke",
    )
    sub.add_argument(
        "--steps", type=count, help="agent steps of the whole training, e.g. 4e7; the preset's if left out"
    )
    sub.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=VALUE",
        help="settings, dotted where nested: reward.collision=2; the preset's if left out",
    )
    sub.add_argument("--worlds", type=count, help="worlds side by side; the preset's if left out")
    sub.add_argument("--threads", type=count, help="of torch; as many as it takes if left out")
    sub.add_argument("--device", help="cpu, cuda or cuda:N; cpu if left out, under torchrun a GPU for each")
    sub.add_argument("--resume", action="store_true", help="continue the run in --run")
    sub.add_argument("--start-from", metavar="POLICY", help="begin with the weights of this policy")

    sub = add("tune", commands.tune, "search training settings for the best held-out goal rate (Optuna)")
    sub.add_argument(
        "--networks", nargs="+", required=True, metavar="PATH", help=".npz, .net.xml, or folders of them"
    )
    sub.add_argument(
        "--held-out", nargs="+", required=True, metavar="PATH", help="networks that trials are judged on"
    )
    sub.add_argument(
        "--run", required=True, metavar="DIR", help="folder of the study; trials join what is there"
    )
    sub.add_argument("--preset", default="phase", help="the training that is varied")
    sub.add_argument("--steps", type=count, default=1_000_000, help="agent steps of each trial")
    sub.add_argument("--trials", type=int, default=20, help="how many this process adds to the study")
    sub.add_argument("--table", default=str(TUNE_TABLE), metavar="CSV", help="settings and their ranges")

    sub = add("evaluate", evaluation.evaluate, "goal, collision and road-edge rates of a policy")
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument(
        "--scenarios",
        nargs="+",
        required=True,
        metavar="SRC",
        help="synthetic:benchmark (fixed worlds), synthetic:PATH of networks, or recorded traffic: "
        "commonroad:DIR, exid:DIR, highd:DIR, ngsim:FILE, tracks:FILE (tracks:FILE@MAP)",
    )
    sub.add_argument(
        "--references",
        action="store_true",
        help="other drivers beside it: constant velocity and, in the benchmark, random actions, in recorded "
        "traffic the log itself and SUMO's IDM",
    )
    sub.add_argument("--worlds", type=count, default=64, help="synthetic worlds side by side")
    sub.add_argument("--episodes", type=int, default=4, help="episodes of 9.1 s per synthetic world")
    sub.add_argument(
        "--windows",
        type=int,
        default=512,
        metavar="N",
        help="recorded windows of 10 s at most, drawn at random",
    )
    sub.add_argument("--all-windows", action="store_true", help="recorded windows without a lane change, too")
    sub.add_argument(
        "--sampled", action="store_true", help="actions drawn from the policy, not its most probable ones"
    )

    sub = add("steer", evaluation.steer, "how far outcomes follow alpha, target speed, vehicle type and goal")
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument(
        "--regime",
        default="moderate",
        choices=["jammed", "dense", "moderate", "free"],
        help="traffic of the benchmark's worlds that are driven",
    )
    sub.add_argument("--worlds", type=count, default=24, help="at most this many of them")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for steering.csv and steering.png")

    sub = add(
        "search",
        evaluation.search,
        "find a near-miss or a cut-in by context alone, as a SUMO scenario to replay",
    )
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument("--time", type=float, default=40.0, metavar="S", help="the moment")
    sub.add_argument("--around", metavar="ID", help="vehicle in the middle; where most are if left out")
    sub.add_argument("--radius", type=float, default=80.0, metavar="METRES", help="of the scene")
    sub.add_argument(
        "--criterion",
        choices=["near-miss", "cut-in"],
        default="near-miss",
        help="least time to collision, or least time gap behind a lane change",
    )
    sub.add_argument("--vary", type=int, default=4, metavar="N", help="vehicles whose context is searched")
    sub.add_argument("--seconds", type=float, default=12.0, help="length of the scenario")
    sub.add_argument("--budget", type=int, default=96, metavar="N", help="runs")
    sub.add_argument("--contact", action="store_true", help="allow runs with collisions")
    sub.add_argument(
        "--out", required=True, metavar="DIR", help="folder of the scenario, which takes its name"
    )

    sub = add("check", commands.check, "what PHASE drives of a scenario, what it leaves to SUMO, and why")
    scenario_arguments.add_driving(sub)
    sub = add("run", commands.run, "run a SUMO scenario with PHASE vehicles")
    scenario_arguments.add_driving(sub)
    scenario_arguments.add_run(sub)
    sub = add("compare", commands.compare, "the same demand under several driver models, with an HTML report")
    scenario_arguments.add_driving(sub, own_seed=False)
    scenario_arguments.add_compare(sub)

    sub = add("realism", evaluation.realism, "how far rollouts from recorded initial states are from the log")
    sub.add_argument(
        "--logs",
        nargs="+",
        required=True,
        metavar="SRC",
        help="tracks:FILE, commonroad:DIR of recorded traffic",
    )
    sub.add_argument("--models", nargs="+", default=["phase", "idm"], help="phase, idm, krauss, eidm ...")
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument(
        "--encoder",
        metavar="FILE",
        help="trained before; if left out, one is trained on every second recording",
    )
    sub.add_argument("--seconds", type=float, default=5.0, help="length of a window in s")
    sub.add_argument("--windows", type=int, default=64, metavar="N", help="windows tested at most")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for encoder and figure")

    sub = add("bench", commands.bench, "throughput of simulator, training, bridge and converter")
    sub.add_argument(
        "parts",
        nargs="*",
        type=_part,
        metavar="PART",
        help=f"{', '.join(commands.PARTS)}; all if left out",
    )
    sub.add_argument(
        "--networks", nargs="+", metavar="PATH", help="the clone's held-out networks if left out"
    )
    sub.add_argument(
        "--vehicles",
        type=int,
        nargs="+",
        default=[250, 1000, 2000],
        help="concurrent PHASE vehicles on a synthetic motorway, for the bridge",
    )
    sub.add_argument(
        "--cfg", metavar="CFG.sumocfg", help="measure the bridge on this scenario instead, to its end"
    )
    sub.add_argument("--steps", type=count, default=100, help="steps of simulator and bridge")
    sub.add_argument("--threads", type=count, default=1, help="torch threads")

    sub = add("demo", commands.demo, "the shipped policy against IDM on the shipped merge scenario")
    sub.add_argument("--out", default="out/demo", metavar="DIR", help="folder for the report")
    sub.set_defaults(seed=1)
    return parser


def _part(text: str) -> str:
    """Of the benchmark; ``choices`` would refuse an empty list."""
    if text not in commands.PARTS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(commands.PARTS)}")
    return text
