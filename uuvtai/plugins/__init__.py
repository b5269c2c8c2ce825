"""Pieces that the user brings: a planner, a controller or a policy in a file of her own, beside the shipped
ones."""

from uuvtai.plugins.api import About, Forecast, View, piece

__all__ = ["About", "Forecast", "View", "piece"]
