"""Obstacles that move, where they will be, and the map."""
