"""The command line: the only place that knows arguments, progress bars and exit statuses."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from phase_sumo.cli.files import write_json
from phase_sumo.cli.parser import make_parser
from phase_sumo.cli.stop import interrupt
from phase_sumo.errors import PhaseError


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    arguments, sumo_options = _split(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(arguments)
    args.sumo_options = sumo_options
    signal.signal(signal.SIGTERM, interrupt)
    try:
        result = args.command(args)
        if args.json:
            write_json(Path(args.json), result)
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
