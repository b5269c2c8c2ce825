"""Where the beams of the sonar look, for those who ask by beam or by bearing: a ring, whose beams go on
behind the last one, or a fan, which ends."""

import math

import taichi as ti

from uuvtai.config import SonarConfig
from uuvtai.kernels.core.geometry import TWO_PI, wrapped_angle
from uuvtai.kernels.core.simd import LANES, f16x, n_lane
from uuvtai.kernels.core.stage import Const, In
from uuvtai.state import SonarScan, TrackState


@ti.func
def beam_bearing(beam, sonar_cfg: Const[SonarConfig]):
    """[rad] of a beam from ahead, counter-clockwise."""
    bearing = 0.0
    if ti.static(sonar_cfg.is_ring):
        bearing = TWO_PI * beam / sonar_cfg.n_ray
    else:
        bearing = ti.static(sonar_cfg.first_beam_rad) + ti.static(sonar_cfg.beam_step_rad) * beam
    return bearing


@ti.func
def beam_towards(bearing, sonar_cfg: Const[SonarConfig]):
    """Number of the beam nearest to a bearing [rad] from ahead, before ``beam_there``."""
    number = 0
    if ti.static(sonar_cfg.is_ring):
        number = ti.cast(ti.floor(bearing / ti.static(sonar_cfg.beam_step_rad) + 0.5), ti.i32)
    else:
        off = wrapped_angle(bearing) - ti.static(sonar_cfg.first_beam_rad)
        number = ti.cast(ti.floor(off / ti.static(sonar_cfg.beam_step_rad) + 0.5), ti.i32)
    return number


@ti.func
def beam_there(number, sonar_cfg: Const[SonarConfig]):
    """The beam of a number that may lie up to two circles below 0, or beyond the last one; -1 = none looks
    there, which no ring says."""
    beam = number
    if ti.static(sonar_cfg.is_ring):
        beam = (number + 2 * sonar_cfg.n_ray) % sonar_cfg.n_ray
    else:
        beam = ti.select((number >= 0) & (number < sonar_cfg.n_ray), number, -1)
    return beam


@ti.func
def beam_lanes(yaw, first_ray, sonar_cfg: Const[SonarConfig]):
    """Horizontal unit vectors (x lanes, y lanes) of sixteen neighbouring beams, then of the beam after each
    (``yaw`` 0: in the body's frame)."""
    bearing = (yaw + ti.static(sonar_cfg.first_beam_rad)) + ti.static(sonar_cfg.beam_step_rad) * first_ray
    c, s = ti.cos(bearing), ti.sin(bearing)
    x, y, next_x, next_y = f16x(0.0), f16x(0.0), f16x(0.0), f16x(0.0)
    for i in ti.static(range(LANES)):
        cosine, sine = ti.static(math.cos(sonar_cfg.turn_rad(i)), math.sin(sonar_cfg.turn_rad(i)))
        x[i] = c * cosine - s * sine
        y[i] = s * cosine + c * sine
        cosine_n, sine_n = ti.static(math.cos(sonar_cfg.turn_rad(i + 1)), math.sin(sonar_cfg.turn_rad(i + 1)))
        next_x[i] = c * cosine_n - s * sine_n
        next_y[i] = s * cosine_n + c * sine_n
    return x, y, next_x, next_y


@ti.func
def beam_packet(yaw, first_ray, sonar_cfg: Const[SonarConfig]):
    """``beam_lanes`` of as many beams as a packet has (``n_lane``), to the same bits: of one it is the beam
    itself."""
    if ti.static(n_lane() == LANES):
        x, y, _x, _y = beam_lanes(yaw, first_ray, sonar_cfg)
        return x, y
    else:
        x, y = beam_unit(yaw, first_ray - first_ray % LANES, first_ray % LANES, sonar_cfg)
        return ti.Vector([x]), ti.Vector([y])


@ti.func
def beam_unit(yaw, first_ray, lane, sonar_cfg: Const[SonarConfig]):
    """What ``beam_lanes`` says of one of its sixteen beams, or the one after them."""
    bearing = (yaw + ti.static(sonar_cfg.first_beam_rad)) + ti.static(sonar_cfg.beam_step_rad) * first_ray
    c, s = ti.cos(bearing), ti.sin(bearing)
    cosine, sine = 1.0, 0.0
    for i in ti.static(range(LANES + 1)):
        cosine = ti.select(lane == i, ti.static(math.cos(sonar_cfg.turn_rad(i))), cosine)
        sine = ti.select(lane == i, ti.static(math.sin(sonar_cfg.turn_rad(i))), sine)
    return c * cosine - s * sine, s * cosine + c * sine


# ------------------------------------------------------------------------------------------------------------
# How fast the distance to what a beam met changes, for those who ask when it will be reached.


@ti.func
def range_rate(env, beam, scan: In[SonarScan], tracks: In[TrackState], sonar_cfg: Const[SonarConfig]):
    """[m/s] negative = it comes nearer: the beam's Doppler.

    Without Doppler, what the own velocity at the ping makes of it, and the velocity of the moving track that
    explains the return; what no such track explains is taken to rest.
    """
    rate = 0.0
    if ti.static(sonar_cfg.doppler):
        rate = scan.doppler_m_s[env, beam]
    else:
        bearing = beam_bearing(beam, sonar_cfg)
        rate = -(scan.ping_vel_b[env][0] * ti.cos(bearing) + scan.ping_vel_b[env][1] * ti.sin(bearing))
        track = tracks.beam_track[env, beam]
        if track >= 0:
            if tracks.moving[env, track] == 1:
                vel, aim = tracks.state[env, track], scan.ping_yaw[env] + bearing
                rate += vel[2] * ti.cos(aim) + vel[3] * ti.sin(aim)
    return rate
