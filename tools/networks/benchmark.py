"""Makes the worlds of the public benchmark anew: phase_sumo/evaluate/benchmark.npz and benchmark.json.

python -m tools.networks.benchmark

Results with other worlds compare with no earlier ones: only a new version of the benchmark has new worlds.
"""

from __future__ import annotations

import json

import numpy as np

from phase_sumo.bridge.maps.convert import build_bundle
from phase_sumo.bridge.maps.sumo_network import read_network
from phase_sumo.evaluate import benchmark
from tools.places import HELD_OUT

VERSION, SEED = 2, 2026


def main() -> None:
    maps = [build_bundle(read_network(path)) for path in sorted(HELD_OUT.glob("*.net.xml"))]
    start, regime = benchmark.sample_worlds(maps, SEED)
    benchmark.save_worlds(start, regime)
    with np.load(benchmark.WORLDS, allow_pickle=False) as data:
        digest = benchmark.sha256(maps, dict(data))
    facts = {
        "version": VERSION,
        "seed": SEED,
        "agent_scale": benchmark.SCENARIOS.agent_scale,
        "worlds": len(regime),
        "agents": int(start.active.sum()),
        "maps": [bundle.name for bundle in maps],
        "sha256": digest,
    }
    benchmark.DIGEST.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    print(f"{facts['worlds']} worlds, {facts['agents']} agents, SHA-256 {digest}")


if __name__ == "__main__":
    main()
