"""Starts that were typed, against the walls that a sonar sees from them: corrected, or refused."""

import math

import numpy as np
import pytest

from uuvtai.config.loader import load_config
from uuvtai.vehicle.onboard import DvlReading, ImuReading, SonarPing
from uuvtai.vehicle.start_fix import LONGEST_S, MISFIT, StartFix, Track, WallWatch, expected
from uuvtai.vehicle.telemetry import ping_of, sectors_of

OBSTACLES = ((9.0, 4.4, 0.35), (12.0, 1.2, 0.3), (6.0, 5.0, 0.25), (15.5, 3.2, 0.4), (3.6, 1.4, 0.3))
"""(x, y, radius) [m] of what stands in the tank, unknown to the fix"""


def ranges(config, pose, rng, obstacles=OBSTACLES):
    """(range, hit) of a scan from ``pose`` (x, y, yaw), with the sonar's noise."""
    sonar = config.sensors.sonar
    bearing = pose[2] + sonar.first_beam_rad + sonar.beam_step_rad * np.arange(sonar.n_ray)
    r = expected(config.world.tank, np.tile(pose[:2], (sonar.n_ray, 1)), bearing)[0]
    for x, y, radius in obstacles:
        along = (x - pose[0]) * np.cos(bearing) + (y - pose[1]) * np.sin(bearing)
        room = radius**2 - (x - pose[0]) ** 2 - (y - pose[1]) ** 2 + along**2
        near = along - np.sqrt(np.maximum(room, 0.0))
        r = np.where((room > 0) & (near > 0), np.minimum(r, near), r)
    hit = (r < sonar.max_range_m) & (rng.random(sonar.n_ray) >= sonar.missed_return)
    noise = (sonar.range_sigma_m + sonar.range_sigma_slope * r) * rng.standard_normal(sonar.n_ray)
    return r + noise + sonar.range_jitter_m * rng.exponential(size=sonar.n_ray), hit


def played(config, true, typed, turn, seed=0, rate=0.35, obstacles=OBSTACLES, coarse=False, dt=0.1):
    """(fix, pose at its end) of a vehicle at ``true`` (x, y, yaw) that takes its yaw for larger by ``turn``
    and its place for ``typed``; after 3 s it is turned around at ``rate`` [rad/s]. ``coarse``: by sectors, as
    MAVLink tells it."""
    fix, rng, sonar = StartFix(config, (*typed, -0.8)), np.random.default_rng(seed), config.sensors.sonar
    pose = np.array(true, float)
    for k in range(round(LONGEST_S / dt) + 20):
        pose[2] = true[2] + rate * max(0.0, dt * k - 3.0)
        rpy = np.array([0.0, 0.0, math.remainder(pose[2] + turn, math.tau)])
        fix.feed(ImuReading(dt * k, rpy, np.zeros(3), np.zeros(3)))
        fix.feed(DvlReading(dt * k, np.zeros(3)))
        r, hit = ranges(config, pose, rng, obstacles)
        ping = SonarPing(dt * k, r, hit, np.zeros(0))
        if coarse:
            distances, increment, offset = sectors_of(sonar, r, hit)
            reach = round(100 * sonar.max_range_m)
            ping = ping_of(sonar, dt * k, np.array(distances), increment, offset, 1, reach)
        fix.feed(ping)
        if fix.result is not None:
            return fix, pose
    raise AssertionError("neither fixed nor refused")


def test_readings_that_were_lost_while_it_slowed_down_move_nothing():
    """0.4 m/s ahead, then slower within 0.6 s of which the DVL tells nothing: 0.4 + 0.12 m."""
    track = Track()
    for k in range(31):
        time_s = 0.1 * k
        speed = 0.4 * max(0.0, min(1.0, (1.6 - time_s) / 0.6))
        if not 1.0 < time_s < 1.6 - 1e-9:
            track.hear(DvlReading(time_s, np.array([speed, 0.0, 0.0])))
        track.go(ImuReading(time_s, np.zeros(3), np.zeros(3), np.zeros(3)))
    assert track.at == pytest.approx([0.52, 0.0], abs=0.005)


def off(found, pose, turn):
    """(m, degrees) by which a fix is wrong."""
    return math.dist(found.place, pose[:2]), abs(math.degrees(found.turn_rad + turn))


@pytest.mark.parametrize(
    ("sensors", "true", "told", "turn_deg", "coarse"),
    [
        ("multibeam", (2.0, 3.0, 0.0), (0.0, 0.0), 0, False),
        ("multibeam", (2.0, 3.0, 0.0), (0.5, 0.0), 0, True),
        ("multibeam", (2.5, 2.0, 0.3), (-0.3, 0.4), 0, False),
        ("multibeam", (11.0, 3.4, 2.8), (0.0, -0.5), 15, True),
        ("multibeam", (17.0, 4.6, -0.6), (0.0, 0.0), -15, False),
        ("nominal", (5.0, 2.0, 1.2), (0.35, 0.35), 15, False),
        ("harsh", (7.0, 3.1, 2.5), (-0.5, 0.0), -15, False),
    ],
)
def test_what_was_typed_wrongly_is_corrected(sensors, true, told, turn_deg, coarse):
    config, turn = load_config("pool", sensors), math.radians(turn_deg)
    typed = (true[0] + told[0], true[1] + told[1])
    fix, pose = played(config, true, typed, turn, coarse=coarse)
    assert not fix.result.refusal, fix.result.refusal
    far, degrees = off(fix.result, pose, turn)
    assert far < 0.1 and degrees < 2.0
    assert np.allclose(fix.result.shift, -np.array(told), atol=0.1)


@pytest.mark.parametrize(
    ("true", "typed", "rate", "why"),
    [
        ((2.0, 3.0, 0.0), (2.0, 3.0), 0.0, "nor at x 20 is seen well, by a sonar to 12 m"),
        ((5.0, 3.0, 0.0), (2.0, 3.0), 0.35, "do not fit"),
        ((17.0, 3.0, 0.0), (15.0, 3.0), 0.0, "do not fit"),
    ],
)
def test_what_cannot_be_checked_is_refused(true, typed, rate, why):
    fix, _ = played(load_config("pool", "multibeam"), true, typed, 0.0, rate=rate, dt=0.5)
    assert why in fix.result.refusal and "--start" in fix.result.refusal


@pytest.mark.parametrize(
    ("told", "is_found"), [((0.05, 0.02), True), ((0.3, 0.0), False), ((-0.5, 0.3), False)]
)
def test_less_of_a_wall_is_enough_where_it_stands_as_typed(told, is_found):
    """0.9 m of the only end wall in reach, between obstacles."""
    config, true = (
        load_config("pool", "nominal", overrides={"sensors.sonar.max_range_m": 12.0}),
        (15.0, 3.0, 0.4),
    )
    between = tuple((17.5, 3.0 + side * off, 0.35) for side in (-1, 1) for off in (0.575, 1.275))
    typed = (true[0] + told[0], true[1] + told[1])
    fix, pose = played(config, true, typed, 0.0, rate=0.0, obstacles=between, dt=0.25)
    if is_found:
        assert not fix.result.refusal and off(fix.result, pose, 0.0)[0] < 0.1
    else:
        assert "x 0 nor at x 20" in fix.result.refusal


@pytest.mark.parametrize(
    ("at", "yaw_deg", "way"),
    [
        ((2.0, 3.5), 0, 1),
        ((2.0, 3.5), -130, -1),
        ((18.0, 5.0), 90, -1),
        ((18.0, 1.0), 20, -1),
        ((18.0, 1.0), -90, 1),
    ],
)
def test_it_turns_to_the_nearest_corner(at, yaw_deg, way):
    fix = StartFix(load_config("pool", "multibeam"), (*at, -0.8))
    fix.feed(ImuReading(0.0, np.array([0.0, 0.0, math.radians(yaw_deg)]), np.zeros(3), np.zeros(3)))
    assert fix.way_round() == way


def test_obstacles_that_might_be_a_wall_where_beams_see_through_it_are_no_second_place():
    """From (12.5, 2.4) a metre of the end wall is in view, and faces of obstacles before it."""
    finer = {"sensors.sonar.max_range_m": 12.0, "sensors.sonar.n_ray": 64}
    config = load_config("pool", "ping360", overrides=finer)
    true, still, sonar = (12.5, 2.4, 0.3), np.zeros(3), config.sensors.sonar
    obstacles = ((19.3, 0.6, 0.45), (19.3, 5.2, 0.45), (19.3, 4.2, 0.4), (16.0, 1.7, 0.35))
    rng, fix, nearest = np.random.default_rng(1), StartFix(config, (*true[:2], -0.8)), np.full(200, math.inf)
    for side in (-1, 0, 1):  # of a beam
        yaws = true[2] + side * sonar.half_width_rad + sonar.turn_rad(sonar.n_ray) * np.arange(4)
        fans = np.array([ranges(config, (*true[:2], yaw), rng, obstacles) for yaw in yaws])
        nearest = np.minimum(nearest, np.where(fans[:, 1] > 0, fans[:, 0], math.inf).ravel()[:200])
    for k in range(400):
        time_s, beam = k * sonar.step_us / 1e6, [k % 200]
        fix.feed(ImuReading(time_s, np.array([0.0, 0.0, true[2]]), still, still))
        fix.feed(DvlReading(time_s, still))
        hit = np.isfinite(nearest[beam])
        fix.feed(SonarPing(time_s, np.where(hit, nearest[beam], 12.0), hit, np.zeros(0), beam[0]))
    assert fix.result is not None and not fix.result.refusal
    far, degrees = off(fix.result, true, 0.0)
    assert far < 0.02 and degrees < 0.2


@pytest.mark.parametrize(("beams", "yaw", "is_found"), [(200, 0.4, True), (64, 0.4, False), (64, 4.5, False)])
def test_a_head_that_looks_all_around_finds_the_start_at_rest(beams, yaw, is_found):
    """Less is not enough, even where it shows two walls: of obstacles aside nobody knows yet."""
    config = load_config("pool", "ping360", overrides={"sensors.sonar.n_ray": 64})
    true, still = (4.0, 2.2, yaw), np.zeros(3)
    sonar, rng, fix = config.sensors.sonar, np.random.default_rng(1), StartFix(config, (4.3, 2.5, -0.8))
    fans = [(*true[:2], true[2] + sonar.turn_rad(sonar.n_ray) * number) for number in range(4)]
    r, hit = np.concatenate([np.array(ranges(config, fan, rng)) for fan in fans], axis=1)
    for k in range(2 * beams):
        time_s, beam = k * sonar.step_us / 1e6, (k % beams - 20) % 200
        fix.feed(ImuReading(time_s, np.array([0.0, 0.0, yaw - 0.1]), still, still))
        fix.feed(DvlReading(time_s, still))
        fix.feed(SonarPing(time_s, r[[beam]], hit[[beam]], np.zeros(0), beam))
    assert (fix.result is not None) == is_found
    if is_found:
        assert not fix.result.refusal
        far, degrees = off(fix.result, true, -0.1)
        assert far < 0.1 and degrees < 2.0


def watched(config, true, believed, obstacles=OBSTACLES):
    """What the watch says after 4 s at ``true`` (x, y, yaw), which is taken for ``believed``."""
    watch, rng, n = WallWatch(config), np.random.default_rng(3), config.sensors.sonar.n_ray
    views = {
        "clock.step": np.zeros(1, int),
        "scan.fresh": np.ones(1, int),
        "scan.ping_yaw": np.array([believed[2]]),
    }
    views["scan.ping_pos_w"], views["scan.new_count"] = np.array([[*believed[:2], -0.8]]), np.array([n])
    views["scan.new_from"] = np.zeros(1, int)
    for views["clock.step"][0] in range(0, 200, 10):
        r, hit = ranges(config, true, rng, obstacles)
        views["scan.range_m"], views["scan.hit"] = r[None], hit[None].astype(int)
        found = watch.look(views)
    return found


@pytest.mark.parametrize(
    ("sensors", "wrong", "fits"),
    [
        ("multibeam", (0.0, 0.0, 0.0), True),
        ("nominal", (0.0, 0.0, 0.0), True),
        ("multibeam", (0.5, 0.0, 0.0), False),
        ("nominal", (-0.5, 0.0, 0.0), False),
        ("multibeam", (0.0, -0.5, 0.0), False),
        ("multibeam", (0.0, 0.0, 0.26), False),
    ],
)
def test_a_place_that_the_walls_do_not_fit_is_noticed_under_way(sensors, wrong, fits):
    true = np.array([13.0, 2.6, 0.4])
    assert (watched(load_config("pool", sensors), true, true + wrong) < MISFIT) == fits
