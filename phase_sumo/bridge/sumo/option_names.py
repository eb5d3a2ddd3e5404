"""The options that SUMO has, asked of SUMO itself."""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass
from functools import cache

import sumolib
from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.errors import PhaseError, nearest

TRUE, FALSE = ("1", "yes", "true", "on", "x", "t"), ("0", "no", "false", "off", "-", "f")  # SUMO's


@dataclass(frozen=True)
class SumoOption:
    """One option: SUMO's own name for it, its default as text, and its kind: BOOL, TIME, FILE ..."""

    name: str
    default: str
    kind: str


@cache
def sumo_options() -> dict[str, SumoOption]:
    """By every name that SUMO takes for one, without the dashes."""
    asked = [sumolib.checkBinary("sumo"), "--save-template", "stdout"]
    template = subprocess.run(asked, capture_output=True, check=False).stdout
    try:
        elements = list(etree.fromstring(template).iter())
    except etree.XMLSyntaxError:
        raise PhaseError(f"{asked[0]}: does not list its options; install eclipse-sumo again") from None
    known: dict[str, SumoOption] = {}
    for element in elements:
        if element.get("type"):
            option = SumoOption(element.tag, element.get("value", ""), element.get("type"))
            known |= dict.fromkeys([option.name, *element.get("synonymes", "").split()], option)
    return known


def canonical(name: str) -> str:
    """SUMO's own name of an option, e.g. ``"n"`` -> ``"net-file"``; one that it does not know stays."""
    option = sumo_options().get(name)
    return option.name if option else name


def is_option(word: str) -> bool:
    """Whether a word of a command line names an option; a negative number does not."""
    return len(word) > 1 and word.startswith("-") and not re.fullmatch(r"-\.?\d.*", word)


def words_of(words: list[str], at: int) -> int:
    """How many words the option of SUMO at ``at`` takes, its value included.

    Raises:
        KeyError: SUMO has no such option.
    """
    name, equals, _ = words[at].lstrip("-").partition("=")
    option = sumo_options()[name]
    if equals or at + 1 == len(words):
        return 1
    return 2 if option.kind != "BOOL" or words[at + 1].lower() in TRUE + FALSE else 1


def parse_options(words: list[str] | tuple[str, ...]) -> dict[str, str]:
    """``["-e", "10", "--fcd-output=x", "--no-warnings"]`` -> SUMO's name -> value."""
    words, result = list(words), {}
    at = 0
    while at < len(words):
        word = words[at]
        if not is_option(word):
            raise PhaseError(f"SUMO option {word!r}: a value without an option; write --NAME VALUE")
        name, equals, value = word.lstrip("-").partition("=")
        if name.startswith("device.phase."):
            raise PhaseError(f"option --{name}: SUMO does not know it; pass it to phase-sumo, see --help")
        if name not in sumo_options():
            raise PhaseError(f"SUMO has no option {word}{nearest(name, sumo_options(), '--')}")
        count = words_of(words, at)
        if not equals:
            value = words[at + 1] if count == 2 else "true"
        result[canonical(name)] = value
        at += count
    return result
