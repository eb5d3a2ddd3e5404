"""SUMO itself: its process, options, demand files and conventions."""
