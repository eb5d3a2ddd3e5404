"""PHASE in a loop of one's own: half the vehicles, and lorries told to keep 22 m/s.

python scenarios/own_loop.py [--end SECONDS] [--traci] [--gui]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import libsumo
import sumolib
import traci

import phase_sumo

MERGE = Path(__file__).parent / "merge" / "merge.sumocfg"


def run(end: float, over_traci: bool = False, gui: bool = False) -> dict[str, Any]:
    sumo: Any = traci if over_traci else libsumo
    options = ["-c", str(MERGE), "--end", str(end), "--no-step-log", "true", *phase_sumo.SUMO_OPTIONS]
    sumo.start([sumolib.checkBinary("sumo-gui" if gui else "sumo"), *options])
    try:
        fleet = phase_sumo.PhaseFleet(sumo, share=0.5)
        sumo.addStepListener(fleet)
        while sumo.simulation.getTime() < end and sumo.simulation.getMinExpectedNumber() > 0:
            sumo.simulationStep()
            for vehicle in sumo.simulation.getDepartedIDList():
                if "truck" in sumo.vehicle.getTypeID(vehicle):
                    fleet.set_context(vehicle, alpha=0.5, target_speed=22.0)
        fleet.close()
        return fleet.report()
    finally:
        sumo.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--end", type=float, default=120.0, help="s")
    parser.add_argument("--traci", action="store_true")
    parser.add_argument("--gui", action="store_true")
    arguments = parser.parse_args()
    for name, value in run(arguments.end, arguments.traci, arguments.gui).items():
        print(f"{name}: {value}")
