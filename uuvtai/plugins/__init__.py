"""Plugins that the user brings: a planner, a controller or a policy in a file of her own, beside the built-in
ones."""

from uuvtai.plugins.api import About, Forecast, View, plugin

__all__ = ["About", "Forecast", "View", "plugin"]
