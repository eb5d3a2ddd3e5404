"""Contacts between vehicles from exact boxes, tractor and trailer alike: one event per contact."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch

from phase_sumo.bridge.table import VehicleTable
from phase_sumo.sim.events import at_fault
from phase_sumo.sim.geometry import boxes_overlap
from phase_sumo.sim.near import pairs_within
from phase_sumo.sim.vehicles import boxes

APART = 1.0  # s without overlap that end a contact
CROSSING = np.radians(60.0)  # headings further apart are on different levels of an interchange


@dataclass
class Contact:
    """Two vehicles that touched.

    Attributes:
        time: s, first overlap.
        seconds: how long it lasted, in s.
        a, b: vehicle ids; type_a, type_b: their vTypes.
        x, y: middle between the two boxes in m.
        speed_a, speed_b: m/s at the first overlap.
        phase_a, phase_b: driven by the policy then.
        fault_a, fault_b: the paper's rule; both when neither is clearly behind the other.
    """

    time: float
    seconds: float
    a: str
    b: str
    type_a: str
    type_b: str
    x: float
    y: float
    speed_a: float
    speed_b: float
    phase_a: bool
    phase_b: bool
    fault_a: bool
    fault_b: bool

    @property
    def phase(self) -> bool:
        """A vehicle under the policy is part of it."""
        return self.phase_a or self.phase_b

    @property
    def phase_at_fault(self) -> bool:
        """A vehicle under the policy is to blame."""
        return (self.phase_a and self.fault_a) or (self.phase_b and self.fault_b)


class ContactMonitor:
    """Finds overlaps of all vehicles in a table and joins them into contacts.

    The network is flat, so vehicles whose headings differ by more than 60 degrees are taken to be on
    different levels; head-on contact does not happen on one carriageway.
    """

    def __init__(self) -> None:
        self.contacts: list[Contact] = []
        self._open: dict[tuple[str, str], tuple[Contact, float]] = {}

    def update(self, table: VehicleTable, time: float, types: dict[str, str]) -> list[Contact]:
        """Contacts that begin now."""
        new: list[Contact] = []
        for i, j, contact in _overlaps(table, time, types):
            pair = (table.ids[i], table.ids[j])
            known = self._open.get(pair)
            if known is None:
                new.append(contact)
                known = (contact, time)
            known[0].seconds = time - known[0].time
            self._open[pair] = (known[0], time)
        self._open = {k: v for k, v in self._open.items() if time - v[1] <= APART}
        self.contacts += new
        return new


def _overlaps(table: VehicleTable, time: float, types: dict[str, str]):
    rows = np.flatnonzero(table.active)
    if len(rows) < 2:
        return []
    every = boxes(table.shape(), table.state())[:, :, 0]  # [6, 2, N]
    box = every[:, :, torch.from_numpy(rows)].flatten(1)
    real = np.flatnonzero(box[4].numpy() > 0)
    owner, box = rows[real % len(rows)], box[:, torch.from_numpy(real)]
    radius = torch.hypot(box[4], box[5]).numpy()
    centre = box[:2].T.numpy()
    first, second = pairs_within(centre, centre, 2.0 * float(radius.max()))
    near = np.hypot(*(centre[first] - centre[second]).T) <= radius[first] + radius[second]
    near &= owner[first] < owner[second]
    first, second = torch.from_numpy(first[near]), torch.from_numpy(second[near])
    a, b = box[:, first], box[:, second]
    level = a[2] * b[2] + a[3] * b[3] > np.cos(CROSSING)
    found: dict[tuple[int, int], Contact] = {}
    for k in torch.nonzero(boxes_overlap(a, b) & level).flatten().tolist():
        i, j = int(owner[first[k]]), int(owner[second[k]])
        if (i, j) not in found:
            middle = 0.5 * (a[:2, k] + b[:2, k])
            found[i, j] = _contact(table, i, j, middle, every[:, 0], time, types)
    return [(i, j, contact) for (i, j), contact in found.items()]


def _contact(
    table: VehicleTable, i: int, j: int, middle, body, time: float, types: dict[str, str]
) -> Contact:
    a, b = table.ids[i], table.ids[j]
    return Contact(
        time=round(time, 3),
        seconds=0.0,
        a=a,
        b=b,
        type_a=types.get(a, ""),
        type_b=types.get(b, ""),
        x=round(float(middle[0]), 2),
        y=round(float(middle[1]), 2),
        speed_a=round(float(table["speed"][i]), 2),
        speed_b=round(float(table["speed"][j]), 2),
        phase_a=bool(table.controlled[i]),
        phase_b=bool(table.controlled[j]),
        fault_a=bool(at_fault(body[:, i], body[:, j])),
        fault_b=bool(at_fault(body[:, j], body[:, i])),
    )


def write_contacts(path: Path, contacts: list[Contact]) -> None:
    """One CSV line per contact."""
    lines = [",".join(f.name for f in fields(Contact))]
    lines += [",".join(_cell(v) for v in asdict(contact).values()) for contact in contacts]
    path.write_text("\n".join(lines) + "\n")


def _cell(value: object) -> str:
    if isinstance(value, bool):
        return str(int(value))
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text
