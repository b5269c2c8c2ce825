"""Memory of a mechanical beam: beams of different ages as one scan.

Each bearing of the head keeps the last return, when it came and where the vehicle was. In every step in which
a beam comes, the scan is made anew: the new beams as they are, and in the others the remembered returns where
they would be seen from here, the nearest of each bearing. A new beam takes away the remembered returns that
it goes through or replaces.
"""

import taichi as ti

from uuvtai.config import SonarConfig
from uuvtai.kernels.core.beams import beam_bearing, beam_there, beam_towards
from uuvtai.kernels.core.signature import Bundle, Const, In, spread
from uuvtai.kernels.perception.bundles import EchoesIO
from uuvtai.native.launch import quick_launch
from uuvtai.state import SonarScan

NEVER = -(1 << 20)
"""Step of a bearing along which no beam has looked."""

_SAME_M = 0.3
"""A new return replaces a remembered one of its bearing up to so far behind it (EC)."""


@ti.func
def is_new(env, beam, scan: In[SonarScan], sonar_cfg: Const[SonarConfig]):
    """Whether a beam of the scan was taken at its ping; so are all but those of a mechanical sonar."""
    new = True
    if ti.static(sonar_cfg.mechanical):
        new = (beam - scan.new_from[env] + sonar_cfg.n_ray) % sonar_cfg.n_ray < scan.new_count[env]
    return new


@quick_launch
@ti.kernel
def reset_echoes(io: Bundle[EchoesIO]):
    """Nothing was heard yet, in the awake rows."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1:
            for slot in range(io.echoes.step.shape[1]):
                io.echoes.step[env, slot] = NEVER
                io.echoes.pos_x_m[env, slot] = 0.0
                io.echoes.pos_y_m[env, slot] = 0.0
                io.echoes.bearing_w[env, slot] = 0.0
                io.echoes.range_m[env, slot] = 0.0
                io.echoes.intensity[env, slot] = 0.0
                io.echoes.hit[env, slot] = 0
                io.echoes.told[env, slot] = 1
                io.echoes.shown[env, slot] = -1


@quick_launch
@ti.kernel
def recall_echoes(io: Bundle[EchoesIO]):
    """Keep the new beams, and fill the others of the scan with what is remembered."""
    n = ti.static(io.clock.awake.shape[0])
    for env, pad in ti.ndrange(n, ti.static(spread(n))):
        if pad == 0 and io.clock.awake[env] == 1 and io.scan.fresh[env] == 1:
            keep_new(env, io)
            show_old(env, io)


@ti.func
def keep_new(env, io: Bundle[EchoesIO]):
    """Remember the new beams; the others of the scan are emptied."""
    for beam in range(io.sonar_cfg.n_ray):
        io.echoes.shown[env, beam] = -1
        if is_new(env, beam, io.scan, io.sonar_cfg):
            io.echoes.step[env, beam] = io.scan.ping_step[env]
            io.echoes.pos_x_m[env, beam] = io.scan.ping_pos_w[env][0]
            io.echoes.pos_y_m[env, beam] = io.scan.ping_pos_w[env][1]
            io.echoes.bearing_w[env, beam] = io.scan.ping_yaw[env] + beam_bearing(beam, io.sonar_cfg)
            io.echoes.range_m[env, beam] = io.scan.range_m[env, beam]
            io.echoes.intensity[env, beam] = io.scan.intensity[env, beam]
            io.echoes.hit[env, beam] = io.scan.hit[env, beam]
            io.echoes.told[env, beam] = 0
            io.echoes.shown[env, beam] = beam
        else:
            io.scan.range_m[env, beam] = io.sonar_cfg.max_range_m
            io.scan.doppler_m_s[env, beam] = 0.0
            io.scan.intensity[env, beam] = 0.0
            io.scan.hit[env, beam] = 0


@ti.func
def show_old(env, io: Bundle[EchoesIO]):
    """Put every remembered return into the beam that would see it from here."""
    here = io.scan.ping_pos_w[env]
    for slot in range(io.sonar_cfg.n_ray):
        if io.echoes.hit[env, slot] == 1 and not is_new(env, slot, io.scan, io.sonar_cfg):
            bearing, far = io.echoes.bearing_w[env, slot], io.echoes.range_m[env, slot]
            x = io.echoes.pos_x_m[env, slot] + far * ti.cos(bearing) - here[0]
            y = io.echoes.pos_y_m[env, slot] + far * ti.sin(bearing) - here[1]
            towards = beam_towards(ti.atan2(y, x) - io.scan.ping_yaw[env], io.sonar_cfg)
            show_in(env, slot, beam_there(towards, io.sonar_cfg), ti.sqrt(x * x + y * y), io)


@ti.func
def show_in(env, slot, beam, range_m, io: Bundle[EchoesIO]):
    """Show a remembered return at this range of a beam (-1 = none) if it is the nearest there; a new beam
    ends the memory of what is not behind its own return."""
    if beam >= 0:
        if is_new(env, beam, io.scan, io.sonar_cfg):
            if range_m < io.scan.range_m[env, beam] + _SAME_M:
                io.echoes.hit[env, slot] = 0
        elif range_m < io.scan.range_m[env, beam]:
            io.scan.range_m[env, beam] = range_m
            io.scan.intensity[env, beam] = io.echoes.intensity[env, slot]
            io.scan.hit[env, beam] = 1
            io.echoes.shown[env, beam] = slot
