"""NumPy float64 oracle of the forecast: one track at a time, closed forms instead of steps."""

import numpy as np

MAX_GROWTH_M = 0.5


def turned(v, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def arc(pos, vel, rate, t):
    """Position after t [s] at constant speed and turn rate."""
    if abs(rate * t) < 1e-9:
        return pos + vel * t
    w = np.array([-vel[1], vel[0]])
    return pos + (np.sin(rate * t) * vel + (1 - np.cos(rate * t)) * w) / rate


def growth(cov, t, tracking):
    """What the filter's uncertainty adds to the radius t [s] ahead; cov is 4 x 4."""
    F = np.hstack([np.eye(2), t * np.eye(2)])
    return min(tracking.growth_sigmas * np.sqrt(np.linalg.eigvalsh(F @ cov @ F.T)[-1]), MAX_GROWTH_M)
