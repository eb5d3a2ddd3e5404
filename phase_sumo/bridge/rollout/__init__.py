"""Recorded initial states rolled out in SUMO."""
