"""The policy network and its checkpoints."""
