"""Clearance with the nearest site, whole maps computed anew, against SciPy's and OpenCV's distance transforms
of the same maps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.common import Job, Row, seconds_per_call
from tests.map_bits import nearest_sites, put_layers
from uuvtai import state
from uuvtai.common.enums import clearance_m
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import ClearanceConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.grid import outside_cells
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.planning import clearance
from uuvtai.kernels.planning.io import ClearanceIO
from uuvtai.sim.setup import load_bounds
from uuvtai.sim.stages import bind

THREADS = 1
FLOOR = 1.0
_MAPS = 64
"""Maps of a kind: small batches stay in the cache for the peers, too."""
_TOLERANCE_M = 1e-5
_MASK_ERROR = 0.02
"""of distances by OpenCV's mask of 5 x 5 cells, the only one that tells sites: sqrt(1 + 0.1969^2) at most"""
_NOTES = {
    "cv2.distanceTransform": "without sites",
    "cv2 with labels": f"with sites, distances within {100 * _MASK_ERROR:g} % only",
    "SciPy": "with sites",
}
_WHOLE_M = 3.2
"""More than half of a pool's width: every cell of it has a site within this, so that nothing is cut off."""


def occupancies(rng: np.random.Generator, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    """Maps (n_map, n_row, n_col) by kind, True where occupied."""
    row, col = np.indices(shape)
    obstacles = np.zeros((_MAPS, *shape), bool)
    for i in range(8 * _MAPS):
        away = np.hypot(row - rng.uniform(0, shape[0]), col - rng.uniform(0, shape[1]))
        obstacles[i % _MAPS] |= np.abs(away - rng.uniform(2, 6)) < 0.7
    return {
        "empty": np.zeros((_MAPS, *shape), bool),
        "8 obstacles": obstacles,
        "2 % at random": rng.random((_MAPS, *shape)) < 0.02,
        "20 % at random": rng.random((_MAPS, *shape)) < 0.2,
    }


class Maps:
    """Our clearance of some worlds' maps, and the peers' of the same cells."""

    def __init__(self, world: str) -> None:
        config = load_config(world)
        self.config, self.cell_m = config, config.mapping.cell_m
        self.outside = np.array(outside_cells(config.world.tank, self.cell_m))
        n_row, n_col = self.outside.shape
        sizes = {"n_env": _MAPS, "n_row": n_row, "n_col": n_col, "n_packet": n_col // LANES, "n_slot": _MAPS}
        names = ("ClearanceState", "ClearanceMemory", "MapState", "GridMask", "ClockState")
        self.structs = [state.allocate(getattr(state, name), sizes) for name in names]
        self.clearance, self.memory, self.grid_map, self.mask, clock = self.structs
        clock.active.fill(1)
        load_bounds(self.mask, self.outside)

    def put(self, occupied: np.ndarray) -> None:
        """Take these maps."""
        put_layers(self.grid_map, occupied, np.zeros_like(occupied), self.config.mapping.occupied)
        self.images = [np.where(one | self.outside, 0, 255).astype(np.uint8) for one in occupied]

    def ours(self, cfg: ClearanceConfig):
        """One call computes every map anew."""

        io = bind(ClearanceIO, *self.structs, cfg, self.config.mapping, self.config.voronoi)

        def call() -> None:
            io.clearance_memory.limit.fill(0)
            clearance.compute_clearance(io)

        return call

    def peers(self) -> dict[str, Callable[[], list]]:
        """One call of each transforms every map; of exact distances OpenCV gives no sites."""
        exact = partial(cv2.distanceTransform, distanceType=cv2.DIST_L2, maskSize=cv2.DIST_MASK_PRECISE)
        masked = partial(cv2.distanceTransformWithLabels, distanceType=cv2.DIST_L2, maskSize=cv2.DIST_MASK_5,
                         labelType=cv2.DIST_LABEL_PIXEL)  # fmt: skip
        both = partial(distance_transform_edt, return_indices=True)
        calls = dict(zip(_NOTES, (exact, masked, both), strict=True))
        return {
            name: lambda call=call: [call(image) for image in self.images] for name, call in calls.items()
        }

    def check(self, cfg: ClearanceConfig) -> None:
        """Raise RuntimeError unless all agree and our sites lie where they are said to."""
        self.ours(cfg)()
        site = self.clearance.site.to_numpy()
        found = clearance_m(site, self.config.model_copy(update={"clearance": cfg}))
        rows, cols = nearest_sites(site)
        row, col = np.indices(self.outside.shape)
        peers = zip(*(call() for call in self.peers().values()), strict=True)
        for i, (image, (precise, (masked, _), (exact, _))) in enumerate(zip(self.images, peers, strict=True)):
            if (np.abs(masked - exact) > _MASK_ERROR * exact + _TOLERANCE_M).any():
                raise RuntimeError(f"map {i}: OpenCV's mask is farther from SciPy than its error")
            cut = [np.minimum(one * self.cell_m, cfg.max_m) for one in (precise, exact)]
            near = rows[i] >= 0
            reach = np.hypot(rows[i] - row, cols[i] - col)[near] * self.cell_m
            worst = max(
                *(np.abs(found[i] - one).max() for one in cut), np.abs(reach - found[i][near]).max(initial=0)
            )
            if worst > _TOLERANCE_M or image[rows[i][near], cols[i][near]].any():
                raise RuntimeError(f"map {i}: {worst} m apart")


def measure(job: Job) -> list[Row]:
    """Maps per second of one core, of the pool and of the maze, empty and full."""
    start_taichi(job.device)
    cv2.setNumThreads(1)
    rows = []
    for world, cfgs in (
        ("pool", (ClearanceConfig(), ClearanceConfig(max_m=_WHOLE_M))),
        ("maze", (ClearanceConfig(),)),
    ):
        maps = Maps(world)
        n_row, n_col = maps.outside.shape
        for kind, occupied in occupancies(np.random.default_rng(0), (n_row, n_col)).items():
            maps.put(occupied)
            for cfg in cfgs:
                job.say(f"{world}, {kind}, to {cfg.max_m} m")
                maps.check(cfg)
                sides = {"ours": maps.ours(cfg), **maps.peers()}
                cost = seconds_per_call(sides, job.seconds / 3)
                what, each = f"{world} {n_col} x {n_row}, {kind}, to {cfg.max_m:g} m", "maps/s per core"
                rate = {side: _MAPS / seconds for side, seconds in cost.items()}
                rows += [
                    Row(what, rate["ours"], each, rate[name], name, floor=FLOOR, floor_on="ratio", note=note)
                    for name, note in _NOTES.items()
                ]
    return rows
