"""Pieces that the user brings: a planner, a controller or a policy in a file of her own, beside the shipped
ones."""

from uuvtai.own.protocol import About, Bodies, View, piece

__all__ = ["About", "Bodies", "View", "piece"]
