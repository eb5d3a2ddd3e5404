"""Self-play training: rollouts, DClamp-PPO, the loop with its checkpoints and curves."""
