"""What the camera says about heights: hand-made scenes by the depth camera's oracle, the rule in float64."""

import numpy as np
import pytest

from tests.bundles import Stage, clear, put
from tests.oracles import height as weighing
from tests.oracles import look as oracle
from tests.oracles.depth import camera_position, camera_rays, z_depths
from tests.oracles.scenes import BOX, CYLINDER, SPHERE, quaternions
from uuvtai.config import DepthConfig, EpisodeConfig, HeightConfig, TankConfig
from uuvtai.kernels.core.simd import LANES
from uuvtai.kernels.perception import camera_tracking
from uuvtai.kernels.perception.io import TrackingIO

N_ENV, N_TRACK = 12, 3
TANK, RULES = TankConfig(x_m=(0.0, 20.0), y_m=(0.0, 6.0), z_m=(-1.6, 0.0)), EpisodeConfig(control_dt_s=0.02)
CAMERA = DepthConfig(rows=36, cols=64, fov_deg=90.0, offset_b_m=(0.2, 0.0, 0.0), max_range_m=8.0)
CFG = HeightConfig(column_share=0.05, use_camera=True)
SIZES = {
    "n_env": N_ENV, "n_track": N_TRACK, "n_height": LANES, "n_ray": 16, "n_pixel_row": CAMERA.rows,
    "n_pixel_col": CAMERA.cols,
}  # fmt: skip
HEIGHTS = weighing.heights(TANK)
SLICE_M = HEIGHTS[1] - HEIGHTS[0]
PRIOR = weighing.prior(CFG)
OWN = np.array([5.0, 3.0, -0.8])
EYE_X = 5.2
TOP = (CAMERA.rows / 2) / (CAMERA.cols / 2)
"""Tangent of the elevation of the image's upper edge."""

SHARE_TOLERANCE = 1e-5
"""One weighing of sixteen shares in float32."""

CLOSE = 1e-4
"""[m, pixel] what is this close to a rule's edge may be decided otherwise in float32 (positions of 20 m are
good to 2e-6 m)."""


class Rig(Stage):
    sizes = SIZES

    def begin(self):
        """Nothing tracked, only walls in view, everyone level at (5, 3, -0.8) facing +x; a fresh image."""
        clear(self.tracks, self.image, self.clock)
        self.clock.active.fill(1)
        self.image.fresh.fill(1)
        self.pos, self.rpy = np.tile(OWN, (N_ENV, 1)), np.zeros((N_ENV, 3))
        self.obstacles = [[] for _ in range(N_ENV)]
        self.place, self.radius = np.zeros((N_ENV, N_TRACK, 2)), np.zeros((N_ENV, N_TRACK))
        self.share, self.present = np.tile(PRIOR, (N_ENV, N_TRACK, 1)), np.full((N_ENV, N_TRACK), 0.9)
        return self

    def track(self, env, x, y, radius=0.2, track=0):
        self.place[env, track], self.radius[env, track] = (x, y), radius

    def put(self, env, kind, x, y, z, size, tracked=True):
        """An obstacle; size: ball's radius, cylinder's (radius, half height), full box's (half x, half y)."""
        extents = {
            SPHERE: lambda: (size,) * 3,
            CYLINDER: lambda: (size[0], *size),
            BOX: lambda: (*size, 0.8),
        }[kind]()
        self.obstacles[env].append((kind, (x, y, z), extents))
        if tracked:
            self.track(env, x, y, size if kind == SPHERE else size[0])

    def load(self):
        """Draw the images, and bring everything to the kernel's structs."""
        n_obstacle = max(1, *(len(obstacles) for obstacles in self.obstacles))
        scene = {
            "pos": self.pos, "quat": quaternions(self.rpy), "kind": np.zeros((N_ENV, n_obstacle), int),
            "yaw": np.zeros((N_ENV, n_obstacle)),
            "obstacle_pos": np.zeros((N_ENV, n_obstacle, 3)), "size": np.ones((N_ENV, n_obstacle, 3)),
        }  # fmt: skip
        pixels = np.argwhere(np.ones((CAMERA.rows, CAMERA.cols)))
        self.depth_m = np.zeros((N_ENV, CAMERA.rows, CAMERA.cols))
        for env, obstacles in enumerate(self.obstacles):
            for slot, (kind, pos, size) in enumerate(obstacles):
                scene["kind"][env, slot], scene["obstacle_pos"][env, slot] = kind, pos
                scene["size"][env, slot] = size
            rays, eye = camera_rays(scene["quat"][env], pixels, CAMERA), camera_position(scene, env, CAMERA)
            seen = np.minimum(z_depths(scene, env, TANK, rays, eye), CAMERA.max_range_m)
            self.depth_m[env] = seen.reshape(CAMERA.rows, CAMERA.cols)
        used = self.radius > 0
        state = np.concatenate([self.place, np.zeros((N_ENV, N_TRACK, 2))], 2)
        put(self.image, depth_m=self.depth_m, shot_pos_w=self.pos, shot_rpy=self.rpy)
        put(self.tracks, alive=used, moving=used, state=state, radius_m=self.radius, present=self.present)
        self.tracks.height.from_numpy(self.share.astype(np.float32).reshape(N_ENV, N_TRACK, 1, LANES))

    def look(self):
        """(shares, presences) after the kernel."""
        camera_tracking.look_at_obstacles(self.io(TrackingIO, CFG, CAMERA, TANK, RULES))
        return self.tracks.height.to_numpy()[:, :, 0].astype(float), self.tracks.present.to_numpy().astype(
            float
        )


rig = Rig.begun()


def mass(share, low, high):
    """Share of the centre heights from ``low`` to ``high``, slices that begin there included."""
    first, last = low - SLICE_M / 2, high + SLICE_M / 2
    return share[:-1][(first < HEIGHTS) & (last > HEIGHTS)].sum()


def test_a_obstacle_seen_wholly_lies_where_it_is_seen(rig):
    """At several heights and distances; also with the nose up or down, rolled, and turned."""
    z = np.linspace(-1.2, -0.4, N_ENV)
    for env in range(N_ENV):
        yaw = 0.7 * env
        rig.rpy[env] = (0.05 * (-1) ** env, 0.2 * np.sin(env), yaw) if env % 2 else (0, 0, yaw)
        rig.pos[env, :2] = 10.0, 3.0
        away = 1.6 + 0.08 * env
        x, y = 10.0 + away * np.cos(yaw), 3.0 + away * np.sin(yaw)
        if env % 3:
            rig.put(env, SPHERE, x, y, z[env], 0.2)
        else:
            rig.put(env, CYLINDER, x, y, z[env], (0.2, 0.2))
    rig.load()
    share, present = rig.look()
    for env in range(N_ENV):
        near, far = np.abs(HEIGHTS - z[env]) <= 0.5 * SLICE_M, np.abs(HEIGHTS - z[env]) > 0.25
        assert share[env, 0, :15][near].min() == share[env, 0].max() > 15 * share[env, 0, :15][far].max()
        assert share[env, 0, -1] < 0.02
    np.testing.assert_allclose(present[:, 0], 0.9, atol=1e-6)


def test_a_obstacle_cut_by_the_image_tells_its_visible_end_only(rig):
    """What may be is from the middle of what shows to 0.4 m beyond its visible end."""
    x = EYE_X + 0.8
    rig.put(0, CYLINDER, x, 3.0, -0.3, (0.2, 0.25))
    rig.put(1, CYLINDER, x, 3.0, -1.3, (0.2, 0.25))
    rig.put(2, CYLINDER, x, 3.0, -0.8, (0.2, 0.7))
    rig.load()
    share, _ = rig.look()
    visible_end, image_end = -0.55, -0.8 + 0.6 * TOP
    assert mass(share[0, 0], 0.5 * (visible_end + image_end) - 0.1, visible_end + 0.4 + 0.1) > 0.85
    assert share[0, 0, :8].max() < 0.1 * share[0, 0].max()
    above = [share[0, 0, i] for i in range(15) if -0.4 < HEIGHTS[i] < -0.2]
    # hidden heights stay equally likely
    assert len(above) == 2 and np.ptp(above) < 1e-6 and above[0] > PRIOR[0]
    np.testing.assert_allclose(share[1, 0, :15], share[0, 0, :15][::-1], atol=1e-5)  # the mirror image
    assert share[2, 0, 7] > PRIOR[7]
    assert share[2, 0, -1] == pytest.approx(share[2, 0, 7] * PRIOR[-1] / PRIOR[7], rel=1e-4)


def test_a_column_shows_from_edge_to_edge(rig):
    """With floor and surface in view an obstacle between them is a column, a tall one is not."""
    rig.put(0, CYLINDER, EYE_X + 2.5, 3.0, -0.8, (0.2, 0.8))
    rig.put(1, CYLINDER, EYE_X + 2.5, 3.0, -0.9, (0.2, 0.5))
    rig.load()
    share, _ = rig.look()
    assert share[0, 0, -1] > 3 * PRIOR[-1] and share[1, 0, -1] < PRIOR[-1] / 2
    assert mass(share[1, 0], -1.0, -0.8) > 0.8


def test_what_is_seen_past_is_not_there(rig):
    """Nothing shows: heights within the image and the column lose HIT_SHARE, so does presence."""
    rig.track(0, EYE_X + 1.0, 3.0)
    rig.track(1, EYE_X + 3.0, 3.0)
    rig.load()
    share, present = rig.look()
    for env, away in enumerate((1.0, 3.0)):
        inside = np.append(np.abs(HEIGHTS + 0.8) < TOP * (away - 0.1), True)
        assert inside.all() == (env == 1) and inside.sum() > 5
        wanted = weighing.seen_not(PRIOR, 0.9, np.where(inside, 1 - oracle.HIT_SHARE, 1.0))
        np.testing.assert_allclose(share[env, 0], wanted[0], atol=SHARE_TOLERANCE)
        assert present[env, 0] == pytest.approx(wanted[1], abs=SHARE_TOLERANCE)
    assert present[1, 0] < present[0, 0] < 0.9


def test_what_is_hidden_is_not_judged(rig):
    """Behind a box or a nearer body the camera learns nothing; past its edges it does."""
    away = EYE_X + 3.0
    rig.put(0, BOX, EYE_X + 1.0, 3.0, -0.8, (0.2, 0.5), tracked=False)
    rig.track(0, away, 3.0)
    rig.put(1, SPHERE, EYE_X + 1.0, 3.0, -0.8, 0.15, tracked=False)
    rig.track(1, away, 3.0)
    rig.load()
    share, present = rig.look()
    np.testing.assert_array_equal(share[0, 0].astype(np.float32), PRIOR.astype(np.float32))
    assert present[0, 0] == np.float32(0.9)
    shadow = np.abs(HEIGHTS + 0.8) < 0.15 * 2.9
    ratio = share[1, 0, :15] / share[1, 0, 7]
    np.testing.assert_allclose(ratio[~shadow], 1 - oracle.HIT_SHARE, rtol=1e-4)
    sure = np.abs(HEIGHTS + 0.8) < 0.12 * 2.9
    np.testing.assert_allclose(ratio[sure], 1.0, rtol=1e-5)


def test_an_end_behind_something_nearer_is_not_an_end(rig):
    """A ball hides half of a cylinder, whose middle may be lower (higher) than what shows."""
    far = EYE_X + 2.5
    for env, side in enumerate((-1, 1)):
        rig.put(env, CYLINDER, far, 3.0, -0.8, (0.2, 0.35))
        rig.put(env, SPHERE, EYE_X + 1.2, 3.0, -0.8 + side * 0.15, 0.17, tracked=False)
    rig.put(2, CYLINDER, far, 3.0, -0.8, (0.2, 0.35))
    rig.load()
    share, _ = rig.look()
    column = rig.depth_m[0, :, CAMERA.cols // 2]
    assert (column < 1.3).any() and ((column > 2) & (column < 2.6)).any()
    for env in range(3):
        assert mass(share[env, 0], -0.8, -0.8) > 2 * PRIOR[7]
    np.testing.assert_allclose(share[1, 0, :15], share[0, 0, :15][::-1], atol=1e-5)


def test_only_fresh_images_of_moving_obstacles_in_view_count(rig):
    """An old image, static, dead, behind, beside, too far, too near, inactive."""
    for env in range(9):
        rig.track(env, EYE_X + 2.0, 3.0)
    for env, place in {
        3: (3.0, 3.0), 4: (EYE_X + 1.0, 5.0), 5: (EYE_X + 7.9, 3.0), 6: (EYE_X + 0.4, 3.0),
    }.items():  # fmt: skip
        rig.track(env, *place)
    rig.load()
    flags = {
        name: np.ones(shape)
        for name, shape in (
            ("fresh", N_ENV), ("active", N_ENV), ("moving", (N_ENV, N_TRACK)), ("alive", (N_ENV, N_TRACK)),
        )
    }  # fmt: skip
    flags["fresh"][0] = flags["moving"][1, 0] = flags["alive"][2, 0] = flags["active"][7] = 0
    put(rig.image, fresh=flags["fresh"])
    put(rig.clock, active=flags["active"])
    put(rig.tracks, moving=flags["moving"], alive=flags["alive"] * (rig.radius > 0))
    share, present = rig.look()
    np.testing.assert_array_equal(share[:8, 0].astype(np.float32), np.tile(PRIOR.astype(np.float32), (8, 1)))
    np.testing.assert_array_equal(present[:8, 0].astype(np.float32), np.float32(0.9))
    assert present[8, 0] < 0.85


def test_a_track_is_looked_for_where_it_is_now(rig):
    """The image is newer than the scan: the body has moved on by 0.1 s at 1 m/s."""
    rig.put(0, SPHERE, EYE_X + 1.5, 3.4, -0.5, 0.15, tracked=False)
    rig.put(1, SPHERE, EYE_X + 1.5, 3.4, -0.5, 0.15, tracked=False)
    rig.track(0, EYE_X + 1.5, 3.0)
    rig.track(1, EYE_X + 1.5, 3.0)
    rig.load()
    state = np.zeros((N_ENV, N_TRACK, 4))
    state[:2, 0] = [EYE_X + 1.5, 3.0, 0.0, 1.0]
    put(rig.tracks, state=state, scan_step=np.full(N_ENV, 10))
    put(rig.clock, step=np.where(np.arange(N_ENV) == 0, 30, 10))
    share, present = rig.look()
    assert mass(share[0, 0], -0.6, -0.4) > 0.8 and present[0, 0] == pytest.approx(0.9)
    assert present[1, 0] < 0.85


def test_any_scene_equals_the_oracle(rig):
    """Random attitudes, up to four obstacles, tracks on and beside them: every track in view."""
    rng = np.random.default_rng(12)
    compared = {"shown": 0, "missed": 0, "untouched": 0}
    for _ in range(4):
        rig.begin()
        rig.pos = rng.uniform([4, 1.5, -1.2], [16, 4.5, -0.4], (N_ENV, 3))
        rig.rpy = rng.uniform([-0.15, -0.3, -3.1], [0.15, 0.3, 3.1], (N_ENV, 3))
        rig.pos, rig.rpy = (v.astype(np.float32).astype(float) for v in (rig.pos, rig.rpy))
        for env in range(N_ENV):
            for slot in range(4):
                bearing, away = rig.rpy[env, 2] + rng.uniform(-0.8, 0.8), rng.uniform(0.9, 4.0)
                x, y = rig.pos[env, 0] + away * np.cos(bearing), rig.pos[env, 1] + away * np.sin(bearing)
                if rng.random() < 0.6:
                    kind = (SPHERE, CYLINDER)[slot % 2]
                    rig.put(
                        env,
                        kind,
                        x,
                        y,
                        rng.uniform(-1.4, -0.2),
                        0.2 if kind == SPHERE else (0.2, rng.choice([0.15, 0.25, 0.8])),
                        False,
                    )
                if slot < N_TRACK:
                    off = rng.normal(0, 0.05, 2)
                    rig.track(
                        env, *np.float32([x + off[0], y + off[1]]), np.float32(rng.uniform(0.15, 0.3)), slot
                    )
        rig.share = rng.dirichlet(np.ones(LANES), (N_ENV, N_TRACK)).astype(np.float32).astype(float)
        rig.present = rng.uniform(0.3, 0.95, (N_ENV, N_TRACK)).astype(np.float32).astype(float)
        rig.load()
        rig.depth_m = rig.depth_m.astype(np.float32).astype(float)
        share, present = rig.look()
        for env, track in np.ndindex(N_ENV, N_TRACK):
            before = rig.share[env, track], rig.present[env, track]
            view = rig.depth_m[env], rig.pos[env], rig.rpy[env], rig.place[env, track], rig.radius[env, track]
            *wanted, doubt = oracle.look(*before, *view, CAMERA, TANK)
            if doubt < CLOSE:
                continue
            np.testing.assert_allclose(share[env, track], wanted[0], atol=SHARE_TOLERANCE)
            assert present[env, track] == pytest.approx(wanted[1], abs=SHARE_TOLERANCE)
            kind = (
                "untouched"
                if np.array_equal(wanted[0], before[0])
                else "shown"
                if wanted[1] == before[1]
                else "missed"
            )
            compared[kind] += 1
    assert min(compared.values()) > 10, compared
