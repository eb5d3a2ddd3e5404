"""All vehicles on the observed road as padded arrays, W = 1, that torch sees without a copy."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch

from phase_sumo.bridge.sumo.conventions import ShapeRow, front_from_reference
from phase_sumo.sim.vehicles import HISTORY, Task, VehicleShape, VehicleState

SHAPE = tuple(f.name for f in fields(VehicleShape))
STATE = tuple(f.name for f in fields(VehicleState))
TASK = tuple(f.name for f in fields(Task))
FAR = 1e5  # m: where empty rows are parked


class VehicleTable:
    """One row per vehicle; the arrays double when they are full, so that their shapes rarely change.

    Attributes:
        ids: vehicle id of each row, "" for an empty one.
        row_of: id -> row.
        active, controlled: [N] bool; controlled rows are moved by the policy, the others by SUMO.
        guarded: [N] bool, the guard looks after a controlled row.
        driver: [N] number of the policy that moves a controlled row, see `Drivers`.
        wanted_speed: [N] m/s that the driver of a controlled row would choose on a free road.
        origin: [2] m, what to add to its positions to get SUMO's.
        arrays: name -> [N] (histories [N, 3]) values of `VehicleShape`, `VehicleState` and `Task`.
    """

    def __init__(self, capacity: int = 32, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        self.origin = np.array(origin)
        self.ids: list[str] = []
        self.row_of: dict[str, int] = {}
        self.active = np.zeros(0, bool)
        self.controlled = np.zeros(0, bool)
        self.guarded = np.zeros(0, bool)
        self.driver = np.zeros(0, np.int64)
        self.wanted_speed = np.zeros(0)
        self.arrays: dict[str, np.ndarray] = {}
        for name in (*SHAPE, *STATE, *TASK):
            kind = bool if name == "truck" else np.float32
            self.arrays[name] = np.zeros((0, HISTORY) if name.endswith("history") else 0, kind)
        self._free: list[int] = []
        self._grow(capacity)

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def _grow(self, capacity: int) -> None:
        old = len(self.ids)
        for name, array in self.arrays.items():
            grown = np.zeros((capacity, *array.shape[1:]), array.dtype)
            grown[:old] = array
            if name in ("x", "y"):
                grown[old:] = FAR
            if name in ("wheelbase", "length", "width"):
                grown[old:] = 1.0
            self.arrays[name] = grown
        extra = np.zeros(capacity - old, bool)
        self.active, self.controlled = np.r_[self.active, extra], np.r_[self.controlled, extra]
        self.guarded = np.r_[self.guarded, extra]
        self.driver = np.r_[self.driver, np.zeros(capacity - old, np.int64)]
        self.wanted_speed = np.r_[self.wanted_speed, np.zeros(capacity - old)]
        self.ids += [""] * (capacity - old)
        self._free += range(capacity - 1, old - 1, -1)

    def add(self, vehicle: str, shape: ShapeRow) -> int:
        """Give a vehicle a row; the caller sets its state next."""
        if not self._free:
            self._grow(2 * len(self.ids))
        row = self._free.pop()
        self.ids[row], self.row_of[vehicle] = vehicle, row
        for name in (*STATE, *TASK):
            self.arrays[name][row] = 0.0
        for name in SHAPE:
            self.arrays[name][row] = getattr(shape, name)
        self.active[row], self.controlled[row], self.guarded[row] = True, False, False
        return row

    def remove(self, vehicle: str) -> None:
        """Free the vehicle's row."""
        row = self.row_of.pop(vehicle)
        self.ids[row] = ""
        self.active[row] = self.controlled[row] = False
        self.arrays["x"][row] = self.arrays["y"][row] = FAR
        self._free.append(row)

    def follow(self, rows: np.ndarray, x, y, yaw, speed, accel, seconds: float) -> None:
        """Overwrite rows that SUMO drives with their pose after ``seconds``; their trailers are drawn along.

        The hitch angle obeys the equation of `kinematics.advance`, driven by the yaw that SUMO gives.
        """
        a = self.arrays
        turned = np.asarray(yaw, np.float64) - a["yaw"][rows]
        turned = np.remainder(turned + np.pi, 2 * np.pi) - np.pi
        base = np.where(a["trailer_base"][rows] > 0, a["trailer_base"][rows], 1.0)
        middle = a["hitch"][rows] + 0.5 * turned
        relaxed = 2.0 * np.arctan(np.tan(0.5 * middle) * np.exp(-np.asarray(speed) * seconds / base))
        hitch = np.clip(relaxed + 0.5 * turned, -0.5 * np.pi, 0.5 * np.pi)
        a["hitch"][rows] = np.where(a["trailer_length"][rows] > 0, hitch, 0.0)
        a["x"][rows], a["y"][rows], a["yaw"][rows] = x, y, yaw
        a["speed"][rows], a["accel"][rows] = speed, accel

    def extrapolate(self, rows: np.ndarray, dt: float) -> None:
        """Move rows on at constant speed and heading: SUMO's vehicles between two steps of SUMO."""
        a = self.arrays
        a["x"][rows] += a["speed"][rows] * np.cos(a["yaw"][rows]) * dt
        a["y"][rows] += a["speed"][rows] * np.sin(a["yaw"][rows]) * dt

    def shape(self) -> VehicleShape:
        """[1, N] tensors on the memory of the arrays."""
        return VehicleShape(**self._views(SHAPE))

    def state(self) -> VehicleState:
        """[1, N] tensors on the memory of the arrays."""
        return VehicleState(**self._views(STATE))

    def task(self) -> Task:
        """[1, N] tensors on the memory of the arrays."""
        return Task(**self._views(TASK))

    def _views(self, names: tuple[str, ...]) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(self.arrays[name]).unsqueeze(0) for name in names}

    def take(self, state: VehicleState, rows: np.ndarray) -> None:
        """Write the states [len(rows)] of the given rows into the table."""
        for name in STATE:
            self.arrays[name][rows] = getattr(state, name).numpy()

    @property
    def front(self) -> tuple[np.ndarray, np.ndarray]:
        """[N] front-bumper centres in m, float64."""
        a = self.arrays
        x, y, yaw = (a[name].astype(np.float64) for name in ("x", "y", "yaw"))
        return front_from_reference(x, y, yaw, a["length"] - a["rear_overhang"])
