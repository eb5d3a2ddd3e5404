"""The command line: the only place that knows arguments, progress bars and exit statuses."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from phase_sumo.cli.files import write_json
from phase_sumo.cli.parser import make_parser
from phase_sumo.cli.words import split
from phase_sumo.errors import PhaseError
from phase_sumo.signals import handled, interrupt


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a name that the terminal cannot show is no reason to fail
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    words, behind = split(sys.argv[1:] if argv is None else argv)
    parser = make_parser()
    args = parser.parse_args(words)
    if behind and not args.runs_sumo:
        parser.error(f"{' '.join(behind)}: options of SUMO, which this command does not run")
    args.sumo_options += behind
    try:
        with handled([signal.SIGTERM], interrupt):
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
