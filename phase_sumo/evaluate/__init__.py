"""Measures on simulated and recorded traffic."""
