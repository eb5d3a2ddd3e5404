"""The words of a command line: ours, SUMO's options among them, and what is neither."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from phase_sumo.errors import nearest

DEVICE = "--device.phase."  # ours, though it reads like one of SUMO's devices
FLAGS = {
    "true": True,
    "1": True,
    "yes": True,
    "on": True,
    "false": False,
    "0": False,
    "no": False,
    "off": False,
}


class Formatter(argparse.HelpFormatter):
    """Says the default of every option that has one."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text, default = action.help or "", action.default
        silent = (
            action.required or default in (None, False, [], argparse.SUPPRESS) or not action.option_strings
        )
        if silent or "%(default)" in text:
            return text
        shown = " ".join(map(str, default)) if isinstance(default, list | tuple) else default
        return f"{text} (default: {str(shown).replace('%', '%%')})"


class CommandParser(argparse.ArgumentParser):
    """Arguments of one command; where SUMO runs, its options are set aside in ``sumo_options``."""

    def __init__(self, *args: Any, runs_sumo: bool = False, **kwargs: Any) -> None:
        super().__init__(*args, allow_abbrev=False, formatter_class=Formatter, **kwargs)
        self.runs_sumo = runs_sumo

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[override]  # argparse's has overloads
        """Called by the parser of all commands with the words behind the command's name."""
        ours, sumos = self._sorted(list(args or ()))
        namespace, rest = super().parse_known_args(ours, namespace)
        if rest:
            self.error(f"{' '.join(rest)}: one argument too many")
        namespace.sumo_options, namespace.runs_sumo = sumos, self.runs_sumo
        return namespace, []

    def _sorted(self, words: Sequence[str]) -> tuple[list[str], list[str]]:
        """Our words and SUMO's, each in their order."""
        ours: list[str] = []
        sumos: list[str] = []
        at = 0
        while at < len(words):
            word = words[at]
            if not word.startswith("-") or _is_number(word) or word.partition("=")[0] in self.known:
                ours.append(word)
                at += 1
                continue
            count = self._count_sumos(words, at)
            sumos += words[at : at + count]
            at += count
        return ours, sumos

    @property
    def known(self) -> list[str]:
        """Our options."""
        return list(self._option_string_actions)

    def _count_sumos(self, words: Sequence[str], at: int) -> int:
        """How many words an option of SUMO takes; one that nobody knows is an error."""
        name = words[at].partition("=")[0]
        names = {each.lstrip("-"): each for each in self.known}
        if self.runs_sumo:
            from phase_sumo.bridge.sumo.option_names import sumo_options, words_of

            if name.lstrip("-") in sumo_options():
                return words_of(list(words), at)
            names |= {each: f"--{each}" for each in sumo_options()}
        return self.error(f"there is no option {name}{nearest(name.lstrip('-'), names, '--')}")


def split(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Our arguments, and SUMO's own behind ``--``; ``--device.phase.*`` is ours on either side of it."""
    at = argv.index("--") if "--" in argv else len(argv)
    ours, sumos = _flags_with_values(argv[:at]), _flags_with_values(argv[at + 1 :])
    while found := [i for i, word in enumerate(sumos) if word.startswith(DEVICE)]:
        i = found[0]
        count = 1 if "=" in sumos[i] else 2
        ours += sumos[i : i + count]
        del sumos[i : i + count]
    return ours, sumos


def count(text: str) -> int:
    """A whole number, also as ``4e5``."""
    value = float(text)
    if value != int(value):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number")
    return int(value)


def flag(text: str) -> bool:
    if text.lower() not in FLAGS:
        raise argparse.ArgumentTypeError(f"{text!r} is neither true nor false")
    return FLAGS[text.lower()]


def time(text: str) -> float:
    """Seconds, also as ``hh:mm:ss``."""
    parts = [float(part) for part in text.split(":")]
    return sum(
        part * scale for part, scale in zip(reversed(parts), (1.0, 60.0, 3600.0, 86400.0), strict=False)
    )


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _flags_with_values(words: Sequence[str]) -> list[str]:
    """SUMO's flags may stand without a value: ``--device.phase.deterministic`` gets its own."""
    result = list(words)
    for i in range(len(words) - 1, -1, -1):
        if words[i] == f"{DEVICE}deterministic":
            given = i + 1 < len(words) and words[i + 1].lower() in FLAGS
            result[i : i + 1 + given] = [f"{words[i]}={words[i + 1] if given else 'true'}"]
    return result
