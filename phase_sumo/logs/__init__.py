"""Recorded traffic: one interface, `recording.Recording`, and a reader for each format."""
