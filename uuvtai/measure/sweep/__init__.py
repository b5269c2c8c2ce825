"""Sweeps over any config keys: the grid, its cells, who plays them, and the run that can be killed at any
moment."""
