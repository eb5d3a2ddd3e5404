"""Who stands on the road for minutes without a stop: something is wrong there, or SUMO's traffic is stuck."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phase_sumo.bridge.fleet.scene import Scene
from phase_sumo.bridge.sumo.session import bare

PERIOD = 10.0  # s between two looks
LONG = 180.0  # s
PLACES = 3  # that are named at most


@dataclass
class Place:
    """An edge on which vehicles stood for long.

    Attributes:
        vehicles: their ids.
        seconds: longest time that one of them stood at a stretch.
        first: the first that was seen, with its lane, the place on it in m and the time in s.
    """

    vehicles: set[str]
    seconds: float
    first: tuple[str, str, float, float]


class StandingWatch:
    """Looks at SUMO's waiting times, which do not count stops, of all vehicles from time to time."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._api = scene, scene.api.vehicle
        self._waited = bare(scene.api, "vehicle", "getWaitingTime")
        self._next = -np.inf
        self._places: dict[str, Place] = {}

    def update(self, time: float) -> None:
        """Look, if it is time to."""
        if time < self._next - 1e-6:
            return
        self._next = time + PERIOD
        for vehicle in self._scene.facts:
            seconds = self._waited(vehicle)
            if seconds >= LONG:
                self._note(vehicle, seconds, time)

    def warnings(self) -> list[str]:
        """One line per place, the worst first."""
        worst = sorted(self._places.items(), key=lambda item: -len(item[1].vehicles))
        lines = [_line(edge, place) for edge, place in worst[:PLACES]]
        rest = [place for _, place in worst[PLACES:]]
        if rest:
            vehicles = set().union(*(place.vehicles for place in rest))
            lines.append(f"{len(vehicles)} vehicles stood for minutes on {len(rest)} other edges")
        return lines

    def _note(self, vehicle: str, seconds: float, time: float) -> None:
        lane = self._api.getLaneID(vehicle)
        edge = self._scene.edge(lane) if lane else "no edge"
        if edge not in self._places:
            at = float(self._api.getLanePosition(vehicle)) if lane else 0.0
            self._places[edge] = Place(set(), 0.0, (vehicle, lane, at, time))
        place = self._places[edge]
        place.vehicles.add(vehicle)
        place.seconds = max(place.seconds, float(seconds))


def _line(edge: str, place: Place) -> str:
    vehicle, lane, at, time = place.first
    number = len(place.vehicles)
    return (
        f"{number} vehicle{'s' * (number > 1)} stood for more than {LONG / 60:g} minutes on edge {edge!r}, "
        f"the longest for {place.seconds:.0f} s, first {vehicle!r} on lane {lane!r} at {at:.0f} m, seen at "
        f"{time:.0f} s: look there with --gui, for a signal, a closed lane or a route that cannot be driven"
    )
