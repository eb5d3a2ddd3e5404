"""Recorded boxes as vehicles of the simulator."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from phase_sumo.logs.recording import poses, shape
from phase_sumo.sim.vehicles import VehicleState, boxes
from tests.helpers.recordings import ROAD, recording_of

ROWS = np.arange(3)


def _boxes(recording, sample):
    x, y, yaw, hitch = (
        torch.from_numpy(v.astype(np.float32)).T for v in poses(recording, ROWS, np.array([sample]))
    )
    zero, history = torch.zeros_like(x), torch.zeros(1, len(ROWS), 3)
    return boxes(shape(recording, ROWS), VehicleState(x, y, yaw, zero, zero, zero, hitch, history, history))


@pytest.mark.parametrize("turn", [0.0, 2.1])
def test_the_boxes_together_are_the_recorded_box(turn):
    time = 0.1 * np.arange(30)
    along = np.stack([20.0 * time, 60.0 + 20.0 * time, 200.0 + 20.0 * time])
    length, width = [4.6, 9.5, 21.3], [1.8, 2.4, 2.6]
    kind = ("car", "rigid_truck", "articulated_truck")
    recording = recording_of(along * np.cos(turn), along * np.sin(turn), length, width, kind, yaw=turn)
    box = _boxes(recording, 20).numpy()[:, :, 0]  # [6, tractor or trailer, N]
    x, y = recording.x[:, 20], recording.y[:, 20]
    ahead = (box[0] - x) * np.cos(turn) + (box[1] - y) * np.sin(turn)
    aside = (box[1] - y) * np.cos(turn) - (box[0] - x) * np.sin(turn)
    front = np.where(box[4] > 0, ahead + box[4], -np.inf).max(0)
    rear = np.where(box[4] > 0, ahead - box[4], np.inf).min(0)
    np.testing.assert_allclose(front, 0.5 * np.array(length), atol=1e-4)
    np.testing.assert_allclose(rear, -0.5 * np.array(length), atol=1e-4)
    np.testing.assert_allclose(aside, 0.0, atol=1e-4)
    np.testing.assert_allclose(2.0 * box[5].max(0), width, atol=1e-5)
    # one piece: the trailer begins before the tractor ends
    assert ahead[1, 2] + box[4, 1, 2] > ahead[0, 2] - box[4, 0, 2]
    assert box[4, 1, 2] > 1.5 * box[4, 0, 2]


def test_a_trailer_on_a_circle_reaches_the_steady_hitch_angle():
    radius, speed = 120.0, 15.0
    angle = speed * 0.1 * np.arange(300) / radius
    x, y = np.tile(radius * np.cos(angle), (3, 1)), np.tile(radius * np.sin(angle), (3, 1))
    kind = ("articulated_truck",) * 3
    recording = recording_of(x, y, [18.0] * 3, [2.5] * 3, kind, yaw=angle + 0.5 * np.pi)
    hitch = poses(recording, ROWS, np.array([0, 299]))[3]
    sizes = shape(recording, ROWS)
    ahead = 9.0 - float(sizes.front_overhang[0, 0])
    steady = np.arcsin(float(sizes.trailer_base[0, 0]) / np.hypot(radius, ahead))
    # the hitch runs on a wider circle than the box's centre, at an angle to the tractor's direction
    assert hitch[0, 1] == pytest.approx(steady - np.arctan2(ahead, radius), rel=0.01)
    assert hitch[0, 0] == 0.0


def test_where_a_vehicle_is_absent_there_is_no_pose():
    x = np.tile(2.0 * np.arange(20.0), (3, 1))
    x[:, 8:12] = np.nan
    recording = recording_of(x, 0.0 * x, [18.0] * 3, [2.5] * 3, ("articulated_truck",) * 3)
    found = np.stack(poses(recording, ROWS, np.arange(20)))
    assert np.isnan(found[:, :, 8:12]).all() and np.isfinite(found[:, :, :8]).all()
    assert np.isfinite(found[:, :, 12:]).all()


def test_a_recording_far_from_the_origin_is_moved_there():
    x, y = np.array([[0.0, 3.0, np.nan]]), np.array([[3.6, 3.7, 3.8]])
    near = recording_of(x, y)
    assert near.near_origin() is near
    far = recording_of(x + 600_000.0, y + 5_400_000.0, network=ROAD.moved(600_000.0, 5_400_000.0))
    moved = far.near_origin()
    assert np.abs(moved.network.lanes[0].points).max() < 1000.0
    beside = [r.y[0, 1] - r.network.lanes[0].points[0, 1] for r in (near, moved)]
    along = [r.x[0, 1] - r.network.lanes[0].points[0, 0] for r in (near, moved)]
    assert beside[0] == pytest.approx(beside[1], abs=1e-6) and along[0] == pytest.approx(along[1], abs=1e-6)
