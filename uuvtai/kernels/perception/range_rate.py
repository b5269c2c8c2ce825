"""How fast the distance to what a beam met changes, for those who ask when it will be reached."""

import taichi as ti

from uuvtai.config import SonarConfig
from uuvtai.kernels.core.beams import beam_bearing
from uuvtai.kernels.core.signature import Const, In
from uuvtai.state import SonarScan, TrackState


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
