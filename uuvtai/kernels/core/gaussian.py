"""A Gaussian of a few numbers: its mean as a vector, its covariance as the upper triangle row by row.

The covariance is symmetric by storage. Measurements are taken in one number at a time, which needs no
inverse: P - (P h)(P h)' / (h'P h + r) equals Joseph's form for the optimal gain.
"""

import taichi as ti

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
