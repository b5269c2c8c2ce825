"""Ranges from the intensity image: the kernels' power is that of the image in logs, its mean and its speckle
too, the detector is a NumPy oracle's and keeps its rate of false alarms, and no row depends on another."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import io_for
from tests.reference import scenes
from tests.reference.cfar import first_cells, side_lobe_level
from uuvtai.config import EpisodeConfig, TankConfig
from uuvtai.errors import UserError
from uuvtai.kernels.core.signature import Bundle
from uuvtai.kernels.sensors import sonar, sonar_image
from uuvtai.kernels.sensors.bundles import SonarIO
from uuvtai.kernels.sensors.cfar import cfar_factor, level_beside
from uuvtai.loader import load_config
from uuvtai.logs.fan_image import echo_power
from uuvtai.multibeam import beam_pattern, elevations, heard_bearings, noise_power
from uuvtai.state import (
    ClockState,
    EpisodeState,
    Proprioception,
    SonarImage,
    SonarMemory,
    SonarScan,
    VehicleState,
    WorldState,
    allocate,
)

SMALL = {"sensors.sonar.n_ray": 64, "sensors.sonar.image_bins": 96}
SONAR = load_config("pool", "multibeam_image", overrides=SMALL).sensors.sonar
TANK, RULES = TankConfig(), EpisodeConfig()
N_ENV, N_BODY, N_BIN = 6, 14, SONAR.image_bins
SIZES = {
    "n_env": N_ENV, "n_body": N_BODY, "n_ray": SONAR.n_ray, "n_latency": 2, "n_cloud": 8, "n_thruster": 6,
    "n_heard": len(heard_bearings(SONAR)), "n_bin": N_BIN, "n_elevation": len(elevations()),
}  # fmt: skip
NAMES = {1: "sphere", 2: "cylinder", 3: "box"}


@ti.kernel
def fold_only(io: Bundle[SonarIO]):
    """Power before speckle."""
    for row in range(io.sonar_image.upright.shape[0]):
        io.sonar_image.upright[row] = sonar_image.heard_upright(row, io)
    for env in range(N_ENV):
        sonar.place_sonar(env, io)
    for env, bearing in ti.ndrange(N_ENV, io.sonar_image.echo.shape[1]):
        sonar_image.fold(env, bearing, io)


@ti.kernel
def side_lobe_levels(io: Bundle[SonarIO], out: ti.types.ndarray(dtype=ti.f32, ndim=3)):  # type: ignore[valid-type]
    """What the detector takes for side lobes."""
    for env, beam, cell in ti.ndrange(N_ENV, io.sonar_cfg.n_ray, io.sonar_cfg.image_bins):
        out[env, beam, cell] = level_beside(env, beam, cell, io)


class Rig:
    """One instance of the structs."""

    def __init__(self):
        self.scan, self.memory, self.image = (
            allocate(s, SIZES) for s in (SonarScan, SonarMemory, SonarImage)
        )
        self.ego, self.vehicle, self.world = (
            allocate(s, SIZES) for s in (Proprioception, VehicleState, WorldState)
        )
        self.episode, self.clock = allocate(EpisodeState, SIZES), allocate(ClockState, SIZES)
        structs = (self.scan, self.memory, self.image, self.ego, self.vehicle, self.world)
        self.io = io_for(SonarIO, *structs, self.episode, self.clock, SONAR, TANK, RULES)

    def start(self, scene, keys):
        scenes.load(scene, self.vehicle, self.world)
        self.episode.key.from_numpy(np.asarray(keys, np.uint32))
        self.clock.awake.fill(1)
        self.clock.step.fill(0)
        sonar.reset_sonar(self.io)

    def ping(self):
        """(range, hit, what was heard)."""
        sonar_image.hear(self.io)
        sonar.cast_sonar(self.io)
        arrays = (self.scan.range_m, self.scan.hit, self.image.heard)
        return [array.to_numpy() for array in arrays]


@pytest.fixture(scope="module")
def rig():
    return Rig()


@pytest.fixture(scope="module")
def scene():
    """Level vehicles, for the image in logs is of a level sonar too."""
    found = scenes.random_scenes(np.random.default_rng(7), N_ENV, N_BODY, TANK, tilt=0.0)
    return found


def document(scene, env):
    """An env's scene as a log's scenario.json has it."""
    bodies = [
        {"kind": NAMES[kind], "path": None, "position": scene["body_pos"][env, k].tolist(),
         "size": scene["size"][env, k].tolist(), "yaw": float(scene["yaw"][env, k])}
        for k, kind in enumerate(scene["kind"][env]) if kind
    ]  # fmt: skip
    return {
        "tank": {"shape": TANK.shape, "x_m": TANK.x_m, "y_m": TANK.y_m, "z_m": TANK.z_m},
        "bodies": bodies,
    }


def power_of(scene, env):
    w, _, _, z = scene["quat"][env]
    return echo_power(document(scene, env), 0.0, scene["pos"][env], 2 * np.arctan2(z, w), SONAR, N_BIN)[1]


def test_power_is_that_of_the_image_in_logs(rig, scene):
    """But for rays on the edge of a body or of a bin, which float32 puts elsewhere."""
    rig.start(scene, range(N_ENV))
    fold_only(rig.io)
    found = rig.image.echo.to_numpy()[:, :, :N_BIN]
    for env in range(N_ENV):
        truth = power_of(scene, env)
        assert np.abs(found[env] - truth).sum() < 0.01 * truth.sum()
        assert found[env].sum() == pytest.approx(truth.sum(), rel=2e-3)


def test_what_is_heard_has_the_scenes_mean_and_rayleighs_speckle(rig, scene):
    rig.start(scene, range(N_ENV))
    heard = []
    for ping in range(60):
        rig.clock.step.fill(5 * ping)
        heard.append(rig.ping()[2][:, :, :N_BIN])
    heard = np.array(heard)
    assert not np.array_equal(heard[0], heard[1]), "each ping has speckle of its own"
    beams = SONAR.first_beam_rad + SONAR.beam_step_rad * np.arange(SONAR.n_ray)
    pattern = beam_pattern(beams[:, None] - heard_bearings(SONAR)[None]) ** 2
    mean = np.array([pattern @ power_of(scene, env) for env in range(N_ENV)]) + noise_power(SONAR)
    ratio = heard[:, :, : SONAR.n_ray] / mean
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    assert (np.sqrt(ratio).std() / np.sqrt(ratio).mean()) == pytest.approx(np.sqrt(4 / np.pi - 1), abs=0.03)


def test_side_lobes_and_returns_are_the_oracles(rig, scene):
    rig.start(scene, range(N_ENV))
    ranges, hit, heard = rig.ping()
    heard = heard[:, : SONAR.n_ray, :N_BIN].astype(float)
    lobes = np.zeros(heard.shape, np.float32)
    side_lobe_levels(rig.io, lobes)
    cells = np.array([first_cells(heard[env], SONAR, cfar_factor(SONAR)) for env in range(N_ENV)])
    truth = np.array([side_lobe_level(heard[env], SONAR) for env in range(N_ENV)])
    np.testing.assert_allclose(lobes, truth, rtol=1e-3, atol=1e-6 * truth.max())
    assert (hit == (cells >= 0)).mean() > 0.998 and hit.mean() > 0.5
    both = (hit == 1) & (cells >= 0)
    wanted = SONAR.max_range_m * (cells + 0.5) / N_BIN
    assert (np.abs(ranges - wanted)[both] < 1e-4).mean() > 0.995


def test_returns_are_where_something_stands(rig):
    """A box ahead: what the beams that look at it report; a body's front is met to a bin."""
    size = [0.4, 0.4, 0.8]
    scene = scenes.one_body_scene(
        N_ENV, N_BODY, (8.0, 3.0, -0.8), kind=scenes.BOX, body_pos=(11.0, 3.0, -0.8), size=size
    )
    rig.start(scene, range(N_ENV))
    ranges, hit, _ = rig.ping()
    beams = SONAR.first_beam_rad + SONAR.beam_step_rad * np.arange(SONAR.n_ray)
    ahead = np.abs(beams) < np.radians(4)
    assert hit[:, ahead].mean() > 0.9
    error = ranges[:, ahead][hit[:, ahead] == 1] - 2.6
    assert np.median(np.abs(error)) < 0.5 * SONAR.max_range_m / N_BIN + 0.01


@pytest.mark.parametrize("detector", ["ca", "so"])
def test_noise_alone_passes_as_rarely_as_asked(detector):
    """Exponentially distributed power, cells with both sides: the share that pass, to a tenth."""
    cfg = SONAR.model_copy(update={"detector": detector, "cfar_false_alarm": 2e-2})
    heard = np.random.default_rng(3).exponential(size=(400, N_BIN)).astype(float)
    n, g, t = N_BIN, cfg.cfar_guard, cfg.cfar_cells
    around = []
    for cell in range(g + t, n - g - t):
        before, behind = heard[:, cell - g - t : cell - g], heard[:, cell + g + 1 : cell + g + 1 + t]
        means = before.mean(1), behind.mean(1)
        around.append(np.minimum(*means) if detector == "so" else np.mean(means, axis=0))
    passing = heard[:, g + t : n - g - t] > cfar_factor(cfg) * np.array(around).T
    assert passing.mean() == pytest.approx(2e-2, rel=0.1)


def test_no_row_depends_on_another(rig, scene):
    """Rows in another order, and asleep beside, have the same bits."""
    rig.start(scene, range(N_ENV))
    first = rig.ping()
    order = [3, 1, 5, 0, 4, 2]
    rig.start({name: value[order] for name, value in scene.items()}, order)
    rig.clock.awake.from_numpy(np.array([1, 1, 1, 0, 1, 1], np.int32))
    again = rig.ping()
    for one, other in zip(first, again, strict=True):
        for row in (0, 1, 2, 4, 5):
            np.testing.assert_array_equal(other[row], one[order[row]])


def test_nothing_is_heard_between_pings(rig, scene):
    rig.start(scene, range(N_ENV))
    _, _, before = rig.ping()
    rig.clock.step.fill(3)
    _, _, after = rig.ping()
    np.testing.assert_array_equal(before, after)
    assert not rig.scan.fresh.to_numpy().any()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"doppler": True}, "sensors.sonar.doppler=false"),
        ({"image_bins": 0}, "sensors.sonar.image_bins=240"),
        ({"detector": "os"}, "detector"),
        ({"cfar_beams": 2}, "1, 3, 5"),
    ],
)
def test_what_cannot_be_detected_is_refused(changes, told):
    overrides = {f"sensors.sonar.{name}": value for name, value in changes.items()}
    with pytest.raises(UserError, match=told):
        load_config("pool", "multibeam_image", overrides=overrides)
