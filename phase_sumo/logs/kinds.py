"""Vehicle type of a recorded box."""

from __future__ import annotations

from phase_sumo.logs.recording import Kind

TRUCK = 7.0  # m: longer vehicles are trucks
ARTICULATED = 12.5  # m: no rigid truck is longer, by law in most countries
CARS = frozenset({"car", "van", "motorcycle", "sedan", "midsize", "pickup", "suv", "taxi"})
TRUCKS = frozenset({"truck", "semi", "trailer", "lorry"})
BUSES = frozenset({"bus"})


def kind_of(length: float, vehicle_class: str | None = None) -> Kind:
    """The one rule for all readers.

    By length: below `TRUCK` a car, below `ARTICULATED` a rigid truck, else articulated. The log's own class,
    where it has one, overrules that in three cases: what it calls a truck is no car, what it calls a car,
    van or motorcycle is no rigid truck (it may tow), and a bus is a rigid truck of any length.
    """
    named = (vehicle_class or "").strip().lower()
    if named in BUSES:
        return "rigid_truck"
    if length >= ARTICULATED:
        return "articulated_truck"
    if named in TRUCKS:
        return "rigid_truck"
    return "rigid_truck" if length >= TRUCK and named not in CARS else "car"
