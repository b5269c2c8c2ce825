"""Obstacles that the camera shows while beams pass above or below: drawn scenes and a float64 oracle."""

import numpy as np
import pytest

from tests.bundles import Stage, put
from tests.oracles import camera_tracking as oracle
from tests.oracles.height import prior
from tests.oracles.scenes import BOX, CYLINDER, SPHERE, load, quaternions
from tests.oracles.tracking import predicted
from uuvtai.config import (
    CameraTrackingConfig,
    DepthConfig,
    EpisodeConfig,
    HeightConfig,
    SonarConfig,
    TankConfig,
    TrackingConfig,
)
from uuvtai.kernels.perception import camera_tracking
from uuvtai.kernels.perception.io import TrackingIO
from uuvtai.kernels.sensors import depth_camera
from uuvtai.kernels.sensors.io import DepthIO

N_ENV, N_TRACK, N_OBSTACLE = 12, 3, 3
TANK, RULES = TankConfig(x_m=(0.0, 20.0), y_m=(0.0, 6.0), z_m=(-1.6, 0.0)), EpisodeConfig(control_dt_s=0.02)
CAMERA, SONAR, ELEVATION, TRACKING = (
    DepthConfig(period_steps=5), SonarConfig(n_ray=256), HeightConfig(), TrackingConfig(),
)  # fmt: skip
CFG = CameraTrackingConfig(range_m=4.0, sigma_m=0.035)
SIZES = {
    "n_env": N_ENV, "n_track": N_TRACK, "n_obstacle": N_OBSTACLE, "n_height": 16, "n_ray": SONAR.n_ray,
    "n_thruster": 6,
    "n_pixel_row": CAMERA.rows, "n_pixel_col": CAMERA.cols,
}  # fmt: skip
STEP = 100
OWN = np.array([5.0, 3.0, -0.8])
EYE = OWN + CAMERA.offset_b_m
HIGH = -0.4
"""[m] height of a ball's centre that the sonar's fan (3 degrees, 0.1 m at 2 m) passes below"""
RADIUS = 0.2
PERIOD_S = CAMERA.period_steps * RULES.control_dt_s

COLUMN_TOLERANCE = 1e-4
"""[m] float32 rays through an attitude, times up to 4 m; pixels this close to a bound of range, height or
wall are left out."""

STATE_TOLERANCE = 2e-4
"""[m, m/s] as for the sonar's corrections (test_tracking.py): places of 20 m are good to 2e-6 m, gains in 1/s
amplify it tenfold."""

COV_TOLERANCE = 2e-4
"""Relative to the variances, as there."""

CLOSE = 1e-4
"""[m, beam, share of the turn gate] what is this close to being decided otherwise in float32 is not
compared."""

PLACE_M = 0.04
"""A centre told by one image: columns 1.6 cm wide at 1 m and 5 cm at 3 m leave half of that across, and a
tenth of the old error."""


class Rig(Stage):
    """One instance of the structs, so that each kernel is compiled once."""

    sizes = SIZES

    def begin(self):
        """Everyone level at OWN facing +x in an empty tank at step 100; no track; a ping that met nothing."""
        self.pos, self.rpy = np.tile(OWN, (N_ENV, 1)), np.zeros((N_ENV, 3))
        self.kind, self.obstacle_pos = np.zeros((N_ENV, N_OBSTACLE), int), np.zeros((N_ENV, N_OBSTACLE, 3))
        self.size = np.ones((N_ENV, N_OBSTACLE, 3))
        self.memory = {name: np.zeros_like(field.to_numpy()) for name, field in vars(self.tracks).items()}
        self.memory["spot_step"][:] = -1
        self.memory["scan_step"][:] = STEP
        self.scanned = {
            "range_m": np.full((N_ENV, SONAR.n_ray), 12.0), "hit": np.zeros((N_ENV, SONAR.n_ray)),
            "ping_yaw": np.zeros(N_ENV),
            "ping_step": np.full(N_ENV, STEP), "ping_pos_w": self.pos,
        }  # fmt: skip
        self.active, self.step = np.ones(N_ENV), STEP
        self.spots.column_m.fill(oracle.FAR_M)
        self.spots.edge_m.fill(oracle.FAR_M)
        return self

    def put(self, env, x, y, z=HIGH, kind=SPHERE, size=(RADIUS, RADIUS, RADIUS), slot=0):
        self.kind[env, slot], self.obstacle_pos[env, slot], self.size[env, slot] = kind, (x, y, z), size

    def track(self, env, place, vel=(0.0, 0.0), slot=0, unseen_s=1.0, sigma=(0.15, 0.3), **fields):
        """A moving track that neither the sonar nor the camera has seen for ``unseen_s``."""
        cov = np.zeros(10)
        cov[[0, 4, 7, 9]] = np.repeat(np.square(sigma), 2)
        known = {
            "alive": 1, "moving": 1, "state": [*place, *vel], "cov": cov, "radius_m": RADIUS,
            "radius_var": 0.0, "present": 0.5,
            "seen_step": self.step - round(unseen_s / RULES.control_dt_s), "spot_step": -1,
        }  # fmt: skip
        for name, value in (known | fields).items():
            self.memory[name][env, slot] = value

    def beams(self, env, bearing, range_m):
        """The sonar met something at a world bearing."""
        ray = round((bearing - self.scanned["ping_yaw"][env]) / (2 * np.pi / SONAR.n_ray)) % SONAR.n_ray
        self.scanned["hit"][env, ray], self.scanned["range_m"][env, ray] = 1, range_m

    def load(self):
        scene = {
            "kind": self.kind,
            "obstacle_pos": self.obstacle_pos,
            "size": self.size,
            "yaw": np.zeros((N_ENV, N_OBSTACLE)),
        }
        scene |= {
            "obstacle_vel": np.zeros((N_ENV, N_OBSTACLE, 3)),
            "pos": self.pos,
            "quat": quaternions(self.rpy),
            "vel_b": np.zeros((N_ENV, 3)),
        }
        load(scene, self.vehicle, self.world)
        put(self.ego, pos_w=self.pos, rpy=self.rpy)
        put(self.tracks, **self.memory)
        put(self.scan, **self.scanned)
        put(self.clock, active=self.active, step=np.full(N_ENV, self.step))

    def look(self):
        """Draw the image and follow what it shows; returns the memory afterwards."""
        self.load()
        io = self.io(DepthIO, CAMERA, TANK)
        depth_camera.cast_depth(io)
        return self.follow()

    def follow(self):
        camera_tracking.scan_columns(self.io(TrackingIO, CFG, CAMERA, TANK))
        camera_tracking.follow_spots(self.io(TrackingIO, CFG, CAMERA, SONAR, ELEVATION, TRACKING, RULES))
        self.memory = {name: field.to_numpy() for name, field in vars(self.tracks).items()}
        return self.memory

    def wait(self):
        """To the next image: a scan that met nothing, and every track predicted to it."""
        self.step += CAMERA.period_steps
        self.memory["scan_step"][:] = self.scanned["ping_step"] = np.full(N_ENV, self.step)
        for env, slot in np.argwhere(self.memory["alive"]):
            x, P = belief(self.memory, env, slot)
            x, P = predicted(x, P, PERIOD_S, TRACKING.accel_density, TRACKING.turn_density)
            self.memory["state"][env, slot], self.memory["cov"][env, slot] = x[:4], P[np.triu_indices(4)]


def belief(memory, env, slot):
    """(mean, covariance) of x, y, vx, vy and turn rate."""
    P = np.zeros((5, 5))
    P[np.triu_indices(4)] = memory["cov"][env, slot]
    P[:, 4] = memory["turn_cov"][env, slot]
    return np.append(memory["state"][env, slot], memory["turn_rate"][env, slot]).astype(float), P + np.triu(
        P, 1
    ).T


rig = Rig.begun()


def off_m(rig, env, slot=0, body=0):
    """Distance of a track from an obstacle's true centre."""
    return np.hypot(*(rig.memory["state"][env, slot, :2] - rig.obstacle_pos[env, body, :2]))


# ----------------------------------------------------------------------------------------------------- oracle


def test_columns_equal_the_oracle(rig):
    """Images of random pixels, some without return, at random attitudes and near walls."""
    rng = np.random.default_rng(1)
    compared, empty, at_edge = 0, 0, 0
    for most in (1.0, 8.0):
        rig.pos = rng.uniform([1, 0.6, -1.4], [19, 5.4, -0.2], (N_ENV, 3)).astype(np.float32).astype(float)
        rig.rpy = (
            rng.uniform([-0.3, -0.4, -3.1], [0.3, 0.4, 3.1], (N_ENV, 3)).astype(np.float32).astype(float)
        )
        rig.load()
        pixels = rng.uniform(most / 4, most, (N_ENV, CAMERA.rows, CAMERA.cols)) * rng.uniform(
            1, 8, (N_ENV, 1, CAMERA.cols)
        )
        pixels = np.minimum(pixels, CAMERA.max_range_m).astype(np.float32)
        put(rig.image, depth_m=pixels, fresh=np.ones(N_ENV), shot_pos_w=rig.pos, shot_rpy=rig.rpy)
        rig.follow()
        near, edge = rig.spots.column_m.to_numpy(), rig.spots.edge_m.to_numpy()
        for env in range(0, N_ENV, 2):
            *wanted, doubt = oracle.columns(
                pixels[env].astype(float), oracle.View(rig.pos[env], rig.rpy[env]), CFG, CAMERA, TANK
            )
            sure = doubt > COLUMN_TOLERANCE
            np.testing.assert_allclose(near[env][sure], wanted[0][sure], atol=COLUMN_TOLERANCE)
            np.testing.assert_allclose(edge[env][sure], wanted[1][sure], atol=COLUMN_TOLERANCE)
            compared, empty = compared + sure.sum(), empty + (wanted[0][sure] == oracle.FAR_M).sum()
            at_edge += (wanted[1][sure] < oracle.FAR_M).sum()
    assert compared > 0.9 * N_ENV * CAMERA.cols and empty > 50 and at_edge > 50


def random_scene(rig, rng):
    """Obstacles ahead, tracks on or beside them (or not), a few beams that met something as far away."""
    rig.pos = rng.uniform([4, 1.8, -1.2], [16, 4.2, -0.4], (N_ENV, 3)).astype(np.float32).astype(float)
    rig.rpy = rng.uniform([-0.1, -0.2, -3.1], [0.1, 0.2, 3.1], (N_ENV, 3)).astype(np.float32).astype(float)
    rig.memory["scan_step"] = rig.scanned["ping_step"] = STEP - rng.integers(0, 4, N_ENV)
    rig.scanned["ping_pos_w"] = (rig.pos + rng.normal(0, 0.02, (N_ENV, 3))).astype(np.float32)
    rig.scanned["ping_yaw"] = (rig.rpy[:, 2] + rng.normal(0, 0.05, N_ENV)).astype(np.float32)
    rig.scanned["hit"] = rng.random((N_ENV, 256)) < 0.15
    rig.scanned["range_m"] = np.float32(rng.uniform(0.5, 3, (N_ENV, 256)))
    for env, slot in np.ndindex(N_ENV, N_OBSTACLE):
        bearing, away = rig.rpy[env, 2] + rng.uniform(-0.8, 0.8), rng.uniform(0.9, 3.0)
        x, y = rig.pos[env, :2] + away * np.array([np.cos(bearing), np.sin(bearing)])
        kind = rng.choice([SPHERE, CYLINDER, BOX], p=[0.5, 0.4, 0.1])
        size = {SPHERE: (0.2, 0.2, 0.2), CYLINDER: (0.2, 0.2, 0.3), BOX: (0.3, 0.6, 0.2)}[kind]
        rig.put(env, x, y, rng.uniform(-1.4, -0.2), kind, size, slot)
        if rng.random() < 0.6:
            off, vel = rng.normal(0, 0.15, 2) * rng.choice([0.3, 1.0, 4.0]), rng.uniform(-0.5, 0.5, 2)
            seen, moves = rng.choice([0.06, 0.3, 1.0]), int(rng.random() < 0.8)
            spot = rng.choice([-1, STEP - 5, STEP - 25])
            rig.track(
                env, (x + off[0], y + off[1]), vel, slot, seen, (rng.uniform(0.03, 0.2), 0.4), moving=moves,
                spot_step=spot,
            )  # fmt: skip
            spread = rng.normal(0, 0.1, (5, 5))
            P = spread @ spread.T * 0.3 + np.diag([0.004, 0.004, 0.05, 0.05, 0.1])
            rig.memory["cov"][env, slot] = P[np.triu_indices(4)]
            turns = rng.random() < 0.5
            rig.memory["turn_cov"][env, slot], rig.memory["turn_rate"][env, slot] = P[4] * turns, 0.3 * turns
            rig.memory["radius_m"][env, slot] = rng.uniform(0.12, 0.3)
            rig.memory["radius_var"][env, slot] = 0.0004


def known_tracks(memory, env):
    """The stored rows of one env as oracle tracks."""
    out = {}
    for slot in np.flatnonzero(memory["alive"][env]):
        radius, var, present, z = (
            float(memory[name][env, slot]) for name in ("radius_m", "radius_var", "present", "z_m")
        )
        moving, seen, spot = (int(memory[name][env, slot]) for name in ("moving", "seen_step", "spot_step"))
        out[int(slot)] = oracle.Track(*belief(memory, env, slot), radius, var, moving, seen, spot, present, z)
    return out


def test_every_track_equals_the_oracle(rig):
    """The oracle takes the kernel's columns: only the rules of spots are compared."""
    rng, done, left_out = np.random.default_rng(2), [], 0
    for _ in range(8):
        rig.begin()
        random_scene(rig, rng)
        rig.load()
        before = {name: field.to_numpy() for name, field in vars(rig.tracks).items()}
        after = rig.look()
        near, edge = (getattr(rig.spots, name).to_numpy().astype(float) for name in ("column_m", "edge_m"))
        sonar = {name: getattr(rig.scan, name).to_numpy() for name in rig.scanned}
        for env in range(N_ENV):
            view, tracks = oracle.View(rig.pos[env], rig.rpy[env]), known_tracks(before, env)
            scan = oracle.Scan(
                *(sonar[n][env] for n in ("range_m", "hit", "ping_pos_w", "ping_yaw", "ping_step"))
            )
            what, doubt = oracle.follow(
                tracks, N_TRACK, near[env], edge[env], view, scan, STEP, before["scan_step"][env], CFG,
                CAMERA, SONAR, TRACKING, 0.02,
            )  # fmt: skip
            if doubt < CLOSE:
                left_out += 1
                continue
            done += what
            assert_equal_tracks(after, env, tracks)
    assert left_out < N_ENV
    counts = {name: done.count(name) for name in ("corrected", "begun", "known", "cut", "sonar's", "wide")}
    assert min(counts.values()) > 5, counts


def assert_equal_tracks(memory, env, expected):
    found = known_tracks(memory, env)
    assert set(found) == set(expected)
    for slot, track in expected.items():
        sigma = np.sqrt(np.diag(track.P)) + 1e-9
        np.testing.assert_allclose(found[slot].x, track.x, atol=STATE_TOLERANCE)
        np.testing.assert_allclose(
            found[slot].P / np.outer(sigma, sigma), track.P / np.outer(sigma, sigma), atol=COV_TOLERANCE
        )
        for name in ("radius", "radius_var", "present", "z"):
            assert getattr(found[slot], name) == pytest.approx(getattr(track, name), abs=1e-5), name
        for name in ("moving", "seen", "spot"):
            assert getattr(found[slot], name) == getattr(track, name), name


# ----------------------------------------------------------------------------------------------------- scenes


def test_a_obstacle_above_or_below_the_fan_corrects_its_track(rig):
    """A track, 15 cm off, comes to within a few centimetres, and to nobody else's."""
    for env in range(N_ENV):
        yaw = 0.6 * env
        rig.pos[env], rig.rpy[env] = (10.0, 3.0, -0.8), (0.02 * (-1) ** env, 0.06 * np.sin(env), yaw)
        bearing, away = yaw + 0.4 * np.cos(env), 1.5 + 0.1 * env
        x, y = 10.0 + away * np.cos(bearing), 3.0 + away * np.sin(bearing)
        rig.put(env, x, y, -0.8 + 0.35 * (-1) ** env)
        rig.track(env, (x + 0.15 * np.cos(env), y + 0.15 * np.sin(env)))
        rig.track(env, (x + 1.0, y), slot=2)
    memory = rig.look()
    assert max(off_m(rig, env) for env in range(N_ENV)) < PLACE_M
    np.testing.assert_array_equal(memory["alive"], np.tile([1, 0, 1], (N_ENV, 1)))
    np.testing.assert_array_equal(memory["spot_step"][:, [0, 2]], np.tile([STEP, -1], (N_ENV, 1)))
    np.testing.assert_allclose(memory["present"][:, [0, 2]], np.tile([0.95, 0.5], (N_ENV, 1)), atol=1e-6)
    assert (memory["cov"][:, 0][:, [0, 4]] < 0.05**2).all()


def test_the_expected_place_is_that_of_the_images_time(rig):
    """The states refer to a ping 0.1 s ago: an obstacle at 1 m/s has gone on by 10 cm."""
    rig.put(0, 7.0, 3.1)
    rig.track(0, (7.0, 3.0), (0.0, 1.0), sigma=(0.05, 0.3))
    rig.memory["scan_step"][:] = STEP - 5
    assert np.abs(rig.look()["state"][0, 0] - [7.0, 3.0, 0.0, 1.0]).max() < 0.03


def test_a_obstacle_that_turned_back_is_recovered(rig):
    """Unseen for 0.6 s, 0.7 m from where it is expected; four images later its motion is known."""
    rig.put(0, 6.8, 2.7)
    rig.track(0, (6.8, 3.4), (0.0, 0.6), unseen_s=0.6, sigma=(0.05, 0.1))
    rig.look()
    assert off_m(rig, 0) < PLACE_M
    for _ in range(5):
        rig.wait()
        rig.obstacle_pos[0, 0, 1] -= 0.6 * PERIOD_S
        rig.look()
    assert off_m(rig, 0) < PLACE_M
    assert rig.memory["alive"][0].sum() == 1
    np.testing.assert_allclose(rig.memory["state"][0, 0, 2:], [0.0, -0.6], atol=0.15)


def test_how_far_a_track_may_be_found(rig):
    """0.5 m off: too far for one just seen or slow, not for a quick one that was long unseen."""
    for env, (speed, unseen_s) in enumerate(((0.5, 0.16), (0.05, 1.0), (0.5, 0.3), (2.0, 1.0))):
        rig.put(env, 6.8, 3.0)
        rig.track(env, (6.8 + (1.25 if speed == 2.0 else 0.5), 3.0), (0.0, speed), unseen_s=unseen_s)
    memory = rig.look()
    np.testing.assert_array_equal(memory["spot_step"][:4, 0] == STEP, [False, False, True, False])
    # 1.25 m away it is an obstacle of its own
    np.testing.assert_array_equal(memory["alive"][:4].sum(1), [1, 1, 1, 2])


def test_one_track_takes_one_spot(rig):
    """Of two small obstacles within reach the left one, first, is it; the other is too near for a track."""
    for slot, y in enumerate((3.13, 2.87)):
        rig.put(0, 6.8, y, size=(0.1, 0.1, 0.1), slot=slot)
    rig.track(0, (6.8, 3.02), radius_m=0.1)
    assert rig.look()["alive"][0].sum() == 1
    assert off_m(rig, 0) < PLACE_M


def test_an_unknown_obstacle_rests_until_its_second_sighting(rig):
    """Called moving by the first image more than 0.15 s later; then its velocity is learnt."""
    for env in range(2):
        rig.put(env, 6.8, 3.0)
    rig.track(1, (12.0, 3.0), slot=2)
    rig.look()
    born = {
        name: value[0, 2]
        for name, value in rig.memory.items()
        if value.ndim > 1 and value.shape[1] == N_TRACK
    }
    assert off_m(rig, 0, 2) < PLACE_M and not born["state"][2:].any()
    assert (born["alive"], born["moving"], born["misses"], born["spot_step"], born["seen_step"]) == (
        1, 0, 1, STEP, STEP,
    )  # fmt: skip
    assert born["radius_m"] == pytest.approx(RADIUS, abs=0.03) and born["z_m"] == pytest.approx(EYE[2])
    np.testing.assert_allclose(born["height"].ravel(), prior(ELEVATION), rtol=1e-5)
    assert off_m(rig, 1, 1) < PLACE_M  # the next free slot
    moving = []
    for _ in range(6):
        rig.wait()
        rig.obstacle_pos[:2, 0, 1] += 0.5 * PERIOD_S
        rig.look()
        moving.append(rig.memory["moving"][0, 2])
        assert rig.memory["alive"][:2].sum() == 3
    assert moving == [0, 1, 1, 1, 1, 1]
    assert off_m(rig, 0, 2) < PLACE_M
    np.testing.assert_allclose(rig.memory["state"][0, 2, 2:], [0.0, 0.5], atol=0.15)


def test_what_the_sonar_shows_is_left_to_the_sonar(rig):
    """A beam met something as far away: neither born nor corrected. Nearer, farther, two beams beside: is."""
    gap = 6.8 - RADIUS - OWN[0]
    beam = 2 * np.pi / SONAR.n_ray
    for env, (bearing, range_m) in enumerate(
        ((0.0, gap), (beam, gap + 0.2), (0.0, gap + 0.3), (0.0, gap - 0.3), (3 * beam, gap))
    ):
        rig.put(env, 6.8, 3.0)
        rig.put(env + 5, 6.8, 3.0)
        rig.track(env, (6.9, 3.0))
        for row in (env, env + 5):
            rig.scanned["ping_yaw"][row] = 0.5 * env
            rig.beams(row, bearing, range_m)
    before = rig.memory["state"].copy()
    memory = rig.look()
    np.testing.assert_array_equal(memory["spot_step"][:5, 0] == STEP, [False, False, True, True, True])
    np.testing.assert_array_equal(memory["alive"][5:10].sum(1), [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(memory["state"][:2], before[:2].astype(np.float32))


def test_tracks_that_the_sonar_sees_and_resting_ones_are_let_alone(rig):
    """Seen 0.1 s ago, resting or dead: not corrected, and only the dead one gets a second track."""
    cases = {
        0: {"unseen_s": 0.1},
        1: {"moving": 0},
        2: {"alive": 0},
        3: {"moving": 0, "spot_step": STEP - 25},
    }
    for env, case in cases.items():
        rig.put(env, 6.8, 3.0)
        rig.track(env, (6.9, 3.0), **case)
    memory = rig.look()
    np.testing.assert_array_equal(memory["spot_step"][:4, 0] == STEP, [False, False, False, True])
    np.testing.assert_array_equal(memory["alive"][:4].sum(1), [1, 1, 1, 1])
    assert memory["moving"][3, 0] == 1 and memory["alive"][2, 2] == 1


def test_walls_and_things_far_high_or_wide_begin_nothing(rig):
    """And without any ping yet, nothing begins at all; the last env shows that the same ball would."""
    rig.pos[0] = (18.5, 3.0, -0.8)  # the end wall, 1.3 m ahead
    rig.pos[1], rig.rpy[1] = (10.0, 0.8, -0.8), (0.0, 0.05, -0.7)  # a side wall askew, the nose down
    rig.put(2, EYE[0] + 4.25, 3.0)
    rig.pos[3, 2] = -1.45
    rig.put(3, EYE[0] + 3.0, 3.0, -0.3, size=(0.15, 0.15, 0.15))
    rig.put(4, EYE[0] + 2.0, 3.0, HIGH, BOX, (0.2, 0.5, 0.2))
    rig.pos[5] = (18.0, 3.0, -0.8)
    rig.put(5, 19.95, 3.0)
    rig.put(6, 6.8, 3.0)
    rig.scanned["ping_step"][6] = -1
    rig.put(7, 6.8, 3.0)
    rig.scanned["ping_pos_w"] = rig.pos
    assert rig.look()["alive"].sum(1).tolist() == [0] * 7 + [1] + [0] * 4
    assert (rig.image.depth_m.to_numpy()[:6].min((1, 2)) < 4.5).all()  # each of them is in the picture


def test_a_spot_cut_by_the_image_corrects_loosely(rig):
    """Beyond the left edge: hardly across; the upper: hardly along. Unknown and cut: nothing begins."""
    edge = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4)])
    inside = np.array([np.cos(0.4), np.sin(0.4)])
    beside = EYE[:2] + 1.8 * edge
    places = {
        0: (EYE[:2] + 1.8 * inside, -0.6),
        1: (beside, -0.6),
        2: ((EYE[0] + 0.9, EYE[1]), -0.25),
        3: (beside, -0.6),
    }
    for env, (place, z) in places.items():
        rig.put(env, *place, z)
        if env < 3:
            rig.track(env, place)
    cov = rig.look()["cov"].astype(float)
    assert rig.memory["spot_step"][:3, 0].tolist() == [STEP] * 3 and not rig.memory["alive"][3].any()
    axes = {0: inside, 1: edge, 2: np.array([1.0, 0.0])}
    tight, loose = (0.15**-2 + CFG.sigma_m**-2) ** -1, (0.15**-2 + (CFG.sigma_m**2 + RADIUS**2) ** -1) ** -1
    for env, wanted in {0: (tight, tight), 1: (tight, loose), 2: (loose, tight)}.items():
        along, P = axes[env], cov[env, 0][[0, 1, 1, 4]].reshape(2, 2)
        across = np.array([-along[1], along[0]])
        np.testing.assert_allclose((along @ P @ along, across @ P @ across), wanted, rtol=0.15)


# ------------------------------------------------------------------------------------------------- discipline


def test_sleeping_rows_old_images_and_other_rows(rig):
    """Rows give the same bits in any company; inactive rows and rows without a new image keep theirs."""
    random_scene(rig, np.random.default_rng(4))
    first = rig.look()
    rig.begin()
    random_scene(rig, np.random.default_rng(4))
    order = np.random.default_rng(5).permutation(N_ENV)
    for name in ("pos", "rpy", "kind", "obstacle_pos", "size"):
        setattr(rig, name, getattr(rig, name)[order])
    for group in (rig.memory, rig.scanned):
        group.update({name: value[order] for name, value in group.items()})
    for name, value in rig.look().items():
        np.testing.assert_array_equal(value, first[name][order], err_msg=name)
    assert (first["spot_step"] == STEP).sum() > N_ENV / 2
    for still, rows in (("asleep", slice(0, 6)), ("stale", slice(6, 12))):
        rig.begin()
        random_scene(rig, np.random.default_rng(4))
        rig.active[rows] = still == "stale"
        rig.load()
        before = {name: field.to_numpy() for name, field in vars(rig.tracks).items()}
        depth_camera.cast_depth(rig.io(DepthIO, CAMERA, TANK))
        fresh = np.ones(N_ENV)
        fresh[rows] = still == "asleep"
        put(rig.image, fresh=fresh)
        after, others = rig.follow(), np.delete(np.arange(N_ENV), rows)
        for name in before:
            np.testing.assert_array_equal(after[name][rows], before[name][rows], err_msg=name)
            np.testing.assert_array_equal(after[name][others], first[name][others], err_msg=name)
        assert (rig.spots.column_m.to_numpy()[rows] == oracle.FAR_M).all()


def test_without_the_camera_nothing_is_spotted(small, monkeypatch):
    """With use_camera off no column is measured and no track spotted; with it some are."""
    sim = small.sim
    for use in (False, True):
        changed = small.config.camera_tracking.model_copy(update={"use_camera": use})
        if not use:
            monkeypatch.setattr(sim, "config", small.config.model_copy(update={"camera_tracking": changed}))
        else:
            monkeypatch.undo()
        small.begin(list(range(small.N)))
        sim.s.spots.column_m.fill(-1.0)
        spotted = 0
        for _ in range(60):
            sim.step()
            spotted += (sim.s.tracks.spot_step.to_numpy() >= 0).sum()
        assert (spotted > 0) == use
        assert (sim.s.spots.column_m.to_numpy() == -1.0).all() == (not use)
