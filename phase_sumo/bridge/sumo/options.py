"""What a ``.sumocfg`` and the user's SUMO options say, what we refuse, and what we add.

PHASE and SUMO-only runs of a scenario get the same command line, so that only the drivers differ.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.sumo.demand import Rewrite, empty_settings, mentions, redirect, rewrite_files
from phase_sumo.errors import PhaseError

# Names that SUMO takes for the same option
SYNONYMS = {
    "c": "configuration-file", "configuration": "configuration-file",
    "n": "net-file", "net": "net-file", "r": "route-files", "routes": "route-files",
    "a": "additional-files", "additional": "additional-files",
    "b": "begin", "e": "end", "tripinfo": "tripinfo-output", "fcd": "fcd-output",
    "l": "log", "log-file": "log", "v": "verbose", "W": "no-warnings", "S": "start", "Q": "quit-on-end",
    "g": "gui-settings-file", "summary": "summary-output",
}  # fmt: skip
# The same for every run: a controlled vehicle must neither teleport nor vanish in a collision
FORCED = {
    "time-to-teleport": "-1",
    "collision.action": "warn",
    "collision.mingap-factor": "0",
}
SUMO_OPTIONS = tuple(text for name, value in FORCED.items() for text in (f"--{name}", value))
FORCED_IF_SET = {"time-to-teleport.highways": "-1", "time-to-teleport.disconnected": "-1"}
INTERNAL = 'function="internal"'  # lanes inside junctions, in a network file
NO_SUBLANES = (
    "{}: has no internal lanes, where SUMO's sublane model crashes once vehicles are moved: run with "
    "lateral-resolution 0"
)
# Ours unless the user's own options say otherwise
QUIET = {
    "verbose": "false",
    "no-step-log": "true",
    "no-warnings": "true",
    "duration-log.disable": "true",
    "duration-log.statistics": "false",
    "xml-validation": "never",
}
OWN_USE = ("tripinfo-output", "collision-output")  # outputs that settle our counts at the end
OUTPUTS = re.compile(
    r".*-output|netstate-dump|log|message-log|error-log|save-configuration|save-state\.files"
)


@dataclass(frozen=True)
class SumoScenario:
    """A ``.sumocfg`` as read.

    Attributes:
        path: the file.
        config: canonical option name -> value in the file, file names as written.
        user: the same for the user's own options, which win.
        net: network file.
        route_files, additional_files: in order.
        begin, end, step_length: s; end is None when the scenario has none.
        warnings: what is done otherwise than the scenario says, and why.
    """

    path: Path
    config: dict[str, str]
    user: dict[str, str]
    net: Path
    route_files: tuple[Path, ...]
    additional_files: tuple[Path, ...]
    begin: float
    end: float | None
    step_length: float
    warnings: tuple[str, ...] = ()

    def value(self, name: str, default: str = "") -> str:
        return self.user.get(name, self.config.get(name, default))

    def has_device(self, name: str) -> bool:
        """Whether options equip vehicles with one of SUMO's devices."""
        return any(self.value(f"device.{name}.{how}") for how in ("probability", "explicit"))


def read_scenario(path: str | Path, sumo_options: list[str] | tuple[str, ...] = ()) -> SumoScenario:
    """Read and check a scenario.

    Raises:
        PhaseError: the file or one that it names is missing, or an option cannot work with PHASE.
    """
    path = Path(path)
    config, user = _read_config(path), parse_options(sumo_options)
    merged = {**config, **user}
    _refuse(path, merged, user)
    folder = path.parent

    def files(name: str) -> tuple[Path, ...]:
        base = Path() if name in user else folder
        parts = re.split(r"[,;]\s*|\s+(?=\S+\.(?:xml|gz))", merged.get(name, "").strip())
        return tuple(_existing(path, name, part, base) for part in parts if part)

    if not files("net-file"):
        raise PhaseError(f'{path}: no net-file; add <net-file value="..."/> or pass -- -n FILE')
    net = files("net-file")[0]
    end = _seconds(path, "end", merged.get("end", "-1"))
    sublanes = float(merged.get("lateral-resolution", "0") or 0) > 0 and not mentions(net, (INTERNAL,))
    return SumoScenario(
        path=path,
        config=config,
        user=user,
        net=net,
        route_files=files("route-files"),
        additional_files=files("additional-files"),
        begin=_seconds(path, "begin", merged.get("begin", "0")),
        end=end if end >= 0 else None,
        step_length=_seconds(path, "step-length", merged.get("step-length", "1")),
        warnings=(NO_SUBLANES.format(net),) if sublanes else (),
    )


def check_options(api: Any) -> None:
    """Refuse a simulation that somebody started without what PHASE needs.

    Args:
        api: ``libsumo``, ``traci`` or one of its connections.
    """
    option = api.simulation.getOption
    needed = " ".join(SUMO_OPTIONS)
    if option("mesosim") == "true":
        raise PhaseError("SUMO runs with mesosim: PHASE needs positions in the lane; start it without")
    if option("collision.action") != FORCED["collision.action"]:
        raise PhaseError(
            f"SUMO runs with collision.action={option('collision.action')}: it would move PHASE vehicles "
            f"that touch; start it with {needed}"
        )
    if float(option("lateral-resolution")) > 0 and not any(e.startswith(":") for e in api.edge.getIDList()):
        raise PhaseError(NO_SUBLANES.format(option("net-file")).replace(": run with ", "; start it with --"))
    for name, below in (
        ("time-to-teleport", 0.0),
        ("time-to-teleport.highways", 0.0),
        ("time-to-teleport.disconnected", -1e-3),
        ("lanechange.duration", 0.0),
    ):
        text = option(name)
        if _seconds(Path("SUMO"), name, text) > below:
            value = "0" if name == "lanechange.duration" else "-1"
            why = "SUMO may crash" if name == "lanechange.duration" else "it would move PHASE vehicles"
            raise PhaseError(f"SUMO runs with {name}={text}: {why}; start it with --{name} {value}")


def command(
    scenario: SumoScenario,
    work_dir: Path,
    *,
    model: str | None = None,
    redirect_outputs: bool = False,
    seed: int | None = None,
    end: float | None = None,
) -> list[str]:
    """SUMO's arguments, without the program's name.

    Args:
        work_dir: folder for rewritten inputs and, with ``redirect_outputs``, for SUMO's outputs.
        model: SUMO car-following model that replaces every vType's own, e.g. ``"IDM"``.
        redirect_outputs: write into ``work_dir`` what the scenario writes beside itself.
        seed, end: override the scenario's, but not the user's own options.
    """
    work_dir.mkdir(parents=True, exist_ok=True)
    options = {k: v for k, v in QUIET.items() if k not in scenario.user}
    options |= {k: v for k, v in FORCED_IF_SET.items() if k in scenario.config}
    options |= FORCED
    if scenario.warnings:
        options["lateral-resolution"] = "0"
    if seed is not None:
        options["seed"] = str(seed)
        options["random"] = "false"
    if end is not None:
        options["end"] = f"{end:g}"
    settings = scenario.value("gui-settings-file")
    if settings and not (scenario.path.parent / settings).is_file() and not Path(settings).is_file():
        options["gui-settings-file"] = str(empty_settings(work_dir))
    for name, value in scenario.config.items():
        if OUTPUTS.fullmatch(name) and name not in scenario.user and value:
            target = redirect(value, work_dir) if redirect_outputs else value
            (scenario.path.parent / target).parent.mkdir(parents=True, exist_ok=True)
            if redirect_outputs:
                options[name] = target
    for name in OWN_USE:
        if not scenario.value(name):
            (work_dir / "inputs").mkdir(exist_ok=True)
            options[name] = str((work_dir / "inputs" / f"{name}.xml").resolve())
    if redirect_outputs and scenario.has_device("ssm") and not scenario.value("device.ssm.file"):
        options["device.ssm.file"] = str((work_dir / "ssm.xml").resolve())
    wanted = Rewrite(model=model, output_dir=work_dir if redirect_outputs else None)
    routes, additional = rewrite_files(scenario.route_files, scenario.additional_files, work_dir, wanted)
    for name, old, new in (
        ("route-files", scenario.route_files, routes),
        ("additional-files", scenario.additional_files, additional),
    ):
        if new and (new != old or ("," not in scenario.value(name) and len(new) > 1)):
            options[name] = ",".join(str(p.resolve()) for p in new)
    user = {k: v for k, v in scenario.user.items() if k not in options or k in ("seed", "end")}
    options |= user
    args = ["-c", str(scenario.path)]
    for name, value in options.items():
        args += [f"--{name}", value]
    return args


def parse_options(args: list[str] | tuple[str, ...]) -> dict[str, str]:
    """``["-e", "10", "--fcd-output=x", "--no-warnings"]`` -> canonical name -> value."""
    result: dict[str, str] = {}
    waiting: str | None = None
    for arg in args:
        is_option = arg.startswith("-") and not re.fullmatch(r"-\d.*", arg)
        if not is_option:
            if waiting is None:
                raise PhaseError(
                    f"SUMO option {arg!r}: a value without an option; write --NAME VALUE after --"
                )
            result[waiting], waiting = arg, None
            continue
        if waiting is not None:
            result[waiting] = "true"
        name, equals, value = arg.lstrip("-").partition("=")
        waiting = SYNONYMS.get(name, name)
        if equals:
            result[waiting], waiting = value, None
    if waiting is not None:
        result[waiting] = "true"
    return result


def _read_config(path: Path) -> dict[str, str]:
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
            config[SYNONYMS.get(element.tag, element.tag)] = value
    if not config:
        raise PhaseError(f"{path}: holds no SUMO options; pass a .sumocfg")
    return config


def _refuse(path: Path, merged: dict[str, str], user: dict[str, str]) -> None:
    def on(name: str) -> bool:
        return merged.get(name, "false").lower() in ("true", "1", "yes", "on", "t", "x")

    if on("mesosim"):
        raise PhaseError(
            f"{path}: option mesosim: PHASE needs positions in the lane; pass -- --mesosim false"
        )
    for name, why in (
        ("lanechange.duration", "SUMO may crash when a vehicle in a timed lane change is moved"),
        ("remote-port", "SUMO would wait for another client"),
    ):
        if float(merged.get(name, "0") or 0) > 0:
            raise PhaseError(f"{path}: option {name}={merged[name]}: {why}; pass -- --{name} 0")
    for name in merged:
        if name.startswith("device.phase."):
            raise PhaseError(
                f"{path}: option {name}: SUMO does not know it; pass it to phase-sumo, see --help"
            )
    for name in ("load-state", "configuration-file", "net-file"):
        if name in user and name != "net-file":
            raise PhaseError(f"SUMO option --{name}: not supported after --; put it into the scenario file")
    for name, value in FORCED.items():
        if name in user and user[name] != value:
            raise PhaseError(
                f"SUMO option --{name} {user[name]}: PHASE needs {value} in every run; leave it out"
            )


def _existing(path: Path, name: str, part: str, base: Path) -> Path:
    for candidate in (base / part, base / part.replace("\\", "/")):
        if candidate.is_file():
            return candidate
    raise PhaseError(f"{path}: option {name}: {base / part} does not exist; correct the path in the file")


def _seconds(path: Path, name: str, text: str) -> float:
    """Seconds from SUMO's ``12.5`` or ``[[d:]h:]m:s``."""
    try:
        parts = [float(p) for p in text.split(":")]
    except ValueError:
        raise PhaseError(f"{path}: option {name}={text!r} is no time; write seconds or hh:mm:ss") from None
    scale = (1.0, 60.0, 3600.0, 86400.0)
    return sum(p * s for p, s in zip(reversed(parts), scale, strict=False))
