"""The report and its pictures from trajectories made by hand."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from phase_sumo.evaluate.measures import MEASURES, curves
from phase_sumo.evaluate.surrogate_safety import following
from phase_sumo.evaluate.traffic import edie_cells, find_corridor, speed_profile
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.report import plots, road_pictures
from phase_sumo.report.comparison_page import write_report
from phase_sumo.report.plots import colours
from phase_sumo.studies.driver_models import is_phase
from phase_sumo.studies.run_analysis import PHASE_MEASURES, Analysis
from tests.helpers.two_lanes import drive, two_lanes


@pytest.fixture(scope="module")
def network():
    return two_lanes()


def analysis(t: Trajectories) -> Analysis:
    f = following(t)
    return Analysis({}, curves(t, f), edie_cells(t, 100.0, 5.0), speed_profile(t, find_corridor(t)), [], {})


def comparison(models, seeds=(1,), collisions=()):
    interval = {"mean": 1.5, "low": 1.25, "high": 1.75, "n": 2}
    if len(seeds) == 1:
        interval |= {"low": math.nan, "high": math.nan}
    difference = {**interval, "mean": -0.5, "low": -0.75, "high": -0.25}
    numbers = {n: {**interval, "interval": "t", "difference": None} for n in {**MEASURES, **PHASE_MEASURES}}
    changed = {n: {**v, "difference": difference} for n, v in numbers.items()}
    reference = next(m for m in models if not is_phase(m))
    return {
        "scenario": "a <b> & c.sumocfg", "network": "n.net.xml", "roads": "freeway",
        "models": models, "seeds": list(seeds), "share": 1.0, "types": [], "alpha": None, "guard": True,
        "policy": "shipped",
        "policy_info": {"agent steps": "1,000"},
        "background": "idm", "reference": reference, "collisions": list(collisions),
        "sumo_options": [], "section": {"edge": "e", "position": 200.0}, "runs": [],
        "summary": {m: numbers if m == reference else changed for m in models},
    }  # fmt: skip


def page_of(tmp_path, network, runs, seeds=(1,), collisions=()):
    """The page of a comparison of trajectories by model and seed."""
    first = {m: ts[0] for m, ts in runs.items()}
    analyses = {m: [analysis(t) for t in ts] for m, ts in runs.items()}
    path = tmp_path / "report.html"
    corridor = find_corridor(next(iter(first.values())))
    write_report(path, comparison(list(runs), seeds, collisions), analyses, first, network, corridor)
    assert not list(tmp_path.glob("*.part"))
    return path.read_text()


def test_page_names_models_and_escapes_names(tmp_path, network):
    page = page_of(tmp_path, network, {"phase": [drive(True)], "idm": [drive(False)]})
    assert "PHASE against IDM" in page
    assert "a &lt;b&gt; &amp; c.sumocfg" in page
    assert "Share under PHASE" in page
    assert "no interval over seeds" in page
    assert "1.5<small>" not in page
    assert "No boxes touched in any run" in page


def test_page_says_where_the_guard_stepped_in_often(tmp_path, network, monkeypatch):
    runs = {"phase": [drive(True)], "idm": [drive(False)]}
    page = page_of(tmp_path, network, runs)
    assert "the guard changed 150.0 % of the decisions" in page and "because of a leader" in page
    monkeypatch.setattr("phase_sumo.bridge.fleet.guarded.OFTEN", 2.0)
    assert "the guard changed 150.0 %" not in page_of(tmp_path, network, runs)


def test_page_without_phase_and_with_intervals(tmp_path, network):
    runs = {"krauss": [drive(False)] * 2, "idm": [drive(False, 10.0)] * 2}
    page = page_of(tmp_path, network, runs, (1, 2))
    assert "1.50<small>[1.25, 1.75]</small>" in page
    assert '<td class="change beyond">−0.50<small>[−0.75, −0.25]</small>' in page
    assert "Δ to Krauss" in page
    assert "Share under PHASE" not in page


def test_page_is_self_contained_and_follows_the_colour_scheme(tmp_path, network):
    page = page_of(tmp_path, network, {"phase": [drive(True)], "idm": [drive(False)]})
    assert "http" not in page
    assert not re.search(r"""(src|href)=["'](?!data:|#)""", page)
    assert page.count("<svg") == 8
    assert plots.INK not in page.replace("--ink: " + plots.INK, "")
    assert "</script" not in page.split('id="film">')[1].split("</script>")[0]


def test_collisions_name_place_pair_and_fault(tmp_path, network):
    collision = {
        "model": "phase", "seed": 1, "time": 3.2, "seconds": 0.4, "lane": "e_1", "position": 71.3, "x": 70.0,
        "y": 3.0, "vehicle": "<car>", "other": "semi", "type": "car", "other_type": "semi", "speed": 20.0,
        "other_speed": 18.0, "phase": True, "other_phase": False, "fault": True, "other_fault": False,
    }  # fmt: skip
    page = page_of(tmp_path, network, {"phase": [drive(True)], "idm": [drive(False)]}, (1,), [collision])
    assert "e_1, 71 m" in page
    assert "&lt;car&gt; (car, PHASE), semi (semi, SUMO)" in page
    assert "<td>&lt;car&gt;</td>" in page  # at fault
    assert 'data-moment="3.2"' in page


def test_view_lies_on_the_road_and_along_it(network):
    view = road_pictures.best_view(network, drive(True))
    assert view.x == pytest.approx(200.0)
    assert view.yaw == pytest.approx(0.0)
    assert 0.0 <= road_pictures.best_time([drive(True)], view) <= 15.0


def test_vehicle_boxes_have_their_size_and_place():
    box = road_pictures._boxes(
        np.array([10.0]), np.array([0.0]), np.array([np.pi / 2]), *(np.array([v]) for v in (-1, 4, 2))
    )[0]
    np.testing.assert_allclose(sorted(box[:, 1]), [-1, -1, 4, 4], atol=1e-12)
    np.testing.assert_allclose(sorted(box[:, 0]), [9, 9, 11, 11], atol=1e-12)


def test_phase_and_the_first_sumo_model_keep_their_colours():
    found = colours(["phase:0.5", "krauss", "phase", "idm"])
    assert (found["phase"], found["krauss"]) == (road_pictures.PHASE, road_pictures.SUMO)
    assert len(set(found.values())) == 4
