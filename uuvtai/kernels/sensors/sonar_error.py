"""What goes wrong in a sonar beam, error by error; each is compiled away at zero. Packets of sixteen beams, FAR_M = no return."""

import taichi as ti

from uuvtai.config import EpisodeConfig, SonarConfig, TankConfig
from uuvtai.kernels.core.geometry import FAR_M, TWO_PI
from uuvtai.kernels.core.lanes import LANES, i16x
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
from uuvtai.kernels.core.signature import Const, In, Out
from uuvtai.kernels.sensors.raycast import nearest_echo
from uuvtai.state import ClockState, EpisodeState, SonarMemory, WorldState

CLOUD_BRIGHTNESS = 0.5
"""Stands for the cosine of incidence of a bubble cloud (EC)."""

_CLOUD_NEAREST_M = 0.5
"""Bubble clouds form between this and the maximum range (EC)."""


@ti.func
def ghosted(
    env,
    echo,
    cosine,
    ux,
    uy,
    pos,
    slope,
    wedge,
    key,
    step,
    ray,
    memory: In[SonarMemory],
    world: In[WorldState],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
):
    """(range, rate of change of range from the surfaces' motion), where one specular bounce replaces the direct return in chosen beams.

    The path is sensor - p1 - p2 with p2 along the mirrored direction m; its length changes by v1.u + (v2 - v1).m - v_sensor.u.
    """
    range_m = echo.range_m
    away = ux * echo.vel_x + uy * echo.vel_y
    out_range, out_away = range_m + 0.0, away + 0.0
    if ti.static(sonar.ghost > 0):
        chosen = uniform_lanes(stream_key(key, step, STREAM_SONAR_GHOST), ray) < sonar.ghost
        if any_lane(chosen):
            mx, my = ux + 2.0 * cosine * echo.normal_x, uy + 2.0 * cosine * echo.normal_y
            x, y = pos[0] + range_m * ux, pos[1] + range_m * uy
            second = nearest_echo(env, x, y, pos[2], mx, my, range_m, slope, wedge, False, memory, world, tank)
            path = range_m + second.range_m
            heard = chosen & (path <= sonar.max_range_m)
            extra = mx * (second.vel_x - echo.vel_x) + my * (second.vel_y - echo.vel_y)
            out_range = ti.select(heard, path, range_m)
            out_away = ti.select(heard, away + extra, away)
    return out_range, out_away


@ti.func
def any_lane(mask):
    """Whether a condition holds in any lane."""
    return mask.any()


@ti.func
def grazing_lost(range_m, cosine, sonar: Const[SonarConfig]):
    """Range, or FAR_M where the surface is met too flatly."""
    out = range_m + 0.0
    if ti.static(sonar.grazing_cosine > 0):
        out = ti.select(cosine < sonar.grazing_cosine, FAR_M, range_m)
    return out


@ti.func
def start_cloud(
    env, memory: Out[SonarMemory], episode: In[EpisodeState], clock: In[ClockState], sonar: Const[SonarConfig], rules: Const[EpisodeConfig]
):
    """A bubble cloud may form in a free slot; it keeps its range and its bearing in the world (beam counted from the x axis)."""
    key = stream_key(episode.key[env], clock.step[env], STREAM_SONAR_CLUTTER)
    first = ti.static(3 * sonar.n_ray)
    if uniform(key, first) < ti.static(sonar.bubble_clouds_per_s * sonar.period_steps * rules.control_dt_s):
        free = -1
        for cloud in range(memory.cloud_until.shape[1]):
            if free < 0 and memory.cloud_until[env, cloud] <= clock.step[env]:
                free = cloud
        if free >= 0:
            width = uniform_in(key, first + 1, sonar.bubble_beams[0], sonar.bubble_beams[1] + 1)
            lasts = uniform_in(key, first + 2, sonar.bubble_s[0], sonar.bubble_s[1])
            memory.cloud_width[env, free] = ti.cast(width, ti.i32)
            memory.cloud_beam[env, free] = ti.cast(uniform_in(key, first + 3, 0.0, sonar.n_ray), ti.i32)
            memory.cloud_range_m[env, free] = uniform_in(key, first + 4, _CLOUD_NEAREST_M, sonar.max_range_m)
            memory.cloud_until[env, free] = clock.step[env] + ti.cast(ti.ceil(lasts / rules.control_dt_s), ti.i32)


@ti.func
def cloud_covered(env, range_m, away, cosine, heading, ray, step, memory: In[SonarMemory], sonar: Const[SonarConfig]):
    """(range, surface's rate, brightness) where bubble clouds, still in the water, hide what is behind them."""
    out_range, out_away, out_bright = range_m + 0.0, away + 0.0, cosine + 0.0
    if ti.static(sonar.bubble_clouds_per_s > 0):
        turn = ti.cast(ti.round(ti.atan2(heading[1], heading[0]) * ti.static(sonar.n_ray / TWO_PI)), ti.i32)
        index = i16x(0)
        for i in ti.static(range(LANES)):
            index[i] = ray + turn + i
        for cloud in range(memory.cloud_until.shape[1]):
            if step < memory.cloud_until[env, cloud]:
                offset = (index - memory.cloud_beam[env, cloud] + 2 * sonar.n_ray) % sonar.n_ray
                distance = ti.cast(memory.cloud_range_m[env, cloud], ti.f32)
                covered = (offset < memory.cloud_width[env, cloud]) & (out_range > distance)
                out_range = ti.select(covered, distance, out_range)
                out_away = ti.select(covered, 0.0, out_away)
                out_bright = ti.select(covered, CLOUD_BRIGHTNESS, out_bright)
    return out_range, out_away, out_bright


@ti.func
def missed(range_m, key, step, ray, sonar: Const[SonarConfig]):
    """Range, or FAR_M where the return is missed."""
    out = range_m + 0.0
    if ti.static(sonar.missed_return > 0):
        out = ti.select(uniform_lanes(stream_key(key, step, STREAM_SONAR_DROP), ray) < sonar.missed_return, FAR_M, range_m)
    return out


@ti.func
def range_noisy(range_m, key, step, ray, sonar: Const[SonarConfig]):
    """Range with its normal error (sigma = a + b r) and its positive exponential jitter."""
    out = range_m + 0.0
    stream = stream_key(key, step, STREAM_SONAR_RANGE)
    if ti.static(sonar.range_sigma_m > 0 or sonar.range_sigma_slope > 0):
        error, _of_doppler = normal_pair_lanes(stream_key(key, step, STREAM_SONAR_NORMAL), ray)
        out += (sonar.range_sigma_m + sonar.range_sigma_slope * range_m) * error
    if ti.static(sonar.range_jitter_m > 0):
        out -= sonar.range_jitter_m * ti.log(1.0 - uniform_lanes(stream, sonar.n_ray + ray))
    return out


@ti.func
def falsely_returned(range_m, away, bright, key, step, ray, sonar: Const[SonarConfig]):
    """(range, surface's rate, brightness) where clutter at any range, still in the water, replaces whatever the beam would have told."""
    out_range, out_away, out_bright = range_m + 0.0, away + 0.0, bright + 0.0
    if ti.static(sonar.false_return > 0):
        stream = stream_key(key, step, STREAM_SONAR_CLUTTER)
        chosen = uniform_lanes(stream, ray) < sonar.false_return
        out_range = ti.select(chosen, sonar.max_range_m * uniform_lanes(stream, sonar.n_ray + ray), range_m)
        out_away = ti.select(chosen, 0.0, away)
        out_bright = ti.select(chosen, uniform_lanes(stream, 2 * sonar.n_ray + ray), bright)
    return out_range, out_away, out_bright


@ti.func
def cut_off(range_m, sonar: Const[SonarConfig]):
    """Range rounded to the quantum and not negative; FAR_M beyond the maximum range."""
    told = ti.max(range_m, 0.0)
    if ti.static(sonar.range_quantum_m > 0):
        told = ti.floor(ti.max(range_m, 0.0) * ti.static(1.0 / sonar.range_quantum_m) + 0.5) * sonar.range_quantum_m
    return ti.select(told > sonar.max_range_m, FAR_M, told)


@ti.func
def doppler_noisy(doppler, key, step, ray, sonar: Const[SonarConfig]):
    """Doppler with its normal error, the other of the range's pair (one draw serves both); an outlier is uniform within +- a limit."""
    out = doppler + 0.0
    stream = stream_key(key, step, STREAM_SONAR_DOPPLER)
    if ti.static(sonar.doppler_sigma_m_s > 0):
        _of_range, error = normal_pair_lanes(stream_key(key, step, STREAM_SONAR_NORMAL), ray)
        out += sonar.doppler_sigma_m_s * error
    noisy = out + 0.0
    if ti.static(sonar.doppler_outlier > 0):
        chosen = uniform_lanes(stream, sonar.n_ray + ray) < sonar.doppler_outlier
        wild = sonar.doppler_outlier_m_s * (2.0 * uniform_lanes(stream, 2 * sonar.n_ray + ray) - 1.0)
        noisy = ti.select(chosen, wild, out)
    return noisy
