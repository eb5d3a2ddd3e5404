"""Vehicles that SUMO drives again: without a jump, and in their order on SUMO's lanes.

SUMO finds leaders by the order of a lane's list, which it keeps by order of entry. moveToXY moves vehicles
within a lane without a look at that order, and who follows one that is behind itself stands for ever.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise

from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.sumo.session import Simulation, bare

SUMO_SPEED_MODE, SUMO_LANE_MODE = 31, 1621  # SUMO's defaults
NEEDED_ONLY, PASSING = 1541, 8.0  # lane changes for the route and for others alone, and for how many s
SIDEWAYS = 0.6  # m/s back to the middle of the lane


class HandBack:
    """Gives vehicles back and leads them to the middle of their lane; puts SUMO's lanes in order."""

    def __init__(self, session: Simulation) -> None:
        self._session, self._api = session, session.api
        self._aside: dict[str, None] = {}
        self._passing: dict[str, float] = {}
        self._sublanes = float(session.api.simulation.getOption("lateral-resolution")) > 0
        self._place = bare(session.api, "vehicle", "getLanePosition")

    def give(self, vehicle: str, passing: bool = False) -> None:
        """SUMO drives it from now on; ``passing`` keeps it in its lane for a while, if its route does."""
        api = self._api.vehicle
        api.setSpeedMode(vehicle, SUMO_SPEED_MODE)
        api.setLaneChangeMode(vehicle, NEEDED_ONLY if passing else SUMO_LANE_MODE)
        if passing:
            self._passing[vehicle] = self._session.time + PASSING
        api.setSpeed(vehicle, -1.0)
        lane = api.getLaneID(vehicle)
        if lane:
            self.order([lane])
        if not self._sublanes:  # that model does so itself
            self._aside[vehicle] = None

    def place(self, vehicle: str, road: Road, node: int) -> None:
        """Put a vehicle that SUMO sees on no lane onto the one that is ours."""
        lane = road.network.lanes[int(road.graph.node_lane[node])]
        if not lane.connector:
            share = road.offset(node) / float(road.count[road.graph.node_lane[node]])
            with suppress(self._session.refused):
                self._api.vehicle.moveTo(vehicle, lane.id, share * self._api.lane.getLength(lane.id))

    def forget(self, vehicle: str) -> None:
        """The vehicle is driven by the policy, or gone."""
        self._aside.pop(vehicle, None)
        self._passing.pop(vehicle, None)

    def settle(self) -> None:
        """After a step: a bit back to the middle of the lane, and the end of `PASSING`."""
        for vehicle in [v for v, until in self._passing.items() if self._session.time > until]:
            del self._passing[vehicle]
            with suppress(self._session.refused):
                self._api.vehicle.setLaneChangeMode(vehicle, SUMO_LANE_MODE)
        api, step = self._api.vehicle, SIDEWAYS * self._session.step_length
        for vehicle in list(self._aside):
            try:
                aside = api.getLateralLanePosition(vehicle)
            except self._session.refused:
                aside = 0.0
            if abs(aside) < 1e-3:
                del self._aside[vehicle]
            elif abs(aside) < 100.0:  # else it is on no lane at the moment
                api.setLateralLanePosition(vehicle, aside - max(-step, min(step, aside)))

    def order(self, lanes: Iterable[str]) -> None:
        """Sort SUMO's lists of the vehicles on some lanes by their places."""
        for lane in lanes:
            if lane.startswith(":"):
                continue
            vehicles = self._api.lane.getLastStepVehicleIDs(lane)
            for _ in vehicles:
                places = [self._place(vehicle) for vehicle in vehicles]
                wrong = next((k for k, (a, b) in enumerate(pairwise(places)) if a > b), None)
                if wrong is None:
                    break
                vehicle = vehicles[wrong]
                k = wrong + 1 if self._api.vehicle.isStopped(vehicle) else wrong
                self._enter_again(vehicles[k], lane, places[k])
                vehicles = self._api.lane.getLastStepVehicleIDs(lane)

    def _enter_again(self, vehicle: str, lane: str, place: float) -> None:
        """SUMO looks for a vehicle's place in the list of a lane when it comes from another one."""
        edge, _, index = lane.rpartition("_")
        beside = int(index) + 1 if int(index) + 1 < self._api.edge.getLaneNumber(edge) else int(index) - 1
        elsewhere, at = f"{edge}_{beside}", place
        if beside < 0:
            route, here = self._api.vehicle.getRoute(vehicle), self._api.vehicle.getRouteIndex(vehicle)
            near = [route[k] for k in (here + 1, here - 1) if 0 <= k < len(route)]
            if not near:
                return
            elsewhere, at = f"{near[0]}_0", 0.0
        with suppress(self._session.refused):
            self._api.vehicle.moveTo(vehicle, elsewhere, at)
        with suppress(self._session.refused):
            self._api.vehicle.moveTo(vehicle, lane, place)
