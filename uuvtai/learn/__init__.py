"""Learning: PPO distilled from the behaviour tree, with a latent world model. Torch only; its world is the
vectorised environment."""
