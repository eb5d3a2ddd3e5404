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
        source: "commonroad", "exid", "highd", "ngsim" or "tracks".
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


@dataclass(frozen=True)
class Window:
    """A scenario cut from a recording: the vehicles that are there when it begins.

    Attributes:
        recording: where it is from.
        begin: first sample.
        steps: samples after it; its last sample is begin + steps.
        agents: [N] rows of the recording, all present at ``begin``.
        last: [N] the last sample, at most begin + steps, up to which each is present without a break; its
            place then is the agent's goal.
        lane_changes: how many lane changes its agents make within it.
    """

    recording: Recording
    begin: int
    steps: int
    agents: NDArray[np.int64]
    last: NDArray[np.int64]
    lane_changes: int

    def with_motion(
        self,
        present: NDArray[np.bool_],
        x: FloatArray,
        y: FloatArray,
        yaw: FloatArray,
        speed: FloatArray,
    ) -> Recording:
        """Its agents alone, with this motion [N, samples] instead of the recorded one."""
        r, rows = self.recording, self.agents
        return replace(
            r,
            present=present,
            x=x,
            y=y,
            yaw=yaw,
            speed=speed,
            length=r.length[rows],
            width=r.width[rows],
            kind=tuple(r.kind[k] for k in rows.tolist()),
            flags=tuple(r.flags[k] for k in rows.tolist()),
        )
