"""Training from converted maps needs few packages, and neither SUMO nor pictures."""

from __future__ import annotations

import subprocess
import sys
import tomllib

from phase_sumo.sim.bundle import save_bundle
from tests.helpers.curves import read_curve
from tests.helpers.places import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NEEDED = {"torch", "numpy", "safetensors", "filelock", "platformdirs"}
# modules that have other names than their packages, or come with them
ALSO = {"sumo", "traci", "mpl_toolkits", "PIL"}
BARE_MACHINE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ImportError(name + " is not on this machine")

sys.meta_path.insert(0, Missing())
from phase_sumo.cli import main
sys.exit(main({arguments}))
"""


def test_smoke_training_needs_few_packages(straight_map, tmp_path):
    extras = PROJECT["optional-dependencies"]["tensorboard"]
    packages = {line.split(">")[0].split("[")[0] for line in PROJECT["dependencies"] + extras}
    assert packages > NEEDED
    save_bundle(tmp_path / "maps" / "straight.npz", straight_map)
    run = tmp_path / "run"
    arguments = ["train", "--networks", str(tmp_path / "maps"), "--held-out", str(tmp_path / "maps")]
    arguments += ["--run", str(run), "--preset", "smoke", "--steps", "6000"]
    code = BARE_MACHINE.format(missing=sorted(packages - NEEDED | ALSO), arguments=arguments)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(read_curve(run)) > 1 and not (run / "tensorboard").exists()
    assert done.stderr.count("pip install 'phase-sumo[tensorboard]'") == 1
    assert "steps/s" in done.stderr and "policy.safetensors" in done.stdout
