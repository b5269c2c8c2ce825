"""Sonar of 256 beams without noise (range, Doppler, intensity) against MuJoCo's mj_multiRay (range only) in
the same scenes."""

from __future__ import annotations

import mujoco
import numpy as np

from benchmarks.common import Job, Row, seconds_per_call
from tests.oracles import scenes
from tests.oracles.sonar import beam_headings
from uuvtai import state
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import EpisodeConfig, SonarConfig, TankConfig
from uuvtai.kernels.sensors import sonar
from uuvtai.kernels.sensors.io import SonarIO
from uuvtai.sim.stages import bind

THREADS = 1
FLOOR = 8.0
N_OBSTACLE = 14
"""Eight at rest and six that move, as in the world that the speed of the whole step is measured in."""
_MODELS = 64
"""Scenes compiled for MuJoCo: the first of ours."""
_TOLERANCE_M = 2e-3
_GRAZING_SHARE = 1e-3
"""Beams that pass an edge within single precision may give either answer."""


class Rays:
    """MuJoCo's rays, everything prepared: one call casts the beams of the next scene."""

    def __init__(self, scene: dict, n_ray: int, max_range_m: float) -> None:
        self.casters = [scenes.Caster(scene, env, TankConfig()) for env in range(_MODELS)]
        bearings = [beam_headings(scene["quat"][env], n_ray) for env in range(_MODELS)]
        self.rays = [np.stack([np.cos(b), np.sin(b), np.zeros(n_ray)], axis=1).ravel() for b in bearings]
        self.starts = [np.array(scene["pos"][env]) for env in range(_MODELS)]
        self.geom, self.found, self.max_range_m = np.zeros(n_ray, np.int32), np.zeros(n_ray), max_range_m

    def cast(self, env: int) -> np.ndarray:
        """Range of every beam [m]."""
        caster, n = self.casters[env], len(self.found)
        mujoco.mj_multiRay(
            caster.model,
            caster.data,
            self.starts[env],
            self.rays[env],
            None,
            1,
            -1,
            self.geom,
            self.found,
            None,
            n,
            self.max_range_m,
        )
        return self.found

    def cast_all(self) -> None:
        """Every scene once."""
        for env in range(_MODELS):
            self.cast(env)

    def apart(self, scan: state.SonarScan) -> int:
        """Beams of our scan of flat beams that saw something else or something elsewhere."""
        ranges, hits = scan.range_m.to_numpy(), scan.hit.to_numpy() == 1
        count = 0
        for env in range(_MODELS):
            found = self.cast(env)
            seen = (self.geom >= 0) & (found <= self.max_range_m)
            count += int(
                (hits[env] != seen).sum()
                + (np.abs(ranges[env] - found)[seen & hits[env]] > _TOLERANCE_M).sum()
            )
        return count


def measure(job: Job) -> list[Row]:
    """Scans per second of one core: with flat beams, which is what MuJoCo casts, and with the vertical
    aperture of the product."""
    n_env = 128 if job.quick else 1024
    start_taichi(job.device)
    flat, wide = SonarConfig(vertical_half_aperture_deg=0.0), SonarConfig()
    scene = scenes.random_scenes(np.random.default_rng(0), n_env, N_OBSTACLE, TankConfig())
    sizes = {
        "n_env": n_env,
        "n_obstacle": N_OBSTACLE,
        "n_ray": flat.n_ray,
        "n_latency": 2,
        "n_cloud": 8,
        "n_thruster": 6,
    }
    names = (
        "SonarScan",
        "SonarMemory",
        "Proprioception",
        "VehicleState",
        "WorldState",
        "EpisodeState",
        "ClockState",
    )
    structs = scan, memory, _ego, vehicle, world, _episode, clock = [
        state.allocate(getattr(state, name), sizes) for name in names
    ]
    scenes.load(scene, vehicle, world)
    clock.active.fill(1)
    sonar.reset_sonar(bind(SonarIO, scan, memory, clock, partial=True))
    peer = Rays(scene, flat.n_ray, flat.max_range_m)

    def ours(config: SonarConfig):
        io = bind(SonarIO, *structs, config, TankConfig(), EpisodeConfig())
        return lambda: sonar.cast_sonar(io)

    ours(flat)()
    apart, beams = peer.apart(scan), _MODELS * flat.n_ray
    if apart > _GRAZING_SHARE * beams:
        raise RuntimeError(f"{apart} of {beams} beams differ from MuJoCo's")

    cost = seconds_per_call({"flat": ours(flat), "wide": ours(wide), "peer": peer.cast_all}, job.seconds)
    return [
        Row(
            what=f"{flat.n_ray} {what}, {N_OBSTACLE} obstacles",
            ours=n_env / cost[side],
            peer=_MODELS / cost["peer"],
            peer_name="mj_multiRay",
            unit="scans/s per core",
            floor=FLOOR,
            floor_on="ratio",
            note=f"{1e6 * cost[side] / n_env:.2f} against {1e6 * cost['peer'] / _MODELS:.1f} us; {apart} of "
            f"{beams} beams apart",
            details={"num_envs": n_env, "beams_apart": apart},
        )
        for side, what in (("flat", "flat beams"), ("wide", "beams with their aperture"))
    ]
