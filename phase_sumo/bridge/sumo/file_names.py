"""File names in scenarios as SUMO reads and writes them."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

# what we write into an output folder
OURS = ("result.json", "events.csv", "trips.csv", "trajectories.npz")
NO_FILE = ("nul", "/dev/null", "stdout", "stderr", "-", "")
STAMP = "%Y-%m-%d-%H-%M-%S"


def expand(text: str) -> str:
    """``${NAME}`` and a leading ``~/`` replaced; a variable that is not set is empty, as for SUMO.

    SUMO's own ``PID``, ``LOCALTIME`` and ``UTC`` are of this process and of now.
    """
    own = {
        "PID": str(os.getpid()),
        "LOCALTIME": time.strftime(STAMP),
        "UTC": time.strftime(STAMP, time.gmtime()),
    }
    text = re.sub(r"\$\{([^}]*)\}", lambda found: own.get(found[1], os.environ.get(found[1], "")), text)
    return str(Path.home()) + text[1:] if text.startswith("~/") else text


def affix(text: str) -> str:
    """An output prefix or suffix with its variables and SUMO's ``TIME`` replaced."""
    return expand(text).replace("TIME", time.strftime(STAMP))


def listed(text: str) -> list[str]:
    """The files of a list, which SUMO separates by commas only."""
    return [part for part in map(str.strip, text.split(",")) if part]


def writes_file(value: str) -> bool:
    """Whether an output goes to a file: not to nowhere, the terminal or a socket (``host:port``)."""
    return value.lower() not in NO_FILE and ":" not in re.sub(r"^[A-Za-z]:[\\/]", "", value)


def written(value: str, prefix: str, suffix: str) -> Path:
    """The file that SUMO writes for an output: the suffix stands before the name's first dot."""
    folder, slash, name = value.replace("\\", "/").rpartition("/")
    stem, dot, ending = name.partition(".")
    return Path(f"{folder}{slash}{prefix}{stem}{suffix}{dot}{ending}")


class OutputFolder:
    """One folder for all outputs of a run: each file a name of its own, and none of ours."""

    def __init__(self, folder: Path, prefix: str = "", suffix: str = "") -> None:
        """``prefix`` and ``suffix`` are SUMO's, which it adds to the names given here."""
        self.folder = folder.resolve()
        self._prefix, self._suffix = prefix, suffix
        self._places: dict[Path, str] = {}
        self._taken = {name.lower() for name in OURS}

    def place(self, value: str, base: Path) -> str:
        """Where an output goes that ``base / value`` would hold; the same file is the same place again."""
        if not writes_file(value):
            return value
        source = (base / expand(value).replace("\\", "/")).resolve()
        if source not in self._places:
            name, number = source.name, 1
            while self._file(name) in self._taken:
                parent = source.parent.name if number == 1 else f"{source.parent.name}_{number}"
                name, number = f"{parent}_{source.name}", number + 1
            self._taken.add(self._file(name))
            self._places[source] = str(self.folder / name)
        return self._places[source]

    def _file(self, name: str) -> str:
        return str(written(name, self._prefix, self._suffix)).lower()  # some file systems ignore case
