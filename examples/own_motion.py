"""Obstacles that move as you say: a shuttle on a figure of eight, and a boat that goes to and fro:
``uuv eval --agent bt --motion examples/own_motion.py:paths --record 1 --report``."""

import numpy as np


def paths():
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    eight = np.column_stack([10 + 6 * np.sin(angle), 3 + 1.5 * np.sin(2 * angle)])
    return [
        {"kind": "sphere", "radius_m": 0.25, "path": eight, "speed_m_s": 0.8},
        {"kind": "cylinder", "radius_m": 0.3, "path": [(4, 1), (4, 5)], "speed_m_s": 0.4},
    ]
