"""Sonar of 256 beams without noise (range, Doppler, intensity) against MuJoCo's mj_multiRay and Embree (range
only) in the same scenes."""

from __future__ import annotations

import mujoco
import numpy as np

from benchmarks.common import Job, Row, seconds_per_call
from benchmarks.peers.sonar_embree import Meshes
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
"""times MuJoCo's rate"""
N_OBSTACLE = 14
"""Eight at rest and six that move, as in the world that the speed of the whole step is measured in."""
_MODELS = 64
"""Scenes prepared for the peers: the first of ours."""
_TOLERANCE_M = 2e-3
PEERS = ("mj_multiRay", "Embree")
_GRAZING_SHARE = 1e-3
"""Beams that pass an edge within single precision may give either answer."""


class Rays:
    """The peers' rays, everything prepared: one call casts the beams of a scene."""

    def __init__(self, scene: dict, n_ray: int, max_range_m: float) -> None:
        tank, envs = TankConfig(), range(_MODELS)
        self.casters = [scenes.Caster(scene, env, tank) for env in envs]
        self.inside, self.around = ([Meshes(scene, e, tank, b) for e in envs] for b in (False, True))
        bearings = [beam_headings(scene["quat"][env], n_ray) for env in envs]
        rays = [np.stack([np.cos(b), np.sin(b), np.zeros(n_ray)], axis=1) for b in bearings]
        self.rays = [(np.array(scene["pos"][env]), rays[env].ravel()) for env in envs]
        tiled = [np.tile(start, (n_ray, 1)) for start, _rays in self.rays]
        self.single = [
            (np.asarray(a, np.float32), np.asarray(b, np.float32)) for a, b in zip(tiled, rays, strict=True)
        ]
        self.geom, self.found, self.max_range_m = np.zeros(n_ray, np.int32), np.zeros(n_ray), max_range_m

    def mujoco(self, env: int) -> np.ndarray:
        """Range of every beam [m]."""
        caster, n = self.casters[env], len(self.found)
        mujoco.mj_multiRay(
            caster.model, caster.data, *self.rays[env], None, 1, -1, self.geom, self.found, None, n,
            self.max_range_m,
        )  # fmt: skip
        return self.found

    def embree(self, env: int) -> np.ndarray:
        """Range of every beam [m], the greatest where there is no echo."""
        return self.inside[env].cast(*self.single[env], self.max_range_m)

    def apart(self, scan: state.SonarScan) -> dict[str, int]:
        """Beams of our scan of flat beams that saw something else or something elsewhere than MuJoCo, and
        those whose range is not between Embree's in meshes around the obstacles and in meshes inside them."""
        hits = scan.hit.to_numpy() == 1
        ranges = np.where(hits, scan.range_m.to_numpy(), self.max_range_m)
        count: dict[str, int] = dict.fromkeys(PEERS, 0)
        for env in range(_MODELS):
            found = self.mujoco(env)
            seen = (self.geom >= 0) & (found <= self.max_range_m)
            far = np.abs(ranges[env] - found)[seen & hits[env]] > _TOLERANCE_M
            count["mj_multiRay"] += int((hits[env] != seen).sum() + far.sum())
            least = self.around[env].cast(*self.single[env], self.max_range_m) - _TOLERANCE_M
            most = self.embree(env) + _TOLERANCE_M
            count["Embree"] += int(((ranges[env] < least) | (ranges[env] > most)).sum())
        return count


def measure(job: Job) -> list[Row]:
    """Scans per second of one core: with flat beams, which is what MuJoCo casts, and with the vertical
    aperture of the product."""
    n_env = 128 if job.quick else 1024
    start_taichi(job.device)
    flat, wide = SonarConfig(vertical_half_aperture_deg=0.0), SonarConfig()
    scene = scenes.random_scenes(np.random.default_rng(0), n_env, N_OBSTACLE, TankConfig())
    sizes = {
        "n_env": n_env, "n_obstacle": N_OBSTACLE, "n_ray": flat.n_ray, "n_latency": 2, "n_cloud": 8,
        "n_thruster": 6, "n_heard": 1, "n_bin": 1, "n_elevation": 1,
    }  # fmt: skip
    names = (
        "SonarScan", "SonarMemory", "Proprioception", "VehicleState", "WorldState", "EpisodeState",
        "ClockState", "SonarImage",
    )  # fmt: skip
    structs = scan, memory, _ego, vehicle, world, _episode, clock, _image = [
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
    if wrong := {name: count for name, count in apart.items() if count > _GRAZING_SHARE * beams}:
        raise RuntimeError(f"of {beams} beams differ: {wrong}")

    def all_scenes(cast):
        return lambda: [cast(env) for env in range(_MODELS)]

    theirs = dict(zip(PEERS, map(all_scenes, (peer.mujoco, peer.embree)), strict=True))
    cost = seconds_per_call({"flat": ours(flat), "wide": ours(wide), **theirs}, job.seconds)
    rate = {side: (_MODELS if side in PEERS else n_env) / seconds for side, seconds in cost.items()}
    return [
        Row(
            f"{flat.n_ray} {what}, {N_OBSTACLE} obstacles", rate[side], "scans/s per core", rate[name], name,
            floor=FLOOR if name == PEERS[0] else None, floor_on="ratio",
            note=f"{1e6 / rate[side]:.2f} against {1e6 / rate[name]:.1f} us, its call from Python included; "
            f"{apart[name]} of {beams} beams apart",
            details={"num_envs": n_env, "beams_apart": apart[name]},
        )
        for side, what in (("flat", "flat beams"), ("wide", "beams with their aperture"))
        for name in PEERS
    ]  # fmt: skip
