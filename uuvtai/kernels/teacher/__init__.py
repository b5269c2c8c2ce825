"""The behaviour tree and the trajectories it weighs."""
