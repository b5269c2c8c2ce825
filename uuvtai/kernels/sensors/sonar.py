"""Sonar: level beams at the body origin, a ring or a fan, cast analytically in packets of sixteen
neighbouring beams.

Beam i looks along the true yaw + the bearing of beam 0 + i times the spacing (``SonarConfig``). A body is
seen where the beam enters its horizontal outline and the vertical gap is within range x tan(half aperture);
the side walls are always seen, floor and surface never. Every error source is a switch that is compiled away
at zero. Order: geometry, ghost, grazing loss, bubble cloud, missed return, range noise, false return,
quantisation.
"""

import math

import taichi as ti

from uuvtai.kernels.core.geometry import FAR_M, rotation_wb
from uuvtai.kernels.core.lanes import LANES, filled
from uuvtai.kernels.core.signature import Bundle, Const, spread
from uuvtai.kernels.sensors.bundles import SonarIO
from uuvtai.kernels.sensors.cfar import detected
from uuvtai.kernels.sensors.raycast import nearest_echo, place_bodies
from uuvtai.kernels.sensors.sonar_error import (
    cloud_covered,
    cut_off,
    doppler_noisy,
    falsely_returned,
    ghosted,
    grazing_lost,
    missed,
    range_noisy,
    start_cloud,
)
from uuvtai.native.gpu_shape import is_gpu_shaped
from uuvtai.native.launch import quick_launch, with_cse

_FALLOFF = 0.9
"""Intensity = cosine of incidence x (1 - 0.9 r / maximum range): Lambert's law and what gain control leaves
of the range loss (EC)."""

_DIMMEST = 0.01
"""Floor of the cosine in the intensity, so that a return is never 0."""

_BEAMS_GPU = 8
"""Beams of one thread of a GPU"""

Mount = ti.types.struct(pos=ti.math.vec3, vel=ti.math.vec2, heading=ti.math.vec2)
"""Truth of the sensor as float32: world position [m], horizontal velocity [m/s], unit vector ahead."""


@quick_launch
@ti.kernel
def reset_sonar(io: Bundle[SonarIO]):
    """Forget scans and clouds of the awake rows: no return anywhere, nothing fresh or under way (step 0 then
    fills the scan)."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            clear_scan(env, io)
            clear_memory(env, io)


@ti.func
def clear_scan(env, io: Bundle[SonarIO]):
    for ray in range(io.scan.range_m.shape[1]):
        io.scan.range_m[env, ray] = 0.0
        io.scan.doppler_m_s[env, ray] = 0.0
        io.scan.intensity[env, ray] = 0.0
        io.scan.hit[env, ray] = 0
    io.scan.fresh[env] = 0
    io.scan.ping_step[env] = 0
    io.scan.ping_pos_w[env] = ti.zero(io.scan.ping_pos_w[env])
    io.scan.ping_yaw[env] = 0.0
    io.scan.ping_vel_b[env] = ti.zero(io.scan.ping_vel_b[env])
    io.scan.ping_vel_valid[env] = 0
    io.scan.new_from[env] = 0
    io.scan.new_count[env] = 0


@ti.func
def clear_memory(env, io: Bundle[SonarIO]):
    for slot in range(io.sonar_memory.step.shape[1]):
        io.sonar_memory.step[env, slot] = -1
    for cloud in range(io.sonar_memory.cloud_until.shape[1]):
        io.sonar_memory.cloud_until[env, cloud] = 0


@quick_launch
@with_cse(lambda io: io.sonar_cfg.detector != "none")
@ti.kernel
def cast_sonar(io: Bundle[SonarIO]):
    """Ping where a ping is due, deliver what is due; ``scan.fresh`` is 1 only in the step of delivery.

    A ping at step s is delivered at s + latency_steps. The first ping of an episode is delivered at once (and
    only then), so that the first observation is not empty. ``memory`` needs n_latency > latency_steps /
    period_steps.
    """
    n = ti.static(io.clock.awake.shape[0])
    beams = ti.static(n_beam())
    n_part = ti.static(io.sonar_cfg.n_ray // beams)
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.clock.step[env] % io.sonar_cfg.period_steps == 0:
            place_sonar(env, io)
            if ti.static(io.sonar_cfg.bubble_clouds_per_s > 0):
                start_cloud(env, io)
    for env, part, pad in ti.ndrange(n, n_part, ti.static(spread(n, n_part))):
        if pad == 0 and io.clock.awake[env] == 1:
            step = io.clock.step[env]
            if step % io.sonar_cfg.period_steps == 0:
                ping(env, part * beams, step, io)
            deliver(env, part * beams, step, io)


def n_beam() -> int:
    """Neighbouring beams that one loop item casts; fewer on a GPU, where a thread has not the registers for a
    packet. Plain Python."""
    return _BEAMS_GPU if is_gpu_shaped() else LANES


@ti.func
def ping(env, first, step, io: Bundle[SonarIO]):
    """The beams from ``first`` on: without latency straight into the scan, else into the ring."""
    range_m, doppler, intensity = measured(env, first, step, io)
    if ti.static(io.sonar_cfg.latency_steps == 0):
        show(env, first, step, range_m, doppler, intensity, io)
    else:
        queue(env, first, step, range_m, doppler, intensity, io)


@ti.func
def show(env, first, step, range_m, doppler, intensity, io: Bundle[SonarIO]):
    """Write beams to the output; the very first also writes the own state of the ping."""
    for i in ti.static(range(range_m.n)):
        ray = first + i
        hit = range_m[i] < FAR_M
        io.scan.range_m[env, ray] = ti.select(hit, range_m[i], io.sonar_cfg.max_range_m)
        io.scan.doppler_m_s[env, ray] = ti.select(hit, doppler[i], 0.0)
        io.scan.intensity[env, ray] = ti.select(hit, intensity[i], 0.0)
        io.scan.hit[env, ray] = ti.select(hit, 1, 0)
    if first == 0:
        note_ping(env, step, io)


@ti.func
def note_ping(env, step, io: Bundle[SonarIO]):
    """Write the own state of a ping to the output."""
    io.scan.ping_step[env] = step
    io.scan.ping_pos_w[env] = io.ego.pos_w[env]
    io.scan.ping_yaw[env] = io.ego.rpy[env][2]
    io.scan.ping_vel_b[env] = io.ego.vel_b[env]
    io.scan.ping_vel_valid[env] = io.ego.vel_valid[env]


@ti.func
def queue(env, first, step, range_m, doppler, intensity, io: Bundle[SonarIO]):
    """Write beams to the ring of scans under way."""
    slot = ring_slot(step, io)
    for i in ti.static(range(range_m.n)):
        ray = first + i
        hit = range_m[i] < FAR_M
        io.sonar_memory.range_m[env, slot, ray] = ti.select(hit, range_m[i], io.sonar_cfg.max_range_m)
        io.sonar_memory.doppler_m_s[env, slot, ray] = ti.select(hit, doppler[i], 0.0)
        io.sonar_memory.intensity[env, slot, ray] = ti.select(hit, intensity[i], 0.0)
        io.sonar_memory.hit[env, slot, ray] = ti.select(hit, 1, 0)
    if first == 0:
        io.sonar_memory.step[env, slot] = step
        io.sonar_memory.pos_w[env, slot] = io.ego.pos_w[env]
        io.sonar_memory.yaw[env, slot] = io.ego.rpy[env][2]
        io.sonar_memory.vel_b[env, slot] = io.ego.vel_b[env]
        io.sonar_memory.vel_valid[env, slot] = io.ego.vel_valid[env]


@ti.func
def ring_slot(step, io: Bundle[SonarIO]):
    """Slot of the ring in which the scan pinged at ``step`` waits."""
    return (step // io.sonar_cfg.period_steps) % io.sonar_memory.step.shape[1]


@ti.func
def deliver(env, first, step, io: Bundle[SonarIO]):
    """Move the scan that is due now from the ring to the output."""
    pinged = step - io.sonar_cfg.latency_steps
    if ti.static(io.sonar_cfg.latency_steps == 0):
        if first == 0:
            io.scan.fresh[env] = ti.cast(step % io.sonar_cfg.period_steps == 0, ti.i32)
    else:
        due = step == 0 or (pinged > 0 and pinged % io.sonar_cfg.period_steps == 0)
        slot = ring_slot(ti.max(pinged, 0), io)
        if first == 0:
            io.scan.fresh[env] = ti.cast(due, ti.i32)
        if due:
            if first == 0:
                io.scan.ping_step[env] = io.sonar_memory.step[env, slot]
                io.scan.ping_pos_w[env] = io.sonar_memory.pos_w[env, slot]
                io.scan.ping_yaw[env] = io.sonar_memory.yaw[env, slot]
                io.scan.ping_vel_b[env] = io.sonar_memory.vel_b[env, slot]
                io.scan.ping_vel_valid[env] = io.sonar_memory.vel_valid[env, slot]
            for ray in range(first, first + ti.static(n_beam())):
                io.scan.range_m[env, ray] = io.sonar_memory.range_m[env, slot, ray]
                io.scan.doppler_m_s[env, ray] = io.sonar_memory.doppler_m_s[env, slot, ray]
                io.scan.intensity[env, ray] = io.sonar_memory.intensity[env, slot, ray]
                io.scan.hit[env, ray] = io.sonar_memory.hit[env, slot, ray]


# ------------------------------------------------------------------------------------------------ measurement


@ti.func
def measured(env, ray, step, io: Bundle[SonarIO]):
    """(range, Doppler, intensity) of the beams from ``ray`` on as the sensor reports them; range FAR_M =
    no return."""
    range_m = filled(FAR_M, ti.static(n_beam()))
    doppler, intensity = filled(0.0, ti.static(n_beam())), filled(0.0, ti.static(n_beam()))
    if ti.static(io.sonar_cfg.detector != "none"):
        range_m, intensity = detected(env, ray, ti.static(n_beam()), io)
    else:
        mount, packet = sonar_mount(env, io), ray // LANES
        ux, uy = beam_directions(ray, mount.heading, io)
        wedge = packet_wedge(packet, mount.heading, io)
        echo = nearest_echo(env, mount.pos[0], mount.pos[1], ux, uy, 0.0, wedge, True, io)
        range_m, doppler, intensity = reported(env, echo, ux, uy, mount, wedge, ray, step, io)
    return range_m, doppler, intensity


@ti.func
def reported(env, echo, ux, uy, mount, wedge, ray, step, io: Bundle[SonarIO]):
    """What a sensor reports, errors included, of sixteen beams from number ``ray`` on that meet ``echo``."""
    cosine = -(ux * echo.normal_x + uy * echo.normal_y)
    own = ux * mount.vel[0] + uy * mount.vel[1]
    key = io.episode.key[env]
    bounced, away = ghosted(env, echo, ux, uy, mount.pos, wedge, step, ray, io)
    clear = grazing_lost(bounced, cosine, io)
    clouded, still, bright = cloud_covered(env, clear, away, cosine, mount.heading, ray, step, io)
    heard = missed(clouded, key, step, ray, io)
    noisy = range_noisy(heard, key, step, ray, io)
    measured, speed, lit = falsely_returned(noisy, still, bright, key, step, ray, io)
    final = cut_off(measured, io)
    doppler = filled(0.0, final.n)
    if ti.static(io.sonar_cfg.doppler):
        doppler = doppler_noisy(speed - own, key, step, ray, io)
    intensity = ti.max(lit, _DIMMEST) * (
        1.0 - _FALLOFF / io.sonar_cfg.max_range_m * ti.min(final, io.sonar_cfg.max_range_m)
    )
    return final, doppler, intensity


@ti.func
def place_sonar(env, io: Bundle[SonarIO]):
    """Truth of a ping that all its beams share, once per ping: roll and pitch do not matter."""
    R_wb = rotation_wb(io.vehicle.quat_wb[env])
    vel_w = R_wb @ io.vehicle.vel_b[env]
    ahead = ti.Vector([R_wb[0, 0], R_wb[1, 0]])
    heading = ahead / ti.max(ahead.norm(), 1.0e-6)
    io.sonar_memory.mount_w[env] = io.vehicle.pos_w[env]
    io.sonar_memory.mount_vel_w[env] = ti.Vector([vel_w[0], vel_w[1]])
    io.sonar_memory.heading_w[env] = heading
    place_bodies(env, io.vehicle.pos_w[env][0], io.vehicle.pos_w[env][1], io)


@ti.func
def sonar_mount(env, io: Bundle[SonarIO]):
    """Where the sonar is, how it moves and where it looks."""
    return Mount(
        pos=io.sonar_memory.mount_w[env].cast(ti.f32),
        vel=io.sonar_memory.mount_vel_w[env].cast(ti.f32),
        heading=io.sonar_memory.heading_w[env].cast(ti.f32),
    )


@ti.func
def direction_before(packet, heading, io: Bundle[SonarIO]):
    """Direction (x, y) one beam before a packet's first, where no cosine or sine of a lane's turn is 0 or 1,
    so that all lanes stay alike.

    The packet's turn comes from a table of constants.
    """
    c, s = 0.0, 0.0
    for k in ti.static(range(io.sonar_cfg.n_ray // LANES)):
        if packet == k:
            turn = ti.static(io.sonar_cfg.first_beam_rad + io.sonar_cfg.turn_rad(LANES * k - 1))
            cosine, sine = ti.static(math.cos(turn), math.sin(turn))
            c, s = cosine, sine
    return ti.Vector([c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]])


@ti.func
def beam_directions(ray, heading, io: Bundle[SonarIO]):
    """Horizontal unit vectors (x, y) of the beams from ``ray`` on."""
    beams = ti.static(n_beam())
    before = direction_before(ray // LANES, heading, io)
    ux, uy = turned_beams(before, 0, io)
    for part in ti.static(range(1, LANES // beams)):
        if ray % LANES == part * beams:
            ux, uy = turned_beams(before, part * beams, io)
    return ux, uy


@ti.func
def turned_beams(before, first: Const[int], io: Bundle[SonarIO]):
    """Horizontal unit vectors (x, y) of the beams from number ``first`` of a packet on."""
    ux, uy = filled(0.0, ti.static(n_beam())), filled(0.0, ti.static(n_beam()))
    for i in ti.static(range(n_beam())):
        turn = ti.static(io.sonar_cfg.turn_rad(first + i + 1))
        c, s = ti.static(math.cos(turn), math.sin(turn))
        ux[i] = before[0] * c - before[1] * s
        uy[i] = before[0] * s + before[1] * c
    return ux, uy


@ti.func
def packet_wedge(packet, heading, io: Bundle[SonarIO]):
    """(x, y) of the middle direction of a packet's beams, then (cos, sin) of the half angle between its
    outermost beams."""
    half = ti.static(0.5 * io.sonar_cfg.turn_rad(LANES - 1))
    middle = ti.static(half + io.sonar_cfg.beam_step_rad)
    c, s = ti.static(math.cos(middle), math.sin(middle))
    before = direction_before(packet, heading, io)
    x, y = c * before[0] - s * before[1], s * before[0] + c * before[1]
    return ti.Vector([x, y, ti.static(math.cos(half)), ti.static(math.sin(half))])
