"""The stack as a folder that drives without Taichi and torch: for a companion computer."""
