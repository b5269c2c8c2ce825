"""Motion of a vehicle whose roll and pitch are given: Fossen's equation in surge, sway, heave and yaw
(T. Fossen, Handbook of Marine Craft, 2011), many vehicles over many stretches of a log at once."""

import taichi as ti

from uuvtai.kernels.core.stage import AnyTensor

FASTEST = 20.0
"""[m/s, rad/s] a trial's motion ends here"""
NET, GAIN, LATER, MUNK, ROLLING = 12, 13, 14, 17, 18
"""columns of net buoyancy, gain and lag (less that of the loads), of lateral less axial added mass, and of
the yaw moment of roll rate times pitch rate, behind masses, linear and quadratic damping of four axes"""


@ti.kernel
def move_stretches(
    told: AnyTensor,
    start: AnyTensor,
    loads: AnyTensor,
    turns: AnyTensor,
    dt_s: ti.f64,  # type: ignore[valid-type]
    parts: ti.i32,  # type: ignore[valid-type]
    out: AnyTensor,
):
    """Velocities ``out`` (runs, s, n + 1, 4) [m/s, rad/s] from ``start`` (runs, s, 4) on, in n steps of
    ``parts`` parts of ``dt_s``; all arrays float64. ``told`` (runs, 19) is what each run believes, with whole
    masses in place of added ones. Each step has ``loads`` (s, n, 2, 2, 4) [N, N m], themselves and by second
    of lag, the mean and that weighted by the time left; and ``turns`` (s, n, 5), roll and pitch rate and the
    upward direction.

    Kutta's method of third order. Its first two stages count for how early a load comes, so they get the
    mean that is weighted by the time left, and the third one what the mean then lacks."""
    for run, s in ti.ndrange(out.shape[0], out.shape[1]):
        x = ti.Vector([start[run, s, i] for i in ti.static(range(4))])
        _put(x, run, s, 0, out)
        for k in range(turns.shape[1]):
            turn = ti.Vector([turns[s, k, i] for i in ti.static(range(5))])
            mean, early = _load(run, s, k, 0, turn, told, loads), _load(run, s, k, 1, turn, told, loads)
            rise = 6 * (mean - early)
            for part in range(parts):
                middle = mean + ((2 * part + 1 - parts) * rise) / (2 * parts)
                soon = middle - rise / (6 * parts)
                first = _acceleration(run, x, soon, turn, told)
                second = _acceleration(run, x + dt_s * first / 2, soon, turn, told)
                third = _acceleration(run, x + dt_s * (2 * second - first), 6 * middle - 5 * soon, turn, told)
                x = ti.math.clamp(x + dt_s * (first + 4 * second + third) / 6, -FASTEST, FASTEST)
            _put(x, run, s, k + 1, out)


@ti.func
def _put(x, run, s, k, out: AnyTensor):
    for i in ti.static(range(4)):
        out[run, s, k, i] = x[i]


@ti.func
def _load(run, s, k, which, turn, told: AnyTensor, loads: AnyTensor):
    """(4,) [N, N m] that do not depend on the velocities: the mean of a step (0), or weighted (1)."""
    net = told[run, NET]
    load = ti.Vector([net * turn[2], net * turn[3], net * turn[4], -told[run, ROLLING] * turn[0] * turn[1]])
    for i in ti.static(range(4)):
        load[i] += told[run, GAIN] * (loads[s, k, 0, which, i] + told[run, LATER] * loads[s, k, 1, which, i])
    return load


@ti.func
def _acceleration(run, x, load, turn, told: AnyTensor):
    """(4,) at velocities ``x`` under ``load``; roll and pitch rate come first in ``turn``."""
    p, q, r = turn[0], turn[1], x[3]
    mu, mv, mw = told[run, 0] * x[0], told[run, 1] * x[1], told[run, 2] * x[2]
    left = load - ti.Vector(
        [q * mw - r * mv, r * mu - p * mw, p * mv - q * mu, told[run, MUNK] * x[0] * x[1]]
    )
    for i in ti.static(range(4)):
        left[i] = (left[i] - (told[run, 4 + i] + told[run, 8 + i] * ti.abs(x[i])) * x[i]) / told[run, i]
    return left
