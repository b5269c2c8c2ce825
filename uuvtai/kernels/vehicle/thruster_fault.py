"""Thruster watch: a vertical thruster that gives nothing is noticed by what the vehicle does instead of what
it was told; the pilot keeps farther off floor and surface, and of two the mate carries on alone. From
measured motion and own commands only.

For frames with two or more vertical thrusters that push the same way. They hold the depth together, and
against each other the roll moment of the horizontal ones, with 20 N each where these push with 60 N: with one
of two dead that is heave.

In every step the vertical thrust that the vehicle felt, from accelerometer, gyro and DVL by its nominal
parameters, is compared with what was asked for of each thruster, a_i; both are smoothed, for rotors follow
late. r is the difference of the felt thrust and the sum A of all a_i. Of several explanations each
leaves a sum of squares, forgotten after ``watch_s``:

- all is well: sum r^2
- thruster i is dead: sum (r + a_i)^2
- all are weaker by the same share c: the smallest sum (r + c A)^2, as after lost gain or with other
  parameters than believed

each about its own mean, as far as the accelerometer's data sheet allows a constant error. Of two a thruster
is given up, until the episode ends, when its death leaves less than ``RATIO`` of what the best of the
others leaves. Where any death leaves far less than whole or weak thrusters do, one is suspected: the pilot
keeps away, which of them it is nobody needs to know.
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.stage import Bundle, n_envs
from uuvtai.kernels.vehicle.dynamics import thrust_of_rpm
from uuvtai.kernels.vehicle.io import ThrusterWatchIO

_OFFSET_NOISE_N2_S = 2.5
"""How much squared residual tells as much of the offset as the accelerometer's data sheet."""

_SMOOTH_S = 0.1  # Time constant of felt and asked thrusts.

RATIO, DOUBT_N2_S = 0.3, 1.0
"""A death must leave less than this share of what any other explanation leaves of the felt thrust, which
thrusters that lost less than 65 % of their gain never do; and so much less: the accelerometer's noise is no
evidence (EC)."""

_SUSPECT, _SUSPECT_RATIO = 0.3, 0.4
"""Share of ``DOUBT_N2_S``, and what stands for ``RATIO``, where one is only suspected."""

_UPRIGHT = 0.99  # Vertical share of a thruster's direction, at least.


def vertical_group(vehicle_cfg):
    """Indices of the vertical thrusters if they push the same way and are two or more, else (); plain
    Python."""
    found = []
    for index, thruster in enumerate(vehicle_cfg.thrusters):
        x, y, z = thruster.direction
        if abs(z) > _UPRIGHT * (x * x + y * y + z * z) ** 0.5:
            found.append((index, z > 0))
    alike = len(found) > 1 and len({up for _, up in found}) == 1
    return tuple(index for index, _ in found) if alike else ()


def vertical_pair(vehicle_cfg):
    """The vertical thrusters if they are two, of which one can carry on alone; else ()."""
    group = vertical_group(vehicle_cfg)
    return group if len(group) == 2 else ()


def is_watched(vehicle_cfg, actuation_cfg):
    """Whether there is anything to do; plain Python."""
    return actuation_cfg.watch_s > 0 and len(vertical_group(vehicle_cfg)) > 1


def response_size(vehicle_cfg):
    """Numbers that the watch remembers (``ActuationState.response``); plain Python."""
    return 6 + 3 * len(vertical_group(vehicle_cfg))


@quick_launch
@ti.kernel
def watch_thrusters(io: Bundle[ThrusterWatchIO]):
    """Weigh what the last commands did, before new ones are given. Active rows only."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            watched = io.clock.step[env] > 0 and io.ego.vel_valid[env] == 1
            if watched and io.ego.given_up[env] <= 0:
                _weigh(env, io)


@ti.func
def _weigh(env, io: Bundle[ThrusterWatchIO]):
    """One step more of evidence, and the verdict."""
    group = ti.static(vertical_group(io.vehicle_cfg))
    n = ti.static(len(group))
    way = ti.static(1.0 if io.vehicle_cfg.thrusters[group[0]].direction[2] > 0 else -1.0)
    n_slot = ti.static(io.actuation.rpm_queue.shape[1])
    slot = (io.clock.step[env] + n_slot - 1) % n_slot
    felt = felt_thrust(
        io.ego.vel_b[env], io.ego.rate_b[env], io.ego.rpy[env], io.ego.specific_force_b[env], io
    )
    r = _smoothed(env, 0, felt, io)
    asked, dead = ti.Vector([0.0] * n), ti.Vector([0.0] * n)
    for i in ti.static(range(n)):
        rpm = io.actuation.rpm_queue[env, slot, group[i]]
        asked[i] = _smoothed(env, 1 + i, way * thrust_of_rpm(rpm, io.vehicle_cfg), io)
    total = asked.sum()
    r -= total
    rr, rt, tt = (
        _summed(env, n + 1, r * r, io),
        _summed(env, n + 2, r * total, io),
        _summed(env, n + 3, total * total, io),
    )
    mean_r, mean_t, time = _summed(env, n + 4, r, io), 0.0, _summed(env, n + 5, 1.0, io)
    # [N^2] variance of the felt thrust's constant error, by the accelerometer's data sheet
    mass_kg = ti.static(io.vehicle_cfg.mass_kg + io.vehicle_cfg.added_mass[2])
    offset_n2 = ti.static((mass_kg * io.sensors_cfg.imu.accel_bias_m_s2) ** 2)
    weight = offset_n2 / (offset_n2 * time + _OFFSET_NOISE_N2_S)
    for i in ti.static(range(n)):
        left, mean_a = r + asked[i], _summed(env, n + 7 + 2 * i, asked[i], io)
        dead[i] = _summed(env, n + 6 + 2 * i, left * left, io) - weight * (mean_r + mean_a) ** 2
        mean_t += mean_a
    whole = rr - weight * mean_r * mean_r
    cross = rt - weight * mean_r * mean_t
    weak = whole - cross * cross / ti.max(tt - weight * mean_t * mean_t, 1e-6)
    for i in ti.static(range(n)):
        rival, doubt = ti.min(whole, weak), DOUBT_N2_S
        if (
            dead[i] + ti.static(_SUSPECT) * doubt < ti.static(_SUSPECT_RATIO) * rival
            and io.ego.given_up[env] == 0
        ):
            io.ego.given_up[env] = -1
        if ti.static(n == 2):
            if dead[i] + doubt < RATIO * ti.min(rival, dead[1 - i]):
                io.ego.given_up[env] = 1 + group[i]


@ti.func
def _smoothed(env, index, value, io: Bundle[ThrusterWatchIO]):
    share = 1.0 - ti.exp(-io.episode_cfg.control_dt_s / ti.static(_SMOOTH_S))
    io.actuation.response[env, index] += share * (value - io.actuation.response[env, index])
    return io.actuation.response[env, index]


@ti.func
def _summed(env, index, value, io: Bundle[ThrusterWatchIO]):
    """A sum over time of which older parts are forgotten."""
    dt = io.episode_cfg.control_dt_s
    kept = ti.exp(-dt / io.actuation_cfg.watch_s)
    io.actuation.response[env, index] = kept * io.actuation.response[env, index] + dt * value
    return io.actuation.response[env, index]


@ti.func
def felt_thrust(vel, rate, rpy, specific_force, io: Bundle[ThrusterWatchIO]):
    """[N] along body z that must have acted besides drag, Coriolis, weight and buoyancy of the nominal
    vehicle."""
    mass, added, gravity = ti.static(
        io.vehicle_cfg.mass_kg, io.vehicle_cfg.added_mass, io.vehicle_cfg.gravity_m_s2
    )
    linear, quadratic = ti.static(io.vehicle_cfg.linear_damping[2], io.vehicle_cfg.quadratic_damping[2])
    up = ti.cos(rpy[0]) * ti.cos(rpy[1])
    gained = specific_force[2] - gravity * up - (rate[0] * vel[1] - rate[1] * vel[0])
    coriolis = (mass + added[1]) * rate[0] * vel[1] - (mass + added[0]) * rate[1] * vel[0]
    drag = (linear + quadratic * ti.abs(vel[2])) * vel[2]
    net = ti.static(gravity * (io.vehicle_cfg.water_density_kg_m3 * io.vehicle_cfg.volume_m3 - mass))
    return (mass + added[2]) * gained + coriolis + drag - net * up
