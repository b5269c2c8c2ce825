"""Clearance against scipy's transform, sites and ties, invariants of any map, and what reads it."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bundles import Stage, put
from tests.map_bits import nearest_sites, put_layers
from tests.oracles.clearance import clearance_of, sites_of
from uuvtai.common.enums import clearance_m
from uuvtai.config import ClearanceConfig, MappingConfig, TankConfig, VoronoiConfig
from uuvtai.kernels.core.grid import grid_shape, outside_cells
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.planning import clearance
from uuvtai.kernels.planning.io import ClearanceIO
from uuvtai.sim.setup import load_bounds
from uuvtai.state import PACKET

N_ENV = 8
TANK = TankConfig(x_m=(0.0, 7.0), y_m=(0.0, 5.0))
POND = TankConfig(shape="circle", x_m=(0.0, 7.0), y_m=(0.0, 5.0))
MAP, CFG, VORONOI = MappingConfig(), ClearanceConfig(), VoronoiConfig()
FUSED = VoronoiConfig(use="fused")
SHORT = ClearanceConfig(max_m=0.75)
"""not a multiple of the cell"""
WIDE = ClearanceConfig(max_m=4.5)
"""reaches farther than half a word of rows"""
SHAPE = grid_shape(TANK, MAP.cell_m)

ROUNDING_M = 5e-7
"""float32 square root and product of numbers up to 2 m"""


class Rig(Stage):
    """The structs of clearance."""

    sizes = {"n_row": SHAPE[0], "n_col": SHAPE[1], "n_packet": SHAPE[1] // LANES}

    def __init__(self, n_env=N_ENV, n_slot=4):
        super().__init__(n_env=n_env, n_slot=n_slot)
        self.clock.active.fill(1)
        self.set_outside(np.array(outside_cells(TANK, MAP.cell_m)))

    def set_outside(self, outside):
        self.outside = outside
        load_bounds(self.mask, outside)

    def compute(self, static, dynamic=None, cfg=CFG, voronoi=VORONOI):
        """(clearance, site_row, site_col) of these layers [n_env, row, col]."""
        static32 = static.astype(np.float32)
        put_layers(
            self.grid_map,
            static32,
            np.zeros_like(static32) if dynamic is None else dynamic.astype(np.float32),
            MAP.occupied,
        )
        return self.launch(cfg, voronoi)

    def launch(self, cfg=CFG, voronoi=VORONOI):
        clearance.compute_clearance(self.io(ClearanceIO, cfg, MAP, voronoi))
        kept = self.clearance.site.to_numpy()
        return (clearance_m(kept, SimpleNamespace(clearance=cfg, mapping=MAP)), *nearest_sites(kept))


stage = Rig.fixture()


@pytest.fixture(autouse=True)
def _fresh_clock(stage):
    put(stage.clock, active=1, step=0)
    stage.set_outside(np.array(outside_cells(TANK, MAP.cell_m)))


def maps_of(seed):
    """Eight kinds of maps: empty, one cell, sparse, dense, full, blobs, baffles with gaps, corridors."""
    rng = np.random.default_rng(seed)
    n_row, n_col = SHAPE
    maps = np.zeros((N_ENV, n_row, n_col))
    maps[1, rng.integers(n_row), rng.integers(n_col)] = 1
    maps[2][rng.random(SHAPE) < 0.003] = 1
    maps[3][rng.random(SHAPE) < 0.3] = 1
    maps[4] = 1
    row, col = np.ogrid[:n_row, :n_col]
    for _ in range(4):
        r, c, radius = rng.integers(n_row), rng.integers(n_col), rng.uniform(1, 5)
        maps[5][(row - r) ** 2 + (col - c) ** 2 < radius**2] = 1
    for k, c in enumerate(range(12, n_col - 8, 14)):
        maps[6][(slice(14, None) if k % 2 else slice(0, n_row - 14)), c] = 1
    corridors = np.kron(rng.random((-(-n_row // 6), -(-n_col // 6))) < 0.5, np.ones((6, 6)))
    maps[7] = corridors[:n_row, :n_col] * (rng.random(SHAPE) < 0.97)
    # values around the threshold instead of 0 and 1
    return np.where(maps > 0, rng.uniform(0.5, 1.0, maps.shape), rng.uniform(0.0, 0.499, maps.shape))


def check(found, sites, cfg):
    """Distance equals scipy's, and the site given is one and lies that far away."""
    distance, site_row, site_col = found
    expected, near = clearance_of(sites, MAP.cell_m, cfg.max_m)
    assert np.abs(distance - expected).max() <= ROUNDING_M
    np.testing.assert_array_equal(site_row >= 0, near)
    np.testing.assert_array_equal(site_col >= 0, near)
    assert (distance[~near] == np.float32(cfg.max_m)).all()
    rows, cols = np.nonzero(near)
    assert sites[site_row[near], site_col[near]].all()
    reach = np.hypot(site_row[near] - rows, site_col[near] - cols) * MAP.cell_m
    assert np.abs(reach - distance[near]).max(initial=0) <= ROUNDING_M


# ----------------------------------------------------------------------------------------------------- oracle


@pytest.mark.parametrize("seed", range(2))
def test_equals_the_exact_transform(stage, seed):
    static = maps_of(seed)
    found = stage.compute(static)
    for env in range(N_ENV):
        check([f[env] for f in found], sites_of(static[env], 0, stage.outside, MAP.occupied, "static"), CFG)


@pytest.mark.parametrize(
    "outside", [outside_cells(TANK, MAP.cell_m), outside_cells(POND, MAP.cell_m)], ids=["tank", "pond"]
)
def test_inflation_brings_obstacles_nearer_and_leaves_the_boundary(stage, outside):
    """min(d_occ - inflation, d_bnd) by the nearest site; the boundary's own distance and far water stay."""
    stage.set_outside(np.array(outside))
    static, cfg = maps_of(8), ClearanceConfig(inflate_m=0.08)
    plain = stage.compute(static)
    # the same map again, else there would be nothing to do
    stage.clearance_memory.limit.fill(0)
    distance, site_row, site_col = stage.compute(static, cfg=cfg)
    stage.clearance_memory.limit.fill(0)
    np.testing.assert_array_equal(plain[1], site_row)
    np.testing.assert_array_equal(plain[2], site_col)
    nearer = 0
    for env in range(N_ENV):
        occupied = (static[env] >= MAP.occupied) & ~stage.outside
        to_obstacle = clearance_of(occupied, MAP.cell_m, 99.0)[0]
        to_bound = clearance_of(stage.outside, MAP.cell_m, 99.0)[0]
        near = (site_row[env] >= 0) & ~stage.outside[site_row[env], site_col[env]]
        expected = np.where(near, np.maximum(to_obstacle - 0.08, 0.0), np.minimum(to_bound, CFG.max_m))
        assert np.abs(distance[env] - expected).max() <= ROUNDING_M
        letter = np.minimum(np.minimum(np.maximum(to_obstacle - 0.08, 0.0), to_bound), CFG.max_m)
        assert np.all(distance[env] - letter < 0.08 + ROUNDING_M)
        assert np.all(distance[env] - letter > -ROUNDING_M)
        nearer += int(near.sum())
    assert nearer > 1000


def test_fused_layer_and_odd_limit(stage):
    static, dynamic = maps_of(3), maps_of(4)[::-1]
    for cfg, voronoi in ((WIDE, VORONOI), (SHORT, FUSED)):
        found = stage.compute(static, dynamic, cfg, voronoi)
        for env in range(N_ENV):
            sites = sites_of(static[env], dynamic[env], stage.outside, MAP.occupied, voronoi.use)
            check([f[env] for f in found], sites, cfg)


def test_grid_without_a_border_of_sites(stage):
    """The window must not rely on the border: cells at the grid's edge, and a grid without any site."""
    stage.set_outside(np.zeros(SHAPE, bool))
    static = maps_of(5)
    static[0] = 0
    found = stage.compute(static)
    assert (found[0][0] == CFG.max_m).all() and (found[1][0] == -1).all()
    for env in range(1, N_ENV):
        check([f[env] for f in found], static[env] >= MAP.occupied, CFG)


def test_round_tank(stage):
    stage.set_outside(np.array(outside_cells(POND, MAP.cell_m)))
    static = maps_of(6)
    found = stage.compute(static)
    for env in range(N_ENV):
        check([f[env] for f in found], sites_of(static[env], 0, stage.outside, MAP.occupied, "static"), CFG)


def test_ties_go_left_then_to_the_lower_row(stage):
    stage.set_outside(np.zeros(SHAPE, bool))
    static = np.zeros((N_ENV, *SHAPE))
    static[0, 20, [30, 34]] = 1  # left and right of column 32
    static[1, [18, 22], 32] = 1  # below and above row 20
    static[2, [18, 22], 30] = 1  # two on the left
    static[3, [18, 22], 34] = 1  # two on the right
    static[4, 18, 34] = static[4, 22, 30] = 1  # lower right, upper left
    _, site_row, site_col = stage.compute(static)
    found = [(int(site_row[env, 20, 32]), int(site_col[env, 20, 32])) for env in range(5)]
    assert found == [(20, 30), (18, 32), (18, 30), (18, 34), (22, 30)]


def test_what_changed_is_redone_and_nothing_else_differs(stage):
    """A map that changes bit by bit, by blocks and at random: the same arrays as computed anew."""
    rng, static = np.random.default_rng(1), maps_of(2)
    for _ in range(12):
        for env in range(N_ENV):
            row, col = rng.integers(SHAPE[0]), rng.integers(SHAPE[1])
            kind = rng.integers(4)
            if kind == 0:
                static[env, row, col] = 1 - static[env, row, col]
            elif kind == 1:
                static[env, row : row + 3, col : col + 2] = rng.integers(2)
            elif kind == 2:
                static[env][rng.random(SHAPE) < 0.01] = rng.random()
        partly = stage.compute(static)
        stage.clearance_memory.limit.fill(0)
        for a, b in zip(partly, stage.compute(static), strict=True):
            np.testing.assert_array_equal(a, b)


def test_what_did_not_change_is_left_alone(stage):
    static = np.zeros((N_ENV, *SHAPE))
    stage.compute(static)
    stage.clearance.site.fill(9 << 8)
    static[0, 20, 30] = 1
    found = stage.compute(static)[0]
    left = np.float32(9) * np.float32(MAP.cell_m)
    assert (found[1:] == left).all()
    stage.clearance_memory.limit.fill(0)
    assert found[0, 20, 30] == 0 and (found[0, :, 64:] == left).all()


def test_limits_of_the_keys():
    assert clearance.squared_limit(CFG, MAP) == 400 and clearance.window_reach(CFG, MAP) == 20
    assert clearance.squared_limit(SHORT, MAP) == 56 and clearance.window_reach(SHORT, MAP) == 7
    assert 1 << clearance.offset_bits(CFG, MAP) > 2 * clearance.window_reach(CFG, MAP)
    with pytest.raises(ValueError, match="max_m"):
        clearance.offset_bits(ClearanceConfig(max_m=60.0), MAP)
    assert PACKET == LANES


# ------------------------------------------------------------------------------------------------- properties


@st.composite
def occupancies(draw):
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    return rng.random((N_ENV, *SHAPE)) < draw(st.sampled_from([0.001, 0.01, 0.1, 0.5]))


@settings(max_examples=10, deadline=None, derandomize=True)
@given(static=occupancies())
def test_clearance_is_lipschitz_and_zero_exactly_at_sites(stage, static):
    distance, _, _ = stage.compute(static)
    for axis in (1, 2):
        assert np.abs(np.diff(distance, axis=axis)).max() <= MAP.cell_m + ROUNDING_M
    np.testing.assert_array_equal(distance == 0, static | stage.outside)
    assert distance.max() <= CFG.max_m


@settings(max_examples=5, deadline=None, derandomize=True)
@given(static=occupancies(), order=st.permutations(range(N_ENV)), changed=st.integers(0, N_ENV - 1))
def test_envs_are_independent(stage, static, order, changed):
    plain, permuted = stage.compute(static), stage.compute(static[list(order)])
    twisted = stage.compute(np.where(np.arange(N_ENV)[:, None, None] == changed, ~static, static))
    others = [env for env in range(N_ENV) if env != changed]
    for a, b, c in zip(plain, permuted, twisted, strict=True):
        np.testing.assert_array_equal(b, a[list(order)])
        np.testing.assert_array_equal(c[others], a[others])
    assert (twisted[0][changed] != plain[0][changed]).any()


def test_only_awake_rows_whose_step_is_due_are_computed(stage):
    before = stage.compute(maps_of(8))[0]
    stage.clearance.fresh.from_numpy(np.array([0, 1, 0, 1, 0, 1, 0, 1], np.int32))
    put(stage.clock, active=[1, 1, 0, 0, 1, 1, 0, 0], step=[0, 1, 0, 1, 5, 4, 10, 11])
    changed = (before != stage.compute(maps_of(9)[::-1])[0]).any(axis=(1, 2))
    np.testing.assert_array_equal(changed, [True, False, False, False, True, False, False, False])
    # inactive rows keep their flag too
    np.testing.assert_array_equal(stage.clearance.fresh.to_numpy(), [1, 0, 0, 1, 1, 0, 0, 1])
