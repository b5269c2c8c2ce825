"""The two-layer map: the oracle on random scans, known situations by hand, invariants of any scan."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bundles import Stage, put
from tests.map_bits import check_bits, get_map, put_map
from tests.oracles.mapping import MapOracle, rotation
from uuvtai.config import DepthConfig, EpisodeConfig, MappingConfig, SonarConfig, TankConfig
from uuvtai.kernels.core.grid import grid_origin, grid_shape, outside_cells
from uuvtai.kernels.perception import mapping
from uuvtai.kernels.perception.io import MappingIO
from uuvtai.sim.setup import load_bounds

N_ENV = 6
TANK = TankConfig(x_m=(0.0, 6.0), y_m=(0.0, 4.0))
POND = TankConfig(shape="circle", x_m=(0.0, 6.0), y_m=(0.0, 4.0))
MAP = MappingConfig(period_steps=2, free_range_m=2.5, wall_margin_m=0.03)
"""25 Hz, so that the rated gains (10 Hz) are scaled by 0.4; a small tank needs a short free range to show it,
and range errors reach deeper than this wall margin"""
SONAR = SonarConfig(
    n_ray=64, range_sigma_m=0.01, range_sigma_slope=0.005, range_quantum_m=0.01, doppler_sigma_m_s=0.04
)
DEPTH_CAMERA = DepthConfig(rows=6, cols=16, period_steps=4)
EPISODE = EpisodeConfig()
SCAN_S = 0.04
SHAPE = grid_shape(TANK, MAP.cell_m)
CONFIDENT = mapping.scans_in(MAP.free_confident_s, SCAN_S)

OCCUPANCY_TOLERANCE = 2.01 / 65535  # half a step in what it begins with, one and a half after it
MAX_DOUBTFUL = 0.08
"""share of the cells in which float32 and float64 may place a sample differently"""

FIELDS = ("static", "dynamic", "depth_hit", "seen", "free_scans", "dynamic_scans")


class Rig(Stage):
    """The structs of mapping, and one call per control step."""

    sizes = {
        "n_row": SHAPE[0], "n_col": SHAPE[1], "n_ray": SONAR.n_ray, "n_track": 4, "n_cluster": 4,
        "n_obstacle": 4, "n_height": 16, "n_slot": 4, "n_pixel_row": DEPTH_CAMERA.rows,
        "n_pixel_col": DEPTH_CAMERA.cols,
    }  # fmt: skip

    def __init__(self, n_env=N_ENV):
        super().__init__(n_env=n_env)
        self.n_env = n_env
        self.set_tank(TANK)

    def set_tank(self, tank):
        self.tank = tank
        load_bounds(self.mask, np.array(outside_cells(tank, MAP.cell_m)))

    def reset(self, active=1):
        self.set_active(active)
        self.set_step(0)
        mapping.reset_map(self.io(MappingIO))

    def set_active(self, active):
        put(self.clock, active=active)

    def set_step(self, step):
        put(self.clock, step=step)

    def read(self):
        return get_map(self.grid_map)

    def write(self, state):
        put_map(self.grid_map, state, MAP.occupied, CONFIDENT)

    def put_scans(self, scans, fresh=1):
        """One scan per env."""
        s = self.scan
        put(s, range_m=np.stack([c["range"] for c in scans]), hit=np.stack([c["hit"] for c in scans]))
        put(s, doppler_m_s=np.stack([c["doppler"] for c in scans]))
        put(s, ping_pos_w=np.stack([c["pos"] for c in scans]), ping_yaw=[c["yaw"] for c in scans])
        put(s, ping_vel_b=np.stack([c["vel"] for c in scans]), fresh=fresh)
        put(s, ping_vel_valid=[c.get("valid", True) for c in scans], ping_step=7)
        walls = [c.get("walls") or ((0.0, 0.0), 0.0, False) for c in scans]
        slip, sigma, same = zip(*walls, strict=True)
        put(self.clusters, slip_w=slip, own_sigma_m_s=sigma, scan_step=np.where(same, 7, 4))
        # untracked beams: half of them on a track that does not move
        still = np.where(np.arange(SONAR.n_ray) % 2, 1, -1)
        put(self.tracks, moving=[1, 0, 0, 0], beam_track=np.where([c["tracked"] for c in scans], 0, still))

    def put_images(self, images):
        self.image.fresh.fill(int(images is not None))
        if images is not None:
            put(self.image, depth_m=np.stack([i["depth"] for i in images]))
            put(self.image, shot_pos_w=[i["pos"] for i in images], shot_rpy=[i["rpy"] for i in images])

    def update(self):
        mapping.update_map(self.io(MappingIO, MAP, SONAR, DEPTH_CAMERA, self.tank, EPISODE))

    def run(self, scan_of, n_scan, first=0, image_of=None):
        """``n_scan`` scans at the map's rate, the same for every env: scan_of(k), image_of(k)."""
        for k in range(first, first + n_scan):
            self.set_step(2 * k)
            self.put_scans([scan_of(k)] * self.n_env)
            self.put_images([image_of(k)] * self.n_env if image_of else None)
            self.update()
        return {name: value[0] for name, value in self.read().items()}


stage = Rig.fixture()


@pytest.fixture(autouse=True)
def _default_tank(stage):
    stage.set_tank(TANK)


# ----------------------------------------------------------------------------------------------------- scenes


def ring(pos, obstacles=(), yaw=0.0, vel=(0.0, 0.0, 0.0), noise=None):
    """Scan of the rectangular tank with discs (x, y, radius, vx, vy): ranges, hits, Doppler."""
    pos = np.array([*pos, -0.8])
    angle = yaw + 2 * np.pi * np.arange(SONAR.n_ray) / SONAR.n_ray
    u = np.stack([np.cos(angle), np.sin(angle)], 1)
    with np.errstate(divide="ignore"):
        best = np.minimum(
            np.where(u[:, 0] > 0, TANK.x_m[1] - pos[0], pos[0] - TANK.x_m[0]) / np.abs(u[:, 0]),
            np.where(u[:, 1] > 0, TANK.y_m[1] - pos[1], pos[1] - TANK.y_m[0]) / np.abs(u[:, 1]),
        )
    obstacle_vel = np.zeros((SONAR.n_ray, 2))
    of_obstacle = np.zeros(SONAR.n_ray, bool)
    for x, y, radius, vx, vy in obstacles:
        along, across = u @ (np.array([x, y]) - pos[:2]), u[:, 0] * (y - pos[1]) - u[:, 1] * (x - pos[0])
        inside = radius**2 - across**2
        r = np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0)), np.inf)
        obstacle_vel[r < best], of_obstacle[r < best] = (vx, vy), True
        best = np.minimum(best, r)
    c, s = np.cos(yaw), np.sin(yaw)
    own = np.array([c * vel[0] - s * vel[1], s * vel[0] + c * vel[1]])
    doppler = np.sum((obstacle_vel - own) * u, axis=1)
    if noise is not None:
        best = np.maximum(
            0.05,
            best + noise.normal(0, 1, best.shape) * (SONAR.range_sigma_m + SONAR.range_sigma_slope * best),
        )
    hit = np.ones(SONAR.n_ray, int)
    return {
        "pos": pos, "yaw": yaw, "range": best, "hit": hit, "doppler": doppler, "vel": np.array(vel),
        "tracked": np.zeros(SONAR.n_ray, bool), "of_obstacle": of_obstacle,
    }  # fmt: skip


def blind(pos):
    """A scan that reaches no cell of interest: every beam returns from 0.2 m."""
    return ring(pos) | {"range": np.full(SONAR.n_ray, 0.2)}


def cell(x, y):
    x0, y0 = grid_origin(TANK, MAP.cell_m)
    return int((y - y0) / MAP.cell_m), int((x - x0) / MAP.cell_m)


def around(layer, x, y, half=3):
    row, col = cell(x, y)
    return layer[row - half : row + half + 1, col - half : col + half + 1]


def random_scan(rng, tank):
    """Obstacles, walls, noise, missed and false returns, Doppler of all sizes."""
    while True:
        pos = np.array([rng.uniform(*tank.x_m), rng.uniform(*tank.y_m)])
        if MapOracle(MAP, SONAR, DEPTH_CAMERA, tank, EPISODE).gap(pos) > 0.2:
            break
    obstacles = [
        (rng.uniform(0, 6), rng.uniform(0, 4), rng.uniform(0.1, 0.5), *rng.normal(0, 0.3, 2))
        for _ in range(4)
    ]
    scan = ring(pos, obstacles, rng.uniform(-7, 7), rng.normal(0, 0.3, 3), rng)
    if tank.shape == "circle":
        scan["range"] = np.minimum(scan["range"], rng.uniform(0.2, 4.0, SONAR.n_ray))
    false = rng.random(SONAR.n_ray) < 0.1
    scan["range"] = np.where(false, rng.uniform(0.1, 5.0, SONAR.n_ray), scan["range"])
    missed = rng.random(SONAR.n_ray) < 0.1
    scan["hit"] = np.where(missed, 0, 1)
    scan["range"] = np.where(missed, SONAR.max_range_m, scan["range"])
    scan["doppler"] = scan["doppler"] + rng.normal(0, 0.08, SONAR.n_ray)
    scan["tracked"] = rng.random(SONAR.n_ray) < 0.1
    # the reading is off by what the walls show, give or take; held or not, of this scan or of one before
    error = rng.normal(0, 0.3, 2)
    wrong = (rotation(0, 0, float(scan["yaw"])).T @ [*error, 0.0]) + rng.normal(0, 0.03, 3)
    scan["vel"] = scan["vel"] + wrong
    scan["valid"] = rng.random() < 0.5
    scan["walls"] = (error.astype(np.float32), np.float32(rng.choice([0.0, 0.02, 0.2])), rng.random() < 0.5)
    return {
        k: (v.astype(np.float32) if getattr(v, "dtype", None) == np.float64 else v) for k, v in scan.items()
    } | {"yaw": np.float32(scan["yaw"])}


def random_state(rng, outside):
    """A map in the middle of its life; every counter near its thresholds somewhere."""
    sparse = rng.random(SHAPE) < 0.15
    state = {
        "static": np.where(sparse, rng.random(SHAPE), 0.0).astype(np.float32),
        "dynamic": np.where(rng.random(SHAPE) < 0.15, rng.random(SHAPE), 0.0).astype(np.float32),
        "depth_hit": rng.random(SHAPE) < 0.1,
        "free_scans": np.where(
            rng.random(SHAPE) < 0.5,
            rng.integers(0, CONFIDENT, SHAPE),
            rng.choice([0, CONFIDENT - 1, CONFIDENT], SHAPE),
        ),
        "dynamic_scans": np.where(
            rng.random(SHAPE) < 0.2, rng.choice([1, 2, 48, 49, 50, 51, 254, 255], SHAPE), 0
        ),
    }
    # occupied patches leave room for cells that have no static neighbour
    state["static"][:, SHAPE[1] // 2 :] *= 0.6 * (rng.random((SHAPE[0], SHAPE[1] // 2)) < 0.95)
    state["seen"] = (state["free_scans"] > 0) | (rng.random(SHAPE) < 0.5)
    return {
        name: np.where(outside, False if value.dtype == bool else 0, value) for name, value in state.items()
    }


def random_image(rng, scan):
    """Depths from 0.1 m to beyond the range, seen with some tilt."""
    depth = rng.uniform(0.1, 1.2 * DEPTH_CAMERA.max_range_m, (DEPTH_CAMERA.rows, DEPTH_CAMERA.cols))
    near = rng.random(depth.shape) < 0.6
    return {
        "depth": np.where(near, rng.uniform(0.1, 2.0, depth.shape), depth).astype(np.float32),
        "pos": scan["pos"].astype(np.float32),
        "rpy": np.array([*rng.normal(0, 0.1, 2), scan["yaw"]], np.float32),
    }


# ----------------------------------------------------------------------------------------------------- oracle


def check_against_oracle(stage, tank, seed):
    stage.set_tank(tank)
    stage.reset()
    oracle, rng, step = MapOracle(MAP, SONAR, DEPTH_CAMERA, tank, EPISODE), np.random.default_rng(seed), 1000
    scans = [random_scan(rng, tank) for _ in range(N_ENV)]
    images = [random_image(rng, scan) for scan in scans]
    before = [random_state(rng, oracle.outside) for _ in range(N_ENV)]
    stage.write({name: np.stack([b[name] for b in before]) for name in FIELDS})
    stage.set_step(step)
    stage.put_scans(scans)
    stage.put_images(images)
    stage.update()
    after = stage.read()
    check_bits(stage.grid_map, MAP.occupied, CONFIDENT)
    seen = {"doubtful": 0.0, "dynamic": 0, "static": 0, "depth": 0}
    for env in range(N_ENV):
        expected, doubtful = oracle.update(before[env], scans[env], images[env])
        seen["doubtful"] = max(seen["doubtful"], doubtful.mean())
        for name in FIELDS:
            tolerance = OCCUPANCY_TOLERANCE if name in ("static", "dynamic") else 0
            off = np.abs(after[name][env].astype(float) - expected[name])
            assert off[~doubtful].max() <= tolerance, (
                name,
                env,
                np.argwhere((off > tolerance) & ~doubtful)[:5],
            )
        seen["dynamic"] += int((expected["dynamic_scans"] > before[env]["dynamic_scans"]).sum())
        seen["static"] += int((expected["static"] > before[env]["static"]).sum())
        assert (after["static"][env][oracle.outside] == 0).all()
        assert (after["dynamic"][env][oracle.outside] == 0).all()
    assert seen["doubtful"] < MAX_DOUBTFUL
    # the random scans exercise what they should
    assert seen["dynamic"] > 10 and seen["static"] > 20


@pytest.mark.parametrize("seed", range(2))
def test_update_equals_the_oracle(stage, seed):
    check_against_oracle(stage, TANK, seed)


def test_update_equals_the_oracle_in_a_circular_tank(stage):
    check_against_oracle(stage, POND, 7)


# ------------------------------------------------------------------------------------------------------ gains


def test_gain_per_second_is_kept_at_any_scan_rate():
    assert mapping.per_scan(0.15, 0.1) == pytest.approx(0.15)
    assert mapping.per_scan(0.15, 0.02) == pytest.approx(0.03)
    assert mapping.per_scan(0.6, 0.5) == 1.0
    assert (1 - mapping.decay_per_scan(0.1, 0.02)) ** 5 == pytest.approx(0.9)


def test_periods_follow_the_slower_clock():
    fast, slow = SonarConfig(), SonarConfig(period_steps=5)
    assert mapping.map_period_s(MappingConfig(period_steps=1), fast, EPISODE) == pytest.approx(0.02)
    assert mapping.map_period_s(MappingConfig(period_steps=6), slow, EPISODE) == pytest.approx(0.2)
    assert mapping.depth_period_s(
        MappingConfig(), fast, DepthConfig(period_steps=10), EPISODE
    ) == pytest.approx(0.2)


def test_times_become_scans_and_too_long_ones_are_refused():
    assert mapping.scans_in(2.0, 0.02) == 100
    assert mapping.scans_in(0.5, 0.04) == 13
    assert mapping.scans_in(0.01, 0.1) == 1
    with pytest.raises(ValueError, match="counters"):
        mapping.scans_in(10.0, 0.02)


# ------------------------------------------------------------------------------------------------- situations

EYE = (1.55, 2.05)
BODY = (3.55, 2.05, 0.3)
FACE = (BODY[0] - BODY[2], BODY[1])
"""where beam 0 meets the body: the middle of a cell"""


def test_static_obstacle_appears_and_outlives_its_sight(stage):
    stage.reset()
    after = stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 25)
    assert after["static"][cell(*FACE)] > MAP.occupied
    assert after["dynamic"].max() == 0
    hidden = stage.run(lambda k: blind(EYE), 25, first=25)
    assert hidden["static"][cell(*FACE)] == pytest.approx(
        after["static"][cell(*FACE)] * (1 - MAP.static_decay) ** 10, abs=25 / 65535
    )


def test_known_walls_are_not_mapped(stage):
    stage.reset()
    noise = np.random.default_rng(0)
    after = stage.run(lambda k: ring((1.0, 0.7), yaw=0.1 * k, noise=noise), 50)
    # one return in 700 lies beyond 3 sigma; no cell collects several
    assert after["static"].max() < 0.2 * MAP.occupied and after["dynamic"].max() == 0
    assert after["free_scans"].max() == CONFIDENT


def test_moving_obstacle_feeds_the_dynamic_layer_only(stage):
    """Towards the vehicle at 0.4 m/s: Doppler. It is never static, and its wake is free again."""
    stage.reset()

    def scan(k):
        return ring(EYE, [(5.0 - 0.4 * SCAN_S * k, 2.05, 0.25, -0.4, 0.0)])

    after = stage.run(scan, 100)
    x = 5.0 - 0.4 * SCAN_S * 99 - 0.25
    # rim beams see little Doppler and are static, but move on too fast to stay
    assert after["static"].max() < MAP.occupied
    assert around(after["dynamic"], x, 2.05, 1).max() > MAP.occupied
    stage.run(lambda k: ring(EYE), 25, first=100)
    assert stage.read()["dynamic"][0].max() < MAP.occupied


def test_doppler_alone_is_dynamic_evidence_and_own_motion_is_compensated(stage):
    stage.reset()
    moving = stage.run(lambda k: ring(EYE, [(*BODY, 0.5, 0.0)], vel=(0.6, 0.1, 0.0), yaw=0.4), 1)
    assert moving["dynamic"][cell(*FACE)] > 0 and moving["static"][cell(*FACE)] == 0
    stage.reset()
    still = stage.run(lambda k: ring(EYE, [(*BODY, 0.0, 0.0)], vel=(0.6, 0.1, 0.0), yaw=0.4), 1)
    assert still["dynamic"].max() == 0 and still["static"][cell(*FACE)] > 0


WRONG = (0.5, -0.3)
"""[m/s, world] what a stale reading of the own velocity may be off by"""


def misread(yaw, valid, walls):
    """A scan at rest whose own velocity is said to be ``WRONG``, beside an obstacle that stands still."""
    c, s = np.cos(yaw), np.sin(yaw)
    measured = (c * WRONG[0] + s * WRONG[1], -s * WRONG[0] + c * WRONG[1], 0.0)
    return ring(EYE, [(*BODY, 0.0, 0.0)], yaw=yaw) | {
        "vel": np.array(measured),
        "valid": valid,
        "walls": walls,
    }


@pytest.mark.parametrize("yaw", [0.0, 21 * 2 * np.pi / SONAR.n_ray])
@pytest.mark.parametrize(("valid", "same"), [(False, True), (False, False), (True, True)])
def test_walls_that_show_a_wrong_own_velocity_keep_the_standing_at_rest(stage, yaw, valid, same):
    """Bottom lost as the vehicle stopped: the walls' Doppler tells, also after the scan."""
    stage.reset()
    after = stage.run(lambda k: misread(yaw, valid, (WRONG, 0.0 if valid else 0.01, same)), 1)
    assert after["dynamic"].max() == 0 and after["static"][cell(*FACE)] > 0


def test_a_valid_reading_is_not_mended_by_an_older_scan(stage):
    """The error of a scan before belongs to a reading that is gone."""
    stage.reset()
    scan = ring(EYE, [(*BODY, 0.0, 0.0)], vel=(0.4, 0.0, 0.0)) | {"walls": (WRONG, 0.0, False)}
    after = stage.run(lambda k: scan, 1)
    assert after["dynamic"].max() == 0 and after["static"][cell(*FACE)] > 0


def test_without_a_reading_and_without_walls_doppler_proves_nothing(stage):
    """What stands does not move by it; an obstacle faster than all doubt still does."""
    stage.reset()
    blindly = stage.run(lambda k: misread(0.0, False, ((0.0, 0.0), 1.0, True)), 1)
    assert blindly["dynamic"].max() == 0 and blindly["static"][cell(*FACE)] > 0
    stage.reset()
    fast = ring(EYE, [(*BODY, -3.5, 0.0)]) | {"valid": False, "walls": ((0.0, 0.0), 1.0, True)}
    after = stage.run(lambda k: fast, 1)
    assert after["dynamic"][cell(*FACE)] > 0 and after["static"][cell(*FACE)] == 0
    stage.reset()
    trusted = stage.run(lambda k: misread(0.0, True, ((0.0, 0.0), 0.0, True)), 1)
    assert trusted["dynamic"][cell(*FACE)] > 0, "a valid reading counts"


def test_beams_of_a_moving_track_are_dynamic_evidence(stage):
    stage.reset()
    scan = ring(EYE, [(*BODY, 0, 0)])
    after = stage.run(lambda k: scan | {"tracked": scan["of_obstacle"]}, 3)
    assert after["dynamic"][cell(*FACE)] > 0 and after["static"].max() == 0


def appearing(k, n_free=20):
    """An obstacle without Doppler that is suddenly there, long after its place was seen free."""
    return ring(EYE, [(*BODY, 0, 0)] if k >= n_free else [])


def test_return_from_free_water_is_dynamic_until_it_has_stayed(stage):
    stage.reset()
    n_free, n_promote = 20, mapping.scans_in(MAP.promote_s, SCAN_S)
    stage.run(appearing, n_free)
    soon = stage.run(appearing, 10, first=n_free)
    assert soon["dynamic"][cell(*FACE)] > MAP.occupied and soon["static"].max() == 0
    assert stage.run(appearing, n_promote - 10, first=n_free + 10)["static"].max() == 0
    after = stage.run(appearing, 40, first=n_free + n_promote)
    assert after["static"][cell(*FACE)] > MAP.occupied
    assert after["dynamic"].max() < MAP.occupied


def test_no_temporal_evidence_before_the_cell_was_free_for_long(stage):
    stage.reset()
    n_free = mapping.scans_in(MAP.free_confident_s, SCAN_S) - 1
    after = stage.run(lambda k: appearing(k, n_free), n_free + 5)
    assert after["dynamic"].max() == 0 and after["static"][cell(*FACE)] > 0


def test_noisy_edges_of_a_static_obstacle_never_become_dynamic(stage):
    """Six seconds of range noise and slow turning around an obstacle whose rim cells are partly free."""
    stage.reset()
    noise = np.random.default_rng(3)
    worst = 0.0
    for second in range(6):
        after = stage.run(
            lambda k: ring(EYE, [(*BODY, 0, 0)], yaw=0.004 * k, noise=noise), 25, first=25 * second
        )
        worst = max(worst, after["dynamic"].max())
    assert worst < MAP.occupied
    assert after["static"][cell(*FACE)] > MAP.occupied


def test_free_water_clears_a_removed_obstacle(stage):
    stage.reset()
    stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 25)
    assert stage.run(lambda k: ring(EYE), 40, first=25)["static"][cell(*FACE)] == 0


def test_dynamic_layer_decays_to_exactly_nothing_unseen(stage):
    stage.reset()
    before = stage.run(lambda k: ring(EYE, [(*BODY, 0.5, 0.0)]), 10)["dynamic"][cell(*FACE)]
    one = stage.run(lambda k: blind(EYE), 1, first=10)["dynamic"][cell(*FACE)]
    assert one == pytest.approx(before * (1 - MAP.dynamic_decay) ** 0.4, abs=OCCUPANCY_TOLERANCE)
    assert stage.run(lambda k: blind(EYE), 350, first=11)["dynamic"][cell(*FACE)] == 0


def test_beam_without_return_clears_only_near_water(stage):
    stage.reset()
    after = stage.run(
        lambda k: ring(EYE) | {"hit": np.zeros(SONAR.n_ray, int), "range": np.full(SONAR.n_ray, 12.0)}, 1
    )
    assert after["seen"][cell(EYE[0] + 2.4, EYE[1])] and not after["seen"][cell(EYE[0] + 2.6, EYE[1])]
    stage.reset()
    after = stage.run(lambda k: ring(EYE), 1)
    assert after["seen"][cell(EYE[0] + 4.0, EYE[1])]


# ------------------------------------------------------------------------------------------------------ depth


def wall_ahead(z_m):
    """Image of a plane across the view, half a pixel sideways so that a column looks along y = EYE[1]."""
    pos = (EYE[0], EYE[1] - z_m * np.tan(np.radians(DEPTH_CAMERA.fov_deg / 2)) / DEPTH_CAMERA.cols, -0.8)
    return {
        "depth": np.full((DEPTH_CAMERA.rows, DEPTH_CAMERA.cols), z_m),
        "pos": np.array(pos),
        "rpy": np.zeros(3),
    }


PLANE_M = FACE[0] - EYE[0] - DEPTH_CAMERA.offset_b_m[0]
"""depth at which the camera sees the body's face"""


def test_depth_alone_maps_nothing_but_strengthens_what_the_sonar_saw(stage):
    stage.reset()
    alone = stage.run(lambda k: blind(EYE), 10, image_of=lambda k: wall_ahead(PLANE_M))
    assert alone["static"][cell(*FACE)] == 0 and alone["seen"][cell(*FACE)]
    stage.reset()
    without = stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 2)["static"][cell(*FACE)]
    stage.reset()
    both = stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 2, image_of=lambda k: wall_ahead(PLANE_M))[
        "static"
    ][cell(*FACE)]
    # images come every fourth step, scans every second: gain per image is that of 12.5 Hz
    assert both - without == pytest.approx(2 * 0.8 * MAP.depth_hit, abs=1e-3)


def test_depth_never_burns_a_moving_obstacle_into_the_static_layer(stage):
    stage.reset()
    after = stage.run(lambda k: ring(EYE, [(*BODY, -0.3, 0.0)]), 10, image_of=lambda k: wall_ahead(PLANE_M))
    assert after["dynamic"][cell(*FACE)] > MAP.occupied and after["static"][cell(*FACE)] == 0
    unseen = stage.run(lambda k: blind(EYE), 3, first=10, image_of=lambda k: wall_ahead(PLANE_M))
    assert unseen["static"][cell(*FACE)] == 0


def test_image_between_scans_waits_for_the_next_merge(stage):
    stage.reset()
    stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 5)
    before = stage.read()["static"][0][cell(*FACE)]
    stage.set_step(9)
    stage.scan.fresh.fill(0)
    stage.put_images([wall_ahead(PLANE_M)] * N_ENV)
    stage.update()
    waiting = stage.read()
    assert waiting["static"][0][cell(*FACE)] == before and waiting["depth_hit"][0][cell(*FACE)]
    after = stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 1, first=5)
    gain = 0.4 * MAP.static_hit + 0.8 * MAP.depth_hit
    assert after["static"][cell(*FACE)] == pytest.approx(
        before * (1 - MAP.static_decay) ** 0.4 + gain, abs=OCCUPANCY_TOLERANCE
    )


# --------------------------------------------------------------------------------------------- clock and rows


def test_scans_closer_than_the_period_stale_scans_and_sleeping_rows_change_nothing(stage):
    stage.reset()
    first = stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 1)
    for step, fresh, active in ((1, 1, 1), (2, 0, 1), (3, 1, 0)):
        stage.set_step(step)
        stage.set_active(active)
        stage.scan.fresh.fill(fresh)
        stage.update()
        for name, value in stage.read().items():
            np.testing.assert_array_equal(value[0], first[name])
    stage.set_active(1)
    stage.update()
    assert stage.read()["static"][0][cell(*FACE)] > first["static"][cell(*FACE)]


def random_run(stage, order, seed, n_scan=6, twist=None):
    """Maps after a few random scans; env i plays the scans of ``order[i]``."""
    stage.reset()
    for k in range(n_scan):
        scans, images = [], []
        for source in order:
            rng = np.random.default_rng([seed, source, k, 1 if twist == source else 0])
            scans.append(random_scan(rng, TANK))
            images.append(random_image(rng, scans[-1]))
        stage.set_step(3 * k)
        stage.put_scans(scans)
        stage.put_images(images if k % 2 else None)
        stage.update()
    return stage.read()


@settings(max_examples=3, deadline=None, derandomize=True)
@given(order=st.permutations(range(N_ENV)), seed=st.integers(0, 1000))
def test_permuting_envs_permutes_maps(stage, order, seed):
    straight, permuted = random_run(stage, range(N_ENV), seed), random_run(stage, order, seed)
    for name in FIELDS:
        np.testing.assert_array_equal(permuted[name], straight[name][list(order)])


@settings(max_examples=3, deadline=None, derandomize=True)
@given(changed=st.integers(0, N_ENV - 1), seed=st.integers(0, 1000))
def test_one_env_never_touches_another(stage, changed, seed):
    plain = random_run(stage, range(N_ENV), seed)
    twisted = random_run(stage, range(N_ENV), seed, twist=changed)
    others = [env for env in range(N_ENV) if env != changed]
    assert (plain["static"][changed] != twisted["static"][changed]).any()
    for name in FIELDS:
        np.testing.assert_array_equal(plain[name][others], twisted[name][others])


@settings(max_examples=4, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n_scan=st.integers(1, 12))
def test_occupancy_stays_in_its_bounds(stage, seed, n_scan):
    after = random_run(stage, range(N_ENV), seed, n_scan)
    for layer in ("static", "dynamic"):
        assert after[layer].min() >= 0 and after[layer].max() <= 1
        assert after[layer].max() > 0


def test_position_estimate_off_the_grid_is_harmless(stage):
    """Dead reckoning may drift through a wall: no write out of bounds, nothing occupied off the tank."""
    stage.reset()
    after = stage.run(
        lambda k: ring(EYE, [(*BODY, 0, 0)]) | {"pos": np.array([-3.0 + k, 9.0 - 2 * k, -0.8])}, 8
    )
    outside = np.array(outside_cells(TANK, MAP.cell_m))
    assert after["static"][outside].max() == 0 and not after["seen"][outside].any()


def test_reset_empties_awake_rows_only(stage):
    random_run(stage, range(N_ENV), 5)
    before = stage.read()
    active = np.array([1, 0, 1, 0, 0, 1])
    stage.reset(active)
    after = stage.read()
    for env in range(N_ENV):
        for name in FIELDS:
            np.testing.assert_array_equal(
                after[name][env], np.zeros(SHAPE) if active[env] else before[name][env]
            )
    # and a reset row starts to map at once, whatever its last scan was
    assert stage.run(lambda k: ring(EYE, [(*BODY, 0, 0)]), 1)["static"][cell(*FACE)] > 0
