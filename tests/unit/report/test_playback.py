"""What is packed for the player comes out of its decoder, and it can be drawn."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from phase_sumo.report import playback
from phase_sumo.report.road_pictures import View
from tests.helpers.two_lanes import drive, two_lanes

NODE = shutil.which("node")
PLAYER = str(files("phase_sumo.report") / "templates" / "playback.js")
SCRIPT = """
const player = require(process.argv[2]);
const film = JSON.parse(require("fs").readFileSync(0, "utf8"));
const calls = [];
const context = new Proxy({}, {
  get: (_, name) => (...args) => calls.push([String(name), ...args]),
  set: (_, name, value) => { calls.push(["set " + String(name), value]); return true; },
});
globalThis.Path2D = class { moveTo() {} lineTo() {} closePath() {} };
(async () => {
  const name = Object.keys(film.runs)[0];
  const run = player.decodeRun(film.runs[name], film.steps, await player.inflate(film.runs[name].data));
  run.period = film.period;
  const at = (time) => player.vehiclesAt(run, (time - film.begin) / film.period);
  const scene = at(film.query);
  const view = { x: 0, y: 0, yaw: film.yaw, scale: 4 };
  const corner = player.toScreen(view, 800, 200, 10, 5);
  const state = { time: film.query, followed: scene[0].id, collisions: run.collisions };
  const size = { width: 800, height: 200, ratio: 2 }, paths = player.roadPaths(film.road);
  const colours = { trailer: (colour) => colour + " light", phase: "orange", sumo: "blue" };
  player.drawScene(context, size, view, paths, scene, state, colours);
  console.log(JSON.stringify({
    scene, late: at(film.end + 10).length, calls,
    back: player.toWorld(view, 800, 200, ...corner),
    hit: player.vehicleNear(scene, scene[1].x - 8, scene[1].y, 1),
    missed: player.vehicleNear(scene, 0, 60, 1),
    text: player.describe(scene[1]),
  }));
})();
"""


@pytest.fixture(scope="module")
def network():
    return two_lanes()


def pack(first, network, moment=7.0, collisions=()):
    return playback.pack(first, network, View(100.0, 2.0, 0.3), moment, collisions)


@pytest.fixture(scope="module")
def played(network):
    if not NODE:
        pytest.skip("no node")
    t = drive(True)
    t = replace(t, yaw=np.where(t.vehicle == 1, 0.02 * t.time, 3.1 + 0.02 * t.time))  # past pi
    collision = {"model": "phase", "time": 6.0, "x": 110.0, "y": 2.0}
    film = pack({"phase": t}, network, collisions=[collision, {**collision, "model": "idm"}])
    text = json.dumps({**film, "query": 7.1})  # between the frames at 6.8 and 7.2 s
    done = subprocess.run(
        [NODE, "-e", SCRIPT, "-", PLAYER], input=text, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def test_poses_come_back_within_their_step(played):
    car, semi = played["scene"]
    assert (car["id"], semi["id"]) == ("car", "semi")
    assert car["x"] == pytest.approx(40.0 + 20.0 * 7.1 - 100.0, abs=0.02)
    assert semi["x"] == pytest.approx(20.0 * 7.1 - 100.0, abs=0.02)
    assert semi["y"] == pytest.approx(3.6 - 2.0, abs=0.02)
    assert car["yaw"] == pytest.approx(3.1 + 0.02 * 7.1, abs=0.002)  # not wrapped
    assert semi["hitch"] == pytest.approx(0.05, abs=0.001)
    assert semi["speed"] == pytest.approx(20.0, abs=0.02)
    assert semi["alpha"] == pytest.approx(0.7, abs=0.01)
    assert semi["phase"] is True
    assert played["late"] == 0


def test_vehicles_are_drawn_where_they_are(played):
    calls = played["calls"]
    car, semi = played["scene"]
    places = [c[1:] for c in calls if c[0] == "translate"]
    assert places == [[car["x"], car["y"]], [semi["x"], semi["y"]], [semi["x"], semi["y"]]]
    turns = [c[1] for c in calls if c[0] == "rotate"]
    assert turns == [car["yaw"], semi["yaw"], semi["yaw"] - semi["hitch"]]
    bodies = [c[1:] for c in calls if c[0] == "fillRect" and len(c) == 5 and c[4] in (1.8, 2.6)]
    np.testing.assert_allclose(bodies, [[-1, -0.9, 5, 1.8], [-0.7, -1.3, 7, 2.6], [-14.1, -1.3, 15, 2.6]])
    assert ["set fillStyle", "orange light"] in calls  # the trailer
    assert sum(c[0] == "strokeRect" for c in calls) == 1  # the followed vehicle
    assert sum(c[0] == "arc" for c in calls) == 1  # this run's collision, not the other's


def test_screen_and_world_are_inverse_and_clicks_hit_trailers(played):
    assert played["back"] == pytest.approx([10.0, 5.0])
    assert played["hit"]["id"] == "semi"
    assert played["missed"] is None
    assert "driven by PHASE" in played["text"]
    assert "hitch 2.9°" in played["text"]


def test_a_long_run_is_cut_to_the_budget_around_its_moment(network, monkeypatch):
    monkeypatch.setattr(playback, "MOST_SAMPLES", 20)
    monkeypatch.setattr(playback, "LEAD", 2.0)
    film = pack({"phase": drive(True), "idm": drive(False)}, network)
    assert film["begin"] == pytest.approx(5.0)
    assert film["begin"] < film["moment"] <= film["end"]
    assert sum(run["samples"] for run in film["runs"].values()) <= 20 + 4


def test_an_empty_run_and_an_absence(network):
    t = drive(True)
    gone = t.select((t.vehicle == 1) | (t.time < 3) | (t.time > 6))
    film = pack({"phase": gone, "idm": t.select(t.time < 0)}, network)
    assert [track[0] for track in film["runs"]["phase"]["tracks"]] == ["car", "car", "semi"]
    assert film["runs"]["idm"]["tracks"] == []
    assert film["runs"]["idm"]["samples"] == 0
