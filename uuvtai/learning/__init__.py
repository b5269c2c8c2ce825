"""PPO, distillation, world model, parameter search, forecast."""
