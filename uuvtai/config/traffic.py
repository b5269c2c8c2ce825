"""What is known of the moving bodies before the first scan."""

from __future__ import annotations

from uuvtai.config.section import OrderedInterval, PositiveInterval, Section


class TrafficConfig(Section):
    """A prior, as an operator can give it who knows the water: where moving bodies swim and how they turn.

    It says nothing of any single episode. Worlds whose bodies are others state their own (``worlds/*.yaml``),
    with the share that fills the whole water (``elevation.column_share``); what is seen counts beside it.
    """

    z_m: OrderedInterval = (-1.2, -0.4)
    """heights of their centres, equally likely"""
    height_m: PositiveInterval = (0.3, 0.5)
    """from top to bottom"""
    leg_m: PositiveInterval = (2.0, 6.0)
    """straight ways between two turns back, equally likely"""
