"""The intensity image of a multibeam: its rays are MuJoCo's, its power is that of a cloud of point
scatterers, its speckle is Rayleigh's, its beams have side lobes, and all elevations fold into one range and
bearing."""

import json

import numpy as np
import pytest

from tests.reference import scenes
from uuvtai.config import Config, SensorsConfig, TankConfig
from uuvtai.errors import UserError
from uuvtai.loader import load_config
from uuvtai.logs import fan_image
from uuvtai.logs.fan_image import cast_rays, echo_power, heard_image
from uuvtai.logs.moment import EpisodeHeader, Moment
from uuvtai.logs.topics.camera_topics import logged_image
from uuvtai.logs.topics.sonar_topics import ROWS
from uuvtai.multibeam import ABSORPTION_NP_M, beam_pattern, elevation_pattern, noise_power

SONAR = load_config("pool", "multibeam").sensors.sonar
N_BIN = 240
ROW = next(row for row in ROWS if row.name == "/sonar/image")
TANK = TankConfig()
POOL = {"shape": "rectangle", "x_m": [-40.0, 40.0], "y_m": [-40.0, 40.0], "z_m": [-40.0, 40.0]}
"""so large that nothing but bodies is within reach"""
AT = np.zeros(3)
HEARD = np.full((320, 240), 1e-12, np.float32)
HEARD[7, 120] = 1e-3
"""of a detector: rows beyond the beams too"""


def body(kind, position, size):
    return {"kind": kind, "position": position, "size": size, "yaw": 0.0, "path": None}


def scene_of(*bodies, **tank):
    return {"tank": POOL | tank, "bodies": list(bodies)}


# ------------------------------------------------------------------------------------------------------- rays


def test_its_rays_are_mujocos():
    """In all directions of the pattern, upwards and downwards too."""
    rng, drawn = np.random.default_rng(3), scenes.random_scenes(np.random.default_rng(5), 8, 14, TANK)
    tank = {"shape": TANK.shape, "x_m": TANK.x_m, "y_m": TANK.y_m, "z_m": TANK.z_m}
    names, wrong, met = {1: "sphere", 2: "cylinder", 3: "box"}, 0, 0
    for env in range(8):
        az, el = rng.uniform(0, 2 * np.pi, 4000), rng.uniform(-0.7, 0.7, 4000)
        unit = np.column_stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
        bodies = [
            body(names[kind], drawn["body_pos"][env, k].tolist(), drawn["size"][env, k].tolist())
            | {"yaw": float(drawn["yaw"][env, k])}
            for k, kind in enumerate(drawn["kind"][env])
            if kind
        ]
        seen = cast_rays({"tank": tank, "bodies": bodies}, 0.0, drawn["pos"][env], unit)
        truth = scenes.Caster(drawn, env, TANK).distances(drawn["pos"][env], unit)
        level = seen.surface > -2  # MuJoCo's tank has neither floor nor surface
        wrong += (np.abs(seen.range_m - truth)[level] > 2e-3).sum()
        met += (seen.surface >= 0).sum()
        z = drawn["pos"][env][2] + seen.range_m * unit[:, 2]
        assert np.abs(z[seen.surface == -2] - TANK.z_m[0]).max() < 1e-9
        assert np.abs(z[seen.surface == -3] - TANK.z_m[1]).max() < 1e-9
    assert wrong < 1e-3 * met and met > 1500


# ------------------------------------------------------------------------------------------------------ power


def points_power(points, normals, area, beams):
    """(beams, N_BIN) of point scatterers that face the sonar at the origin: power pattern across and upwards,
    cos^2 / r^4, absorption there and back. Written from the sonar equation, point by point."""
    r = np.linalg.norm(points, axis=1)
    u = points / r[:, None]
    cosine = -(u * normals).sum(1)
    near = (cosine > 0) & (r < SONAR.max_range_m)
    u, r, cosine = u[near], r[near], cosine[near]
    el, az = np.arcsin(u[:, 2]), np.arctan2(u[:, 1], u[:, 0])
    loss_db = 2 * r * ABSORPTION_NP_M * 20 / np.log(10)
    power = cosine**2 * area * r**-4.0 * 10 ** (-loss_db / 10) * elevation_pattern(el, SONAR) ** 2
    out = np.zeros((len(beams), N_BIN))
    for i, beam in enumerate(beams):
        out[i] = np.bincount(
            (r / SONAR.max_range_m * N_BIN).astype(int), power * beam_pattern(az - beam) ** 2, N_BIN
        )
    return out


def sphere_points(rng, centre, radius, n):
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return np.array(centre) + radius * normal, normal, 4 * np.pi * radius**2 / n


def floor_points(rng, depth, n):
    at = np.column_stack([rng.uniform(0, 12, n), rng.uniform(-12, 12, n), np.full(n, -depth)])
    return at, np.tile([0.0, 0.0, 1.0], (n, 1)), 12.0 * 24.0 / n


def rendered(scene, beams):
    bearing, power = echo_power(scene, 0.0, AT, 0.0, SONAR, N_BIN)
    return beam_pattern(beams[:, None] - bearing[None]) ** 2 @ power


@pytest.mark.parametrize("centre", [(4.0, 0.0, 0.0), (6.0, 2.0, 0.8), (3.0, -1.0, -0.7)])
def test_a_sphere_returns_what_its_points_return(centre):
    """Power in all to 5 %, power of each beam to 6 % of the strongest."""
    beams = np.radians(np.arange(-40, 40.1, 0.5))
    found = rendered(scene_of(body("sphere", list(centre), [0.4] * 3)), beams)
    truth = points_power(*sphere_points(np.random.default_rng(1), centre, 0.4, 400_000), beams)
    assert found.sum() == pytest.approx(truth.sum(), rel=0.05)
    assert np.abs(found.sum(1) - truth.sum(1)).max() < 0.06 * truth.sum(1).max()
    near, far = (np.flatnonzero(t.sum(0) > 0.02 * t.sum(0).max())[[0, -1]] for t in (found, truth))
    assert np.abs(near - far).max() <= 2, "in the same range bins"


def test_the_floor_returns_what_its_points_return():
    """1.2 m below: it folds into the image from 1.2 m on."""
    beams = np.radians([-30.0, 0.0, 20.0])
    found = rendered(scene_of(z_m=[-1.2, 40.0]), beams)
    truth = points_power(*floor_points(np.random.default_rng(2), 1.2, 2_000_000), beams)
    assert not found[:, : int(1.15 / 12 * N_BIN)].any()
    for low, high in ((2.0, 4.0), (4.0, 7.0), (7.0, 11.0)):
        part = slice(int(low / 12 * N_BIN), int(high / 12 * N_BIN))
        np.testing.assert_allclose(found[:, part].sum(1), truth[:, part].sum(1), rtol=0.1)


def test_all_elevations_fold_into_one_range_and_bearing():
    level, above = (
        rendered(scene_of(body("sphere", [5 * np.cos(e), 0.0, 5 * np.sin(e)], [0.2] * 3)), np.zeros(1))[0]
        for e in (0.0, np.radians(8.0))
    )
    assert abs(int(level.argmax()) - int(above.argmax())) <= 1
    weight = elevation_pattern(np.radians(8.0), SONAR) ** 2
    assert above.sum() == pytest.approx(weight * level.sum(), rel=0.1)


def test_beams_have_side_lobes_13_db_down():
    off = np.radians(np.linspace(0.0, 5.0, 5001))
    level = 20 * np.log10(np.maximum(np.abs(beam_pattern(off)), 1e-9))
    assert level[np.searchsorted(off, np.radians(0.5))] == pytest.approx(-3.0, abs=0.05)
    null = np.flatnonzero(level < -60)[0]
    assert level[null:].max() == pytest.approx(-13.26, abs=0.05)


# ---------------------------------------------------------------------------------------------------- speckle


def test_amplitudes_are_rayleighs_and_their_mean_power_is_the_scenes():
    bearing, power = echo_power(
        scene_of(body("box", [6.0, 0.0, 0.0], [0.5, 3.0, 3.0])), 0.0, AT, 0.0, SONAR, N_BIN
    )
    rng = np.random.default_rng(4)
    pings = np.array([heard_image(bearing, power, SONAR, rng) for _ in range(300)])
    beams = SONAR.first_beam_rad + SONAR.beam_step_rad * np.arange(SONAR.n_ray)
    mean = beam_pattern(beams[:, None] - bearing[None]) ** 2 @ power + noise_power(SONAR)
    strong = mean > 0.1 * mean.max()
    assert strong.sum() > 50
    np.testing.assert_allclose((pings.mean(0) / mean)[strong].mean(), 1.0, atol=0.03)
    contrast = np.sqrt(pings).std(0)[strong] / np.sqrt(pings).mean(0)[strong]
    assert contrast.mean() == pytest.approx(np.sqrt(4 / np.pi - 1), abs=0.02)
    empty = (mean < 1.01 * noise_power(SONAR)).all(0)
    assert empty.any(), "before the box there is noise alone"


# ----------------------------------------------------------------------------------------------- log, picture


def logged(sonar):
    """(message, its image, moment) of a log's step with a sphere 3 m ahead of a vehicle that looks to +y."""
    scenario = scene_of(body("sphere", [0.0, 3.0, 0.0], [0.4] * 3), z_m=[-1.0, 1.0])
    config = Config(sensors=SensorsConfig(sonar=sonar))
    header = EpisodeHeader("bt", config, "", scenario | {"seed": 1, "episode": 2})
    values = {"scan.fresh": np.int32(1), "clock.step": np.int32(50), "vehicle.pos_w": np.zeros(3, np.float32)}
    values["vehicle.quat_wb"] = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], np.float32)
    values["sonar_image.heard"] = HEARD
    moment = Moment(header, values)
    data = json.loads(ROW.encode(moment))
    return data, logged_image(data), moment


def test_a_log_holds_the_image_of_the_true_scene_and_always_the_same():
    data, image, moment = logged(SONAR)
    assert data["format"] == "png" and image.shape == (240, 256) and image.dtype == np.uint8
    assert (image == logged(SONAR)[1]).all(), "the speckle is the episode's and the step's"
    row = 239 - int(2.6 / 12 * 240)
    assert image[row - 1 : row + 3, 118:138].mean() > image[row - 12 : row - 8, 118:138].mean() + 15
    assert ROW.on_request and ROW.when.holds(moment, True) and not ROW.when.holds(moment, False)


def test_where_ranges_are_detected_the_log_holds_what_the_detector_saw():
    _, image, _ = logged(SONAR.model_copy(update={"detector": "so"}))
    bright = np.argwhere(image > 200)
    assert bright.tolist() == [[239 - 120, 255 - 7]], "beam 7, bin 120: range upwards, left on the left"


@pytest.mark.parametrize("changes", [{"image_bins": 0}, {"image_bins": 0, "doppler": True}])
def test_other_sonars_have_no_image(changes):
    sonar = SONAR.model_copy(update=changes)
    header = EpisodeHeader("bt", Config(sensors=SensorsConfig(sonar=sonar)), "", {})
    assert not ROW.when.holds(Moment(header, {"scan.fresh": np.int32(1)}), True)


@pytest.mark.parametrize("bins", ["-1", "2049", "many"])
def test_bins_that_cannot_be_are_refused(bins):
    with pytest.raises(UserError, match=r"sonar\.image_bins"):
        load_config("pool", "multibeam", overrides={"sensors.sonar.image_bins": bins})


@pytest.mark.parametrize("aperture", [130.0, 360.0])
def test_a_fan_is_drawn_with_left_on_the_left_and_the_vehicle_at_its_tip(aperture):
    sonar = SONAR.model_copy(update={"horizontal_aperture_deg": aperture})
    bearing = sonar.first_beam_rad + sonar.beam_step_rad * np.arange(256)
    heard = np.full((256, 240), 1e-12)
    left = int(np.argmin(np.abs(bearing - np.radians(50.0))))
    heard[left - 3 : left + 4, 118:123] = 1.0  # 6 m away, 50 degrees to the left
    shown = np.where(heard.T[::-1, ::-1] > 0.5, 255, 20).astype(np.uint8)
    picture = fan_image.polar_picture(shown, bearing, 400, 0)
    row, col = (int(np.median(at)) for at in np.nonzero(picture == 255))
    scale = 399 / (1 if aperture < 180 else 2)
    tip = 399 if aperture < 180 else 200
    assert tip - row == pytest.approx(0.5 * scale * np.cos(np.radians(50.0)), abs=4)
    assert picture.shape[1] // 2 - col == pytest.approx(0.5 * scale * np.sin(np.radians(50.0)), abs=4)
    assert picture[0, 0] == 0, "no beam looks there"
