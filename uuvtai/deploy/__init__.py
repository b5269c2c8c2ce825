"""Policies that leave the simulator: a folder with the networks, what they read and write, and a driver that
needs NumPy alone."""
