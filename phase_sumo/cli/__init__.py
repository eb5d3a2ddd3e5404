"""The command line: the only place that knows arguments, progress bars and exit statuses."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from phase_sumo.cli.files import write_json
from phase_sumo.cli.parser import FLAGS, make_parser
from phase_sumo.errors import PhaseError
from phase_sumo.signals import handled, interrupt

DEVICE = "--device.phase."


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    arguments, sumo_options = _split(sys.argv[1:] if argv is None else argv)
    args = make_parser().parse_args(arguments)
    args.sumo_options = sumo_options
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


def _split(argv: list[str]) -> tuple[list[str], list[str]]:
    """Our arguments, and SUMO's own behind ``--``; ``--device.phase.*`` is ours on either side of it."""
    at = argv.index("--") if "--" in argv else len(argv)
    ours, sumos = _flags_with_values(argv[:at]), _flags_with_values(argv[at + 1 :])
    while found := [i for i, word in enumerate(sumos) if word.startswith(DEVICE)]:
        i = found[0]
        count = 1 if "=" in sumos[i] else 2
        ours += sumos[i : i + count]
        del sumos[i : i + count]
    return ours, sumos


def _flags_with_values(words: list[str]) -> list[str]:
    """SUMO's flags may stand without a value: ``--device.phase.deterministic`` gets its own."""
    result = list(words)
    for i in range(len(words) - 1, -1, -1):
        if words[i] == f"{DEVICE}deterministic":
            given = i + 1 < len(words) and words[i + 1].lower() in FLAGS
            result[i : i + 1 + given] = [f"{words[i]}={words[i + 1] if given else 'true'}"]
    return result
