"""A mechanical sonar: one beam, which a motor turns from bearing to bearing, for a while each.

Its k-th step ends after k (2 maximum range / speed of sound + overhead); a beam counts as taken at the end of
the control step in which that is, from where the vehicle is then: at 20 ms less than a step of the head, so
that hardly ever two fall into one. A beam is as wide as ``beam_width_deg``: sixteen rays part it, and the
nearest return of them is the beam's. Errors are those of ``sonar.py``, drawn once for the beam.
"""

import math

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.core.beams import beam_bearing
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.simd import LANES, f16x
from uuvtai.kernels.core.stage import Bundle, Const, n_envs
from uuvtai.kernels.sensors.io import SonarIO
from uuvtai.kernels.sensors.raycast import nearest_echo
from uuvtai.kernels.sensors.sonar import note_ping, place_sonar, reported, sonar_mount, start_cloud


@quick_launch
@ti.kernel
def turn_head(io: Bundle[SonarIO]):
    """Take the beams that are due; ``scan.fresh`` is 1 only where there is one. The first is due at
    step 0."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            step = io.clock.step[env]
            begin, end = ti.cast(0, ti.i64), head_steps(step, io)
            if step > 0:
                begin = head_steps(step - 1, io) + 1
            io.scan.fresh[env] = ti.cast(begin <= end, ti.i32)
            if begin <= end:
                take_beams(env, begin, end, step, io)


@ti.func
def head_steps(step, io: Bundle[SonarIO]):
    """Steps of the head that have ended by a control step."""
    return (
        ti.cast(step, ti.i64)
        * ti.static(round(1e6 * io.episode_cfg.control_dt_s))
        // ti.static(io.sonar_cfg.step_us)
    )


@ti.func
def take_beams(env, begin, end, step, io: Bundle[SonarIO]):
    """Take the beams of the head's steps ``begin`` to ``end``, each bearing once."""
    place_sonar(env, io)
    if ti.static(io.sonar_cfg.bubble_clouds_per_s > 0):
        start_cloud(env, io)
    first, count = new_beams(begin, end, ti.static(io.sonar_cfg.n_ray), ti.static(io.sonar_cfg.is_ring))
    io.scan.new_from[env], io.scan.new_count[env] = first, count
    for k in range(count):
        take_beam(env, (first + k) % io.sonar_cfg.n_ray, step, io)
    note_ping(env, step, io)


@ti.func
def new_beams(begin, end, n_ray: Const[int], is_ring: Const[bool]):
    """(first, number) of the neighbouring beams along which the head looks in its steps ``begin`` to
    ``end``."""
    first, count = 0, 0
    if ti.static(is_ring):
        first = ti.cast(begin % n_ray, ti.i32)
        count = ti.cast(ti.min(end - begin + 1, n_ray), ti.i32)
    else:
        low, high, k = n_ray, -1, begin
        while k <= end and k < begin + 2 * n_ray:
            there = ti.cast(k % ti.static(2 * n_ray - 2), ti.i32)
            beam = ti.min(there, ti.static(2 * n_ray - 2) - there)
            low, high = ti.min(low, beam), ti.max(high, beam)
            k += 1
        first, count = low, high - low + 1
    return first, count


@ti.func
def take_beam(env, beam, step, io: Bundle[SonarIO]):
    """Write what one beam hears to the scan."""
    mount = sonar_mount(env, io)
    bearing = beam_bearing(beam, io.sonar_cfg)
    half = ti.static(io.sonar_cfg.half_width_rad)
    c, s = ti.cos(bearing), ti.sin(bearing)
    mx, my = c * mount.heading[0] - s * mount.heading[1], s * mount.heading[0] + c * mount.heading[1]
    ux, uy = f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        off = ti.static(half * ((2 * i + 1) / LANES - 1))
        cosine, sine = ti.static(math.cos(off), math.sin(off))
        ux[i] = cosine * mx - sine * my
        uy[i] = sine * mx + cosine * my
    wedge = ti.Vector([mx, my, ti.static(math.cos(half)), ti.static(math.sin(half))])
    across = nearest_echo(env, mount.pos[0], mount.pos[1], ux, uy, 0.0, wedge, True, io)
    nearest, lane = FAR_M, 0
    for i in ti.static(range(LANES)):
        if across.range_m[i] < nearest:
            nearest, lane = across.range_m[i], i
    vx, vy = f16x(ux[lane]), f16x(uy[lane])  # from here on lane 0 is the beam
    echo = nearest_echo(env, mount.pos[0], mount.pos[1], vx, vy, 0.0, wedge, True, io)
    range_m, _still, intensity = reported(env, echo, vx, vy, mount, wedge, beam, step, io)
    put_beam(env, beam, range_m, intensity, io)


@ti.func
def put_beam(env, beam, range_m, intensity, io: Bundle[SonarIO]):
    """Write lane 0 as a beam of the scan."""
    hit = range_m[0] < FAR_M
    io.scan.range_m[env, beam] = ti.select(hit, range_m[0], io.sonar_cfg.max_range_m)
    io.scan.doppler_m_s[env, beam] = 0.0
    io.scan.intensity[env, beam] = ti.select(hit, intensity[0], 0.0)
    io.scan.hit[env, beam] = ti.select(hit, 1, 0)
