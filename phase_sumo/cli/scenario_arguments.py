"""Arguments of the commands that run a SUMO scenario."""

from __future__ import annotations

import argparse
import re

from phase_sumo.cli.words import count, flag, time


def add_driving(sub: argparse.ArgumentParser, own_seed: bool = True) -> None:
    """Who drives which vehicles, until when; ``own_seed`` for one run alone."""
    sub.add_argument("--policy", metavar="FILE", help="the shipped policy if left out")
    sub.add_argument(
        "--share",
        "--device.phase.probability",
        type=float,
        metavar="P",
        help="of the vehicles that PHASE drives, 0..1; if left out 1, or 0 with explicit ids",
    )
    sub.add_argument(
        "--device.phase.explicit",
        dest="explicit",
        type=_ids,
        default=[],
        metavar="ID,ID",
        help="vehicles that PHASE drives in any case",
    )
    sub.add_argument(
        "--device.phase.deterministic",
        dest="deterministic",
        type=flag,
        default=False,
        metavar="BOOL",
        help="meet the share by counting vehicles instead of drawing",
    )
    sub.add_argument(
        "--types",
        nargs="+",
        default=[],
        metavar="VTYPE",
        help="vTypes that the share is taken of; all if left out",
    )
    sub.add_argument(
        "--alpha",
        nargs="+",
        type=float,
        metavar="A",
        help="action range, one value or two bounds in 0.1..1; drawn from 0.3..1 if left out",
    )
    sub.add_argument(
        "--time-gap",
        type=float,
        metavar="S",
        help="that target speeds leave to the leader; 0: the policy alone; each vType's tau if left out",
    )
    sub.add_argument(
        "--guard",
        type=flag,
        default=True,
        metavar="on/off",
        help="keep PHASE vehicles from what is unsafe whatever the policy wants; on if left out",
    )
    sub.add_argument(
        "-e", "--end", type=time, metavar="S", help="stop at this time; the scenario's end if left out"
    )
    if own_seed:
        sub.add_argument("--seed", type=int, help="SUMO's and ours; the scenario's if left out")


def add_run(sub: argparse.ArgumentParser) -> None:
    """What one run alone has."""
    sub.add_argument(
        "--out",
        metavar="DIR",
        help="folder for SUMO's and our outputs; without, SUMO's stay where the scenario has them",
    )
    sub.add_argument("--gui", action="store_true", help="show SUMO's window")
    sub.add_argument("--traci", action="store_true", help="SUMO in a process of its own instead of libsumo")


def add_compare(sub: argparse.ArgumentParser) -> None:
    """What several runs have."""
    sub.add_argument(
        "--models",
        nargs="+",
        default=["phase", "idm"],
        help="phase, phase:0.3 (30 %% PHASE among the first SUMO model named), idm, krauss, eidm ...",
    )
    sub.add_argument(
        "--seeds",
        type=count,
        nargs="+",
        default=[1],
        metavar="N",
        help="how many, counted from --seed; or which, when there are several numbers",
    )
    sub.add_argument("--seed", type=int, default=1, help="the first of them")
    sub.add_argument("--jobs", type=int, metavar="N", help="simulations at a time; one per core if left out")
    sub.add_argument("--out", required=True, metavar="DIR", help="folder for the report")


def _ids(text: str) -> list[str]:
    return [name for name in re.split(r"[,;\s]+", text) if name]
