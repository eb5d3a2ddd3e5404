"""Queues of SUMO's vehicles on the observed road, before the crossing that it ends at.

The policy was never told to stand, so vehicles that wait their turn are followed by SUMO's own models.
"""

from __future__ import annotations

import numpy as np

from phase_sumo.bridge.fleet.member import Member
from phase_sumo.bridge.fleet.occupancy import Occupancy
from phase_sumo.bridge.fleet.road import BoolArray, FloatArray, IntArray, Road
from phase_sumo.bridge.fleet.table import VehicleTable

LOOK = 150.0  # m
WAITING = 2.0  # m/s, at most, of a vehicle that waits


def queue_rooms(
    road: Road,
    table: VehicleTable,
    node: IntArray,
    rows: IntArray,
    members: list[Member],
    on_route: BoolArray,
) -> FloatArray:
    """[n] m that each member has left to a waiting vehicle of SUMO's, inf for none or no crossing ahead.

    Args:
        node: [N] node of each row's front bumper, -1 off the road.
        rows: [n] of the members in the table.
        on_route: [n] whether they are on their route.
    """
    room = np.full(len(rows), np.inf)
    leaving = np.flatnonzero(on_route & np.array([member.leads_off for member in members], bool))
    if len(leaving):
        own, routes = rows[leaving], [members[k].route for k in leaving.tolist()]
        occupancy = Occupancy(road, table, node)
        leader, gap = occupancy.leaders(node[own], own, routes, np.full(len(own), LOOK))
        waits = ~table.controlled[leader] & (table["speed"][leader] <= WAITING)
        room[leaving] = np.where((leader >= 0) & waits, gap, np.inf)
    return room
