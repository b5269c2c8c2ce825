"""Extended Kalman filter of a planar body that keeps its speed and turns at a constant rate; measurements one
number at a time.

Mean (x, y, vx, vy) with covariance as its upper triangle row by row; beside it the turn rate with its
``link``: covariance with each of the four, and its own variance. A link of zeros is a plain filter of
constant velocity: what an obstacle at rest gets.

The covariance is symmetric by storage. A measurement of one number needs no inverse; its update P - (Ph)(Ph)'
/ s equals Joseph's form for the optimal gain. Variances are kept above a floor: float32 rounds P to 1e-7 of
itself, far below the least measurement variance (1e-4).
"""

import taichi as ti

from uuvtai.kernels.core.geometry import turned_z

AT = ((0, 1, 2, 3), (1, 4, 5, 6), (2, 5, 7, 8), (3, 6, 8, 9))
"""Place of element [i][j] in the stored triangle."""

_FLOOR = 1.0e-7  # Smallest variance [m^2, m^2/s^2].


@ti.func
def predicted(mean, cov, rate, link, dt, density, rate_density):
    """(mean, covariance, link) after dt [s] on an arc of constant speed and turn rate; the rate itself stays.

    The velocity's noise is white acceleration of spectral density [m^2/s^3], that of the turn rate
    [rad^2/s^3].
    """
    # With a = rate dt and R(a) a turn by a, the state u = (p, v) becomes (p + dt R(a/2) v, R(a) v): the
    # chord points half-way through the turn (its length is taken for the arc's: off by a^2 / 24). The
    # derivatives are F = [[1, dt R(a/2)], [0, R(a)]] by u (``_carried``) and g by the rate (``turn``), so of
    # the whole covariance [[P, l], [l', s]] remain P <- F P F' + F l g' + g (F l)' + s g g' + Q, l <- F l + s
    # g and s <- s + q dt. Q: white acceleration over dt (Bar-Shalom, Li, Kirubarajan 2001, section 6.2).
    vel = ti.Vector([mean[2], mean[3]])
    chord, late = dt * turned_z(vel, 0.5 * dt * rate), turned_z(vel, dt * rate)
    moved = ti.Vector([mean[0] + chord[0], mean[1] + chord[1], late[0], late[1]])
    # what one unit of turn rate adds: half a step's turn to the chord, a whole step's to the velocity
    turn = dt * ti.Vector([-0.5 * chord[1], 0.5 * chord[0], -late[1], late[0]])
    c0, c1 = turned_z(ti.Vector([1.0, 0.0]), 0.5 * dt * rate), turned_z(ti.Vector([1.0, 0.0]), dt * rate)
    linked = _carried(ti.Vector([link[0], link[1], link[2], link[3]]), dt, c0, c1)
    half = ti.Matrix.zero(ti.f32, 4, 4)
    for j in ti.static(range(4)):
        column = _carried(ti.Vector([cov[ti.static(AT[i][j])] for i in range(4)]), dt, c0, c1)
        for i in ti.static(range(4)):
            half[i, j] = column[i]
    grown = cov + 0.0
    for i in ti.static(range(4)):
        row = _carried(ti.Vector([half[i, j] for j in range(4)]), dt, c0, c1)
        for j in ti.static(range(i, 4)):
            grown[ti.static(AT[i][j])] = (
                row[j] + linked[i] * turn[j] + turn[i] * linked[j] + link[4] * turn[i] * turn[j]
            )
    q0, q1, q2 = density * dt * dt * dt / 3.0, density * dt * dt / 2.0, density * dt
    noise = ti.Vector([q0, 0.0, q1, 0.0, q0, 0.0, q1, q2, 0.0, q2])
    reach = linked + link[4] * turn
    var = link[4] + ti.select(link[4] > 0.0, rate_density * dt, 0.0)
    return moved, grown + noise, ti.Vector([reach[0], reach[1], reach[2], reach[3], var])


@ti.func
def _carried(u, dt, c0, c1):
    """A small change of (x, y, vx, vy) one step later; c0, c1: cosine and sine of half and of the whole
    step's turn."""
    return ti.Vector(
        [
            u[0] + dt * (c0[0] * u[2] - c0[1] * u[3]),
            u[1] + dt * (c0[1] * u[2] + c0[0] * u[3]),
            c1[0] * u[2] - c1[1] * u[3],
            c1[1] * u[2] + c1[0] * u[3],
        ]
    )


@ti.func
def corrected(mean, cov, rate, link, h, residual, variance):
    """(mean, covariance, rate, link) after measuring h' (x, y, vx, vy) with the given variance; residual =
    measured - h' mean."""
    # The Kalman gain of one number measured by (h, 0), the rate being unmeasured: K = (P h, l'h) / (h'P h +
    # r). P <- P - (P h)(P h)' / (h'P h + r), and so for the link (P h)(l'h) and for the rate's variance
    # (l'h)^2.
    ph = ti.Vector([0.0, 0.0, 0.0, 0.0])
    pl = 0.0
    for i in ti.static(range(4)):
        pl += link[i] * h[i]
        for j in ti.static(range(4)):
            ph[i] += cov[ti.static(AT[i][j])] * h[j]
    scale = 1.0 / (ph.dot(h) + variance)
    moved = mean + ph * (residual * scale)
    shrunk = cov + 0.0
    for i in ti.static(range(4)):
        for j in ti.static(range(i, 4)):
            shrunk[ti.static(AT[i][j])] -= ph[i] * ph[j] * scale
        shrunk[ti.static(AT[i][i])] = ti.max(shrunk[ti.static(AT[i][i])], _FLOOR)
    bound = link - ti.Vector([ph[0], ph[1], ph[2], ph[3], pl]) * (pl * scale)
    bound[4] = ti.select(link[4] > 0.0, ti.max(bound[4], _FLOOR), 0.0)
    return moved, shrunk, rate + pl * residual * scale, bound


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
    """Variance [m^2] of the position dt [s] ahead along the axis where it is largest, without new
    acceleration."""
    xx = cov[0] + dt * (2.0 * cov[2] + dt * cov[7])
    yy = cov[4] + dt * (2.0 * cov[6] + dt * cov[9])
    xy = cov[1] + dt * (cov[3] + cov[5] + dt * cov[8])
    half = 0.5 * (xx - yy)
    return 0.5 * (xx + yy) + ti.sqrt(half * half + xy * xy)


@ti.func
def born(pos, along, radial_var, cross_var, speed, speed_var, cross_speed_var):
    """Mean and covariance of an obstacle first seen at ``pos``, moving with ``speed`` along the unit vector
    ``along``."""
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


# ------------------------------------------------------------------------------------------------------------
# A Gaussian of a few numbers: its mean as a vector, its covariance as the upper triangle row by row.
#
# The covariance is symmetric by storage. Measurements are taken in one number at a time, which needs no
# inverse: P - (P h)(P h)' / (h'P h + r) equals Joseph's form for the optimal gain.


_LEAST_LEFT = 1.0e-6
"""Share of a variance that one measurement leaves at least: float32 rounds at a tenth of that."""


def place(i, j, n):
    """Place of element [i][j] of an n x n matrix in the stored triangle; plain Python."""
    low, high = min(i, j), max(i, j)
    return low * n - low * (low - 1) // 2 + high - low


@ti.func
def measured(mean, cov, h, residual, variance):
    """(mean, covariance) after measuring h'x with the given variance; residual = measured - h' mean."""
    n = ti.static(mean.n)
    ph = ti.zero(mean)
    for i in ti.static(range(n)):
        for j in ti.static(range(n)):
            ph[i] += cov[ti.static(place(i, j, n))] * h[j]
    scale = 1.0 / (ph.dot(h) + variance)
    shrunk = cov + 0.0
    for i in ti.static(range(n)):
        least = _LEAST_LEFT * cov[ti.static(place(i, i, n))]
        for j in ti.static(range(i, n)):
            shrunk[ti.static(place(i, j, n))] -= ph[i] * ph[j] * scale
        shrunk[ti.static(place(i, i, n))] = ti.max(shrunk[ti.static(place(i, i, n))], least)
    return mean + ph * (residual * scale), shrunk


@ti.func
def halved(info, vector):
    """(L, y): the k x k information matrix as L L' (its triangle in ``info``), and y = L^-1 ``vector``.

    An information vector L y then says what k measurements of unit variance say: row j of L' was measured to
    differ by y[j] from the mean. Directions of which next to nothing is known (float32 cannot tell it from
    nothing) get rows of zeros.
    """
    # Cholesky's method column by column; a pivot that cancels down to rounding is no information
    k = ti.static(vector.n)
    root = ti.Matrix.zero(ti.f32, k, k)
    y = ti.zero(vector)
    for j in ti.static(range(k)):
        own = info[ti.static(place(j, j, k))]
        pivot, left = own, vector[j]
        for i in ti.static(range(j)):
            pivot -= root[j, i] * root[j, i]
            left -= root[j, i] * y[i]
        known = pivot > 1.0e-5 * own and pivot > 0.0
        inverse = ti.select(known, 1.0 / ti.sqrt(ti.max(pivot, 1.0e-30)), 0.0)
        y[j] = left * inverse
        for i in ti.static(range(j, k)):
            cross = info[ti.static(place(j, i, k))]
            for m in ti.static(range(j)):
                cross -= root[i, m] * root[j, m]
            root[i, j] = cross * inverse
    return root, y
