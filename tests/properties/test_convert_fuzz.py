"""Whatever a network file holds, the converter makes a finite map of it or says in one line why not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.coordinates import LanePositions
from phase_sumo.bridge.maps.stretches import cut
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.errors import PhaseError
from tests.helpers.places import ROOT
from tests.helpers.small_nets import SmallNet, lanes_from

SHIPPED = sorted((ROOT / "networks").glob("*.net.xml"))
quick = settings(
    max_examples=40, deadline=8000, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
thorough = settings(quick, max_examples=1500, deadline=30000)


def check(folder: Path, data: bytes, stretch: float) -> None:
    """Read, cut and build; every number must be finite, and every complaint one line that names the file."""
    path = folder / "fuzz.net.xml"
    path.write_bytes(data)
    try:
        for keep in ("freeway", "all"):
            network = read_network(path, keep)
            parts = cut(network, stretch)
            lanes = sum(len(part.lanes) for part in parts)
            assert lanes > 0
    except PhaseError as error:
        assert str(error).startswith(f"{path}: ")
        assert "\n" not in str(error)
        return
    sizes = [np.ptp(np.concatenate([lane.points for lane in part.lanes]), axis=0).max() for part in parts]
    if max(sizes) > 1000.0 or len(parts) > 3:
        return  # not worth the seconds
    for part in parts:
        positions = LanePositions(part)
        for lane in part.lanes:
            assert np.isfinite(lane.points).all()
            assert np.isfinite(positions.xy([lane.id], [0.5 * lane.length])).all()
        bundle = build_bundle(part)
        for table in (bundle.road_map, bundle.graph, *bundle.pools):
            for name, array in table.arrays().items():
                assert np.isfinite(array).all(), name


# --- networks drawn from nothing -----------------------------------------------------------------------

coordinate = st.one_of(
    st.floats(-300.0, 300.0, allow_nan=False),
    st.sampled_from([0.0, 0.01, 100.0, 100.0001, 200.0, -3.2]),
    st.floats(-2e4, 2e4, allow_nan=False),
)
shape = st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=5)


@st.composite
def networks(draw) -> bytes:
    net = SmallNet(draw(st.sampled_from([{}, {"lefthand": "true"}, {"version": "0.13"}])))
    count = draw(st.integers(1, 4))
    lanes = []
    for k in range(count):
        own = draw(st.lists(shape, min_size=1, max_size=3))
        lanes.append(len(own))
        extra = {
            j: {
                "width": draw(st.sampled_from([None, 3.2, 0.4, 2.0, 5.4, 12.0])),
                "length": draw(st.sampled_from([0.1, 1.0, 50.0, 333.0])),
                "disallow": draw(st.sampled_from([None, None, None, "all", "truck", "passenger"])),
                "changeLeft": draw(st.sampled_from([None, "all", "bus", ""])),
            }
            for j in range(len(own))
        }
        kind = draw(st.sampled_from([None, "highway.motorway", "highway.motorway_link", "highway.service"]))
        net.edge(f"e{k}", own, extra, speed=draw(st.sampled_from([0.0, 13.89, 30.0])), type=kind)
    for _ in range(draw(st.integers(0, 10))):
        a, b = draw(st.integers(0, count - 1)), draw(st.integers(0, count - 1))
        pair = draw(st.integers(0, lanes[a] - 1)), draw(st.integers(0, lanes[b] - 1))
        via = draw(st.sampled_from([None, None, f"e{draw(st.integers(0, count - 1))}_0"]))
        net.connect(f"e{a}", f"e{b}", pair, via=via)
    return net.text.encode()


@quick
@given(networks(), st.sampled_from([0.0, 200.0, 500.0]))
def test_networks_drawn_from_nothing(tmp_path_factory, data, stretch):
    check(tmp_path_factory.mktemp("drawn"), data, stretch)


@pytest.mark.slow
@thorough
@given(networks(), st.sampled_from([0.0, 200.0, 500.0]))
def test_many_networks_drawn_from_nothing(tmp_path_factory, data, stretch):
    check(tmp_path_factory.mktemp("drawn"), data, stretch)


# --- damaged networks ----------------------------------------------------------------------------------


def small() -> bytes:
    net = SmallNet().edge("a", lanes_from(0, 300, 0, 3.6)).edge("b", lanes_from(310, 700, 1.8, 5.4, 9.0))
    net.edge(":n_0", [[(300, 0), (310, 1.8)], [(300, 3.6), (310, 5.4)]], function="internal")
    net.connect("a", "b", (0, 0), via=":n_0_0").connect("a", "b", (1, 1), via=":n_0_1").connect(
        "a", "b", (1, 2)
    )
    return net.connect(":n_0", "b", (0, 0), (1, 1)).text.encode()


VALUES = [
    "",
    "nan",
    "inf",
    "-1",
    "1e308",
    "1e9",
    "0",
    "x",
    "0.0001",
    "all",
    "é☃",
    "0,0",
    "0,0 0,0",
    "1,2 nan,3",
]
ATTRIBUTE = re.compile(rb' [\w.]+="[^"]*"')
VALUE = re.compile(rb'(?<==")[^"]*(?=")')
ELEMENT = re.compile(rb"<(?:lane|connection|edge|junction|location)\b[^>]*?/?>")


def mutated(draw, data: bytes) -> bytes:
    for _ in range(draw(st.integers(1, 4))):
        action = draw(
            st.sampled_from(
                ["drop", "set", "swap", "truncate", "repeat", "remove", "shuffle", "flip", "move"]
            )
        )
        if action == "truncate":
            data = data[: draw(st.integers(0, len(data)))]
        elif action == "flip" and data:
            at = draw(st.integers(0, len(data) - 1))
            data = data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
        else:
            pattern = {"drop": ATTRIBUTE, "set": VALUE, "swap": VALUE, "move": VALUE}.get(action, ELEMENT)
            found = list(pattern.finditer(data))
            if not found:
                continue
            one = found[draw(st.integers(0, len(found) - 1))]
            two = found[draw(st.integers(0, len(found) - 1))]
            new = {
                "drop": b"",
                "set": draw(st.sampled_from(VALUES)).encode(),
                "move": re.sub(rb"\d", draw(st.sampled_from([b"1", b"7", b"99"])), one[0], count=2),
                "repeat": one[0] + two[0],
                "remove": b"",
            }.get(action, two[0])
            data = data[: one.start()] + new + data[one.end() :]
    return data


@settings(quick, max_examples=150)
@given(st.data(), st.sampled_from([0.0, 200.0]))
def test_a_damaged_small_network(tmp_path_factory, data, stretch):
    check(tmp_path_factory.mktemp("damaged"), mutated(data.draw, small()), stretch)


@pytest.mark.slow
@pytest.mark.parametrize("base", [None, *SHIPPED], ids=lambda path: path.name if path else "small")
@settings(thorough, max_examples=200)
@given(data=st.data(), stretch=st.sampled_from([0.0, 200.0, 500.0]))
def test_damaged_networks(tmp_path_factory, base, data, stretch):
    original = small() if base is None else base.read_bytes()
    check(tmp_path_factory.mktemp("damaged"), mutated(data.draw, original), stretch)
