"""Sampled trajectories of many vehicles: what every traffic measure is computed from.

Any simulator or log can fill them; nothing here knows SUMO.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phase_sumo.atomic_files import whole
from phase_sumo.errors import PhaseError


@dataclass(frozen=True)
class Trajectories:
    """Samples (rows), sorted by time, with tables of vehicles and lanes.

    Attributes:
        time: [S] s.
        vehicle: [S] row of the vehicle tables.
        x, y: [S] rear-axle midpoint in m.
        yaw: [S] rad.
        hitch: [S] tractor yaw minus trailer yaw in rad.
        speed, accel: [S] m/s and m/s^2 (accel = speed change over the simulator's own step).
        lane: [S] row of the lane tables, -1 off any lane.
        position: [S] front bumper along the lane in m.
        lateral: [S] offset of the front bumper from the lane centre in m, positive to the left.
        controlled: [S] bool, driven by the policy.
        target_speed: [S] m/s that the vehicle would drive there on an empty road.
        alpha: [S] action range of the conditioning context, NaN where the policy does not drive.
        vehicle_ids, vehicle_types: [V].
        emission_classes: [V] SUMO's name, e.g. "HBEFA4/PC_petrol_Euro-4".
        shape: [V, 8] length, width, wheelbase, rear overhang, trailer length, width, base, setback in m.
        length: [V] bumper to bumper, trailer included, in m.
        lane_ids, lane_edges: [L]; an edge id that starts with ":" lies inside a junction.
        lane_length, lane_speed: [L] m, m/s.
        lane_next: for each lane the rows of the lanes that follow it.
        period: sampling period in s.
    """

    time: NDArray[np.float64]
    vehicle: NDArray[np.int64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    yaw: NDArray[np.float64]
    hitch: NDArray[np.float64]
    speed: NDArray[np.float64]
    accel: NDArray[np.float64]
    lane: NDArray[np.int64]
    position: NDArray[np.float64]
    lateral: NDArray[np.float64]
    controlled: NDArray[np.bool_]
    target_speed: NDArray[np.float64]
    alpha: NDArray[np.float64]
    vehicle_ids: tuple[str, ...]
    vehicle_types: tuple[str, ...]
    emission_classes: tuple[str, ...]
    shape: NDArray[np.float64]
    length: NDArray[np.float64]
    lane_ids: tuple[str, ...]
    lane_edges: tuple[str, ...]
    lane_length: NDArray[np.float64]
    lane_speed: NDArray[np.float64]
    lane_next: tuple[tuple[int, ...], ...]
    period: float

    def select(self, mask: NDArray[np.bool_]) -> Trajectories:
        """The samples where ``mask`` [S] holds, with the same tables."""
        samples = {name: getattr(self, name)[mask] for name in SAMPLES}
        rest = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in SAMPLES}
        return Trajectories(**samples, **rest)

    def by_vehicle(self) -> NDArray[np.int64]:
        """Row order sorted by vehicle, then time."""
        return np.lexsort((self.time, self.vehicle))

    def save(self, path: str | Path) -> None:
        """Write an ``.npz``."""
        arrays = {}
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name in COMPACT:
                value = value.astype(COMPACT[f.name])
            arrays[f.name] = np.array(json.dumps(value)) if isinstance(value, tuple) else np.asarray(value)
        with whole(Path(path)) as file:
            np.savez_compressed(file, **arrays)

    @staticmethod
    def load(path: str | Path) -> Trajectories:
        """Inverse of `save`."""
        try:
            with np.load(path, allow_pickle=False) as data:
                arrays = {f.name: data[f.name] for f in fields(Trajectories)}
        except (OSError, ValueError, KeyError) as error:
            raise PhaseError(f"{path}: not a trajectory file ({error})") from None
        values: dict = {}
        for name, value in arrays.items():
            if value.dtype.kind == "U":
                values[name] = tuple(json.loads(str(value)))
            elif value.dtype.kind == "f":
                values[name] = value.astype(np.float64)
            else:
                values[name] = value.astype(np.int64) if value.dtype.kind == "i" else value
        values["lane_next"] = tuple(tuple(row) for row in values["lane_next"])
        values["period"] = float(values["period"])
        return Trajectories(**values)


SAMPLES = [
    "time",
    "vehicle",
    "x",
    "y",
    "yaw",
    "hitch",
    "speed",
    "accel",
    "lane",
    "position",
    "lateral",
    "controlled",
    "target_speed",
    "alpha",
]
COMPACT = {
    "vehicle": np.int32,
    "lane": np.int32,
    **dict.fromkeys(
        ("yaw", "hitch", "speed", "accel", "position", "lateral", "target_speed", "alpha"), np.float32
    ),
}
