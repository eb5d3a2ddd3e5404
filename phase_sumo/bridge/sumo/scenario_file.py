"""Reading a ``.sumocfg``: its options, the files that it names, times in SUMO's spelling."""

from __future__ import annotations

from pathlib import Path

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.sumo.option_names import canonical
from phase_sumo.errors import PhaseError


def read_config(path: Path) -> dict[str, str]:
    """SUMO's option name -> value as written."""
    if not path.is_file():
        raise PhaseError(f"{path}: no such scenario file; pass a .sumocfg")
    try:
        root = etree.parse(str(path)).getroot()
    except etree.XMLSyntaxError as error:
        raise PhaseError(f"{path}: not readable as XML ({error}); pass a .sumocfg") from None
    config = {}
    for element in root.iter():
        if not isinstance(element.tag, str):
            continue
        value = element.get("value", element.get("v"))
        if value is not None:
            config[canonical(element.tag)] = value
    if not config:
        raise PhaseError(f"{path}: holds no SUMO options; pass a .sumocfg")
    return config


def existing(path: Path | None, option: str, name: str, base: Path) -> Path:
    """The file ``name``, relative to ``base``, that an option of the scenario ``path`` names."""
    for candidate in (base / name, base / name.replace("\\", "/")):
        if candidate.is_file():
            return candidate
    raise PhaseError(
        f"{path or 'the command line'}: option {option}: {base / name} does not exist; correct the path"
    )


def seconds(path: Path | None, name: str, text: str) -> float:
    """Seconds from SUMO's ``12.5`` or ``[[d:]h:]m:s``."""
    try:
        parts = [float(p) for p in text.split(":")]
    except ValueError:
        raise PhaseError(
            f"{path or 'SUMO'}: option {name}={text!r} is no time; write seconds or hh:mm:ss"
        ) from None
    scale = (1.0, 60.0, 3600.0, 86400.0)
    return sum(p * s for p, s in zip(reversed(parts), scale, strict=False))
