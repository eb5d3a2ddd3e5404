"""Near-misses and cut-ins in a scene, found by context alone and written as a SUMO scenario.

The scene is a moment of a scenario. Alpha, target speed, vehicle type and destination of a few of its
vehicles are varied, and every variant is driven from there as ``phase-sumo run`` would drive it.
"""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet.drivers import Driver
from phase_sumo.bridge.live import PhaseFleet
from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.options import command, read_scenario
from phase_sumo.bridge.sumo.session import Session
from phase_sumo.errors import PhaseError
from phase_sumo.evaluate.surrogate_safety import HEADWAY_SPEED, following, time_to_collision
from phase_sumo.evaluate.traffic import lane_changes
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.studies.cross_entropy import Candidate, minimise
from phase_sumo.studies.scenario_export import BOXES, SceneVehicle, write_scene

Criterion = Literal["near-miss", "cut-in"]
SPEEDS = 0.6, 1.4  # bounds of the target speed as multiples of the present one
SLOWEST, FASTEST = 5.0, 40.0  # m/s, of a target speed
AFTERMATH = 3.0  # s at the end of a run in which no encounter counts, lest it end in a collision unseen
ROOM = 4.0  # m kept free behind a vehicle that becomes longer
DIGITS = 3  # of what is written


@dataclass(frozen=True)
class Scene:
    """A moment of a scenario.

    Attributes:
        net: network file.
        vehicles: the one in the middle first, then by distance from it.
        destinations: routes by which each could leave the network, its own first.
    """

    net: Path
    vehicles: tuple[SceneVehicle, ...]
    destinations: tuple[tuple[tuple[str, ...], ...], ...]


@dataclass(frozen=True)
class Encounter:
    """The closest encounter of a run.

    Attributes:
        value: s: time to collision (near-miss) or time gap of the follower when the other enters its lane.
        follower, leader: ids.
        time: s.
        contacts: collisions in the whole run.
    """

    value: float
    follower: str
    leader: str
    time: float
    contacts: int


NOTHING = Encounter(np.inf, "", "", np.nan, 0)


def read_scene(
    cfg: str | Path | None, options: DriveOptions, time: float, around: str | None, radius: float
) -> Scene:
    """Run a scenario under PHASE up to ``time`` s and take the vehicles within ``radius`` m of one.

    Vehicles inside junctions are left out: SUMO cannot insert there.

    Args:
        around: vehicle in the middle; the one with most others within the radius if None.
    """
    scenario = read_scenario(cfg, tuple(options.sumo_options))
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as folder:
        args = command(scenario, Path(folder), redirect_outputs=True, seed=options.seed, end=time + 1.0)
        with Session(args, Path(folder)) as simulation:
            fleet = PhaseFleet(simulation.api, options=options)
            try:
                simulation.step()
                fleet.observe()
                while simulation.time < time - 1e-6:
                    fleet.drive()
                    simulation.step()
                    fleet.observe()
                return _scene(scenario.net, fleet, around, radius)
            finally:
                fleet.close()


def _scene(net: Path, fleet: PhaseFleet, around: str | None, radius: float) -> Scene:
    table, api = fleet.scene.table, fleet.simulation.api
    rows = np.flatnonzero(table.active & table.controlled)
    rows = np.array([r for r in rows if not api.vehicle.getLaneID(table.ids[r]).startswith(":")], int)
    ids = [table.ids[row] for row in rows]
    if not ids or (around is not None and around not in ids):
        raise PhaseError(
            f"vehicle {around!r} is not driven by PHASE on a lane at {fleet.simulation.time:g} s; there are: "
            f"{', '.join(ids) or 'none'}"
        )
    xy = np.stack((table["x"][rows], table["y"][rows]), -1)
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    middle = ids.index(around) if around is not None else int((distance < radius).sum(1).argmax())
    order = [k for k in np.argsort(distance[middle], kind="stable") if distance[middle, k] < radius]
    sinks = sorted(
        {
            lane.rpartition("_")[0]
            for lane in api.lane.getIDList()
            if not lane.startswith(":") and not api.lane.getLinks(lane)
        }
    )
    vehicles = [_vehicle(fleet, int(rows[k]), ids[k]) for k in order]
    routes = [(v.route, *_detours(api, v.route, sinks)) for v in vehicles]
    return Scene(net, tuple(vehicles), tuple(routes))


def _vehicle(fleet: PhaseFleet, row: int, name: str) -> SceneVehicle:
    table, api = fleet.scene.table, fleet.simulation.api
    kind = fleet.scene.facts[name].kind
    assert kind is not None  # PHASE drives it
    of_type, vtype = api.vehicletype, fleet.scene.types[name]
    route = tuple(api.vehicle.getRoute(name))[api.vehicle.getRouteIndex(name) :]
    return SceneVehicle(
        id=name,
        kind=kind,
        vclass=of_type.getVehicleClass(vtype),
        length=round(of_type.getLength(vtype), 2),
        width=round(of_type.getWidth(vtype), 2),
        lane=api.vehicle.getLaneIndex(name),
        position=round(api.vehicle.getLanePosition(name), DIGITS),
        offset=round(api.vehicle.getLateralLanePosition(name), DIGITS),
        speed=round(float(table["speed"][row]), DIGITS),
        route=route,
        alpha=round(float(table["alpha"][row]), DIGITS),
        target_speed=round(float(table.wanted_speed[row]), DIGITS),
    )


def _detours(api: Any, route: tuple[str, ...], sinks: list[str]) -> list[tuple[str, ...]]:
    """Ways from the first edge to the other ends of the network."""
    found = (tuple(api.simulation.findRoute(route[0], sink).edges) for sink in sinks if sink != route[-1])
    return [edges for edges in found if edges]


class Search:
    """Varies the contexts of the first vehicles of a scene.

    Attributes:
        scene, seconds: what is driven, and for how long.
        varied: vehicles whose context is searched.
        tried: contexts and encounter of every run so far.
    """

    def __init__(
        self,
        scene: Scene,
        policy: Driver,
        criterion: Criterion,
        vary: int,
        seconds: float,
        contact: bool = False,
    ) -> None:
        """``contact`` allows runs with collisions; otherwise they are of no use."""
        self.scene, self._policy = scene, policy
        self._criterion: Criterion = criterion
        self.seconds, self._contact = seconds, contact
        self.varied = scene.vehicles[:vary]
        self._kinds = [_fitting(v, scene.vehicles) for v in self.varied]
        self.tried: list[tuple[tuple[SceneVehicle, ...], Encounter]] = []

    def run(
        self, budget: int, seed: int, progress: Callable[[float, str], None] | None = None
    ) -> tuple[tuple[SceneVehicle, ...], Encounter]:
        """The vehicles with the closest encounter that was found.

        Raises:
            PhaseError: no run of the budget had one.
        """
        if budget < 1:
            raise PhaseError(f"budget {budget}: a search needs at least one run")
        best = np.inf

        def score(candidate: Candidate) -> float:
            nonlocal best
            vehicles = self.vehicles(candidate)
            encounter = drive_scene(self.scene.net, vehicles, self.seconds, self._policy, self._criterion)
            self.tried.append((vehicles, encounter))
            value = encounter.value if self._contact or not encounter.contacts else np.inf
            best = min(best, value)
            if progress is not None:
                progress(len(self.tried) / budget, f"best {best:.2f} s")
            return value

        options = [n for kinds, ways in zip(self._kinds, self.scene.destinations, strict=False)
                   for n in (len(kinds), len(ways))]  # fmt: skip
        scores = [value for _, value in minimise(score, 2 * len(self.varied), options, budget, seed)]
        if not np.isfinite(min(scores)):
            raise PhaseError(
                f"none of {budget} runs had a {self._criterion}"
                + ("" if self._contact else " without a collision")
                + "; raise --budget or --vary, or take another moment or vehicle"
            )
        return self.tried[int(np.argmin(scores))]

    def vehicles(self, candidate: Candidate) -> tuple[SceneVehicle, ...]:
        """The scene with a candidate's contexts."""
        changed = []
        for k, v in enumerate(self.varied):
            alpha, speed = candidate.numbers[2 * k : 2 * k + 2]
            kind, way = candidate.choices[2 * k : 2 * k + 2]
            factor = SPEEDS[0] + (SPEEDS[1] - SPEEDS[0]) * speed
            target = float(np.clip(factor * v.speed, SLOWEST, FASTEST))
            other = replace(
                v,
                alpha=round(0.1 + 0.9 * alpha, DIGITS),
                target_speed=round(target, DIGITS),
                route=self.scene.destinations[k][way],
            )
            name = self._kinds[k][kind]
            if name != v.kind:
                vclass, length, width = BOXES[name]
                other = replace(other, kind=name, vclass=vclass, length=length, width=width)
            changed.append(other)
        return (*changed, *self.scene.vehicles[len(changed) :])


def _fitting(vehicle: SceneVehicle, everybody: Sequence[SceneVehicle]) -> list[str]:
    """Its own type, and those whose box has room behind its front bumper."""
    behind = [
        vehicle.position - other.position
        for other in everybody
        if other.route[0] == vehicle.route[0]
        and other.lane == vehicle.lane
        and other.position < vehicle.position
    ]
    room = min([*behind, vehicle.position]) - ROOM
    return [vehicle.kind] + [k for k, (_, length, _) in BOXES.items() if k != vehicle.kind and length < room]


def drive_scene(
    net: Path, vehicles: Sequence[SceneVehicle], seconds: float, policy: Driver, criterion: Criterion
) -> Encounter:
    """The closest encounter when the scene is driven as ``phase-sumo run`` does."""
    with tempfile.TemporaryDirectory(prefix="phase_sumo_") as name:
        folder = Path(name)
        cfg = write_scene(folder, "scene", net, vehicles, seconds)
        return replay(cfg, policy, criterion, folder / "out")


def replay(cfg: Path, policy: Driver, criterion: Criterion, out: Path) -> Encounter:
    """Run a scenario and measure its closest encounter."""
    result = run_scenario(cfg, policy=policy, output_dir=out)
    t = Trajectories.load(out / "trajectories.npz")
    return replace(encounter(t, criterion), contacts=result["collisions"])


def encounter(t: Trajectories, criterion: Criterion) -> Encounter:
    """The closest one in recorded traffic: by time to collision, or by the time gap left by a lane change.

    Time to collision: of followers whose box lies behind the leader's, not beside its way. Time gap: gap to
    the vehicle that has just entered the lane / speed of the follower there. Nothing in the last `AFTERMATH`.
    """
    f = following(t)
    counted = f.gap >= 0.0
    if len(t.time):
        counted &= t.time[f.follower] <= t.time[-1] - AFTERMATH
    if criterion == "near-miss":
        width = np.maximum(t.shape[:, 1], t.shape[:, 5])[t.vehicle]  # of body and trailer
        aside = np.abs(t.lateral[f.follower] - t.lateral[f.leader])
        counted &= aside < 0.5 * (width[f.follower] + width[f.leader])
        values = np.where(counted, time_to_collision(t, f), np.inf)
    else:
        speed = t.speed[f.follower]
        counted &= np.isin(f.leader, lane_changes(t).after) & (speed > HEADWAY_SPEED)
        values = np.where(counted, f.gap / np.maximum(speed, HEADWAY_SPEED), np.inf)
    if not len(values) or not np.isfinite(values.min()):
        return NOTHING
    k = int(values.argmin())
    row = int(f.follower[k])
    names = [t.vehicle_ids[t.vehicle[r]] for r in (row, int(f.leader[k]))]
    return Encounter(float(values[k]), names[0], names[1], float(t.time[row]), 0)


def export(folder: Path, search: Search, vehicles: Sequence[SceneVehicle], facts: dict[str, Any]) -> Path:
    """Write the scenario, what was found (``NAME.json``) and every run of the search (``search.csv``)."""
    cfg = write_scene(folder, folder.name, search.scene.net, vehicles, search.seconds)
    described = facts | {"varied": [v.id for v in search.varied]}
    (folder / f"{folder.name}.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    with (folder / "search.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        parts = ("alpha", "target_speed", "kind", "route")
        heads = [f"{v.id}.{part}" for v in search.varied for part in parts]
        writer.writerow(["run", "value", "follower", "leader", "time", "contacts", *heads])
        for number, (tried, e) in enumerate(search.tried):
            cells = [getattr(v, part) for v in tried[: len(search.varied)] for part in parts]
            texts = [" ".join(c) if isinstance(c, tuple) else c for c in cells]
            writer.writerow(
                [number, f"{e.value:.4g}", e.follower, e.leader, f"{e.time:g}", e.contacts, *texts]
            )
    return cfg
