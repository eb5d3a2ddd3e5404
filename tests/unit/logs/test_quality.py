"""Flags of tracks: every one is raised by what it is about, and a sound track has none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from phase_sumo.errors import PhaseError
from phase_sumo.logs.ngsim import savitzky_golay
from phase_sumo.logs.recording import kind_of
from phase_sumo.logs.windows import FLAGS, finished
from tests.helpers.recordings import recording_of

T = 200
X = 3.0 * np.arange(T)
PATH = Path("log.csv")


def _flags(x: ArrayLike, y: ArrayLike = 0.0, **kwargs: Any):
    """Flags of a vehicle that drives next to a sound one."""
    x = np.stack((X + 30.0, np.broadcast_to(np.asarray(x, float), T)))
    y = np.stack((np.full(T, 3.6), np.broadcast_to(np.asarray(y, float), T)))
    first, second = finished(recording_of(x, y, **kwargs), PATH).flags
    return first, second


def test_a_sound_track_has_no_flag():
    assert _flags(X) == (frozenset(), frozenset())


def test_each_flag():
    gap = np.where((np.arange(T) > 90) & (np.arange(T) < 99), np.nan, X)
    late = np.where(np.arange(T) > 90, X, np.nan)
    jump = X + 2.0 * (np.arange(T) > 100)
    brake = 20.0 + np.cumsum(np.where(np.arange(T) < 100, 3.0, 1.0))
    found = {
        "breaks": _flags(gap)[1] & _flags(late)[1],
        "jumps": _flags(jump)[1] & _flags(brake)[1],
        "off_road": _flags(X, 0.05 * np.maximum(np.arange(T) - 100, 0) * -1.0)[1],
        "against": _flags(X, yaw=np.array([[0.0], [np.pi]]))[1],
        "stands": _flags(np.full(T, 0.3))[1],
        "brief": _flags(np.where(np.arange(T) < 8, X, np.nan))[1],
        "overlaps": _flags(X + 30.0, np.full(T, 3.0))[1],
    }
    assert found.keys() == FLAGS.keys()
    assert all(name in flags for name, flags in found.items()), found
    assert "overlaps" in _flags(X + 30.0, np.full(T, 3.0))[0]
    # 1.9 m wide boxes side by side touch at 1.9 m, and not from there on
    assert "overlaps" not in _flags(X + 30.0, np.full(T, 3.6 - 1.91))[1]


def test_a_long_vehicle_is_found_from_afar():
    x = np.stack([X, X + 15.01, *(X + 40.0 * k for k in range(2, 13))])
    length = [4.8, 25.2] + [4.8] * 11
    flags = finished(recording_of(x, np.zeros_like(x), length), PATH).flags
    assert ["overlaps" in f for f in flags[:2]] == [False, False]  # 15.01 m against 2.4 + 12.6: just apart
    flags = finished(recording_of(x, np.zeros_like(x), [4.9, *length[1:]]), PATH).flags
    assert ["overlaps" in f for f in flags[:2]] == [True, True]


def test_other_units_and_other_roads_are_refused():
    sound = recording_of(np.stack((X, X + 30.0)), np.zeros((2, T)))
    with pytest.raises(PhaseError, match=r"log.csv: by_hand: the median vehicle is 15.7 m long.*0\.3048"):
        finished(replace(sound, length=sound.length / 0.3048), PATH)
    with pytest.raises(PhaseError, match=r"speeds are 3.60 times those of the positions"):
        finished(replace(sound, speed=3.6 * sound.speed), PATH)
    with pytest.raises(PhaseError, match="100% of the positions are beside the lanes of straight"):
        finished(replace(sound, y=sound.y - 50.0), PATH)


@pytest.mark.parametrize(
    ("length", "word", "kind"),
    [
        (4.8, None, "car"),
        (6.99, "", "car"),
        (7.0, None, "rigid_truck"),
        (12.5, None, "articulated_truck"),
        (6.2, "Truck", "rigid_truck"),
        (16.5, "truck", "articulated_truck"),
        (9.0, "pickup", "car"),
        (15.0, "car", "articulated_truck"),
        (18.0, "bus", "rigid_truck"),
    ],
)
def test_vehicle_types(length, word, kind):
    assert kind_of(length, word) == kind


@pytest.mark.parametrize("size", [21, 22, 60])
@pytest.mark.parametrize("derivative", [0, 1])
def test_the_smoothing_is_scipys(size, derivative):
    signal = pytest.importorskip("scipy.signal", reason="scipy is not installed")
    values = np.random.default_rng(size).normal(size=(2, size))
    expected = signal.savgol_filter(values, 21, 3, deriv=derivative, mode="interp")
    np.testing.assert_allclose(savitzky_golay(values, derivative), expected, atol=1e-10)


def test_short_tracks_are_smoothed_as_one_piece():
    time = np.arange(9.0)
    np.testing.assert_allclose(savitzky_golay(time**3 - 2.0 * time), time**3 - 2.0 * time, atol=1e-9)
    np.testing.assert_allclose(savitzky_golay(np.array([[3.0], [5.0]])), [[3.0], [5.0]])
