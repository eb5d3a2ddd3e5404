"""Longitude and latitude to network coordinates and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sumo
import sumolib

from phase_sumo.bridge.maps.coordinates import NetProjection
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.errors import PhaseError
from phase_sumo.sim.lanes import GeoReference
from tests.helpers.small_nets import SmallNet, lanes_from

A10 = Path(sumo.SUMO_HOME) / "tools" / "game" / "A10KW" / "osm.net.xml"
UTM = "+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"


def test_the_reference_is_kept_with_the_network(tmp_path):
    net = SmallNet().edge("a", lanes_from(0, 100, 0))
    assert read_network(net.write(tmp_path / "a.net.xml")).geo is None
    net.rows.insert(0, f'<location netOffset="-5.00,7.00" origBoundary="0,0,1,1" projParameter="{UTM}"/>')
    assert read_network(net.write(tmp_path / "b.net.xml")).geo == GeoReference(UTM, "-5.00,7.00")


@pytest.mark.parametrize(
    ("proj", "zone_centre"), [(UTM, -81.0), ("+proj=merc +datum=WGS84", 0.0), ("EPSG:3857", 0.0)]
)
def test_both_ways_agree(proj, zone_centre):
    projection = NetProjection(GeoReference(proj, "-1000.0,2500.5"), "net")
    rng = np.random.default_rng(0)
    lon, lat = zone_centre + rng.uniform(-2, 2, 50), rng.uniform(-60, 60, 50)
    x, y = projection.to_xy(lon, lat)
    again = projection.to_lonlat(x, y)
    np.testing.assert_allclose(again, (lon, lat), atol=1e-9)
    x2, y2 = projection.to_xy(*again)
    np.testing.assert_allclose((x2, y2), (x, y), atol=1e-3)


def test_the_offset_is_added():
    zero, moved = (NetProjection(GeoReference(UTM, text), "net") for text in ("0,0", "-100,20"))
    np.testing.assert_allclose(np.subtract(moved.to_xy(-81, 40), zero.to_xy(-81, 40)), (-100, 20), atol=1e-6)


def test_sumolib_agrees():
    if not A10.is_file():
        pytest.skip("SUMO was installed without its game scenarios")
    projection = NetProjection(read_network(A10).geo, "A10")
    net = sumolib.net.readNet(str(A10))
    for x, y in ((0.0, 0.0), (1234.5, 2345.6), (2800.0, 10.0)):
        lon, lat = net.convertXY2LonLat(x, y)
        np.testing.assert_allclose(projection.to_lonlat(x, y), (lon, lat), atol=1e-9)
        np.testing.assert_allclose(projection.to_xy(lon, lat), net.convertLonLat2XY(lon, lat), atol=1e-6)


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        (None, "no <location>"),
        (GeoReference("!", "0,0"), "projParameter='!'"),
        (GeoReference("-", "0,0"), "projParameter='-'"),
        (GeoReference("", "0,0"), "projParameter=''"),
        (GeoReference("+proj=moon", "0,0"), "+proj=moon"),
        (GeoReference(UTM, ""), "netOffset=''"),
        (GeoReference(UTM, "1,nan"), "netOffset='1,nan'"),
    ],
)
def test_what_is_missing_is_named(reference, words):
    with pytest.raises(PhaseError) as caught:
        NetProjection(reference, "town.net.xml")
    assert str(caught.value).startswith("town.net.xml: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
