"""What PHASE will drive of a scenario, what it leaves to SUMO, and what is changed for it: before a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet.parameters import KEYS
from phase_sumo.bridge.maps.freeway import kind_of_road
from phase_sumo.bridge.maps.network_facts import network_facts
from phase_sumo.bridge.sumo.conventions import vehicle_kind
from phase_sumo.bridge.sumo.demand import sumo_model
from phase_sumo.bridge.sumo.demand_survey import DemandSurvey, survey
from phase_sumo.bridge.sumo.option_names import TRUE
from phase_sumo.bridge.sumo.options import ASKED, SumoScenario, changes, read_scenario
from phase_sumo.errors import PhaseError, nearest
from phase_sumo.sim.dimensions import KINDS
from phase_sumo.sim.lanes import LaneNetwork

OURS = ("phase.", "has.phase.", "device.phase.")  # beginnings of our parameters


@dataclass(frozen=True)
class Check:
    """Counts and reasons; vehicles of flows are counted as about as many as the flows will bring.

    Attributes:
        scenario, network: files.
        time: begin, end (None for none) and step_length in s, and the seed, or None for a random one.
        roads: edges and lane_km that PHASE drives, and of all.
        other_roads: kind of road -> edges that SUMO drives.
        phase, sumo: vehicle class -> vehicles; SUMO's with the reason.
        share: of the former that PHASE drives.
        signals: traffic lights, and how many signs of each kind, between two driven roads.
        stops: on driven roads, and elsewhere.
        rerouting: what may change a route or a lane on the way, on driven roads.
        changed: options that are set otherwise than the scenario says, and why.
        warnings: of the network.
    """

    scenario: str
    network: str
    time: dict[str, Any]
    roads: dict[str, float]
    other_roads: dict[str, int]
    phase: dict[str, int]
    sumo: dict[str, int]
    share: float
    signals: dict[str, Any]
    stops: dict[str, int]
    rerouting: dict[str, int]
    changed: list[str]
    warnings: list[str]

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def lines(self) -> list[str]:
        """Ten lines for people, and one for each warning."""
        rows = [*self.rows().items(), *(("warning", text) for text in self.warnings)]
        wide = max(len(name) for name, _ in rows)
        return [f"{name:<{wide}}  {text}" for name, text in rows]

    def rows(self) -> dict[str, str]:
        """Ten headings and what is to be said there."""
        time, roads = self.time, self.roads
        end = "no end" if time["end"] is None else f"{time['end']:g} s"
        seed = "random" if time["seed"] is None else time["seed"]
        driven = f"{roads['edges']:g} of {roads['all_edges']:g} edges, "
        driven += f"{roads['lane_km']:.1f} of {roads['all_lane_km']:.1f} km of lane"
        lights, signs = self.signals["traffic_lights"], self.signals["signs"]
        signals = [f"{len(lights)} traffic lights ({_some(lights)})"] * bool(lights)
        signals += [f"{count} {name}" for name, count in signs.items()]
        stops = f"{self.stops['on_driven_roads']} on PHASE's roads, {self.stops['elsewhere']} elsewhere; "
        return {
            "scenario": f"{self.scenario}, network {self.network}",
            "time": f"{time['begin']:g} s to {end}, steps of {time['step_length']:g} s, seed {seed}",
            "PHASE drives": driven,
            "SUMO drives": f"the other roads: {_counts(self.other_roads)}",
            "PHASE's vehicles": f"{_counts(self.phase)}; {100 * self.share:g} % of these",
            "SUMO's vehicles": _counts(self.sumo),
            "right of way": f"{', '.join(signals)}: SUMO drives where one must wait"
            if signals
            else "none asked for",
            "stops": f"{stops}SUMO drives before and at them" if any(self.stops.values()) else "none",
            "on the way": _counts(self.rerouting),
            "changed": "; ".join(self.changed) or "nothing",
        }


def check_scenario(
    cfg: str | Path | None, options: DriveOptions | None = None, network: LaneNetwork | None = None
) -> Check:
    """Check a scenario without running it.

    Args:
        network: the observed roads, see `DriveOptions.network`; None reads them.

    Raises:
        PhaseError: it cannot be run, or names parameters, vTypes or vehicles that there are not.
    """
    drive = options or DriveOptions()
    scenario = read_scenario(cfg, tuple(drive.sumo_options))
    files = (*scenario.route_files, *scenario.additional_files, *scenario.files("load-state"))
    end = scenario.end if drive.end is None else drive.end
    demand = survey(files, scenario.begin, end)
    check_names(demand, drive)
    network = network or drive.network(scenario.net)
    driven = frozenset(lane.edge for lane in network.lanes if not lane.connector)
    facts = network_facts(scenario.net)
    phase, sumo = _vehicles(demand, drive)
    metres = facts.lane_metres
    return Check(
        scenario=scenario.name,
        network=str(scenario.net),
        time={
            "begin": scenario.begin,
            "end": end,
            "step_length": scenario.step_length,
            "seed": _seed(scenario, drive),
        },
        roads={
            "edges": len(driven),
            "lane_km": sum(metres.get(edge, 0.0) for edge in driven) / 1000.0,
            "all_edges": len(metres),
            "all_lane_km": sum(metres.values()) / 1000.0,
        },
        other_roads=_ordered(Counter(kind_of_road(k) for e, k in facts.kinds.items() if e not in driven)),
        phase=phase,
        sumo=sumo,
        share=drive.choice(0).probability if drive.phase else 0.0,
        signals={"traffic_lights": facts.lights(driven), "signs": dict(facts.signs(driven))},
        stops={
            "on_driven_roads": sum(edge in driven for _, edge in demand.stops),
            "elsewhere": sum(edge not in driven for _, edge in demand.stops),
        },
        rerouting=_rerouting(demand, driven, scenario),
        changed=_changed(scenario, drive),
        warnings=[*network.warnings, *scenario.warnings],
    )


def check_names(demand: DemandSurvey, drive: DriveOptions) -> None:
    """Refuse parameters that PHASE does not know, and vTypes and ids that no file holds."""
    for who, key, value in demand.params:
        if key.startswith(OURS) and key not in KEYS:
            raise PhaseError(f"{who}: parameter {key}={value!r} is not known{nearest(key, KEYS)}")
        if key == "phase.type" and value not in KINDS:
            known = ", ".join(KINDS)
            raise PhaseError(
                f"{who}: parameter {key}={value!r}, expected one of {known}{nearest(value, KINDS)}"
            )
    for name in drive.types:
        if name in demand.mixes:
            members = " ".join(demand.mixes[name])
            raise PhaseError(f"type {name!r} is a vTypeDistribution; name its vTypes: {members}")
        known = {*demand.types, *(name for name in demand.vehicles if name not in demand.mixes)}
        if name not in known and not demand.open_ended:
            raise PhaseError(f"type {name!r} is in none of the scenario's files{nearest(name, known)}")
    for name in drive.explicit:
        if not demand.knows(name) and not demand.open_ended:
            raise PhaseError(
                f"vehicle {name!r} is in none of the scenario's files{nearest(name, demand.ids)}"
            )


def _vehicles(demand: DemandSurvey, drive: DriveOptions) -> tuple[dict[str, int], dict[str, int]]:
    """Vehicle class -> count of those that PHASE may drive, and of the others with the reason."""
    phase: Counter[str] = Counter()
    sumo: Counter[str] = Counter()
    for (name, vclass), count in demand.by_class().items():
        kind = demand.type(name)
        if not drive.phase:
            sumo[f"{vclass} (no PHASE in this run)"] += count
        elif kind.params.get("phase.type") not in KINDS and not vehicle_kind(vclass, kind.length):
            sumo[f"{vclass} (neither car nor truck)"] += count
        elif drive.types and name not in drive.types:
            sumo[f"{vclass} (not of the types asked for)"] += count
        else:
            phase[vclass] += count
    if demand.people:
        sumo["persons and containers"] = demand.people
    return _ordered(phase), _ordered(sumo)


def _rerouting(demand: DemandSurvey, driven: frozenset[str], scenario: SumoScenario) -> dict[str, int]:
    equipped = any(key.startswith("has.rerouting.device") for _, key, _ in demand.params)
    devices = equipped or scenario.has_device("rerouting")
    found = {
        "rerouters": sum(any(edge in driven for edge in edges) for edges in demand.rerouters),
        "closings": len(demand.closed & driven),
        "variable speed signs": sum(edge in driven for edge in demand.speed_signs),
        "calibrators (SUMO drives on their edges)": sum(edge in driven for edge in demand.calibrators),
        "rerouting devices": int(devices),
    }
    return {name: count for name, count in found.items() if count}


def _changed(scenario: SumoScenario, drive: DriveOptions) -> list[str]:
    found = [str(change) for change in changes(scenario, drive.seed, drive.end)]
    if drive.model:
        found.append(f"the car-following model of every vType -> {sumo_model(drive.model)} ({ASKED})")
    return found


def _seed(scenario: SumoScenario, drive: DriveOptions) -> int | None:
    if drive.seed is not None and "seed" not in scenario.user:
        return drive.seed
    if scenario.value("random").lower() in TRUE:
        return None
    return int(scenario.value("seed", "23423"))


def _ordered(counts: Mapping[str, int]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"


def _some(names: Iterable[str], most: int = 4) -> str:
    names = list(names)
    return ", ".join(names[:most]) + (" ..." if len(names) > most else "")
