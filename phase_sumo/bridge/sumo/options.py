"""What a ``.sumocfg`` and the user's SUMO options say, what we refuse, and what we add.

PHASE and SUMO-only runs of a scenario get the same command line, so that only the drivers differ.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phase_sumo.bridge.sumo.demand import InputFiles, empty_settings, mentions
from phase_sumo.bridge.sumo.file_names import OutputFolder, affix, expand, listed, writes_file
from phase_sumo.bridge.sumo.option_names import TRUE, parse_options, sumo_options
from phase_sumo.bridge.sumo.scenario_file import existing, read_config, seconds
from phase_sumo.errors import PhaseError

# The same for every run, where neither the scenario nor the user says otherwise: collisions are counted
COUNTED = {"collision.action": "warn", "collision.mingap-factor": "0"}
SUMO_OPTIONS = tuple(text for name, value in COUNTED.items() for text in (f"--{name}", value))
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
    r".*-output|netstate-dump|log|message-log|error-log|save-configuration|save-state\.files|"
    r"device\.(ssm|toc|fcd)\.file|device\..*\.output"
)
WHY = {
    "collision.action": "the scenario says nothing of it; SUMO would move vehicles that touch, we count them",
    "collision.mingap-factor": "the scenario says nothing of it; a collision is that boxes touch",
    "lateral-resolution": "the network has no internal lanes: SUMO crashes there once vehicles are moved",
    "random": "a seed is given",
}
ASKED = "the command line says so"
NOISE = "our own lines tell how the run goes; pass it on the command line to have it"


@dataclass(frozen=True)
class SumoScenario:
    """A ``.sumocfg`` as read, or the user's options alone.

    Attributes:
        path: the file, or None.
        config: SUMO's option name -> value in the file, file names as written.
        user: the same for the user's own options, which win.
        net: network file.
        route_files, additional_files: in order.
        begin, end, step_length: s; end is None when the scenario has none.
        warnings: what is done otherwise than the scenario says, and why.
    """

    path: Path | None
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

    @property
    def name(self) -> str:
        """For people: the file, or the network of a run without one."""
        return str(self.path or self.net)

    @property
    def folder(self) -> Path:
        """That file names in the scenario are relative to."""
        return self.path.parent if self.path else Path()

    def files(self, option: str) -> tuple[Path, ...]:
        """The files that an option names."""
        names = listed(expand(self.value(option)))
        return tuple(existing(self.path, option, name, self.base(option)) for name in names)

    def base(self, option: str) -> Path:
        """Folder that the file names of an option are relative to: the user's are as for SUMO."""
        return Path() if option in self.user else self.folder

    def has_device(self, name: str) -> bool:
        """Whether options equip vehicles with one of SUMO's devices."""
        return any(self.value(f"device.{name}.{how}") for how in ("probability", "explicit"))


def read_scenario(path: str | Path | None, sumo_options: list[str] | tuple[str, ...] = ()) -> SumoScenario:
    """Read and check a scenario.

    Args:
        path: a ``.sumocfg``, or None when ``sumo_options`` name the files (``-n``, ``-r``, ``-a``).
        sumo_options: further options of SUMO, as words.

    Raises:
        PhaseError: the file or one that it names is missing, or an option cannot work with PHASE.
    """
    path = None if path is None else Path(path)
    config, user = read_config(path) if path else {}, parse_options(sumo_options)
    merged = {**config, **user}
    _refuse(path, merged, user)
    folder = path.parent if path else Path()

    def files(name: str) -> tuple[Path, ...]:
        base = Path() if name in user else folder
        return tuple(existing(path, name, part, base) for part in listed(expand(merged.get(name, ""))))

    if not files("net-file"):
        raise PhaseError(f'{path or "no scenario"}: no net-file; add <net-file value="..."/> or pass -n FILE')
    net = files("net-file")[0]
    end = seconds(path, "end", merged.get("end", "-1"))
    sublanes = float(merged.get("lateral-resolution", "0") or 0) > 0 and not mentions(net, (INTERNAL,))
    return SumoScenario(
        path=path,
        config=config,
        user=user,
        net=net,
        route_files=files("route-files"),
        additional_files=files("additional-files"),
        begin=seconds(path, "begin", merged.get("begin", "0")),
        end=end if end >= 0 else None,
        step_length=seconds(path, "step-length", merged.get("step-length", "1")),
        warnings=(NO_SUBLANES.format(net),) if sublanes else (),
    )


def check_options(api: Any, sumo_options: Sequence[str] = ()) -> None:
    """Refuse a simulation that somebody started without what PHASE needs.

    Args:
        api: ``libsumo``, ``traci`` or one of its connections.
        sumo_options: words with which it was started, as far as they are known.
    """
    option = api.simulation.getOption
    needed = " ".join(SUMO_OPTIONS)
    if option("mesosim") == "true":
        raise PhaseError("SUMO runs with mesosim: PHASE needs positions in the lane; start it without")
    if option("collision.action") == "teleport" and not _asks_for("collision.action", option, sumo_options):
        raise PhaseError(
            "SUMO runs with collision.action=teleport: it would move PHASE vehicles that touch; start it "
            f"with {needed}, or ask for it in the scenario"
        )
    if float(option("lateral-resolution")) > 0 and not any(e.startswith(":") for e in api.edge.getIDList()):
        raise PhaseError(NO_SUBLANES.format(option("net-file")).replace(": run with ", "; start it with --"))
    text = option("lanechange.duration")
    if seconds(None, "lanechange.duration", text) > 0.0:
        raise PhaseError(
            f"SUMO runs with lanechange.duration={text}: SUMO may crash; start it with "
            "--lanechange.duration 0"
        )


def _asks_for(name: str, option: Callable[[str], str], sumo_options: Sequence[str]) -> bool:
    """Whether a running simulation's scenario or command line names an option."""
    path = option("configuration-file")
    return name in parse_options(list(sumo_options)) or bool(path and name in read_config(Path(path)))


@dataclass(frozen=True)
class Change:
    """An option that a run sets otherwise than its scenario, or than SUMO by default."""

    option: str
    before: str
    after: str
    why: str

    def __str__(self) -> str:
        return f"{self.option} {self.before or 'unset'} -> {self.after} ({self.why})"


def changes(scenario: SumoScenario, seed: int | None = None, end: float | None = None) -> list[Change]:
    """What is not as the scenario says, or as SUMO does where the scenario says nothing, and why."""
    found = []
    for name, after in overrides(scenario, seed, end).items():
        said, ours = scenario.config.get(name), name in WHY and name not in scenario.user
        if said is None and not ours:
            continue  # more than the scenario says, not otherwise
        before = sumo_options()[name].default if said is None else said
        if not _same(name, before, after):
            why = NOISE if name in QUIET else ASKED
            found.append(Change(name, before, after, WHY[name] if ours else why))
    return found


def _same(name: str, a: str, b: str) -> bool:
    try:
        one, other = (seconds(None, name, text) for text in (a, b))
    except PhaseError:
        kind = sumo_options()[name].kind if name in sumo_options() else ""
        return (a.lower() in TRUE) == (b.lower() in TRUE) if kind == "BOOL" else a == b
    return one == other


def overrides(scenario: SumoScenario, seed: int | None = None, end: float | None = None) -> dict[str, str]:
    """Options that every run sets beside the scenario's, the user's own among them.

    Args:
        seed, end: win over the scenario's, but not over the user's own options.
    """
    options = {k: v for k, v in QUIET.items() if k not in scenario.user}
    options |= {k: v for k, v in COUNTED.items() if k not in scenario.config}
    if scenario.warnings:
        options["lateral-resolution"] = "0"
    if seed is not None:
        options |= {"seed": str(seed), "random": "false"}
    if end is not None:
        options["end"] = f"{end:g}"
    users = ("seed", "end", *COUNTED)
    return options | {k: v for k, v in scenario.user.items() if k not in options or k in users}


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
    options = overrides(scenario, seed, end)
    for name in ("output-prefix", "output-suffix"):
        if scenario.value(name):
            options[name] = affix(scenario.value(name))
    prefix, suffix = (options.get(f"output-{what}", "") for what in ("prefix", "suffix"))
    outputs = OutputFolder(work_dir, prefix, suffix) if redirect_outputs else None
    settings = scenario.value("gui-settings-file")
    if settings and not (scenario.folder / settings).is_file() and not Path(settings).is_file():
        options["gui-settings-file"] = str(empty_settings(work_dir))
    options |= _outputs(scenario, work_dir, outputs)
    inputs, state = InputFiles(work_dir / "inputs", model, outputs), scenario.files("load-state")
    for name, old, new in (
        ("route-files", scenario.route_files, inputs.rewritten(scenario.route_files)),
        ("load-state", state, inputs.rewritten(state)),
        ("additional-files", scenario.additional_files, inputs.with_types(scenario.additional_files)),
    ):
        if new != old:
            options[name] = ",".join(str(p.resolve()) for p in new)
    args = ["-c", str(scenario.path)] if scenario.path else []
    for name, value in options.items():
        args += [f"--{name}", value]
    return args


def _outputs(scenario: SumoScenario, work_dir: Path, outputs: OutputFolder | None) -> dict[str, str]:
    """Where SUMO writes: the scenario's outputs into ``outputs``, if given, and those that we need."""
    options = {}
    for name in {**scenario.config, **scenario.user}:
        value = scenario.value(name)
        if not OUTPUTS.fullmatch(name) or not value:
            continue
        parts = listed(expand(value)) if name == "save-state.files" else [expand(value)]
        places = [part for part in parts if writes_file(part)]
        if outputs and name not in scenario.user:
            parts = [outputs.place(part, scenario.folder) for part in parts]
            options[name] = ",".join(parts)
        elif "${" in value:
            options[name] = ",".join(str((scenario.base(name) / part).resolve()) for part in parts)
        for part in places if name in scenario.user or not outputs else ():
            (scenario.base(name) / part).parent.mkdir(parents=True, exist_ok=True)
    for name in OWN_USE:
        if not scenario.value(name):
            (work_dir / "inputs").mkdir(exist_ok=True)
            options[name] = str((work_dir / "inputs" / f"{name}.xml").resolve())
    if outputs and scenario.has_device("ssm") and not scenario.value("device.ssm.file"):
        options["device.ssm.file"] = outputs.place("ssm.xml", scenario.folder)
    return options


def _refuse(path: Path | None, merged: dict[str, str], user: dict[str, str]) -> None:
    where = path or "the command line"
    if merged.get("mesosim", "false").lower() in TRUE:
        raise PhaseError(
            f"{where}: option mesosim: PHASE needs positions in the lane; pass -- --mesosim false"
        )
    for name, why in (
        ("lanechange.duration", "SUMO may crash when a vehicle in a timed lane change is moved"),
        ("remote-port", "SUMO would wait for another client"),
    ):
        if float(merged.get(name, "0") or 0) > 0:
            raise PhaseError(f"{where}: option {name}={merged[name]}: {why}; pass -- --{name} 0")
    for name in merged:
        if name.startswith("device.phase."):
            raise PhaseError(
                f"{where}: option {name}: SUMO does not know it; pass it to phase-sumo, see --help"
            )
    if "configuration-file" in user:
        raise PhaseError("a second scenario behind --: pass one, as CFG.sumocfg or with -c")
