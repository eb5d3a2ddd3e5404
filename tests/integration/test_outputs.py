"""SUMO's output files of a run with PHASE vehicles, against each other, SUMO's schemas and the model."""

from __future__ import annotations

import csv
import itertools
import json
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest
import sumolib
import torch
from lxml import etree  # type: ignore[attr-defined]  # has no stubs

from phase_sumo.bridge.fleet import fleet
from phase_sumo.bridge.fleet.event_log import read_events, under_policy
from phase_sumo.bridge.run import run_scenario
from phase_sumo.bridge.sumo.emission_tables import emission_tables
from tests.helpers.places import NETWORKS
from tests.helpers.standin import Standin

NETWORK = NETWORKS / "f04_onramp3.net.xml"
SCHEMAS = Path(sumolib.checkBinary("sumo")).parents[1] / "data" / "xsd"
ROUTES = """<routes>
    <vType id="car" vClass="passenger" length="4.8" width="1.9" speedFactor="normc(0.9,0.1,0.7,1.1)"/>
    <vType id="semi" vClass="trailer" length="20.0" width="2.55" accel="0.9" maxSpeed="25"
           speedFactor="0.85">
        <param key="phase.target_speed" value="14"/>
    </vType>
    <flow id="m" type="car" from="main0" to="main2" begin="0" end="40" period="2.2" departLane="best"
          departSpeed="avg"/>
    <flow id="t" type="semi" from="main0" to="main2" begin="0" end="40" period="9" departLane="0"
          departSpeed="avg"/>
    <flow id="r" type="car" from="onramp1" to="main2" begin="0" end="40" period="8" departSpeed="avg"/>
</routes>
"""


def write_scenario(folder, step=0.1, network=NETWORK, additional="", demand=ROUTES):
    (folder / "demand.rou.xml").write_text(demand)
    (folder / "more.add.xml").write_text(f"<additional>{additional}</additional>")
    path = folder / "test.sumocfg"
    path.write_text(
        f'<configuration><net-file value="{network}"/><route-files value="demand.rou.xml"/>'
        f'<additional-files value="more.add.xml"/><step-length value="{step}"/></configuration>'
    )
    return path


def outputs(folder, *names):
    return [part for name in names for part in (f"--{name}", str(folder / f"{name}.xml"))]


def rows(path):
    return list(etree.parse(str(path)).getroot())


def frames(path):
    """Time -> vehicle -> attributes."""
    return {float(step.get("time")): {v.get("id"): dict(v.attrib) for v in step} for step in rows(path)}


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Half of the vehicles under a policy that looks at no one."""
    folder = tmp_path_factory.mktemp("mixed")
    names = ("fcd-output", "tripinfo-output", "lanechange-output", "collision-output", "statistic-output")
    options = [
        *outputs(folder, *names),
        *("--precision", "6", "--tripinfo-output.write-unfinished", "true"),
        *("--device.ssm.probability", "1", "--device.ssm.file", str(folder / "ssm.xml")),
        *("--device.ssm.measures", "TTC DRAC PET", "--device.ssm.thresholds", "12 0.1 1"),
    ]
    result = run_scenario(
        write_scenario(folder), policy=Standin(reckless=True), alpha=0.5, seed=1, share=0.5, time_gap=0.0,
        guard=False, end=50, sumo_options=options, output_dir=folder / "ours", record=False,
    )  # fmt: skip
    return folder, result, read_events(folder / "ours" / "events.csv")


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_fcd_carries_the_hitch_angle(tmp_path, monkeypatch, step):
    model = {}
    follow = fleet.Fleet.follow_sumo

    def note(self, time):
        for vehicle in set(self._members) & set(self._scene.facts):
            row = self._table.row_of[vehicle]
            model[round(time - step, 3), vehicle] = float(self._table["hitch"][row])
        follow(self, time)

    monkeypatch.setattr(fleet.Fleet, "follow_sumo", note)
    options = [*outputs(tmp_path, "fcd-output"), "--fcd-output.params", "phase.hitch"]
    demand = ROUTES.replace('type="semi" from="main0"', 'type="semi" from="onramp1"')  # trailers bend there
    run_scenario(
        write_scenario(tmp_path, step, demand=demand), policy=Standin(), seed=1, end=30, sumo_options=options,
        output_dir=tmp_path / "out", record=False,
    )  # fmt: skip
    bent = []
    for time, vehicles in frames(tmp_path / "fcd-output.xml").items():
        for name, seen in vehicles.items():
            assert seen["type"] == "semi" or "phase.hitch" not in seen
            if "phase.hitch" in seen and (time, name) in model:
                bent.append((float(seen["phase.hitch"]), model[time, name]))
    bent = np.array(bent)
    assert len(bent) > 20
    np.testing.assert_allclose(bent[:, 0], bent[:, 1], atol=1e-6)
    assert np.abs(bent[:, 1]).max() > 1e-3


@pytest.mark.parametrize("name", ["tripinfo", "collision", "statistic", "fcd"])
def test_files_keep_to_sumos_schemas(mixed, name):
    schema = etree.XMLSchema(etree.parse(str(SCHEMAS / f"{name}_file.xsd")))
    schema.assertValid(etree.parse(str(mixed[0] / f"{name}-output.xml")))


def test_every_lane_change_is_in_sumos_file(mixed):
    folder, _, events = mixed
    turns = defaultdict(list)
    for event in events:
        if event.kind == "adoption":
            turns[event.vehicle].append(event)
    expected = Counter()
    last = {}
    for time, vehicles in frames(folder / "fcd-output.xml").items():
        for name, seen in vehicles.items():
            before, lane = last.get(name, ""), seen["lane"]
            if before != lane and before.rpartition("_")[0] == lane.rpartition("_")[0]:
                expected[name, time, before, lane] += 1
            last[name] = lane
    changes = rows(folder / "lanechange-output.xml")
    found = Counter((c.get("id"), float(c.get("time")), c.get("from"), c.get("to")) for c in changes)
    ours = {c.get("id") for c in changes if c.get("reason") == "traci"}
    # SUMO's own vehicles also change lane in the step in which they leave a junction
    assert {k: n for k, n in found.items() if k[0] in ours} == {
        k: n for k, n in expected.items() if turns[k[0]]
    }
    theirs = {c.get("id") for c in changes} - ours
    assert ours and theirs
    assert all(turns[name] for name in ours) and not any(turns[name] for name in theirs)
    assert all(set(c.attrib) == set(changes[0].attrib) for c in changes)
    times = [float(c.get("time")) for c in changes]
    assert times == sorted(times)


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_route_lengths_are_what_was_driven(mixed, tmp_path, step):
    folder = mixed[0]
    if step == 1.0:
        folder = tmp_path
        options = outputs(tmp_path, "fcd-output", "tripinfo-output", "lanechange-output")
        run_scenario(
            write_scenario(tmp_path, step), policy=Standin(), seed=1, end=60, sumo_options=options,
            output_dir=tmp_path / "out", record=False,
        )  # fmt: skip
    driven = defaultdict(float)
    last = {}
    for vehicles in frames(folder / "fcd-output.xml").values():
        for name, seen in vehicles.items():
            x, y = float(seen["x"]), float(seen["y"])
            if name in last:
                driven[name] += np.hypot(x - last[name][0], y - last[name][1])
            last[name] = x, y
    trips = {t.get("id"): t for t in rows(folder / "tripinfo-output.xml")}
    changed = [c.get("id") for c in rows(folder / "lanechange-output.xml")]
    assert set(changed) & trips.keys()
    for name, trip in trips.items():
        final = step * max(float(trip.get("arrivalSpeed")), 0.0)  # the last step ends beyond the network
        aside = 2.0 * changed.count(name)  # m of its way; SUMO's own vehicles jump from lane to lane
        assert float(trip.get("routeLength")) == pytest.approx(
            driven[name] + 0.5 * final, abs=0.5 * final + 4.0 + aside
        )


def test_statistics_are_the_means_of_the_trips(mixed):
    folder, result, _ = mixed
    trips = rows(folder / "tripinfo-output.xml")
    root = etree.parse(str(folder / "statistic-output.xml")).getroot()
    mean = root.find("vehicleTripStatistics")
    length = np.array([float(t.get("routeLength")) for t in trips])
    duration = np.array([float(t.get("duration")) for t in trips])
    assert int(mean.get("count")) == len(trips) == result["vehicles"]
    assert float(mean.get("routeLength")) == pytest.approx(length.mean(), abs=1e-3)
    assert float(mean.get("speed")) == pytest.approx((length / duration).mean(), abs=1e-3)
    collisions = len(rows(folder / "collision-output.xml"))
    assert int(root.find("safety").get("collisions")) == collisions


@pytest.mark.parametrize("step", [0.1, 1.0])
def test_emissions_are_those_of_the_models_motion(tmp_path, step):
    """By SUMO's tables for fcd's speed and acceleration, also above the speed that SUMO would allow."""
    options = [
        *outputs(tmp_path, "fcd-output", "tripinfo-output", "emission-output"),
        *("--device.emissions.probability", "1", "--fcd-output.acceleration", "true", "--precision", "6"),
        *("--tripinfo-output.write-unfinished", "true"),
    ]
    fast = '<param key="phase.target_speed" value="38"/></vType>'
    demand = ROUTES.replace('speedFactor="normc(0.9,0.1,0.7,1.1)"/>', f'speedFactor="0.8">{fast}')
    run_scenario(
        write_scenario(tmp_path, step, demand=demand), policy=Standin(), seed=1, end=20,
        sumo_options=options, output_dir=tmp_path / "out", record=False,
    )  # fmt: skip
    moved = frames(tmp_path / "fcd-output.xml")
    emitted = frames(tmp_path / "emission-output.xml")
    fastest, pairs, total, most = 0.0, [], defaultdict(float), defaultdict(float)
    (name,) = {v["eclass"] for frame in emitted.values() for v in frame.values() if v["type"] == "car"}
    table = emission_tables([name])[name]
    for time, vehicles in emitted.items():
        for vehicle, gases in vehicles.items():
            total[vehicle] += step * float(gases["CO2"])
            most[vehicle] = max(most[vehicle], step * float(gases["CO2"]))
            speed, accel = (np.array([float(moved[time][vehicle][k])]) for k in ("speed", "acceleration"))
            if gases["type"] == "car" and -10.0 < accel[0] < 6.0:
                fastest = max(fastest, speed[0] / 29.0)  # the limit
                pairs.append((float(gases["CO2"]), table.rate(table.co2, speed, accel)[0]))
    assert fastest > 1.0
    written, expected = np.array(pairs).T
    assert np.abs(written - expected).mean() < 2e-3 * expected.mean()  # the tables blur the cut-off
    sums = {
        t.get("id"): float(t.find("emissions").get("CO2_abs")) for t in rows(tmp_path / "tripinfo-output.xml")
    }
    running = [v for v in max(moved.items())[1] if v in sums]
    assert len(running) > 5
    for vehicle in running:  # SUMO's sum leaves out the step of the insertion
        assert sums[vehicle] == pytest.approx(total[vehicle], abs=1.01 * most[vehicle])


def test_collisions_are_those_of_the_boxes(mixed):
    folder, result, events = mixed
    ours = [e for e in events if e.kind == "collision" and e.with_phase]
    assert len(ours) == result["phase_collisions"] > 0
    written = rows(folder / "collision-output.xml")
    turns = defaultdict(list)
    for event in events:
        if event.kind in ("adoption", "hand-back"):
            turns[event.vehicle].append(event)
    with_phase = [
        c for c in written
        if any(under_policy(turns[c.get(role)], float(c.get("time"))) for role in ("collider", "victim"))
    ]  # fmt: skip
    assert [(float(c.get("time")), c.get("collider"), c.get("victim")) for c in with_phase] == [
        (e.time, e.vehicle, e.other) for e in ours
    ]
    seen = frames(folder / "fcd-output.xml")
    for event in ours:  # the time stamp is that of the trajectories, and both vehicles are there
        at = seen[event.time]
        for name, speed in ((event.vehicle, event.speed), (event.other, event.other_speed)):
            assert float(at[name]["speed"]) == pytest.approx(speed, abs=1e-3)
            assert np.hypot(float(at[name]["x"]) - event.x, float(at[name]["y"]) - event.y) < 22.0
        assert at[event.vehicle]["lane"] == event.lane
        assert float(at[event.vehicle]["pos"]) == pytest.approx(event.position, abs=1e-3)
    assert {e.box for e in ours} | {e.other_box for e in ours} >= {"body", "trailer"}


def test_surrogate_safety_of_followers_is_right(mixed):
    """SUMO's device: minTTC of same-lane following, recomputed from the trajectories."""
    folder = mixed[0]
    length = {"car": 4.8, "semi": 20.0}
    best = {}
    for time, vehicles in frames(folder / "fcd-output.xml").items():
        lanes = defaultdict(list)
        for name, seen in vehicles.items():
            lanes[seen["lane"]].append((float(seen["pos"]), name, float(seen["speed"]), seen["type"]))
        for lane in lanes.values():
            for (back, a, fast, _), (front, b, slow, kind) in itertools.pairwise(sorted(lane)):
                gap = front - length[kind] - back
                if gap > 0 and fast > slow:
                    best[a, b] = min(best.get((a, b), (np.inf, 0.0)), (gap / (fast - slow), time))
    checked = 0
    for conflict in rows(folder / "ssm.xml"):
        smallest = conflict.find("minTTC")
        pair = conflict.get("ego"), conflict.get("foe")
        if smallest.get("type") == "2" and pair in best:  # following as the follower
            value, time = best[pair]
            if float(smallest.get("time")) == pytest.approx(time):
                assert float(smallest.get("value")) == pytest.approx(value, rel=1e-3)
                checked += 1
    assert checked >= 1


def settled(folder, result):
    """Our accounts against SUMO's own files."""
    accounts = dict(result["accounts"])
    inserted = accounts.pop("inserted")
    assert result["accounts_balance"] and inserted == sum(accounts.values())
    vehicles = etree.parse(str(folder / "statistic-output.xml")).getroot().find("vehicles")
    assert int(vehicles.get("inserted")) == inserted == result["vehicles"]
    assert int(vehicles.get("running")) == accounts["running"]
    assert int(vehicles.get("waiting")) == result["waiting_for_insertion"]
    trips = rows(folder / "tripinfo-output.xml")
    assert len(trips) == inserted
    ended = [t for t in trips if float(t.get("arrival")) >= 0]
    assert len(ended) == inserted - accounts["running"]
    assert sum(t.get("vaporized") == "" for t in ended) == accounts["arrived"]
    with (folder / "out" / "trips.csv").open() as file:
        ours = {t["vehicle"]: t for t in csv.DictReader(file)}
    for trip in trips:
        own = ours[trip.get("id")]
        assert float(own["depart"]) == pytest.approx(float(trip.get("depart")), abs=1e-3)
        assert float(own["seconds"]) == pytest.approx(float(trip.get("duration")), abs=1e-3)
        if own["arrive"] != "nan":
            assert float(own["arrive"]) == pytest.approx(float(trip.get("arrival")), abs=1e-3)
    events = read_events(folder / "out" / "events.csv")
    removed = Counter(f"removed: {e.reason}" for e in events if e.kind == "removal")
    assert removed == {k: v for k, v in accounts.items() if k.startswith("removed")}
    assert [e.time for e in events] == sorted(e.time for e in events)
    return accounts, events


def account_run(folder, additional="", network=NETWORK, end=40, share=1.0, demand=ROUTES, driver=None):
    options = [
        *outputs(folder, "tripinfo-output", "statistic-output"),
        *("--tripinfo-output.write-unfinished", "true", "--precision", "3"),
    ]
    result = run_scenario(
        write_scenario(folder, 0.1, network, additional, demand), policy=driver or Standin(),
        seed=1, end=end, share=share, sumo_options=options, guard=driver is None,
        output_dir=folder / "out", record=False,
    )  # fmt: skip
    return settled(folder, result)


CALIBRATOR = (
    '<vType id="any"/><route id="all" edges="main1 main2"/><calibrator id="c" edge="main1" pos="60">'
    '<flow begin="0" end="99" vehsPerHour="700" speed="30" type="any" route="all"/></calibrator>'
)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_sumo_drives_past_calibrators(tmp_path, share):
    accounts, events = account_run(tmp_path, CALIBRATOR, share=share)
    assert accounts["removed: by SUMO: calibrator"] > 3
    driven = [e.lane for e in events if e.phase]
    assert bool(driven) == (share > 0)
    assert not any(lane.startswith("main1") for lane in driven)


def test_accounts_with_vaporized_vehicles(tmp_path):
    accounts, events = account_run(tmp_path, '<vaporizer id="main2" begin="0" end="25"/>')
    assert accounts["removed: by SUMO: vaporizer"] > 1
    assert accounts["arrived"] > 1
    assert all(e.lane.startswith("main2") for e in events if e.kind == "removal")


def test_accounts_with_routes_that_end_early(tmp_path):
    rerouter = (
        '<rerouter id="r" edges="main1"><interval begin="0" end="99">'
        '<destProbReroute id="terminateRoute" probability="1"/></interval></rerouter>'
    )
    accounts, _ = account_run(tmp_path, rerouter, share=0.5)
    assert accounts["arrived"] > 5


class Swerve(Standin):
    """Turns left whatever comes."""

    def tokens(self, observation):
        steady = self.actions.jerk.index(0.0) * len(self.actions.steering_rate)
        left = steady + len(self.actions.steering_rate) - 1
        return torch.full((len(observation.ego),), left)


def test_accounts_with_vehicles_that_run_off_the_road_and_others_still_waiting(tmp_path):
    demand = ROUTES.replace('period="2.2"', 'period="0.4"')
    accounts, events = account_run(tmp_path, end=25, share=0.4, demand=demand, driver=Swerve())
    assert "removed: off road" not in accounts  # SUMO leads them back
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["waiting_for_insertion"] > 0
    touched = {(e.vehicle, e.time) for e in events if e.kind == "road edge"}
    off = [event for event in events if event.reason == "it runs off the road"]
    assert len(off) > 2
    for event in off:
        assert event.kind == "hand-back"
        assert any(who == event.vehicle and when <= event.time for who, when in touched)
        if event.lane.startswith("main"):
            assert event.y > -3.0  # the road lies below y = 0: its left edge
    assert result["off_road"] == len(touched)


def test_accounts_with_hand_overs_both_ways(tmp_path):
    """The ramp and the end of the road are made city streets: SUMO drives there."""
    text = NETWORK.read_text()
    for edge in ("onramp1", "main2"):
        head, _, tail = text.partition(f'<edge id="{edge}"')
        text = head + f'<edge id="{edge}"' + tail.replace("highway.motorway", "highway.residential", 1)
    network = tmp_path / "city.net.xml"
    network.write_text(text)
    accounts, events = account_run(tmp_path, network=network, end=60)
    adopted = {e.vehicle: e for e in events if e.kind == "adoption"}
    back = {e.vehicle: e for e in events if e.kind == "hand-back"}
    assert back and set(back) <= set(adopted)
    assert accounts["arrived"] > 0
    ramp = [e for v, e in adopted.items() if v.startswith("r.")]
    assert ramp and all(e.lane.startswith("main1") and "reached" in e.reason for e in ramp)
    assert all(e.reason == "departed" for v, e in adopted.items() if not v.startswith("r."))
    assert all(e.lane.startswith("main1") and e.position > 0 for e in back.values())
