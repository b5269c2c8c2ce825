"""Thruster watch: a vertical thruster that gives nothing is noticed by what the vehicle does instead of what
it was told, and its mate carries on alone. From measured motion and own commands only.

For frames with two vertical thrusters a and b. They hold the depth together, and against each other the roll
moment of the horizontal ones, with 20 N each where these push with 60 N: with one of them dead that is heave.

In every step the vertical thrust that the vehicle felt, from accelerometer, gyro and DVL by its nominal
parameters, is compared with a + b that were asked for; r is the difference. Of four explanations each leaves
a sum of squares, forgotten after ``watch_s``:

- all is well: sum r^2
- a is dead: sum (r + a)^2; b is dead: sum (r + b)^2
- both are weaker by the same share c: the smallest sum (r + c (a + b))^2, as after lost gain or with other
  parameters than believed

each about its own mean, as far as the accelerometer's data sheet allows a constant error. A thruster is given
up, until the episode ends, when its death leaves less than ``watch_ratio`` of what the best of the other
three leaves.
"""

import taichi as ti

from uuvtai.kernels.core.signature import Bundle, spread
from uuvtai.kernels.vehicle.bundles import ThrusterWatchIO
from uuvtai.kernels.vehicle.rotor import thrust_of_rpm
from uuvtai.native.launch import quick_launch

_OFFSET_NOISE_N2_S = 2.5
"""How much squared residual tells as much of the offset as the accelerometer's data sheet."""

_UPRIGHT = 0.99
"""Vertical share of a thruster's direction, at least."""


def vertical_pair(vehicle_cfg):
    """Indices of the two vertical thrusters that push the same way, () = the frame has another number of
    them; plain Python."""
    found = []
    for index, thruster in enumerate(vehicle_cfg.thrusters):
        x, y, z = thruster.direction
        if abs(z) > _UPRIGHT * (x * x + y * y + z * z) ** 0.5:
            found.append((index, z > 0))
    alike = len(found) == 2 and found[0][1] == found[1][1]
    return tuple(index for index, _ in found) if alike else ()


def is_watched(vehicle_cfg, actuation_cfg):
    """Whether there is anything to do; plain Python."""
    return actuation_cfg.watch_s > 0 and len(vertical_pair(vehicle_cfg)) == 2


def _offset_n2(vehicle_cfg, sensors_cfg):
    """[N^2] variance of the felt thrust's constant error, by the accelerometer's data sheet; plain Python."""
    return ((vehicle_cfg.mass_kg + vehicle_cfg.added_mass[2]) * sensors_cfg.imu.accel_bias_m_s2) ** 2


@quick_launch
@ti.kernel
def watch_thrusters(io: Bundle[ThrusterWatchIO]):
    """Weigh what the last commands did, before new ones are given. Awake rows only."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            watched = io.clock.step[env] > 0 and io.ego.vel_valid[env] == 1
            if watched and io.actuation.given_up[env] == 0:
                _weigh(env, io)


@ti.func
def _weigh(env, io: Bundle[ThrusterWatchIO]):
    """One step more of evidence, and the verdict."""
    pair = ti.static(vertical_pair(io.vehicle_cfg))
    way = ti.static(1.0 if io.vehicle_cfg.thrusters[pair[0]].direction[2] > 0 else -1.0)
    n_slot = ti.static(io.actuation.rpm_queue.shape[1])
    slot = (io.clock.step[env] + n_slot - 1) % n_slot
    a = way * thrust_of_rpm(io.actuation.rpm_queue[env, slot, pair[0]], io.vehicle_cfg)
    b = way * thrust_of_rpm(io.actuation.rpm_queue[env, slot, pair[1]], io.vehicle_cfg)
    r = felt_thrust(io.ego.vel_b[env], io.ego.rate_b[env], io.ego.rpy[env], io.ego.specific_force_b[env], io)
    r -= a + b
    dt, memory_s = io.episode_cfg.control_dt_s, io.actuation_cfg.watch_s
    kept = ti.exp(-dt / memory_s)
    sums = ti.Vector([r * r, r * a, r * b, a * a, a * b, b * b, r, a, b, 1.0])
    for i in ti.static(range(io.actuation.response.shape[1])):
        sums[i] = kept * io.actuation.response[env, i] + dt * sums[i]
        io.actuation.response[env, i] = sums[i]
    offset_n2 = ti.static(_offset_n2(io.vehicle_cfg, io.sensors_cfg))
    weight = offset_n2 / (offset_n2 * sums[9] + _OFFSET_NOISE_N2_S)
    mean_r, mean_a, mean_b = weight * sums[6], weight * sums[7], weight * sums[8]
    rr, ra, rb = sums[0] - mean_r * sums[6], sums[1] - mean_r * sums[7], sums[2] - mean_r * sums[8]
    aa, ab, bb = sums[3] - mean_a * sums[7], sums[4] - mean_a * sums[8], sums[5] - mean_b * sums[8]
    dead_a, dead_b = rr + 2.0 * ra + aa, rr + 2.0 * rb + bb
    weak = rr - (ra + rb) * (ra + rb) / ti.max(aa + 2.0 * ab + bb, 1e-6)
    others, ratio, doubt = ti.min(rr, weak), io.actuation_cfg.watch_ratio, io.actuation_cfg.watch_doubt_n2_s
    if dead_a + doubt < ratio * ti.min(others, dead_b):
        io.actuation.given_up[env] = 1 + pair[0]
    elif dead_b + doubt < ratio * ti.min(others, dead_a):
        io.actuation.given_up[env] = 1 + pair[1]


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
