"""What goes wrong in a sonar beam, error by error; each is compiled away at zero. Packets of beams,
FAR_M = no return."""

import taichi as ti

from uuvtai.kernels.core.geometry import FAR_M, TWO_PI
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
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.sensors.bundles import SonarIO
from uuvtai.kernels.sensors.raycast import nearest_echo

CLOUD_BRIGHTNESS = 0.5
"""Stands for the cosine of incidence of a bubble cloud (EC)."""

_CLOUD_NEAREST_M = 0.5
"""Bubble clouds form between this and the maximum range (EC)."""


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
