"""Heights of tracked obstacles: hypotheses against their float64 oracle, and what they come to."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, clear, put
from tests.oracles import height as oracle
from uuvtai.config import EpisodeConfig, HeightConfig, SonarConfig, TankConfig, TrackingConfig
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.core.stage import AnyTensor, Bundle
from uuvtai.kernels.perception import height
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.perception.tracking import GONE_SHARE, prune_tracks

N_ENV, N_TRACK, N_RAY = 8, 32, 64
TANK, RULES = TankConfig(z_m=(-1.6, 0.0)), EpisodeConfig(control_dt_s=0.02)
SONAR = SonarConfig(n_ray=N_RAY, max_range_m=12.0, vertical_half_aperture_deg=10.0)
TRACKING = TrackingConfig(n_track=N_TRACK, max_misses=8, see_through_s=0.15, hidden_s=2.0)
NUMBERS = {"half_height_m": 0.2, "least_half_height_m": 0.1, "column_share": 0.05}
CFG = HeightConfig(memory_s=8.0, **NUMBERS)
FORGETFUL = HeightConfig(memory_s=0.0, **NUMBERS)
SIZES = {"n_env": N_ENV, "n_track": N_TRACK, "n_height": LANES, "n_ray": N_RAY, "n_forecast": 2}
BEGIN, HIT, MISS = 0, 1, 2

SHARE_TOLERANCE = 2e-5
"""Ten weighings in float32 (6e-8 each) of shares whose ramp multiplies errors of a height (1e-7 m) by 1 /
EDGE_M, about 10."""

BOUND_TOLERANCE = 1e-5
"""[m] float32 sums of heights."""


@ti.kernel
def weigh(what: AnyTensor, own: AnyTensor, dt: ti.f32, io: Bundle[TrackingIO]):
    """Apply what[env, track] to every track, seen from own[env, 3]."""
    for env, track in ti.ndrange(N_ENV, N_TRACK):
        eye = ti.Vector([own[env, 0], own[env, 1], own[env, 2]])
        if what[env, track] == BEGIN:
            height.begin_height(env, track, io.tracks, io.height_cfg)
        elif what[env, track] == HIT:
            height.weigh_seen(env, track, eye, io)
        else:
            height.weigh_unseen(env, track, eye, dt, io)


@ti.kernel
def prune(dt: ti.f32, io: Bundle[TrackingIO]):
    for env in range(N_ENV):
        prune_tracks(env, dt, io)


class Rig(Stage):
    sizes = SIZES

    def begin(self):
        """Moving tracks of any height lie east of their env's vehicle at (5, 3, -0.8)."""
        clear(self.tracks, self.clock, self.ego, self.scan)
        put(self.forecast, above_w=-9.0, below_w=-9.0)
        self.clock.active.fill(1)
        put(self.tracks, alive=1, spot_step=-1, moving=1, radius_m=0.2)
        self.own = np.tile([5.0, 3.0, -0.8], (N_ENV, 1))
        self.place = np.tile([6.0, 3.0], (N_ENV, N_TRACK, 1))
        self.stand()
        self.weigh(np.full((N_ENV, N_TRACK), BEGIN))
        return self

    def stand(self):
        """Bring vehicles and obstacles to ``own`` and ``place``."""
        put(self.tracks, state=np.concatenate([self.place, np.zeros((N_ENV, N_TRACK, 2))], 2))
        put(self.ego, pos_w=self.own)
        put(self.scan, ping_pos_w=self.own)

    def weigh(self, what, dt=0.06):
        what = np.broadcast_to(what, (N_ENV, N_TRACK)).astype(np.int32)
        weigh(what, self.own.astype(np.float32), dt, self.io(TrackingIO, CFG, SONAR, TANK))

    def bound(self, cfg=CFG):
        """(above_w, below_w) as the kernel writes them."""
        height.bound_heights(self.io(TrackingIO, cfg, TANK))
        return self.forecast.above_w.to_numpy().astype(float), self.forecast.below_w.to_numpy().astype(float)

    def set_share(self, share):
        self.tracks.height.from_numpy(np.asarray(share, np.float32).reshape(N_ENV, N_TRACK, 1, LANES))

    @property
    def share(self):
        return self.tracks.height.to_numpy()[:, :, 0].astype(float)

    @property
    def present(self):
        return self.tracks.present.to_numpy().astype(float)


stage = Rig.begun()


def near(z):
    """Index of the slice around a height."""
    return int(np.abs(oracle.heights(TANK) - z).argmin())


# ------------------------------------------------------------------------------------- hypotheses, one by one


def test_nothing_is_known_at_first(stage):
    np.testing.assert_allclose(stage.share, np.broadcast_to(oracle.prior(CFG), stage.share.shape), atol=1e-6)
    np.testing.assert_allclose(stage.present, 0.95)


def test_any_sequence_of_hits_and_misses_equals_the_oracle(stage):
    """Ten scans with random own depths, places, radii, filters and answers, the same for nobody."""
    rng = np.random.default_rng(4)
    radius = rng.uniform(0.1, 0.4, (N_ENV, N_TRACK)).astype(np.float32)
    xx, yy = rng.uniform(1e-4, 0.02, (2, N_ENV, N_TRACK))
    xy = rng.uniform(-0.9, 0.9, (N_ENV, N_TRACK)) * np.sqrt(xx * yy)
    cov = np.zeros((N_ENV, N_TRACK, 10))
    cov[..., 0], cov[..., 1], cov[..., 4] = xx, xy, yy
    put(stage.tracks, radius_m=radius, cov=cov)
    share = np.broadcast_to(oracle.prior(CFG), (N_ENV, N_TRACK, LANES)).copy()
    present = np.full((N_ENV, N_TRACK), 0.95)
    for scan in range(10):
        stage.own = rng.uniform([3, 2, -1.5], [6, 4, -0.1], (N_ENV, 3)).astype(np.float32).astype(float)
        stage.place = (
            (stage.own[:, None, :2] + rng.uniform(-2.5, 2.5, (N_ENV, N_TRACK, 2)))
            .astype(np.float32)
            .astype(float)
        )
        stage.stand()
        what = rng.choice([HIT, MISS], (N_ENV, N_TRACK), p=[0.2, 0.8])
        dt = float(np.float32((0.02, 0.06, 0.3)[scan % 3]))
        stage.weigh(what, dt)
        for env, track in np.ndindex(N_ENV, N_TRACK):
            here = (stage.own[env], stage.place[env, track])
            size = float(radius[env, track])
            if what[env, track] == HIT:
                found = oracle.after_hit(share[env, track], *here, size, CFG, SONAR, TANK)
            else:
                spread = np.array([[xx[env, track], xy[env, track]], [xy[env, track], yy[env, track]]])
                found = oracle.after_miss(
                    share[env, track], present[env, track], *here, spread, size, dt, CFG, SONAR, TANK
                )
            share[env, track], present[env, track] = found
    np.testing.assert_allclose(stage.share, share, atol=SHARE_TOLERANCE)
    np.testing.assert_allclose(stage.present, present, atol=SHARE_TOLERANCE)
    assert present.min() < 0.5 and (share.max(axis=2) > 0.5).any()


def test_a_hit_near_by_rules_out_what_is_far_above_or_below(stage):
    stage.weigh(HIT)
    share = stage.share[0, 0]
    assert max(share[near(-0.2)], share[near(-1.5)]) < 0.02 * share[near(-0.8)]
    assert share.sum() == pytest.approx(1, abs=1e-5)
    stage.place[:] = [5.0 + 6.0, 3.0]  # six metres away the fan holds the full depth: a hit says nothing
    before = stage.share
    stage.stand()
    stage.weigh(HIT)
    np.testing.assert_allclose(stage.share, before, atol=1e-6)


def test_own_change_of_depth_tells_above_from_below(stage):
    """Misses leave both sides open; after a dive a miss where a body below would show: it is above."""
    for _ in range(20):
        stage.weigh(MISS)
    share = stage.share[0, 0]
    assert share[near(-0.8)] < 0.01
    assert share[: near(-0.8)].sum() == pytest.approx(share[near(-0.8) + 1 : -1].sum(), rel=1e-3)
    above, below = stage.bound()
    assert -0.8 < above[0, 0] < -0.5 and above[0, 0] + below[0, 0] == pytest.approx(-1.6, abs=1e-4)
    stage.own[:, 2] = -1.2
    stage.stand()
    for _ in range(20):
        stage.weigh(MISS)
    share = stage.share[0, 0]
    assert share[near(-0.3)] > 100 * share[near(-1.2)]
    above, below = stage.bound()
    assert -0.8 < above[0, 0] < -0.5 and below[0, 0] < -1.22  # below, only the floor is left


def test_what_is_missed_everywhere_has_gone(stage):
    """A miss where it could hide takes little of its presence; misses at all depths take nearly all of it."""
    stage.weigh(MISS)
    assert 0.9 < stage.present[0, 0] < 0.95
    for own_z in (-1.4, -1.1, -0.8, -0.5, -0.2):
        stage.own[:, 2] = own_z
        for _ in range(20):
            stage.weigh(MISS)
    assert stage.present[0, 0] < 0.25 * GONE_SHARE


def test_a_wrong_belief_is_given_up(stage):
    """Hundreds of scans say "level"; after a dive it is hit where it was believed not to be."""
    for _ in range(300):
        stage.weigh(HIT)
    stage.own[:, 2] = -1.5
    for _ in range(20):
        stage.weigh(HIT)
    assert stage.share[0, 0, near(-0.8)] < 2e-3
    assert stage.share[0, 0, : near(-1.0)].sum() + stage.share[0, 0, -1] > 0.9


def test_an_unsure_place_makes_a_miss_say_less(stage):
    """Tracks of equal obstacles, one of them known to 2 cm and one to 60 cm."""
    cov = np.zeros((N_ENV, N_TRACK, 10))
    cov[:, 0, [0, 4]], cov[:, 1, [0, 4]] = 0.02**2, 0.6**2
    put(stage.tracks, cov=cov)
    stage.weigh(MISS, 0.3)
    level = stage.share[0, :2, near(-0.8)]
    assert level[0] < 0.3 * level[1] < 0.29 * oracle.prior(CFG)[0]


def test_scans_close_together_count_as_one(stage):
    """Ten scans within 0.15 s say as much as one so long after the last; twice that time says no more."""
    level, top = near(-0.8), near(-0.1)
    for _ in range(10):
        stage.weigh(MISS, height.EVIDENCE_S / 10)
    often, present = stage.share[0, 0], stage.present[0, 0]
    for dt in (height.EVIDENCE_S, 2 * height.EVIDENCE_S):
        stage.begin()
        stage.weigh(MISS, dt)
        once = stage.share[0, 0]
        assert once[level] / once[top] == pytest.approx(often[level] / often[top], rel=1e-3)
        assert once[level] < 0.2 * once[top]
        assert present == pytest.approx(stage.present[0, 0], abs=0.01)


# ------------------------------------------------------------------------------------------------- free water


def test_free_water_equals_the_oracle(stage):
    """Random peaked shares, depths and radii: edges of what is likely enough, up to the own height."""
    rng = np.random.default_rng(6)
    share = rng.dirichlet(np.full(LANES, 0.15), (N_ENV, N_TRACK)).astype(np.float32)
    radius = rng.uniform(0.1, 0.4, (N_ENV, N_TRACK)).astype(np.float32)
    stage.own[:, 2] = rng.uniform(-1.5, -0.1, N_ENV).astype(np.float32)
    stage.stand()
    stage.set_share(share)
    put(stage.tracks, radius_m=radius)
    above, below = stage.bound()
    kinds = set()
    for env, track in np.ndindex(N_ENV, N_TRACK):
        wanted = oracle.free_water(
            share[env, track].astype(float), stage.own[env, 2], float(radius[env, track]), CFG, TANK
        )
        for found, edge in zip((above[env, track], below[env, track]), wanted, strict=True):
            assert (
                found == pytest.approx(edge, abs=BOUND_TOLERANCE) if np.isfinite(edge) else abs(found) > 100.0
            )
        kinds.add((np.isfinite(wanted[0]), np.isfinite(wanted[1]), wanted[0] == wanted[1]))
    assert len(kinds) == 4  # above, below, both, level


def test_a_likely_column_leaves_no_free_water(stage):
    share = np.zeros((N_ENV, N_TRACK, LANES))
    share[:, :, near(-0.2)] = (
        1 - np.where(np.arange(N_TRACK) % 2 == 0, 0.9, 1.1)[None] * height.COLUMN_TAIL_SHARE
    )
    share[:, :, -1] = 1 - share[:, :, near(-0.2)]
    stage.set_share(share)
    above, below = stage.bound()
    assert (above[:, 0] > -0.5).all() and (below[:, 0] < -100).all()
    np.testing.assert_allclose((above[:, 1], below[:, 1]), -0.8, atol=BOUND_TOLERANCE)


def test_without_memory_every_obstacle_is_level(stage):
    """So is, with memory, what does not move or is not there; who sleeps sleeps."""
    share = np.zeros((N_ENV, N_TRACK, LANES))
    share[:, :, near(-0.2)] = 1
    stage.set_share(share)
    moving, alive, active = np.ones((N_ENV, N_TRACK)), np.ones((N_ENV, N_TRACK)), np.ones(N_ENV)
    moving[0, 1], alive[0, 2], active[1] = 0, 0, 0
    put(stage.tracks, moving=moving, alive=alive)
    put(stage.clock, active=active)
    above, below = stage.bound(FORGETFUL)
    np.testing.assert_allclose((above[active == 1], below[active == 1]), -0.8, atol=BOUND_TOLERANCE)
    np.testing.assert_array_equal((above[1], below[1]), -9.0)
    above, below = stage.bound()
    bounded = (moving * alive * active[:, None]).astype(bool)
    assert (above[bounded] > -0.5).all() and (below[bounded] < -100).all()
    np.testing.assert_allclose((above[0, 1:3], below[0, 1:3]), -0.8, atol=BOUND_TOLERANCE)
    np.testing.assert_array_equal((above[1], below[1]), -9.0)


def test_no_obstacle_is_in_water_called_free(stage):
    """256 obstacles, seen by the fan's geometry from a vehicle that drives by and changes depth: the free
    water holds none of them.

    Tolerance: a slice (0.11 m) rounds a height by half of it, the fan's edge is soft, and what is less likely
    than TAIL_SHARE is given up.
    """
    rng = np.random.default_rng(8)
    half = rng.uniform(0.12, 0.25, (N_ENV, N_TRACK))
    z = rng.uniform(-1.4, -0.2, (N_ENV, N_TRACK))
    put(stage.tracks, radius_m=rng.uniform(0.15, 0.25, (N_ENV, N_TRACK)))
    away, begin = rng.uniform(0.6, 1.2, (N_ENV, N_TRACK)), rng.uniform(-1.2, -0.4, N_ENV)
    end = rng.uniform(-1.2, -0.4, N_ENV)
    deepest = np.zeros((N_ENV, N_TRACK))
    opened = 0
    for k in range(60):
        stage.own[:, 2] = begin + (end - begin) * k / 60
        stage.own[:, 0] = 2.0 + 0.06 * k
        stage.place = np.stack([np.full((N_ENV, N_TRACK), 4.0), 3.0 + away], 2)
        stage.stand()
        distance = np.hypot(stage.place[..., 0] - stage.own[:, None, 0], away)
        inside = np.abs(z - stage.own[:, None, 2]) < half + np.tan(np.radians(10.0)) * distance
        stage.weigh(np.where(inside, HIT, MISS))
        above, below = stage.bound()
        deepest = np.maximum(deepest, np.minimum(z + half, above) - np.maximum(z - half, below))
        opened += (above - below > 0.3).sum()
    assert np.quantile(deepest, 0.98) < 0.15
    assert opened > 0.2 * 60 * N_ENV * N_TRACK


# ----------------------------------------------------------------------------------------------------- memory


def scan_for(stage, range_m):
    """Every beam of every env returns at this range; tracks have been missed once."""
    put(
        stage.scan,
        range_m=np.full((N_ENV, N_RAY), range_m),
        hit=np.full((N_ENV, N_RAY), range_m < SONAR.max_range_m),
    )
    put(stage.tracks, misses=np.ones((N_ENV, N_TRACK)), age=np.full((N_ENV, N_TRACK), 10))
    others = np.arange(N_TRACK) > 2  # three tracks are enough, apart from each other
    stage.place[:, :3] = np.array([5.0, 3.0]) + np.array([[1.0, 0.0], [0.0, 1.5], [-1.2, 0.0]])
    put(stage.tracks, alive=np.tile(~others, (N_ENV, 1)))
    stage.stand()


def pruned(stage, count, cfg=CFG, dt=0.06):
    for k in range(1, count + 1):
        put(stage.scan, ping_step=np.full(N_ENV, 3 * k))
        prune(dt, stage.io(TrackingIO, TRACKING, cfg, SONAR, TANK, RULES))
    return stage.tracks.alive.to_numpy()[:, :3]


def test_unseen_obstacles_are_remembered_for_their_time(stage):
    """Behind something nearer it is only forgotten: with time constant memory_s until GONE_SHARE."""
    scan_for(stage, 0.5)
    assert pruned(stage, 50).all()
    np.testing.assert_allclose(stage.present[:, :3], 0.95 * np.exp(-50 * 0.06 / CFG.memory_s), rtol=1e-4)
    np.testing.assert_allclose(
        stage.share[:, 0], np.broadcast_to(oracle.prior(CFG), (N_ENV, LANES)), atol=1e-6
    )
    scans = int(np.log(0.95 / GONE_SHARE) * CFG.memory_s / 0.06)
    stage.begin()
    scan_for(stage, 0.5)
    assert pruned(stage, scans).all()
    assert not pruned(stage, 2).any()


def test_a_obstacle_seen_through_is_kept_if_it_may_be_above_or_below(stage):
    """Near by it may have left the fan, but not far away, where the fan holds the full depth."""
    scan_for(stage, SONAR.max_range_m)
    stage.place[:, 2] = [5.0 - 5.0, 3.0]
    stage.stand()
    alive = pruned(stage, 12)
    assert alive[:, :2].all() and not alive[:, 2].any()
    assert stage.share[0, 0, near(-0.8)] < 0.01 < oracle.prior(CFG)[0] < stage.share[0, 0, near(-0.1)]


def test_seen_obstacles_are_weighed_and_resting_ones_are_not(stage):
    scan_for(stage, SONAR.max_range_m)
    put(stage.tracks, misses=np.zeros((N_ENV, N_TRACK)))
    moving = np.ones((N_ENV, N_TRACK))
    moving[:, 1] = 0
    put(stage.tracks, moving=moving)
    assert pruned(stage, 1).all()
    assert stage.share[0, 0, near(-0.1)] < 0.01
    np.testing.assert_allclose(stage.share[0, 1], oracle.prior(CFG), atol=1e-6)


def test_memory_can_be_switched_off(stage):
    """An obstacle that beams see through ends after see_through_s, a hidden one after hidden_s."""
    scan_for(stage, SONAR.max_range_m)
    assert pruned(stage, 2, FORGETFUL).all()
    assert not pruned(stage, 3, FORGETFUL).any()
    stage.begin()
    scan_for(stage, 0.5)
    assert pruned(stage, round(TRACKING.hidden_s / 0.06) - 1, FORGETFUL).all()
    np.testing.assert_allclose(stage.present[:, :3], 0.95)
    put(stage.scan, ping_step=np.full(N_ENV, round(TRACKING.hidden_s / RULES.control_dt_s) + 1))
    prune(0.06, stage.io(TrackingIO, TRACKING, FORGETFUL, SONAR, TANK, RULES))
    assert not stage.tracks.alive.to_numpy()[:, :3].any()


# ----------------------------------------------------------------------------------------------------- config


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("height.memory_s=-1", "height.memory_s"),
        ("height.column_share=1.5", "height.column_share"),
        ("height.half_height=0.3", "did you mean 'half_height_m'"),
    ],
)
def test_numbers_that_cannot_work_are_refused(override, says):
    with pytest.raises(ConfigError, match=says):
        load_config("pool", overrides=[override])
