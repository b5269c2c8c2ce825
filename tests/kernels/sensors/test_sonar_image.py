"""Ranges from the intensity image: power and speckle by MuJoCo's rays, an oracle's detector, rows, logs."""

import json

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, put
from tests.oracles import scenes
from tests.oracles.cfar import first_cells, side_lobe_level
from tests.oracles.sonar_image import cast_rays, echo_power
from uuvtai.common.errors import UserError
from uuvtai.config import Config, EpisodeConfig, SensorsConfig, TankConfig, multibeam
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.stage import Bundle
from uuvtai.kernels.sensors import sonar, sonar_image
from uuvtai.kernels.sensors.io import SonarIO
from uuvtai.kernels.sensors.sonar import cfar_factor, level_beside
from uuvtai.logs.encode import EpisodeHeader, Moment
from uuvtai.logs.topics.sensors import SONAR_ROWS, logged_image

SMALL = {"sensors.sonar.n_ray": 64, "sensors.sonar.image_bins": 96}
SONAR = load_config("pool", "multibeam_image", overrides=SMALL).sensors.sonar
TANK, RULES = TankConfig(), EpisodeConfig()
N_ENV, N_OBSTACLE, N_BIN = 6, 14, SONAR.image_bins
SIZES = {
    "n_env": N_ENV, "n_obstacle": N_OBSTACLE, "n_ray": SONAR.n_ray, "n_latency": 2, "n_cloud": 8,
    "n_thruster": 6, "n_heard": len(multibeam.heard_bearings(SONAR)), "n_bin": N_BIN,
    "n_elevation": len(multibeam.elevations()),
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


class Rig(Stage):
    """One instance of the structs."""

    def __init__(self):
        super().__init__(**SIZES)
        self.sonar = self.io(SonarIO, SONAR, TANK, RULES)

    def start(self, scene, keys):
        super().start(scene)
        put(self.episode, key=keys)
        sonar.reset_sonar(self.sonar)

    def ping(self):
        """(range, hit, what was heard)."""
        sonar_image.hear(self.sonar)
        sonar.cast_sonar(self.sonar)
        return [array.to_numpy() for array in (self.scan.range_m, self.scan.hit, self.sonar_image.heard)]


rig = Rig.fixture()


@pytest.fixture(scope="module")
def scene():
    """Level vehicles, for the oracle's sonar is level too."""
    found = scenes.random_scenes(np.random.default_rng(7), N_ENV, N_OBSTACLE, TANK, tilt=0.0)
    return found


def document(scene, env):
    """An env's scene as a log's scenario.json has it, which the oracle reads."""
    obstacles = [
        {"kind": NAMES[kind], "path": None, "position": scene["obstacle_pos"][env, k].tolist(),
         "size": scene["size"][env, k].tolist(), "yaw": float(scene["yaw"][env, k])}
        for k, kind in enumerate(scene["kind"][env]) if kind
    ]  # fmt: skip
    return {
        "tank": {"shape": TANK.shape, "x_m": TANK.x_m, "y_m": TANK.y_m, "z_m": TANK.z_m},
        "obstacles": obstacles,
    }


def power_of(scene, env):
    w, _, _, z = scene["quat"][env]
    return echo_power(document(scene, env), 0.0, scene["pos"][env], 2 * np.arctan2(z, w), SONAR, N_BIN)[1]


def test_power_is_the_oracles(rig, scene):
    """But for rays on the edge of an obstacle or of a bin, which float32 puts elsewhere."""
    rig.start(scene, range(N_ENV))
    fold_only(rig.sonar)
    found = rig.sonar_image.echo.to_numpy()[:, :, :N_BIN]
    for env in range(N_ENV):
        truth = power_of(scene, env)
        assert np.abs(found[env] - truth).sum() < 0.01 * truth.sum()
        assert found[env].sum() == pytest.approx(truth.sum(), rel=2e-3)


def test_what_is_heard_has_the_scenes_mean_and_rayleighs_speckle(rig, scene):
    rig.start(scene, range(N_ENV))
    heard = []
    for ping in range(12):
        rig.clock.step.fill(5 * ping)
        heard.append(rig.ping()[2][:, :, :N_BIN])
    heard = np.array(heard)
    assert not np.array_equal(heard[0], heard[1]), "each ping has speckle of its own"
    beams = SONAR.first_beam_rad + SONAR.beam_step_rad * np.arange(SONAR.n_ray)
    pattern = multibeam.beam_pattern(beams[:, None] - multibeam.heard_bearings(SONAR)[None]) ** 2
    mean = np.array([pattern @ power_of(scene, env) for env in range(N_ENV)]) + multibeam.noise_power(SONAR)
    ratio = heard[:, :, : SONAR.n_ray] / mean
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    assert (np.sqrt(ratio).std() / np.sqrt(ratio).mean()) == pytest.approx(np.sqrt(4 / np.pi - 1), abs=0.03)


def test_side_lobes_and_returns_are_the_oracles(rig, scene):
    rig.start(scene, range(N_ENV))
    ranges, hit, heard = rig.ping()
    heard = heard[:, : SONAR.n_ray, :N_BIN].astype(float)
    lobes = np.zeros(heard.shape, np.float32)
    side_lobe_levels(rig.sonar, lobes)
    cells = np.array([first_cells(heard[env], SONAR, cfar_factor(SONAR)) for env in range(N_ENV)])
    truth = np.array([side_lobe_level(heard[env], SONAR) for env in range(N_ENV)])
    np.testing.assert_allclose(lobes, truth, rtol=1e-3, atol=1e-6 * truth.max())
    assert (hit == (cells >= 0)).mean() > 0.998 and hit.mean() > 0.5
    both = (hit == 1) & (cells >= 0)
    wanted = SONAR.max_range_m * (cells + 0.5) / N_BIN
    assert (np.abs(ranges - wanted)[both] < 1e-4).mean() > 0.995


def test_returns_are_where_something_stands(rig):
    """A box ahead: what the beams that look at it report; an obstacle's front is met to a bin."""
    size = [0.4, 0.4, 0.8]
    scene = scenes.one_obstacle_scene(
        N_ENV, N_OBSTACLE, (8.0, 3.0, -0.8), kind=scenes.BOX, obstacle_pos=(11.0, 3.0, -0.8), size=size
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
    """Rows in another order, and inactive beside, have the same bits."""
    rig.start(scene, range(N_ENV))
    first = rig.ping()
    order = [3, 1, 5, 0, 4, 2]
    rig.start({name: value[order] for name, value in scene.items()}, order)
    rig.clock.active.from_numpy(np.array([1, 1, 1, 0, 1, 1], np.int32))
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


# ----------------------------------------------------------------------------------------------------- oracle


FAN = load_config("pool", "multibeam").sensors.sonar
FAN_BINS = 240
POOL = {"shape": "rectangle", "x_m": [-40.0, 40.0], "y_m": [-40.0, 40.0], "z_m": [-40.0, 40.0]}
"""so large that nothing but obstacles is within reach"""


def body(kind, position, size):
    return {"kind": kind, "position": position, "size": size, "yaw": 0.0, "path": None}


def scene_of(*obstacles, **tank):
    return {"tank": POOL | tank, "obstacles": list(obstacles)}


def test_its_rays_are_mujocos():
    """In all directions of the pattern, upwards and downwards too."""
    rng, drawn = np.random.default_rng(3), scenes.random_scenes(np.random.default_rng(5), 8, 14, TANK)
    tank = {"shape": TANK.shape, "x_m": TANK.x_m, "y_m": TANK.y_m, "z_m": TANK.z_m}
    wrong, met = 0, 0
    for env in range(8):
        az, el = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-0.7, 0.7, 4000)
        unit = np.column_stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        obstacles = [
            body(NAMES[kind], drawn["obstacle_pos"][env, k].tolist(), drawn["size"][env, k].tolist())
            | {"yaw": float(drawn["yaw"][env, k])}
            for k, kind in enumerate(drawn["kind"][env])
            if kind
        ]
        seen = cast_rays({"tank": tank, "obstacles": obstacles}, 0.0, drawn["pos"][env], unit)
        truth = scenes.Caster(drawn, env, TANK).distances(drawn["pos"][env], unit)
        level = seen.surface > -2  # MuJoCo's tank has neither floor nor surface
        wrong += (np.abs(seen.range_m - truth)[level] > 2e-3).sum()
        met += (seen.surface >= 0).sum()
        z = drawn["pos"][env][2] + seen.range_m * unit[:, 2]
        assert np.abs(z[seen.surface == -2] - TANK.z_m[0]).max() < 1e-9
        assert np.abs(z[seen.surface == -3] - TANK.z_m[1]).max() < 1e-9
    assert wrong < 1e-3 * met and met > 1500


def points_power(points, normals, area, beams):
    """(beams, FAN_BINS) of point scatterers facing the sonar at the origin, from the sonar equation."""
    r = np.linalg.norm(points, axis=1)
    u = points / r[:, None]
    cosine = -(u * normals).sum(1)
    near = (cosine > 0) & (r < FAN.max_range_m)
    u, r, cosine = u[near], r[near], cosine[near]
    el, az = np.arcsin(u[:, 2]), np.arctan2(u[:, 1], u[:, 0])
    loss_db = 2 * r * multibeam.ABSORPTION_NP_M * 20 / np.log(10)
    power = cosine**2 * area * r**-4.0 * 10 ** (-loss_db / 10) * multibeam.elevation_pattern(el, FAN) ** 2
    out = np.zeros((len(beams), FAN_BINS))
    for i, beam in enumerate(beams):
        out[i] = np.bincount(
            (r / FAN.max_range_m * FAN_BINS).astype(int),
            power * multibeam.beam_pattern(az - beam) ** 2,
            FAN_BINS,
        )
    return out


def rendered(scene, beams):
    bearing, power = echo_power(scene, 0.0, np.zeros(3), 0.0, FAN, FAN_BINS)
    return multibeam.beam_pattern(beams[:, None] - bearing[None]) ** 2 @ power


@pytest.mark.parametrize("centre", [(6.0, 2.0, 0.8), (3.0, -1.0, -0.7)])
def test_a_sphere_returns_what_its_points_return(centre):
    """Power in all to 5 %, power of each beam to 6 % of the strongest."""
    beams = np.radians(np.arange(-40, 40.1, 1.0))
    found = rendered(scene_of(body("sphere", list(centre), [0.4] * 3)), beams)
    normal = np.random.default_rng(1).normal(size=(n := 100_000, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    truth = points_power(np.array(centre) + 0.4 * normal, normal, 4 * np.pi * 0.4**2 / n, beams)
    assert found.sum() == pytest.approx(truth.sum(), rel=0.05)
    assert np.abs(found.sum(1) - truth.sum(1)).max() < 0.06 * truth.sum(1).max()
    near, far = (np.flatnonzero(t.sum(0) > 0.02 * t.sum(0).max())[[0, -1]] for t in (found, truth))
    assert np.abs(near - far).max() <= 2, "in the same range bins"


def test_the_floor_returns_what_its_points_return():
    """1.2 m below: it folds into the image from 1.2 m on."""
    beams = np.radians([-30.0, 0.0, 20.0])
    found = rendered(scene_of(z_m=[-1.2, 40.0]), beams)
    rng, n = np.random.default_rng(2), 2_000_000
    at = np.column_stack([rng.uniform(0, 12, n), rng.uniform(-12, 12, n), np.full(n, -1.2)])
    truth = points_power(at, np.tile([0.0, 0.0, 1.0], (n, 1)), 12.0 * 24.0 / n, beams)
    assert not found[:, : int(1.15 / 12 * FAN_BINS)].any()
    for low, high in ((2.0, 4.0), (4.0, 7.0), (7.0, 11.0)):
        part = slice(int(low / 12 * FAN_BINS), int(high / 12 * FAN_BINS))
        np.testing.assert_allclose(found[:, part].sum(1), truth[:, part].sum(1), rtol=0.1)


def test_all_elevations_fold_into_one_range_and_bearing():
    level, above = (
        rendered(scene_of(body("sphere", [5 * np.cos(e), 0.0, 5 * np.sin(e)], [0.2] * 3)), np.zeros(1))[0]
        for e in (0.0, np.radians(8.0))
    )
    assert abs(int(level.argmax()) - int(above.argmax())) <= 1
    weight = multibeam.elevation_pattern(np.radians(8.0), FAN) ** 2
    assert above.sum() == pytest.approx(weight * level.sum(), rel=0.1)


def test_beams_have_side_lobes_13_db_down():
    off = np.radians(np.linspace(0.0, 5.0, 5001))
    level = 20 * np.log10(np.maximum(np.abs(multibeam.beam_pattern(off)), 1e-9))
    assert level[np.searchsorted(off, np.radians(0.5))] == pytest.approx(-3.0, abs=0.05)
    assert level[np.flatnonzero(level < -60)[0] :].max() == pytest.approx(-13.26, abs=0.05)


# -------------------------------------------------------------------------------------------------------- log


ROW = next(row for row in SONAR_ROWS if row.name == "/sonar/image")


def moment_of(sonar, heard=None):
    values = {"scan.fresh": np.int32(1), "clock.step": np.int32(50), "sonar_image.heard": heard}
    return Moment(EpisodeHeader("bt", Config(sensors=SensorsConfig(sonar=sonar)), "", {}), values)


def test_the_log_holds_what_the_detector_saw():
    heard = np.full((320, 240), 1e-12, np.float32)  # rows beyond the beams too
    heard[7, 120] = 1e-3
    moment = moment_of(FAN.model_copy(update={"detector": "so", "image_bins": 240}), heard)
    data = json.loads(ROW.encode(moment))
    image = logged_image(data)
    assert data["format"] == "png" and image.shape == (240, 256) and image.dtype == np.uint8
    bright = np.argwhere(image > 200)
    assert bright.tolist() == [[239 - 120, 255 - 7]], "beam 7, bin 120: range upwards, left on the left"
    assert ROW.on_request and ROW.when.holds(moment, True) and not ROW.when.holds(moment, False)


def test_sonars_without_a_detector_have_no_image():
    assert not ROW.when.holds(moment_of(FAN), True)


@pytest.mark.parametrize("bins", ["-1", "2049", "many"])
def test_bins_that_cannot_be_are_refused(bins):
    with pytest.raises(UserError, match=r"sonar\.image_bins"):
        load_config("pool", "multibeam_image", overrides={"sensors.sonar.image_bins": bins})
