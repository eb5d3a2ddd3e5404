"""PHASE in a simulation that somebody else steps: what `run_scenario` and a user's own loop share."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from traci.step import StepListener

from phase_sumo.bridge.drive_options import DriveOptions
from phase_sumo.bridge.fleet.contacts import ContactMonitor
from phase_sumo.bridge.fleet.drivers import Driver, Drivers
from phase_sumo.bridge.fleet.event_log import Event
from phase_sumo.bridge.fleet.fleet import Fleet
from phase_sumo.bridge.fleet.guarded import tally, warning
from phase_sumo.bridge.fleet.parameters import Parameters
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.fleet.standing import StandingWatch
from phase_sumo.bridge.maps.levels import Levels
from phase_sumo.bridge.maps.sumo_network import odd_lengths
from phase_sumo.bridge.outputs.trailers import Trailers
from phase_sumo.bridge.sumo.options import check_options
from phase_sumo.bridge.sumo.session import Simulation
from phase_sumo.errors import PhaseError
from phase_sumo.policy.checkpoint import load_policy
from phase_sumo.sim.lanes import LaneNetwork


class PhaseFleet(StepListener):
    """PHASE vehicles in a running simulation of libsumo or traci::

        libsumo.start(["sumo", "-c", "my.sumocfg", *phase_sumo.SUMO_OPTIONS])
        fleet = phase_sumo.PhaseFleet(libsumo, share=0.3)
        libsumo.addStepListener(fleet)  # or call fleet.step() after every simulationStep()

    A vehicle's ``phase.*`` parameters are read when it departs (type and dimensions) and when PHASE takes it
    over; later changes count after `set_context`, so that no step has to ask for them.

    SUMO is told every pose one step ahead: who stops before SUMO's ``end`` calls `close` before SUMO closes.

    Attributes:
        simulation: the one that it drives in.
        choice: which vehicles.
        scene: all vehicles and their trips.
    """

    def __init__(
        self,
        api: Any,
        policy: Driver | str | Path | None = None,
        *,
        options: DriveOptions | None = None,
        network: LaneNetwork | None = None,
        **changes: Any,
    ) -> None:
        """Take part in a simulation that was started.

        Args:
            api: ``libsumo``, ``traci`` or one of traci's connections.
            policy: a loaded policy or its file; None for that of the options.
            options: see `DriveOptions`; those that SUMO was started with are not changed by them.
            network: the roads to observe, see `DriveOptions.network`; None reads them.
            changes: single options, e.g. ``share=0.3``; ``seed`` is SUMO's if left out.

        Raises:
            PhaseError: SUMO was started without an option that PHASE needs, or an argument cannot be used.
        """
        drive = (options or DriveOptions()).changed(changes)
        check_options(api, drive.sumo_options)
        option = api.simulation.getOption
        self.choice = drive.choice(int(option("seed")) if drive.seed is None else drive.seed)
        self.simulation = Simulation(api)
        if network is None:
            network = drive.network(option("net-file"))
        edges = frozenset(lane.edge for lane in network.lanes if not lane.connector)
        self.scene = Scene(self.simulation, edges, network.origin)
        self._standing = StandingWatch(self.scene)
        self._levels, self._road_warnings = Levels(network), odd_lengths(network.warnings)
        self._contacts = ContactMonitor(self.scene.events, self._touching)
        self._trailers = Trailers(api, self.scene.table) if api.hasGUI() else None
        self._fleet: Fleet | None = None
        if drive.phase:
            common = drive.policy if policy is None else policy
            if common is None or isinstance(common, str | Path):
                common = load_policy(common)
            drivers = Drivers(common, Path(option("configuration-file")).parent)
            hitch = "phase.hitch" in option("fcd-output.params")
            self._fleet = Fleet(self.scene, Road(network, self._levels), drivers, self.choice, hitch)
        self._start = self._last = self.simulation.time
        self._pending = self._closed = False
        self._waited = 0

    @property
    def events(self) -> list[Event]:
        """What happened so far: collisions, contacts with the road edge, hand-overs, removals."""
        return self.scene.events.events

    @property
    def driven(self) -> int:
        """Vehicles under the policy at the moment."""
        return int(self.scene.table.controlled.sum())

    def step(self, t: float = 0.0) -> bool:  # type: ignore[override]  # False ends it in traci
        """Follow SUMO's step and prepare the next one; libsumo and traci call it for a step listener.

        Returns:
            Whether to be called again: no longer when closed, or when another simulation was started.
        """
        if self._closed or self.simulation.time < self._last:
            return False
        self.observe()
        if not self._over:
            self.drive()
        return True

    def observe(self) -> None:
        """After SUMO's step: who came and went, who is taken over or given back, who touches whom."""
        time, seconds = self.simulation.time, self.simulation.step_length
        if abs(time - self._last - seconds) > 1e-6:
            raise PhaseError(
                f"PHASE was called at {self._last:g} s and {time:g} s, SUMO's step is {seconds:g} s: call "
                "simulationStep() without a time, and register the fleet or call its step(), not both"
            )
        self._last, self._pending = time, False
        self.scene.update()
        self._standing.update(time)
        if self._fleet and not self._closed:
            self._fleet.follow_sumo(time)
        for event in self._contacts.update(self.scene.table, time, self.scene.types):
            for vehicle in (event.vehicle, event.other):
                self.scene.trips[vehicle].after_hand_back += (
                    event.after_hand_back and self.scene.events.given_back(vehicle)
                )
        if self._fleet and not self._closed:
            self._fleet.clear(self._contacts.wrecks(time))
        if self._trailers:
            self._trailers.update()

    def drive(self) -> None:
        """Move the vehicles and tell SUMO where they will be after its next step."""
        if self._fleet and not self._closed:
            self._pending = True
            self._fleet.drive(self.simulation.time)

    def take(self, vehicle: str) -> None:
        """PHASE drives the vehicle from the next step on, or as soon as it is on an observed road."""
        self._mark(vehicle, "true").take(vehicle)

    def release(self, vehicle: str) -> None:
        """SUMO drives the vehicle from the next step on, for the rest of its trip or until `take`."""
        self._mark(vehicle, "false").release(vehicle)

    def set_context(
        self,
        vehicle: str,
        *,
        alpha: float | None = None,
        target_speed: float | None = None,
        time_gap: float | None = None,
        policy: str | Path | None = None,
        guard: bool | None = None,
    ) -> None:
        """Set the vehicle's ``phase.*`` parameters and drive by them from the next step on.

        Without values the parameters are read again as they are, after the caller set them in SUMO.

        Args:
            alpha: longitudinal action range, 0.1..1.
            target_speed: m/s, 3..40.
            time_gap: s to the leader that the target speed leaves, up to 5; 0 to take no heed of leaders.
            policy: file.
            guard: keep it from what is unsafe.
        """
        fleet, api = self._checked(vehicle), self.simulation.api.vehicle
        file = None if policy is None else Path(policy).resolve()
        given = {"alpha": alpha, "target_speed": target_speed, "time_gap": time_gap, "policy": file}
        given["guard"] = None if guard is None else str(guard).lower()
        texts = {f"phase.{name}": str(value) for name, value in given.items() if value is not None}
        before = {key: api.getParameter(vehicle, key) for key in texts}
        for key, text in texts.items():
            api.setParameter(vehicle, key, text)
        try:
            Parameters(self.simulation.api, vehicle, self.scene.types[vehicle]).context()
            fleet.read_context(vehicle)
        except PhaseError:
            for key, text in before.items():
                api.setParameter(vehicle, key, text)
            raise

    def close(self) -> None:
        """Drive no more, and let SUMO take the step it was told about.

        libsumo keeps poses that it never stepped to, and its next simulation in this process would crash.
        """
        self._waited = self._waiting()
        self._closed = True
        if self._pending:
            self._pending = False
            with suppress(PhaseError, self.simulation.failed):  # SUMO may have ended already
                if self.simulation.time <= self._last:
                    self.simulation.step()
                self.observe()

    def report(self) -> dict[str, Any]:
        """What came of the vehicles so far, by the names of the command line's JSON."""
        trips, fleet, events = list(self.scene.trips.values()), self._fleet, self.scene.events
        collisions = events.of("collision")
        phase = [t for t in trips if t.adopted]
        accounts = self.scene.accounts()
        travel = [t.arrive - t.depart for t in trips if math.isfinite(t.arrive)]
        guard = tally(trips, fleet.guarding.decisions if fleet else 0)
        report: dict[str, Any] = {
            "share": self.choice.probability,
            "seed": self.choice.seed,
            "vehicles": len(trips),
            "phase_vehicles": len(phase),
            "arrived": sum(math.isfinite(t.arrive) for t in phase) if phase else accounts["arrived"],
            "collisions": len(collisions),
            "phase_collisions": sum(c.with_phase for c in collisions),
            "phase_at_fault_collisions": sum(c.phase_at_fault for c in collisions),
            "collisions_after_hand_back": sum(c.after_hand_back for c in collisions),
            "off_road": len(events.of("road edge")),
            **guard,
            "phase_vehicle_km": sum(t.policy_metres for t in trips) / 1000.0,
            "sim_seconds": self._last - self._start,
            "policy_cpu_us_per_vehicle_step": fleet.cpu_per_decision if fleet else 0.0,
            "guard_cpu_us_per_vehicle_step": fleet.guarding.cpu_per_decision if fleet else 0.0,
            "share_of_time_under_policy": _ratio(
                sum(t.policy_seconds for t in phase), sum(t.seconds for t in phase)
            ),
            "share_of_freeway_time_under_policy": _ratio(
                sum(t.policy_seconds for t in phase), sum(t.freeway_seconds for t in phase)
            ),
            "phase_arrived_under_policy": sum(t.finished for t in phase),
            "mean_travel_time": sum(travel) / len(travel) if travel else None,
            "mean_depart_delay": sum(t.delay for t in trips) / len(trips) if trips else None,
            "waiting_for_insertion": self._waiting(),
            "teleports": self.scene.teleports,
            "accounts": accounts,
            "accounts_balance": accounts["inserted"]
            == sum(v for k, v in accounts.items() if k != "inserted"),
            "warnings": self._warnings() + warning(guard["guard_share_of_decisions"]),
        }
        if fleet:
            report["fleet"] = fleet.report()
        return report

    def _touching(self, vehicle: str, other: str) -> bool:
        """Whether two vehicles are on one level; those of which it is not known are."""
        a, b = self._piece(vehicle), self._piece(other)
        return a < 0 or b < 0 or bool(self._levels.touching(np.array([a]), np.array([b]))[0])

    def _piece(self, vehicle: str) -> int:
        """The piece of road that a vehicle is on, -1 where it is not known."""
        piece = self._fleet.piece(vehicle) if self._fleet else -1
        if piece < 0 and vehicle in self.scene.lane_of:
            position = float(self.simulation.api.vehicle.getLanePosition(vehicle))
            piece = self._levels.of_lane(self.scene.lane_of[vehicle], position)
        return piece

    @property
    def _over(self) -> bool:
        """SUMO makes no further step: its demand is used up, or its end has come."""
        end = float(self.simulation.api.simulation.getEndTime())
        return self.simulation.used_up or 0 <= end <= self._last

    def _waiting(self) -> int:
        """Vehicles that SUMO could not insert yet; at the end, those that it never could."""
        if not self._closed:
            with suppress(self.simulation.refused, self.simulation.failed):
                return len(self.simulation.api.simulation.getPendingVehicles())
        return self._waited

    def _mark(self, vehicle: str, text: str) -> Fleet:
        fleet = self._checked(vehicle)
        self.simulation.api.vehicle.setParameter(vehicle, "phase.device", text)
        return fleet

    def _checked(self, vehicle: str) -> Fleet:
        facts = self.scene.facts.get(vehicle)
        if facts is None or self._fleet is None:
            raise PhaseError(f"vehicle {vehicle!r} is not in the simulation, or PHASE no longer drives in it")
        if facts.kind is None:
            raise PhaseError(
                f"vehicle {vehicle!r}: PHASE drives cars and trucks only, vType {facts.type!r} is neither; "
                "set phase.type on it if it drives like one"
            )
        return self._fleet

    def _warnings(self) -> list[str]:
        trips = self.scene.trips
        seen = {t.type for t in trips.values()}
        found = [f"no vehicle of type {t!r} was inserted" for t in self.choice.types if t not in seen]
        found += [f"no vehicle {v!r} was inserted" for v in self.choice.explicit if v not in trips]
        wanted = self.choice.probability > 0 or self.choice.explicit
        found += self._road_warnings
        if not trips:
            found.append("no vehicle was inserted: check the demand and its times")
        elif self._fleet and wanted and not any(t.adopted for t in trips.values()):
            found.append("no vehicle was driven by PHASE: check share, types and roads")
        return found + self._standing.warnings()


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else 0.0
