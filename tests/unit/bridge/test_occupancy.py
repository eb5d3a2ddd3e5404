"""Leaders and followers against a look at all pairs on one long row of lanes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from phase_sumo.bridge.fleet.occupancy import BEHIND, FAST, Occupancy, standing_rooms
from phase_sumo.bridge.fleet.road import Road
from phase_sumo.bridge.fleet.route import route_lanes
from phase_sumo.bridge.fleet.table import VehicleTable
from phase_sumo.sim.lanes import LaneNetwork
from tests.helpers.toy_motorway import W, lane, nodes, put

CUTS = (0, 40, 90, 100, 300, 330, 600)
LENGTH = 5.0


@pytest.fixture(scope="module")
def road():
    """Two rows of lanes, each cut at `CUTS`."""
    lanes = [lane(f"e{k}", y, a, b) for y in (0, 1) for k, (a, b) in enumerate(pairwise(CUTS))]
    pieces = len(CUTS) - 1
    following = [(y * pieces + k, y * pieces + k + 1) for y in (0, 1) for k in range(pieces - 1)]
    return Road(LaneNetwork("rows", tuple(lanes), tuple(following)))


def test_as_a_look_at_all_pairs(road):
    route = route_lanes(road, [f"e{k}" for k in range(len(CUTS) - 1)], truck=False)
    rng = np.random.default_rng(0)
    for count in (1, 3, 12, 40):
        table = VehicleTable(64)
        x, y = rng.uniform(5.0, 595.0, count), rng.integers(0, 2, count)
        rows = np.array([put(table, f"v{k}", x[k], y[k] * W, 20.0) for k in range(count)])
        node = nodes(table, road)[rows]
        at = road.graph.node_xy[node][:, 0]
        everybody = np.full(len(table), -1)
        everybody[rows] = node
        occupancy, reach = Occupancy(road, table, everybody), np.full(count, 150.0)
        leader, gap = occupancy.leaders(node, rows, [route] * count, reach)
        follower, behind = occupancy.followers(node, rows)
        for k in range(count):
            others = np.array([j for j in range(count) if j != k and y[j] == y[k]], int)
            ahead = others[at[others] > at[k] + 1.5]
            if not len(others) or (np.abs(at[others] - at[k]) <= 1.5).any():
                continue
            near = at[ahead].min() - at[k] - LENGTH if len(ahead) else np.inf
            if near < 145.0:
                assert gap[k] == pytest.approx(near, abs=2.0)
                assert leader[k] in rows[ahead]
            elif near > 155.0:
                assert leader[k] == -1 and np.isinf(gap[k])
            back = others[at[others] < at[k] - 1.5]
            near = at[k] - at[back].max() if len(back) else np.inf
            if near < BEHIND - 5.0:
                assert behind[k] == pytest.approx(near - LENGTH, abs=2.0)
                assert follower[k] in rows[back]
            elif not len(back):
                assert follower[k] == -1 and np.isinf(behind[k])


def test_who_stands_is_found_ahead_and_beside_the_way_of_fast_ones():
    road = Road(LaneNetwork("two", (lane("e", 0, 0, 900, left=1), lane("e", 1, 0, 900, right=0)), ()))
    route = route_lanes(road, ("e",), truck=False)
    for standing, speed, own, beside in (
        (0.0, 20.0, 95.0, np.inf),
        (W, 20.0, np.inf, 95.0),
        (W, FAST - 1.0, np.inf, np.inf),
        (W, -1.0, np.inf, np.inf),
    ):
        table = VehicleTable(4)
        row = put(table, "a", 100.0, 0.0, max(speed, 20.0 if speed < 0 else speed), 25.0)
        put(table, "moves", 150.0, 0.0, 15.0)
        put(table, "stands", 200.0, standing, 5.0 if speed < 0 else 0.0)
        node = nodes(table, road)
        occupancy = Occupancy(road, table, node)
        found = standing_rooms(road, occupancy, node[[row]], np.array([row]), [route])
        assert [float(room[0]) for room in found] == pytest.approx([own, beside], abs=1.0)
