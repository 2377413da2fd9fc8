"""Training by rewards: environments, checkpoints, curves. The algorithms are stable-baselines3's."""
