"""What every log reader yields: tracks of all vehicles on one road, and windows cut from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phase_sumo.sim.lanes import LaneNetwork

FloatArray = NDArray[np.float64]
Kind = Literal["car", "rigid_truck", "articulated_truck"]

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
