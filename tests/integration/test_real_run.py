"""The shipped policy on real roads: US freeway stretches beside the repository, and SUMO's own A10."""

from __future__ import annotations

from pathlib import Path

import pytest
import sumo

from phase_sumo.bridge.run import run_scenario
from tests.helpers.places import NOT_SHARED, SHARED

US = SHARED / "nets" / "us"
A10 = Path(sumo.SUMO_HOME) / "tools" / "game" / "A10KW.sumocfg"


def check(result: dict, least: int) -> None:
    assert result["accounts_balance"], result["accounts"]
    assert result["vehicles"] == result["accounts"]["inserted"]
    assert result["phase_vehicles"] >= least
    assert result["share_of_time_under_policy"] > 0.5
    assert result["phase_vehicle_km"] > 0.0
    # whatever else it does, the policy moves its vehicles along the road
    metres_per_second = 1000.0 * result["phase_vehicle_km"] / result["sim_seconds"]
    assert metres_per_second > 5.0, result


@pytest.mark.parametrize("name", ["us_harrisburg_04", "us_i24flow_02"])
def test_a_real_us_stretch(name: str, tmp_path: Path):
    scenario = US / f"{name}.sumocfg"
    if not scenario.is_file():
        pytest.skip(f"{NOT_SHARED}/nets/us")
    result = run_scenario(scenario, seed=1, end=60.0, output_dir=tmp_path)
    check(result, least=10)
    assert (tmp_path / "events.csv").is_file() and (tmp_path / "trips.csv").is_file()


def test_the_interchange_that_sumo_ships(tmp_path: Path):
    """Half-second steps, town roads with traffic lights around a motorway."""
    if not A10.is_file():
        pytest.skip("SUMO was installed without its game scenarios")
    result = run_scenario(A10, seed=1, end=40.0, output_dir=tmp_path, record=False)
    check(result, least=20)
    assert result["vehicles"] > result["phase_vehicles"]  # the town is left to SUMO
