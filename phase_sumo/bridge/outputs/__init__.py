"""What a run leaves: trajectories, SUMO's own files put right, trailers in its window."""
