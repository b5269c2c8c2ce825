"""Sonar: level beams at the obstacle origin, a ring or a fan, cast analytically in packets of sixteen
neighbouring beams.

Beam i looks along the true yaw + the bearing of beam 0 + i times the spacing (``SonarConfig``). An obstacle
is seen where the beam enters its horizontal outline and the vertical gap is within range x tan(half
aperture); the side walls are always seen, floor and surface never. Every error source is a switch that is
compiled away at zero. Order: geometry, ghost, grazing loss, bubble cloud, missed return, range noise, false
return, quantisation.
"""

import math

import taichi as ti

from uuvtai.compile.launch import is_gpu_shaped, quick_launch, with_cse
from uuvtai.config import SonarConfig
from uuvtai.config.multibeam import ABSORPTION_NP_M, SHOWN_DB, filled_beam
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI, rotation_wb
from uuvtai.kernels.core.noise import (
    STREAM_SONAR_CLUTTER,
    STREAM_SONAR_DOPPLER,
    STREAM_SONAR_DROP,
    STREAM_SONAR_GHOST,
    STREAM_SONAR_NORMAL,
    STREAM_SONAR_RANGE,
    normal_pair_lanes,
    stream_key,
    uniform,
    uniform_in,
    uniform_lanes,
)
from uuvtai.kernels.core.simd import LANES, filled
from uuvtai.kernels.core.stage import Bundle, Const, n_envs, shares
from uuvtai.kernels.sensors.io import SonarIO
from uuvtai.kernels.sensors.raycast import nearest_echo, place_obstacles

# ------------------------------------------------------------------------------------------------------------
# What goes wrong in a sonar beam, error by error; each is compiled away at zero. Packets of beams,
# FAR_M = no return.


CLOUD_BRIGHTNESS = 0.5
"""Stands for the cosine of incidence of a bubble cloud (EC)."""

_CLOUD_NEAREST_M = 0.5  # Bubble clouds form between this and the maximum range (EC).


@ti.func
def ghosted(env, echo, ux, uy, pos, wedge, step, ray, io: Bundle[SonarIO]):
    """(range, rate of change of range from the surfaces' motion), where one specular bounce replaces the
    direct return in chosen beams.

    The path is sensor - p1 - p2 with p2 along the mirrored direction m; its length changes by v1.u + (v2 -
    v1).m - v_sensor.u.
    """
    range_m = echo.range_m
    away = ux * echo.vel_x + uy * echo.vel_y
    out_range, out_away = range_m + 0.0, away + 0.0
    if ti.static(io.sonar_cfg.ghost > 0):
        stream = stream_key(io.episode.key[env], step, STREAM_SONAR_GHOST)
        chosen = uniform_lanes(stream, ray, ux.n) < io.sonar_cfg.ghost
        if any_lane(chosen):
            cosine = -(ux * echo.normal_x + uy * echo.normal_y)
            mx, my = ux + 2.0 * cosine * echo.normal_x, uy + 2.0 * cosine * echo.normal_y
            x, y = pos[0] + range_m * ux, pos[1] + range_m * uy
            second = nearest_echo(env, x, y, mx, my, range_m, wedge, False, io)
            path = range_m + second.range_m
            heard = chosen & (path <= io.sonar_cfg.max_range_m)
            extra = mx * (second.vel_x - echo.vel_x) + my * (second.vel_y - echo.vel_y)
            out_range = ti.select(heard, path, range_m)
            out_away = ti.select(heard, away + extra, away)
    return out_range, out_away


@ti.func
def any_lane(mask):
    """Whether a condition holds in any lane."""
    return mask.any()


@ti.func
def grazing_lost(range_m, cosine, io: Bundle[SonarIO]):
    """Range, or FAR_M where the surface is met too flatly."""
    out = range_m + 0.0
    if ti.static(io.sonar_cfg.grazing_cosine > 0):
        out = ti.select(cosine < io.sonar_cfg.grazing_cosine, FAR_M, range_m)
    return out


@ti.func
def start_cloud(env, io: Bundle[SonarIO]):
    """A bubble cloud may form in a free slot; it keeps its range and its bearing in the world (beam counted
    from the x axis)."""
    key = stream_key(io.episode.key[env], io.clock.step[env], STREAM_SONAR_CLUTTER)
    first = ti.static(3 * io.sonar_cfg.n_ray)
    if uniform(key, first) < ti.static(
        io.sonar_cfg.bubble_clouds_per_s * io.sonar_cfg.period_steps * io.episode_cfg.control_dt_s
    ):
        free = -1
        for cloud in range(io.sonar_memory.cloud_until.shape[1]):
            if free < 0 and io.sonar_memory.cloud_until[env, cloud] <= io.clock.step[env]:
                free = cloud
        if free >= 0:
            width = uniform_in(key, first + 1, io.sonar_cfg.bubble_beams[0], io.sonar_cfg.bubble_beams[1] + 1)
            lasts = uniform_in(key, first + 2, io.sonar_cfg.bubble_s[0], io.sonar_cfg.bubble_s[1])
            io.sonar_memory.cloud_width[env, free] = ti.cast(width, ti.i32)
            io.sonar_memory.cloud_beam[env, free] = ti.cast(
                uniform_in(key, first + 3, 0.0, io.sonar_cfg.circle_beams), ti.i32
            )
            io.sonar_memory.cloud_range_m[env, free] = uniform_in(
                key, first + 4, _CLOUD_NEAREST_M, io.sonar_cfg.max_range_m
            )
            io.sonar_memory.cloud_until[env, free] = io.clock.step[env] + ti.cast(
                ti.ceil(lasts / io.episode_cfg.control_dt_s), ti.i32
            )


@ti.func
def cloud_covered(env, range_m, away, cosine, heading, ray, step, io: Bundle[SonarIO]):
    """(range, surface's rate, brightness) where bubble clouds, still in the water, hide what is behind
    them."""
    out_range, out_away, out_bright = range_m + 0.0, away + 0.0, cosine + 0.0
    if ti.static(io.sonar_cfg.bubble_clouds_per_s > 0):
        turn = 0
        if ti.static(io.sonar_cfg.is_ring):
            turn = ti.cast(
                ti.round(ti.atan2(heading[1], heading[0]) * ti.static(io.sonar_cfg.n_ray / TWO_PI)), ti.i32
            )
        else:
            first = ti.atan2(heading[1], heading[0]) + ti.static(io.sonar_cfg.first_beam_rad)
            turn = ti.cast(ti.round(first / ti.static(io.sonar_cfg.beam_step_rad)), ti.i32)
        index = ti.Vector([ray + turn + i for i in range(range_m.n)])
        for cloud in range(io.sonar_memory.cloud_until.shape[1]):
            if step < io.sonar_memory.cloud_until[env, cloud]:
                offset = (
                    index - io.sonar_memory.cloud_beam[env, cloud] + 2 * io.sonar_cfg.circle_beams
                ) % io.sonar_cfg.circle_beams
                distance = ti.cast(io.sonar_memory.cloud_range_m[env, cloud], ti.f32)
                covered = (offset < io.sonar_memory.cloud_width[env, cloud]) & (out_range > distance)
                out_range = ti.select(covered, distance, out_range)
                out_away = ti.select(covered, 0.0, out_away)
                out_bright = ti.select(covered, CLOUD_BRIGHTNESS, out_bright)
    return out_range, out_away, out_bright


@ti.func
def missed(range_m, key, step, ray, io: Bundle[SonarIO]):
    """Range, or FAR_M where the return is missed."""
    out = range_m + 0.0
    if ti.static(io.sonar_cfg.missed_return > 0):
        out = ti.select(
            uniform_lanes(stream_key(key, step, STREAM_SONAR_DROP), ray, range_m.n)
            < io.sonar_cfg.missed_return,
            FAR_M,
            range_m,
        )
    return out


@ti.func
def range_noisy(range_m, key, step, ray, io: Bundle[SonarIO]):
    """Range with its normal error (sigma = a + b r) and its positive exponential jitter."""
    out = range_m + 0.0
    stream = stream_key(key, step, STREAM_SONAR_RANGE)
    if ti.static(io.sonar_cfg.range_sigma_m > 0 or io.sonar_cfg.range_sigma_slope > 0):
        error, _of_doppler = normal_pair_lanes(stream_key(key, step, STREAM_SONAR_NORMAL), ray, range_m.n)
        out += (io.sonar_cfg.range_sigma_m + io.sonar_cfg.range_sigma_slope * range_m) * error
    if ti.static(io.sonar_cfg.range_jitter_m > 0):
        out -= io.sonar_cfg.range_jitter_m * ti.log(
            1.0 - uniform_lanes(stream, io.sonar_cfg.n_ray + ray, range_m.n)
        )
    return out


@ti.func
def falsely_returned(range_m, away, bright, key, step, ray, io: Bundle[SonarIO]):
    """(range, surface's rate, brightness) where clutter at any range, still in the water, replaces whatever
    the beam would have told."""
    out_range, out_away, out_bright = range_m + 0.0, away + 0.0, bright + 0.0
    if ti.static(io.sonar_cfg.false_return > 0):
        stream = stream_key(key, step, STREAM_SONAR_CLUTTER)
        chosen = uniform_lanes(stream, ray, range_m.n) < io.sonar_cfg.false_return
        out_range = ti.select(
            chosen,
            io.sonar_cfg.max_range_m * uniform_lanes(stream, io.sonar_cfg.n_ray + ray, range_m.n),
            range_m,
        )
        out_away = ti.select(chosen, 0.0, away)
        out_bright = ti.select(chosen, uniform_lanes(stream, 2 * io.sonar_cfg.n_ray + ray, range_m.n), bright)
    return out_range, out_away, out_bright


@ti.func
def cut_off(range_m, io: Bundle[SonarIO]):
    """Range rounded to the quantum and not negative; FAR_M beyond the maximum range."""
    clipped = ti.max(range_m, 0.0)
    if ti.static(io.sonar_cfg.range_quantum_m > 0):
        clipped = (
            ti.floor(ti.max(range_m, 0.0) * ti.static(1.0 / io.sonar_cfg.range_quantum_m) + 0.5)
            * io.sonar_cfg.range_quantum_m
        )
    return ti.select(clipped > io.sonar_cfg.max_range_m, FAR_M, clipped)


@ti.func
def doppler_noisy(doppler, key, step, ray, io: Bundle[SonarIO]):
    """Doppler with its normal error, the other of the range's pair (one draw serves both); an outlier is
    uniform within +- a limit."""
    out = doppler + 0.0
    stream = stream_key(key, step, STREAM_SONAR_DOPPLER)
    if ti.static(io.sonar_cfg.doppler_sigma_m_s > 0):
        _of_range, error = normal_pair_lanes(stream_key(key, step, STREAM_SONAR_NORMAL), ray, doppler.n)
        out += io.sonar_cfg.doppler_sigma_m_s * error
    noisy = out + 0.0
    if ti.static(io.sonar_cfg.doppler_outlier > 0):
        chosen = uniform_lanes(stream, io.sonar_cfg.n_ray + ray, doppler.n) < io.sonar_cfg.doppler_outlier
        wild = io.sonar_cfg.doppler_outlier_m_s * (
            2.0 * uniform_lanes(stream, 2 * io.sonar_cfg.n_ray + ray, doppler.n) - 1.0
        )
        noisy = ti.select(chosen, wild, out)
    return noisy


# ------------------------------------------------------------------------------------------------------------


_FALLOFF = 0.9
"""Intensity = cosine of incidence x (1 - 0.9 r / maximum range): Lambert's law and what gain control leaves
of the range loss (EC)."""

_DIMMEST = 0.01  # Floor of the cosine in the intensity, so that a return is never 0.

_BEAMS_GPU = 8  # Beams of one thread of a GPU

Mount = ti.types.struct(pos=ti.math.vec3, vel=ti.math.vec2, heading=ti.math.vec2)
"""Truth of the sensor as float32: world position [m], horizontal velocity [m/s], unit vector ahead."""


@quick_launch
@ti.kernel
def reset_sonar(io: Bundle[SonarIO]):
    """Forget scans and clouds of the active rows: no return anywhere, nothing fresh or under way (step 0 then
    fills the scan)."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
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
    n = n_envs(io.clock)
    beams = ti.static(n_beam())
    n_part = ti.static(io.sonar_cfg.n_ray // beams)
    n_share = ti.static(shares(n_part))
    for env in range(n):
        if io.clock.active[env] == 1 and io.clock.step[env] % io.sonar_cfg.period_steps == 0:
            place_sonar(env, io)
            if ti.static(io.sonar_cfg.bubble_clouds_per_s > 0):
                start_cloud(env, io)
    for env, share in ti.ndrange(n, n_share):
        if io.clock.active[env] == 1:
            step = io.clock.step[env]
            for part in range(share * n_part // n_share, (share + 1) * n_part // n_share):
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
    place_obstacles(env, io.vehicle.pos_w[env][0], io.vehicle.pos_w[env][1], io)


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


# ------------------------------------------------------------------------------------------------------------
# Ranges from the intensity image: constant false alarm rate (CFAR) along each beam, the first that passes
# counts.
#
# Power is averaged over a few neighbouring beams, for the speckle of floor and surface nearby would else
# raise a false alarm every second. A cell is a return where that stands above three things: the mean of the
# cells around it, beyond a guard, by the factor at which exponentially distributed noise passes with
# ``cfar_false_alarm`` (cell averaging, CA, both sides together; smallest of, SO, the quieter side: P.
# Gandhi, S. Kassam, *Analysis of CFAR Processors in Nonhomogeneous Background*, IEEE Trans. AES 24(4),
# 1988); what the beam's side lobes bring from other bearings of the same range, by the factor of that
# probability; and the least level.


@ti.func
def detected(env, first, beams: Const[int], io: Bundle[SonarIO]):
    """(range [m], FAR_M = none; intensity [0, 1]) of the beams from ``first`` on: the middle of the nearest
    range bin that passes, and its level over ``SHOWN_DB``."""
    range_m, intensity = filled(FAR_M, beams), filled(0.0, beams)
    bin_m = ti.static(io.sonar_cfg.max_range_m / io.sonar_cfg.image_bins)
    for lane in range(beams):
        cell = first_return(env, first + lane, io)
        if cell >= 0:
            range_m[lane] = bin_m * (cell + 0.5)
            share = relative_level(mean_power(env, first + lane, cell, io), cell, io)
            level_db = ti.log(ti.max(share, 1.0e-12)) * ti.static(10.0 / math.log(10.0))
            intensity[lane] = ti.min(ti.max(1.0 + level_db / SHOWN_DB, 0.01), 1.0)
    return range_m, intensity


@ti.func
def first_return(env, beam, io: Bundle[SonarIO]):
    """The nearest range bin that passes; -1 = none."""
    found, cell = -1, 0
    lobes = ti.static(-math.log(io.sonar_cfg.cfar_false_alarm))
    least = ti.static(10.0 ** (0.1 * io.sonar_cfg.least_level_db))
    factor = ti.static(cfar_factor(io.sonar_cfg))
    while found < 0 and cell < io.sonar_cfg.image_bins:
        power = mean_power(env, beam, cell, io)
        if relative_level(power, cell, io) > least and power > factor * level_around(env, beam, cell, io):
            if power > lobes * level_beside(env, beam, cell, io):
                found = cell
        cell += 1
    return found


@ti.func
def mean_power(env, beam, cell, io: Bundle[SonarIO]):
    """Mean over ``cfar_beams`` neighbours; at the edges of a fan over those that there are."""
    half, n_ray = ti.static(io.sonar_cfg.cfar_beams // 2, io.sonar_cfg.n_ray)
    total, count = 0.0, 0
    for off in ti.static(range(-half, half + 1)):
        other = beam + off
        if ti.static(io.sonar_cfg.is_ring):
            other = (beam + off + n_ray) % n_ray
        if 0 <= other < n_ray:
            total += io.sonar_image.heard[env, other, cell]
            count += 1
    return total / count


@ti.func
def relative_level(power, cell, io: Bundle[SonarIO]):
    """Power as a share of what a wall across the beam would return from there."""
    range_m = ti.static(io.sonar_cfg.max_range_m / io.sonar_cfg.image_bins) * (cell + 0.5)
    gain = range_m * range_m * ti.exp(ti.static(4.0 * ABSORPTION_NP_M) * range_m)
    return power * gain * ti.static(1.0 / filled_beam(io.sonar_cfg))


@ti.func
def level_around(env, beam, cell, io: Bundle[SonarIO]):
    """Mean power of the cells around, beyond the guard; at the ends of the beam of those that there are."""
    guard, cells = ti.static(io.sonar_cfg.cfar_guard, io.sonar_cfg.cfar_cells)
    before, n_before, behind, n_behind = 0.0, 0, 0.0, 0
    for i in range(ti.max(cell - guard - cells, 0), ti.max(cell - guard, 0)):
        before += mean_power(env, beam, i, io)
        n_before += 1
    for i in range(cell + guard + 1, ti.min(cell + guard + 1 + cells, io.sonar_cfg.image_bins)):
        behind += mean_power(env, beam, i, io)
        n_behind += 1
    level = (before + behind) / ti.max(n_before + n_behind, 1)
    if ti.static(io.sonar_cfg.detector == "so"):
        if n_before > 0 and n_behind > 0:
            level = ti.min(before / n_before, behind / n_behind)
    return level


@ti.func
def level_beside(env, beam, cell, io: Bundle[SonarIO]):
    """Mean power that side lobes bring, from what all beams hear in the same range bin."""
    level = 0.0
    for other in range(ti.static(io.sonar_cfg.n_ray)):
        share = io.sonar_image.across[ti.abs(other - beam)][1]
        level += share * io.sonar_image.heard[env, other, cell]
    return level


def cfar_factor(sonar_cfg: SonarConfig) -> float:
    """By how much a cell must stand above the mean around it. Plain Python."""
    n, wanted = sonar_cfg.cfar_cells, sonar_cfg.cfar_false_alarm
    if sonar_cfg.detector == "ca":
        return 2 * n * (wanted ** (-0.5 / n) - 1.0)
    low, high = 0.0, 1e6
    for _ in range(100):
        middle = 0.5 * (low + high)
        passing = 2.0 * sum(math.comb(n - 1 + k, k) * (2.0 + middle) ** -(n + k) for k in range(n))
        low, high = (middle, high) if passing > wanted else (low, middle)
    return n * high
