"""Who is asked, and how often, before PHASE takes a vehicle over."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from phase_sumo.bridge.fleet.adoption import Adoption
from phase_sumo.bridge.fleet.choice import Choice


def test_a_vehicle_that_waits_for_its_road_is_chosen_once():
    nothing = SimpleNamespace(getParameter=lambda *_: "")
    names = [f"v{i}" for i in range(4)]
    facts = SimpleNamespace(kind="car", type="car", shape=SimpleNamespace(truck=False))
    scene = SimpleNamespace(
        api=SimpleNamespace(vehicle=nothing, vehicletype=nothing),
        table=SimpleNamespace(row_of={name: row for row, name in enumerate(names)}),
        lane_of=dict.fromkeys(names, "main_0"),
        facts=dict.fromkeys(names, facts),
    )
    choice = Choice(share=0.5, deterministic=True)
    adoption = Adoption(scene, None, choice, None, None)  # type: ignore[arg-type]
    nowhere = np.full(4, -1)
    for _ in range(5):
        assert not list(adoption.take_over(nowhere, ()))
        assert adoption.left_to_sumo == {"v1", "v3"}
