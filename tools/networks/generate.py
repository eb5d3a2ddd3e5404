"""Generate our own freeway networks: plain XML, then netconvert.

    python -m tools.networks.generate            # all networks and tuples.csv
    python -m tools.networks.generate f04_onramp3

Every network is a freeway of about 550 m; `specs` says what each one is. The result is the same on every
run: all dimensions are drawn with fixed seeds and netconvert's comment with time and options is removed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tools.networks.build import build
from tools.networks.plain_xml import netconvert
from tools.networks.spec import Spec
from tools.networks.specs import SPECS
from tools.networks.tuples import write_tuples
from tools.places import NETWORKS


def generate(spec: Spec, folder: Path = NETWORKS) -> Path:
    """Write the plain sources and the network of one spec; returns the ``.net.xml``."""
    plain = folder / "plain"
    target = folder / "held_out" if spec.held_out else folder
    for directory in (plain, target):
        directory.mkdir(parents=True, exist_ok=True)
    output = target / f"{spec.name}.net.xml"
    netconvert(build(spec).write(plain / spec.name), output, spec.left_hand)
    return output


def main() -> None:
    parser = argparse.ArgumentParser(description="Generate the shipped freeway networks with netconvert.")
    parser.add_argument("names", nargs="*", help="networks to generate (default: all, and tuples.csv)")
    parser.add_argument(
        "--out", type=Path, default=NETWORKS, help="folder to write to (default: the shipped ones)"
    )
    args = parser.parse_args()
    known = {spec.name: spec for spec in SPECS}
    if unknown := [name for name in args.names if name not in known]:
        parser.error(f"no network {', '.join(unknown)}; choose from {', '.join(known)}")
    for name in args.names or known:
        print(generate(known[name], args.out))
    if not args.names:
        print(write_tuples(args.out))


if __name__ == "__main__":
    main()
