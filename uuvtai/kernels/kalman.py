"""Kalman filter of a planar body: mean (x, y, vx, vy), covariance as its upper triangle row by row, measurements one number at a time.

The covariance is symmetric by storage. A measurement of one number needs no inverse; its update P - (Ph)(Ph)' / s equals Joseph's form for
the optimal gain. Variances are kept above a floor: float32 rounds P to 1e-7 of itself, far below the least measurement variance (1e-4).
"""

import taichi as ti

_AT = ((0, 1, 2, 3), (1, 4, 5, 6), (2, 5, 7, 8), (3, 6, 8, 9))
"""Place of element [i][j] in the stored triangle."""

_FLOOR = 1.0e-7
"""Smallest variance [m^2, m^2/s^2]."""


@ti.func
def predicted(mean, cov, dt, density):
    """Mean and covariance after dt [s] at constant velocity; the acceleration is white noise of spectral density [m^2/s^3]."""
    moved = ti.Vector([mean[0] + dt * mean[2], mean[1] + dt * mean[3], mean[2], mean[3]])
    q0, q1, q2 = density * dt * dt * dt / 3.0, density * dt * dt / 2.0, density * dt
    grown = ti.Vector(
        [
            cov[0] + dt * (2.0 * cov[2] + dt * cov[7]) + q0,
            cov[1] + dt * (cov[3] + cov[5] + dt * cov[8]),
            cov[2] + dt * cov[7] + q1,
            cov[3] + dt * cov[8],
            cov[4] + dt * (2.0 * cov[6] + dt * cov[9]) + q0,
            cov[5] + dt * cov[8],
            cov[6] + dt * cov[9] + q1,
            cov[7] + q2,
            cov[8],
            cov[9] + q2,
        ]
    )
    return moved, grown


@ti.func
def corrected(mean, cov, h, residual, variance):
    """Mean and covariance after measuring h' x with the given variance; residual = measured - h' mean."""
    ph = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for i in ti.static(range(4)):
        for j in ti.static(range(4)):
            ph[i] += cov[ti.static(_AT[i][j])] * h[j]
    scale = 1.0 / (ph.dot(h) + variance)
    moved = mean + ph * (residual * scale)
    shrunk = cov + 0.0
    for i in ti.static(range(4)):
        for j in ti.static(range(i, 4)):
            shrunk[ti.static(_AT[i][j])] -= ph[i] * ph[j] * scale
        shrunk[ti.static(_AT[i][i])] = ti.max(shrunk[ti.static(_AT[i][i])], _FLOOR)
    return moved, shrunk


@ti.func
def position_variance(cov, along):
    """Variance [m^2] of the position along a unit vector."""
    return along[0] * along[0] * cov[0] + 2.0 * along[0] * along[1] * cov[1] + along[1] * along[1] * cov[4]


@ti.func
def velocity_variance(cov, along):
    """Variance [m^2/s^2] of the velocity along a unit vector."""
    return along[0] * along[0] * cov[7] + 2.0 * along[0] * along[1] * cov[8] + along[1] * along[1] * cov[9]


@ti.func
def largest_position_variance(cov, dt):
    """Variance [m^2] of the position dt [s] ahead along the axis where it is largest, without new acceleration."""
    xx = cov[0] + dt * (2.0 * cov[2] + dt * cov[7])
    yy = cov[4] + dt * (2.0 * cov[6] + dt * cov[9])
    xy = cov[1] + dt * (cov[3] + cov[5] + dt * cov[8])
    half = 0.5 * (xx - yy)
    return 0.5 * (xx + yy) + ti.sqrt(half * half + xy * xy)


@ti.func
def born(pos, along, radial_var, cross_var, speed, speed_var, cross_speed_var):
    """Mean and covariance of a body first seen at ``pos``, moving with ``speed`` along the unit vector ``along``."""
    xx, yy, xy = along[0] * along[0], along[1] * along[1], along[0] * along[1]
    mean = ti.Vector([pos[0], pos[1], speed * along[0], speed * along[1]])
    cov = ti.Vector(
        [
            radial_var * xx + cross_var * yy,
            (radial_var - cross_var) * xy,
            0.0,
            0.0,
            radial_var * yy + cross_var * xx,
            0.0,
            0.0,
            speed_var * xx + cross_speed_var * yy,
            (speed_var - cross_speed_var) * xy,
            speed_var * yy + cross_speed_var * xx,
        ]
    )
    return mean, cov
