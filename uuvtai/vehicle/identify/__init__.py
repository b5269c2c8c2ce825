"""A vehicle's parameters from its logs."""
