"""The report and its pictures from trajectories made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from phase_sumo.bridge import pictures
from phase_sumo.bridge.compare import PHASE_TABLE, TABLE
from phase_sumo.bridge.plots import colours
from phase_sumo.bridge.report import write_report
from phase_sumo.evaluate.trajectories import Trajectories
from phase_sumo.sim.lanes import Lane, LaneNetwork


@pytest.fixture(scope="module")
def network():
    lanes = tuple(
        Lane(
            f"e_{i}",
            "e",
            np.array([[0.0, 3.6 * i], [400.0, 3.6 * i]]),
            3.6,
            30.0,
            400.0,
            left=1 - i * 2,
            right=i - 1,
        )
        for i in range(2)
    )
    return LaneNetwork("toy", lanes, ())


def drive(controlled: bool, speed: float = 20.0) -> Trajectories:
    """A car and a semitrailer, 15 s."""
    time = np.repeat(np.arange(0, 15, 0.2), 2)
    vehicle = np.tile([0, 1], 75)
    x = 40.0 * (1 - vehicle) + speed * time
    size = len(time)
    return Trajectories(
        time=time,
        vehicle=vehicle,
        x=x,
        y=3.6 * vehicle,
        yaw=np.zeros(size),
        hitch=np.where(vehicle == 1, 0.05, 0.0),
        speed=np.full(size, speed),
        accel=np.zeros(size),
        lane=vehicle,
        position=x + 4.0,
        lateral=np.zeros(size),
        controlled=np.full(size, controlled),
        vehicle_ids=("car", "semi"),
        vehicle_types=("car", "semi"),
        shape=np.array([[5, 1.8, 3, 1, 0, 0, 0, 0], [7, 2.6, 5.2, 0.7, 15, 2.6, 12, 0.9]]),
        length=np.array([5.0, 20.4]),
        lane_ids=("e_0", "e_1"),
        lane_edges=("e", "e"),
        lane_length=np.array([400.0, 400.0]),
        lane_speed=np.array([30.0, 30.0]),
        lane_next=((), ()),
        period=0.2,
    )


def comparison(models, seeds=(1,)):
    numbers = {name: {"mean": 1.5, "std": 0.25} for name in {**TABLE, **PHASE_TABLE}}
    return {
        "scenario": "a <b> & c.sumocfg", "network": "n.net.xml", "roads": "freeway",
        "models": models, "seeds": list(seeds), "share": 1.0, "types": [], "alpha": None, "policy": "shipped",
        "policy_info": {"agent steps": "1,000"},
        "background": "idm",
        "sumo_options": [], "section": {"edge": "e", "position": 200.0}, "runs": [],
        "summary": dict.fromkeys(models, numbers),
    }  # fmt: skip


def test_page_names_models_and_escapes_names(tmp_path, network):
    path = tmp_path / "report.html"
    write_report(path, comparison(["phase", "idm"]), {"phase": [drive(True)], "idm": [drive(False)]}, network)
    page = path.read_text()
    assert "PHASE against IDM" in page
    assert "a &lt;b&gt; &amp; c.sumocfg" in page
    assert "± " not in page
    assert "Share under PHASE" in page
    assert not list(tmp_path.glob("*.part"))


def test_page_without_phase_and_with_spread(tmp_path, network):
    path = tmp_path / "report.html"
    runs = {"krauss": [drive(False)] * 2, "idm": [drive(False, 10.0)] * 2}
    write_report(path, comparison(["krauss", "idm"], (1, 2)), runs, network)
    page = path.read_text()
    assert "1.50 ± 0.25" in page
    assert "Share under PHASE" not in page


def test_view_lies_on_the_road_and_along_it(network):
    view = pictures.best_view(network, drive(True))
    assert view.x == pytest.approx(200.0)
    assert view.yaw == pytest.approx(0.0)
    assert 0.0 <= pictures.best_time([drive(True)], view) <= 15.0


def test_vehicle_boxes_have_their_size_and_place():
    box = pictures._boxes(
        np.array([10.0]), np.array([0.0]), np.array([np.pi / 2]), *(np.array([v]) for v in (-1, 4, 2))
    )[0]
    np.testing.assert_allclose(sorted(box[:, 1]), [-1, -1, 4, 4], atol=1e-12)
    np.testing.assert_allclose(sorted(box[:, 0]), [9, 9, 11, 11], atol=1e-12)


def test_phase_and_the_first_sumo_model_keep_their_colours():
    assert colours(["krauss", "phase"]) == {"phase": pictures.PHASE, "krauss": pictures.SUMO}
