"""How models are spelled."""

from __future__ import annotations

import pytest

from phase_sumo.errors import PhaseError
from phase_sumo.studies.driver_models import Model, label, parse_models


def test_mixed_shares_drive_among_the_first_sumo_model():
    models = parse_models(["phase:0.3", "Krauss", "phase", "idm", "krauss"], share=0.8)
    assert models == [
        Model("phase:0.3", 0.3, "krauss"),
        Model("krauss", 0.0, "krauss"),
        Model("phase", 0.8, "krauss"),
        Model("idm", 0.0, "idm"),
    ]
    assert [label(m.name) for m in models] == ["PHASE 30 %", "Krauss", "PHASE", "IDM"]
    assert models[0].folder == "phase_0.3"


def test_without_a_sumo_model_the_scenarios_own_drives():
    assert parse_models(["phase"]) == [Model("phase", None, None)]


@pytest.mark.parametrize(
    "name", ["phase:0", "phase:1.2", "phase:-1", "phase:", "phase:some", "nosuch", "idm:0.3"]
)
def test_what_cannot_be_is_named(name):
    with pytest.raises(PhaseError, match=name):
        parse_models([name])
    with pytest.raises(PhaseError, match="no models"):
        parse_models([])
