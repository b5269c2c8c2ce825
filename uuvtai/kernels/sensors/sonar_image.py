"""The intensity image of a multibeam, ping by ping, in which ranges are detected (``cfar.py``).

Rays of one bearing and all elevations meet obstacles, side walls, floor and surface; their power folds into
range bins; random phases make speckle of it; beams hear all bearings by their pattern, and noise. Numbers are
those of ``multibeam.py``, speckle and noise are functions of (episode, step, bearing or beam, bin).
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch, with_cse
from uuvtai.config import SonarConfig
from uuvtai.config.multibeam import (
    ABSORPTION_NP_M,
    BEAM_DEG,
    HALF_POWER,
    STEEPEST_RAD,
    STEP_RAD,
    main_lobe,
    noise_power,
    pad_beams,
)
from uuvtai.kernels.core.geometry import BOX, FAR_M, SPHERE
from uuvtai.kernels.core.noise import STREAM_SONAR_HISS, STREAM_SONAR_SPECKLE, normal_pair_lanes, stream_key
from uuvtai.kernels.core.simd import LANES, f16x
from uuvtai.kernels.core.stage import Bundle, n_envs
from uuvtai.kernels.sensors.io import SonarIO
from uuvtai.kernels.sensors.raycast import ball_span, disc_span, obstacles_in_wedge, slab_span, wall_echo
from uuvtai.kernels.sensors.sonar import place_sonar, sonar_mount

_WALL, _FLOOR, _SURFACE = -1, -2, -3  # surfaces that are no obstacle


@quick_launch
@with_cse()
@ti.kernel
def hear(io: Bundle[SonarIO]):
    """Fill ``heard`` of the active rows whose sonar pings in this step."""
    n = n_envs(io.clock)
    n_heard, n_packet = ti.static(io.sonar_image.echo.shape[1], packets(io.sonar_cfg))
    for beams in range(n_heard):
        io.sonar_image.across[beams] = heard_across(beams, io)
    for row in range(ti.static(io.sonar_image.upright.shape[0])):
        io.sonar_image.upright[row] = heard_upright(row, io)
    for env in range(n):
        if pings(env, io):
            place_sonar(env, io)
    for env, bearing in ti.ndrange(n, n_heard):
        if pings(env, io):
            fold(env, bearing, io)
            speckle(env, bearing, io)
    for env, packet in ti.ndrange(n, n_packet):
        if pings(env, io):
            listen(env, packet, io)


def packets(sonar_cfg: SonarConfig) -> int:
    """Packets of sixteen range bins. Plain Python."""
    return -(-sonar_cfg.image_bins // LANES)


@ti.func
def pings(env, io: Bundle[SonarIO]):
    """Whether a row pings in this step."""
    return io.clock.active[env] == 1 and io.clock.step[env] % io.sonar_cfg.period_steps == 0


# --------------------------------------------------------------------------------------------------- patterns


@ti.func
def heard_across(beams, io: Bundle[SonarIO]):
    """(amplitude, share of the power by side lobes) of what comes from so many beams off: side lobes as the
    mean over lobes and nulls, 0 within the main lobe, per power that all main lobes hear together."""
    off = ti.static(io.sonar_cfg.beam_step_rad) * beams
    lobes = ti.abs(ti.sin(off)) * ti.static(HALF_POWER / math.sin(math.radians(0.5 * BEAM_DEG)))
    front = ti.cos(off) > 0.0
    amplitude = ti.select(front, sinc(lobes), 0.0)
    side = ti.static(0.5 / math.pi**2 / main_lobe(io.sonar_cfg)) / ti.max(lobes * lobes, 1.0)
    return ti.Vector([amplitude, ti.select(front and lobes > 1.0, side, 0.0)])


@ti.func
def heard_upright(row, io: Bundle[SonarIO]):
    """(sine, cosine of the elevation of a ray, pattern squared times its solid angle [sr])."""
    elevation = ti.static(STEP_RAD) * row - ti.static(STEEPEST_RAD)
    half = ti.static(math.sin(math.radians(max(io.sonar_cfg.vertical_half_aperture_deg, 0.1))))
    pattern = sinc(ti.sin(elevation) * ti.static(HALF_POWER) / half)
    solid = ti.static(io.sonar_cfg.beam_step_rad * STEP_RAD) * ti.cos(elevation)
    return ti.Vector([ti.sin(elevation), ti.cos(elevation), pattern * pattern * solid])


@ti.func
def sinc(x):
    """sin(pi x) / (pi x)."""
    angle = math.pi * ti.abs(x)
    return ti.select(angle < 1.0e-3, 1.0, ti.sin(angle) / ti.max(angle, 1.0e-3))


# ------------------------------------------------------------------------------------------------------ echo


@ti.func
def fold(env, bearing, io: Bundle[SonarIO]):
    """Mean power that comes back from one bearing, by range: what two neighbouring rays meet of one surface
    lies evenly between their ranges."""
    for cell in range(ti.static(packets(io.sonar_cfg) * LANES)):
        io.sonar_image.echo[env, bearing, cell] = 0.0
    level = towards(env, bearing, io)
    obstacles = ti.Vector([0 for _ in range(ti.static(io.sonar_memory.obstacle_reach_m.shape[1] // LANES))])
    for group in ti.static(range(obstacles.n)):
        obstacles[group] = obstacles_in_wedge(
            env, group * LANES, ti.Vector([level[0], level[1], 1.0, 0.0]), io
        )
    last_cell, last_surface, last_power, farthest = 0, 0, 0.0, 0
    for row in range(ti.static(io.sonar_image.upright.shape[0])):
        up = io.sonar_image.upright[row]
        range_m, cosine, surface = met(env, level, up, obstacles, io)
        lost = ti.exp(ti.static(-4.0 * ABSORPTION_NP_M) * range_m) / ti.max(range_m, 0.1) ** 2
        power = up[2] * cosine * lost
        cell = bin_of(range_m, io)
        if row > 0:
            both = 0.5 * (power + last_power)
            if surface == last_surface:
                deposit(env, bearing, ti.min(cell, last_cell), ti.max(cell, last_cell), both, io)
            else:
                deposit(env, bearing, cell, cell, 0.5 * both, io)
                deposit(env, bearing, last_cell, last_cell, 0.5 * both, io)
        last_cell, last_surface, last_power, farthest = cell, surface, power, ti.max(farthest, cell)
    io.sonar_image.farthest[env, bearing] = farthest


@ti.func
def towards(env, bearing, io: Bundle[SonarIO]):
    """Horizontal unit vector of a bearing."""
    heading = io.sonar_memory.heading_w[env].cast(ti.f32)
    turn = ti.static(io.sonar_cfg.first_beam_rad) + ti.static(io.sonar_cfg.beam_step_rad) * (
        bearing - ti.static(pad_beams(io.sonar_cfg))
    )
    c, s = ti.cos(turn), ti.sin(turn)
    return ti.Vector([c * heading[0] - s * heading[1], s * heading[0] + c * heading[1]])


@ti.func
def bin_of(range_m, io: Bundle[SonarIO]):
    """Range bin; ``image_bins`` = beyond the last."""
    cells = ti.min(range_m * ti.static(io.sonar_cfg.image_bins / io.sonar_cfg.max_range_m), 1.0e6)
    return ti.min(ti.cast(cells, ti.i32), io.sonar_cfg.image_bins)


@ti.func
def deposit(env, bearing, low, high, power, io: Bundle[SonarIO]):
    """Spread power evenly over range bins, both included; what lies beyond the last is lost."""
    each = power / (high - low + 1)
    for cell in range(low, ti.min(high + 1, io.sonar_cfg.image_bins)):
        io.sonar_image.echo[env, bearing, cell] = io.sonar_image.echo[env, bearing, cell] + each


@ti.func
def met(env, level, up, obstacles, io: Bundle[SonarIO]):
    """(range [m], cosine of incidence, surface) of what a ray meets first."""
    mount = sonar_mount(env, io)
    wall = wall_echo(mount.pos[0], mount.pos[1], ti.Vector([level[0]]), ti.Vector([level[1]]), io)
    range_m, surface = wall.range_m[0] / up[1], _WALL
    cosine = up[1] * ti.abs(level[0] * wall.normal_x[0] + level[1] * wall.normal_y[0])
    if ti.abs(up[0]) > 1.0e-6:
        edge = ti.select(up[0] < 0.0, ti.static(io.tank_cfg.z_m[0]), ti.static(io.tank_cfg.z_m[1]))
        away = ti.max((edge - mount.pos[2]) / up[0], 0.0)
        if away < range_m:
            range_m, cosine, surface = away, ti.abs(up[0]), ti.select(up[0] < 0.0, _FLOOR, _SURFACE)
    ray = ti.Vector([level[0] * up[1], level[1] * up[1], up[0]])
    for group in ti.static(range(obstacles.n)):
        waiting = obstacles[group]
        while waiting != 0:
            obstacle = group * LANES + 31 - ti.math.clz(waiting & -waiting)
            waiting &= waiting - 1
            enter, steep = obstacle_met(env, obstacle, mount.pos, ray, io)
            if enter < range_m:
                range_m, cosine, surface = enter, steep, obstacle
    return range_m, cosine, surface


@ti.func
def obstacle_met(env, obstacle, start, ray, io: Bundle[SonarIO]):
    """(range [m], cosine of incidence) where a ray enters an obstacle from outside; FAR_M = it does not."""
    kind, size = io.world.kind[env, obstacle], io.world.size[env, obstacle].cast(ti.f32)
    off = start - io.world.pos_w[env, obstacle].cast(ti.f32)
    enter, leave, cosine = FAR_M, -FAR_M, 0.0
    if kind == SPHERE:
        enter, leave = ball_span(off[0], off[1], off[2], ray[0], ray[1], ray[2], size[0] * size[0])
        cosine = ti.abs((off + enter * ray).dot(ray)) / size[0]
    else:
        in_z, out_z = slab_span(off[2], ray[2], size[2])
        if kind == BOX:
            yaw = ti.cast(io.world.yaw[env, obstacle], ti.f32)
            c, s = ti.cos(yaw), ti.sin(yaw)
            dx, dy = ray[0] * c + ray[1] * s, ray[1] * c - ray[0] * s
            in_x, out_x = slab_span(off[0] * c + off[1] * s, dx, size[0])
            in_y, out_y = slab_span(off[1] * c - off[0] * s, dy, size[1])
            enter, leave = ti.max(in_x, in_y, in_z), ti.min(out_x, out_y, out_z)
            cosine = ti.select(
                in_z >= enter, ti.abs(ray[2]), ti.select(in_x >= enter, ti.abs(dx), ti.abs(dy))
            )
        else:
            in_disc, out_disc = disc_span(off[0], off[1], ray[0], ray[1], size[0] * size[0])
            enter, leave = ti.max(in_disc, in_z), ti.min(out_disc, out_z)
            across = (off[0] + in_disc * ray[0]) * ray[0] + (off[1] + in_disc * ray[1]) * ray[1]
            cosine = ti.select(in_z >= enter, ti.abs(ray[2]), ti.abs(across) / size[0])
    is_met = enter <= leave and enter > 0.0
    return ti.select(is_met, enter, FAR_M), cosine


# ------------------------------------------------------------------------------------------------------ beams


@ti.func
def speckle(env, bearing, io: Bundle[SonarIO]):
    """Power becomes a field of random phase and Rayleigh's amplitude."""
    key = stream_key(io.episode.key[env], io.clock.step[env], STREAM_SONAR_SPECKLE)
    n_packet = ti.static(packets(io.sonar_cfg))
    for packet in range(n_packet):
        power = image_lanes(io.sonar_image.echo, env, bearing, packet)
        real, imag = normal_pair_lanes(key, (bearing * n_packet + packet) * LANES, LANES)
        amplitude = ti.sqrt(0.5 * power)
        put_image(io.sonar_image.echo, env, bearing, packet, amplitude * real)
        put_image(io.sonar_image.echo_imag, env, bearing, packet, amplitude * imag)


@ti.func
def image_lanes(image, env, row, packet):
    """Sixteen neighbouring range bins of a bearing or beam."""
    out = f16x(0.0)
    for i in ti.static(range(LANES)):
        out[i] = image[env, row, packet * LANES + i]
    return out


@ti.func
def put_image(image, env, row, packet, values):
    """Write sixteen neighbouring range bins of a bearing or beam."""
    for i in ti.static(range(LANES)):
        image[env, row, packet * LANES + i] = values[i]


@ti.func
def listen(env, packet, io: Bundle[SonarIO]):
    """Power that all beams hear in sixteen range bins, two beams at a time."""
    key = stream_key(io.episode.key[env], io.clock.step[env], STREAM_SONAR_HISS)
    for pair in range(ti.static(io.sonar_cfg.n_ray // 2)):
        beam = 2 * pair
        real, imag, next_real, next_imag = f16x(0.0), f16x(0.0), f16x(0.0), f16x(0.0)
        for bearing in range(ti.static(io.sonar_image.echo.shape[1])):
            if packet * LANES <= io.sonar_image.farthest[env, bearing]:
                off = bearing - ti.static(pad_beams(io.sonar_cfg)) - beam
                weight = pattern_amplitude(off, io)
                next_weight = pattern_amplitude(off - 1, io)
                one = image_lanes(io.sonar_image.echo, env, bearing, packet)
                other = image_lanes(io.sonar_image.echo_imag, env, bearing, packet)
                real += weight * one
                imag += weight * other
                next_real += next_weight * one
                next_imag += next_weight * other
        keep(env, beam, packet, real, imag, key, io)
        keep(env, beam + 1, packet, next_real, next_imag, key, io)


@ti.func
def pattern_amplitude(beams, io: Bundle[SonarIO]):
    """What a beam hears of a bearing so many beams to its left."""
    return io.sonar_image.across[ti.abs(beams)][0]


@ti.func
def keep(env, beam, packet, real, imag, key, io: Bundle[SonarIO]):
    """Write what a beam hears, with its noise."""
    sigma = ti.static(math.sqrt(0.5 * noise_power(io.sonar_cfg)))
    first = (beam * ti.static(packets(io.sonar_cfg)) + packet) * LANES
    hiss_real, hiss_imag = normal_pair_lanes(key, first, LANES)
    all_real, all_imag = real + sigma * hiss_real, imag + sigma * hiss_imag
    put_image(io.sonar_image.heard, env, beam, packet, all_real * all_real + all_imag * all_imag)
