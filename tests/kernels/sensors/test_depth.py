"""Depth camera against MuJoCo's rays and the float64 oracle; noise, rate, independence of envs."""

import numpy as np
import pytest

from tests.bundles import Stage, put
from tests.conftest import set_step
from tests.oracles import scenes
from tests.oracles.depth import camera_position, camera_rays, z_depths
from uuvtai.config import DepthConfig, TankConfig
from uuvtai.kernels.sensors import depth_camera
from uuvtai.kernels.sensors.io import DepthIO

N_ENV, N_OBSTACLE, N_BATCH = 125, 14, 2
CLEAN = DepthConfig()
SIZES = {
    "n_env": N_ENV, "n_obstacle": N_OBSTACLE, "n_thruster": 6, "n_pixel_row": CLEAN.rows,
    "n_pixel_col": CLEAN.cols,
}  # fmt: skip
EVERY = 5
"""MuJoCo and the oracle look at every fifth pixel, at another offset in each scene (5 is coprime to the
packet width)."""

TOLERANCE_M = 2.0e-3
"""Asked for by the issue; float32 rounding itself is below 0.1 mm but for grazing hits."""

GRAZING_RAD = 2.0e-5
"""A pixel whose answer changes when its ray is turned by this may give either answer: float32 places the
camera to about 2e-6 m (an offset through the attitude, coordinates up to 20 m), which 0.1 m away is 2e-5
rad."""

GRAZING_SHARE = 1.0e-4
"""At most this share of the pixels may need that allowance."""

TANK, ROUND_TANK = TankConfig(), TankConfig(shape="circle", x_m=(0.0, 16.0), y_m=(0.0, 16.0))
SIGMAS = 5.0


class Rig(Stage):
    """One instance of the structs, so that the kernel is compiled once per config."""

    sizes = SIZES

    def start(self, scene, key=1):
        super().start(scene, key)
        depth_camera.reset_depth(self.io(DepthIO))

    def shoot(self, config=CLEAN, tank=TANK):
        depth_camera.cast_depth(self.io(DepthIO, config, tank))
        return self.image.depth_m.to_numpy()


rig = Rig.fixture()


@pytest.fixture(scope="module")
def batches():
    rng = np.random.default_rng(30)
    return [scenes.random_scenes(rng, N_ENV, N_OBSTACLE, TANK) for _ in range(N_BATCH)]


def compare(image, scene, env, offset, tank, truth_of):
    """Assert the pixels offset, offset + EVERY, ...; (how many needed the grazing allowance, of how many)."""
    index = np.arange(offset, image.size, EVERY)
    pixels = np.stack([index // CLEAN.cols, index % CLEAN.cols], axis=1)
    rays, eye = camera_rays(scene["quat"][env], pixels, CLEAN), camera_position(scene, env, CLEAN)
    cast = truth_of(scene, env, tank, eye)
    got, truth = image.ravel()[index], np.minimum(cast(rays), CLEAN.max_range_m)
    wrong = np.abs(got - truth) > TOLERANCE_M
    if wrong.any():
        low, high = (
            np.minimum(bound, CLEAN.max_range_m) for bound in scenes.envelope(cast, rays[wrong], GRAZING_RAD)
        )
        assert np.all((got[wrong] >= low - TOLERANCE_M) & (got[wrong] <= high + TOLERANCE_M))
    return wrong.sum(), len(index)


def by_mujoco(scene, env, tank, eye):
    caster = scenes.Caster(scene, env, tank)
    return lambda rays: caster.distances(eye, rays)


def by_oracle(scene, env, tank, eye):
    return lambda rays: z_depths(scene, env, tank, rays, eye)


def assert_images(images, scene, tank, truth_of, envs=range(N_ENV)):
    counts = np.array([compare(images[env], scene, env, env % EVERY, tank, truth_of) for env in envs])
    assert counts[:, 0].sum() < GRAZING_SHARE * counts[:, 1].sum()


def test_random_scenes_against_oracle(rig, batches):
    scene = batches[0]
    rig.start(scene)
    images = rig.shoot()
    assert_images(images, scene, TANK, by_oracle)
    rig.start({**scene, "kind": np.zeros_like(scene["kind"])})
    assert 0.1 < np.mean(np.abs(images - rig.shoot()) > 0.01) < 0.9, (
        "the scenes must show obstacles and walls"
    )


def test_round_tank_against_mujoco(rig):
    scene = scenes.random_scenes(np.random.default_rng(4), N_ENV, N_OBSTACLE, ROUND_TANK)
    rig.start(scene)
    assert_images(rig.shoot(CLEAN, ROUND_TANK), scene, ROUND_TANK, by_mujoco, range(80))


def test_axes_and_scale_of_the_image(rig):
    """A ball 0.5 m left of and 0.25 m above the axis, 2 m ahead: level, and rolled by 90 deg to the left."""
    scene = scenes.one_obstacle_scene(
        N_ENV, N_OBSTACLE, (5.0, 3.0, -0.8), kind=scenes.SPHERE, obstacle_pos=(7.2, 3.5, -0.55),
        size=(0.1, 0.1, 0.1),
    )  # fmt: skip
    rig.start(scene)
    image = rig.shoot()[0]
    row, col = np.argwhere(image < 2.5).mean(axis=0)
    assert (row, col) == pytest.approx((35.5 - 64 * 0.125, 63.5 - 64 * 0.25), abs=0.6)
    assert image.min() == pytest.approx(1.9, abs=5e-3)
    assert image[36, 64] == CLEAN.max_range_m, "the wall ahead is 14.8 m away"
    scene["quat"][:] = scenes.quaternions(np.array([[-np.pi / 2, 0.0, 0.0]]))
    rig.start(scene)
    row, col = np.argwhere(rig.shoot()[0] < 2.5).mean(axis=0)
    assert (row, col) == pytest.approx((35.5 - 64 * 0.25, 63.5 + 64 * 0.125), abs=0.6)


def test_obstacle_around_the_image_plane_is_not_lost(rig):
    """A box whose corners lie behind the camera while its face is in view."""
    scene = scenes.one_obstacle_scene(
        N_ENV, N_OBSTACLE, (5.0, 3.0, -0.8), kind=scenes.BOX, obstacle_pos=(5.2, 4.0, -0.8),
        size=(0.9, 0.5, 0.8),
    )  # fmt: skip
    rig.start(scene)
    image = rig.shoot()[0]
    assert_images([image], scene, TANK, by_oracle, range(1))
    assert image[36, 0] == pytest.approx(0.5 / (63.5 / 64), abs=1e-4)


def test_noise_grows_with_depth_and_stops_at_the_range(rig):
    config = DepthConfig(sigma_m=0.02, sigma_slope=0.01, period_steps=1)
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (13.0, 3.0, -0.8))
    rig.start(scene)
    clean = rig.shoot()
    first, again = rig.shoot(config), rig.shoot(config)
    assert np.array_equal(first, again)
    returns = clean < CLEAN.max_range_m - 1.0
    error = ((first - clean) / (0.02 + 0.01 * clean))[returns]
    assert error.size > 100000
    assert abs(error.mean()) < SIGMAS / np.sqrt(error.size)
    assert error.std() == pytest.approx(1.0, rel=SIGMAS / np.sqrt(2 * error.size))
    rig.clock.step.fill(1)
    later = ((rig.shoot(config) - clean) / (0.02 + 0.01 * clean))[returns]
    assert abs(np.corrcoef(error, later)[0, 1]) < SIGMAS / np.sqrt(error.size)
    rig.start(scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (5.0, 3.0, -0.8)))
    far = rig.shoot() == CLEAN.max_range_m
    assert far.any() and np.all(rig.shoot(config)[far] == CLEAN.max_range_m), "no noise on no return"


def test_rate_and_labels(rig):
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (13.0, 3.0, -0.8))
    rig.start(scene)
    seen = []
    for step in range(12):
        set_step(rig.clock, step)
        scene["pos"][:, 0] = 13.0 - 0.1 * step
        scenes.load(scene, rig.vehicle, rig.world)
        put(rig.ego, pos_w=step, rpy=-step)
        image = rig.shoot()
        shot = step - step % 5
        assert np.all(rig.image.fresh.to_numpy() == (step == shot))
        assert image[0, 36, 64] == pytest.approx(20.0 - 0.2 - 13.0 + 0.1 * shot, abs=1e-4)
        assert np.all(rig.image.shot_pos_w.to_numpy() == shot)
        assert np.all(rig.image.shot_rpy.to_numpy() == -shot)
        seen.append(image)
    assert np.array_equal(seen[0], seen[4]) and not np.array_equal(seen[4], seen[5])


def test_envs_do_not_touch_each_other_and_sleepers_keep_their_image(rig, batches):
    config = DepthConfig(sigma_m=0.02, sigma_slope=0.01, period_steps=1)
    order = np.random.default_rng(0).permutation(N_ENV)
    rig.start(batches[0])
    first = rig.shoot(config)
    rig.start({name: value[order] for name, value in batches[0].items()})
    rig.episode.key.from_numpy((np.arange(N_ENV) + 1)[order].astype(np.uint32))
    assert np.array_equal(rig.shoot(config), first[order])
    before = rig.image.depth_m.to_numpy()
    rig.clock.active.from_numpy((np.arange(N_ENV) % 2).astype(np.int32))
    scenes.load(batches[1], rig.vehicle, rig.world)
    after = rig.shoot(config)
    assert np.array_equal(before[::2], after[::2]) and not np.array_equal(before[1::2], after[1::2])
