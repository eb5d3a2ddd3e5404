"""The vehicles that PHASE drives in a running simulation, and what it knows of the others."""
