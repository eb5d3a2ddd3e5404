"""What every log reader yields: tracks of all vehicles on one road, and windows cut from them.

Recorded boxes become vehicles of the simulator: type, shape, and poses of the reference point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from phase_sumo.arrays import FloatArray, IntArray
from phase_sumo.sim.dimensions import (
    ARTICULATED_FROM,
    KINDS,
    REAR_OVERHANG,
    TRAILER_BASE,
    TRAILER_SETBACK,
    WHEELBASE,
    Kind,
    split,
)
from phase_sumo.sim.lanes import DECIMALS, LaneNetwork, away
from phase_sumo.sim.vehicles import VehicleShape

PERIOD = 0.1  # s: every recording is resampled to the step of the simulator


@dataclass(frozen=True)
class Recording:
    """Tracks of V vehicles over T samples of `PERIOD`, in the coordinates of their road.

    Attributes:
        name: unique among the recordings of a source; what results are bootstrapped by.
        source: place, or scene, by which results are told apart, as far as the log names one: "USA_US101" of
            a CommonRoad scenario, "exid/location 2", "highd/location 1", "ngsim/us-101", "FILE/SCENE" of
            plain tracks.
        network: the road.
        present: [V, T] bool, the vehicle was seen then.
        x, y: [V, T] centre of the vehicle's box, trailer included, in m; NaN where absent, like the next two.
        yaw: [V, T] rad, counter-clockwise from east.
        speed: [V, T] m/s, >= 0.
        length, width: [V] of that box in m.
        kind: [V] vehicle type; articulated where class and length say so.
        flags: [V] what is wrong with each track, by the names of `quality.FLAGS`; empty where nothing is.
    """

    name: str
    source: str
    network: LaneNetwork
    present: NDArray[np.bool_]
    x: FloatArray
    y: FloatArray
    yaw: FloatArray
    speed: FloatArray
    length: FloatArray
    width: FloatArray
    kind: tuple[Kind, ...]
    flags: tuple[frozenset[str], ...]

    def near_origin(self) -> Recording:
        """The same, moved to the origin if its road lies far from it: float32 is too coarse there."""
        x, y = away(np.concatenate([lane.points for lane in self.network.lanes]))
        if (x, y) == (0.0, 0.0):
            return self
        network = self.network.moved(-x, -y)
        return replace(
            self, network=network, x=np.round(self.x - x, DECIMALS), y=np.round(self.y - y, DECIMALS)
        )

    def cut(self, rows: NDArray[np.int64], begin: int, end: int) -> Recording:
        """The vehicles ``rows`` alone, over the samples begin..end - 1; copies, none of this one is kept."""
        return replace(
            self,
            **{name: getattr(self, name)[rows, begin:end] for name in ("present", "x", "y", "yaw", "speed")},
            length=self.length[rows],
            width=self.width[rows],
            kind=tuple(self.kind[k] for k in rows.tolist()),
            flags=tuple(self.flags[k] for k in rows.tolist()),
        )


@dataclass(frozen=True)
class Window:
    """A scenario cut from a recording: the vehicles that are there when it begins, its agents.

    It holds all that is needed of the recording, which can be let go.

    Attributes:
        recording: the agents [N] alone, over the window and what was recorded shortly before it.
        agents: [N] their rows in the whole recording.
        begin: first sample of the window in ``recording``; all agents are present then.
        steps: samples after it; its last sample is begin + steps.
        last: [N] the last sample of ``recording``, at most begin + steps, up to which each is present without
            a break; its place then is the agent's goal.
        lane_changes: how many lane changes its agents make within it.
        lane_speed: [N] m/s, the 85th percentile of all speeds recorded in the lane that each begins in: what
            its drivers like to drive.
    """

    recording: Recording
    agents: NDArray[np.int64]
    begin: int
    steps: int
    last: NDArray[np.int64]
    lane_changes: int
    lane_speed: FloatArray


TRUCK = 7.0  # m: longer vehicles are trucks
CARS = frozenset({"car", "van", "motorcycle", "sedan", "midsize", "pickup", "suv", "taxi"})
TRUCKS = frozenset({"truck", "semi", "trailer", "lorry"})
BUSES = frozenset({"bus"})


def kind_of(length: float, vehicle_class: str | None = None) -> Kind:
    """The one rule for all readers.

    By length: below `TRUCK` a car, below `ARTICULATED_FROM` a rigid truck, else articulated. The log's own
    class, where it has one, overrules that in three cases: what it calls a truck is no car, what it calls a
    car, van or motorcycle is no rigid truck (it may tow), and a bus is a rigid truck of any length.
    """
    named = (vehicle_class or "").strip().lower()
    if named in BUSES:
        return "rigid_truck"
    if length >= ARTICULATED_FROM:
        return "articulated_truck"
    if named in TRUCKS:
        return "rigid_truck"
    return "rigid_truck" if length >= TRUCK and named not in CARS else "car"


HISTORY = 10.0  # s of path that turn a trailer, several times its length


def shape(recording: Recording, rows: IntArray) -> VehicleShape:
    """Geometry of the vehicles ``rows`` [N], as one world of N; see `dimensions.split` for trailers."""
    sizes = {
        name: torch.from_numpy(value.astype(np.float32))[None]
        for name, value in _sizes(recording, rows).items()
    }
    kind = np.array(recording.kind, object)[rows]
    return VehicleShape(**sizes, truck=torch.from_numpy(kind != "car")[None])


def poses(
    recording: Recording, rows: IntArray, samples: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Reference points of the vehicles ``rows`` [N] at ``samples`` [S].

    The box's front bumper and direction are those of the car, rigid truck or tractor. The trailer is drawn
    along the recorded path: over the `HISTORY` that there is, its axle follows the hitch at a constant
    distance (a tractrix, which solves the hitch equation); at the path's begin it is in line.

    Returns:
        x, y in m, yaw and hitch angle in rad, each [N, S]; NaN where absent.
    """
    sizes = _sizes(recording, rows)
    ahead = 0.5 * recording.length[rows] - (sizes["length"] - sizes["rear_overhang"])
    yaw = recording.yaw[rows]
    x = recording.x[rows] + ahead[:, None] * np.cos(yaw)
    y = recording.y[rows] + ahead[:, None] * np.sin(yaw)
    hitch = np.where(recording.present[rows][:, samples], 0.0, np.nan)
    long = np.flatnonzero(sizes["trailer_base"] > 0)
    if len(long) and len(samples):
        begin = max(0, int(samples.min()) - round(HISTORY / PERIOD))
        span = slice(begin, int(samples.max()) + 1)
        found = _hitch(x[long, span], y[long, span], yaw[long, span], sizes["trailer_base"][long])
        hitch[long] = found[:, samples - begin]
    return x[:, samples], y[:, samples], yaw[:, samples], hitch


def _sizes(recording: Recording, rows: IntArray) -> dict[str, FloatArray]:
    """Numbers of `VehicleShape` in its order, each [N]."""
    kind = np.array([KINDS.index(recording.kind[row]) for row in rows], np.int64)
    length, width = recording.length[rows], recording.width[rows]
    towing = kind == KINDS.index("articulated_truck")
    tractor, trailer = split(length)
    length, trailer = np.where(towing, tractor, length), np.where(towing, trailer, 0.0)
    return {
        "length": length,
        "width": width,
        "wheelbase": _by_kind(WHEELBASE)[kind] * length,
        "rear_overhang": _by_kind(REAR_OVERHANG)[kind] * length,
        "trailer_length": trailer,
        "trailer_width": np.where(towing, width, 0.0),
        "trailer_base": TRAILER_BASE * trailer,
        "trailer_setback": np.where(towing, TRAILER_SETBACK, 0.0),
    }


def _by_kind(values: dict[Kind, float]) -> FloatArray:
    return np.array([values[kind] for kind in KINDS])


def _hitch(x: FloatArray, y: FloatArray, yaw: FloatArray, base: FloatArray) -> FloatArray:
    """[M, S] hitch angles along paths of the hitch [M, S], for trailers ``base`` [M] m long.

    The axle moves along the mean of the trailer's directions before and after a step, s = (s_x, s_y) long:
    with u the direction before, half of the turn is the angle from u to 2 base u + s.
    """
    result, trailer = np.full(x.shape, np.nan), np.full(len(x), np.nan)
    behind_x, behind_y = np.full(len(x), np.nan), np.full(len(x), np.nan)  # 2 base behind the hitch
    for t in range(x.shape[1]):
        half = _wrap(np.arctan2(y[:, t] - behind_y, x[:, t] - behind_x) - trailer)
        # an absent vehicle leaves NaN, so that it begins anew where it is seen again
        trailer = np.where(np.isnan(behind_x), yaw[:, t], trailer + 2.0 * half)
        result[:, t] = _wrap(yaw[:, t] - trailer)
        behind_x, behind_y = x[:, t] - 2.0 * base * np.cos(trailer), y[:, t] - 2.0 * base * np.sin(trailer)
    return result


def _wrap(angle: FloatArray) -> FloatArray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
