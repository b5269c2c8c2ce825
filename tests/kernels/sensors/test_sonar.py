"""Sonar against MuJoCo's rays and the float64 oracle; every error source, timing, independence of envs."""

import numpy as np
import pytest
import taichi as ti

from tests.bundles import Stage, io_for, put
from tests.conftest import set_step
from tests.oracles import scenes
from tests.oracles.sonar import WALL, beam_headings, doppler_by_differences, sonar_scan
from uuvtai.config import EpisodeConfig, SonarConfig, TankConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.geometry import FAR_M
from uuvtai.kernels.core.simd import LANES, f16x
from uuvtai.kernels.core.stage import Const
from uuvtai.kernels.sensors import sonar
from uuvtai.kernels.sensors.io import SonarIO

N_ENV, N_OBSTACLE, N_RAY, N_BATCH = 125, 14, 256, 2
SIZES = {
    "n_env": N_ENV, "n_obstacle": N_OBSTACLE, "n_ray": N_RAY, "n_latency": 3, "n_cloud": 8, "n_thruster": 6,
}  # fmt: skip

RANGE_TOLERANCE_M = 2.0e-3
"""Asked for by the issue; float32 rounding itself is below 0.1 mm but for grazing hits."""

GRAZING_RAD = 5.0e-6
"""A beam whose answer changes when it is turned by this may give either answer: float32 holds directions to
about 2e-7 and positions to 1e-6 m at 20 m, which 0.2 m away is 5e-6 rad."""

GRAZING_SHARE = 1.0e-4
"""At most this share of the beams may need that allowance."""

DOPPLER_TOLERANCE_M_S = 1.0e-4
"""float32 products of speeds up to 4 m/s and truncation of the central difference (dt 1e-4 s, accelerations
below 20 m/s^2)."""

TANK, ROUND_TANK = TankConfig(), TankConfig(shape="circle", x_m=(0.0, 16.0), y_m=(0.0, 16.0))
CLEAN, FLAT = SonarConfig(), SonarConfig(vertical_half_aperture_deg=0.0)
RULES = EpisodeConfig()
SIGMAS = 5.0
"""Statistics over n draws may be off by this many standard errors; seeds are fixed, so a pass stays a
pass."""


class Rig(Stage):
    """One instance of the structs, so that each kernel is compiled once per config."""

    sizes = SIZES

    def start(self, scene, key=1):
        super().start(scene, key)
        put(self.ego, pos_w=scene["pos"])
        sonar.reset_sonar(self.io(SonarIO))

    def cast(
        self,
        config=CLEAN,
        tank=TANK,
        names=("range_m", "doppler_m_s", "intensity", "hit", "fresh", "ping_step"),
    ):
        sonar.cast_sonar(self.io(SonarIO, config, tank, RULES))
        return {name: getattr(self.scan, name).to_numpy() for name in names}


rig = Rig.fixture()


@pytest.fixture(scope="module")
def batches():
    """250 scenes in batches of N_ENV: 64,000 beams."""
    rng = np.random.default_rng(20)
    return [scenes.random_scenes(rng, N_ENV, N_OBSTACLE, TANK) for _ in range(N_BATCH)]


def assert_ranges(got, hit, lowest, truth, highest, max_range_m):
    """Every beam within tolerance, but for a small share between what its closest neighbours see."""
    seen = np.where(truth > max_range_m, max_range_m, truth)
    wrong = (np.abs(got - seen) > RANGE_TOLERANCE_M) | (hit != (truth <= max_range_m))
    low = np.minimum(lowest, max_range_m) - RANGE_TOLERANCE_M
    high = np.minimum(highest, max_range_m) + RANGE_TOLERANCE_M
    assert np.all((got[wrong] >= low[wrong]) & (got[wrong] <= high[wrong]))
    assert wrong.mean() < GRAZING_SHARE


def test_random_scenes_against_oracle_with_aperture(rig, batches):
    """Ranges, hits, intensity and Doppler; most obstacles are above or below the beams' plane."""
    scene, different, obstacles, compared = batches[0], 0, 0, 0
    rig.start(scene)
    out = rig.cast(CLEAN)
    oracle = [
        [sonar_scan(scene, env, TANK, N_RAY, 10.0, turn) for env in range(N_ENV)]
        for turn in (0.0, GRAZING_RAD, -GRAZING_RAD)
    ]
    ranges = np.array([[answer[0] for answer in row] for row in oracle])
    assert_ranges(
        out["range_m"], out["hit"], ranges.min(axis=0), ranges[0], ranges.max(axis=0), CLEAN.max_range_m
    )
    for env in range(N_ENV):
        truth, cosine, who = oracle[0][env]
        same = np.all(
            [(turned[env][2] == who) & (np.abs(turned[env][1] - cosine) < 1e-3) for turned in oracle[1:]],
            axis=0,
        )
        steady = same & (np.abs(out["range_m"][env] - truth) < RANGE_TOLERANCE_M) & (out["hit"][env] == 1)
        compared += steady.sum()
        bearing = beam_headings(scene["quat"][env], N_RAY)
        u = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        rate = doppler_by_differences(scene, env, u, truth, who)
        assert np.abs(out["doppler_m_s"][env] - rate)[steady].max() < DOPPLER_TOLERANCE_M_S
        intensity = np.maximum(cosine, 0.01) * (1 - 0.9 * truth / 12.0)
        gently = steady & (cosine > 0.05)
        assert np.abs(out["intensity"][env] - intensity)[gently].max() < 1.0e-3
        assert np.all(out["doppler_m_s"][env][out["hit"][env] == 0] == 0)
        obstacles += np.sum(who != WALL)
        different += np.sum(np.abs(truth - sonar_scan(scene, env, TANK, N_RAY, 0.0)[0]) > 0.1)
    assert compared > 0.9 * N_ENV * N_RAY
    assert obstacles > 2500 and different > 625, (
        "the scenes must show obstacles, many of them only thanks to the aperture"
    )


def test_round_tank_against_mujoco(rig):
    scene = scenes.random_scenes(np.random.default_rng(3), N_ENV, N_OBSTACLE, ROUND_TANK)
    rig.start(scene)
    out = rig.cast(FLAT, ROUND_TANK)
    truth, low, high = [], [], []
    for env in range(N_ENV):
        caster = scenes.Caster(scene, env, ROUND_TANK)
        bearing = beam_headings(scene["quat"][env], N_RAY)
        rays = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(N_RAY)], axis=1)
        truth.append(caster.distances(scene["pos"][env], rays))
        around = scenes.envelope(
            lambda r, c=caster, s=scene["pos"][env]: c.distances(s, r), rays, GRAZING_RAD
        )
        low.append(around[0])
        high.append(around[1])
    assert_ranges(
        out["range_m"], out["hit"], np.array(low), np.array(truth), np.array(high), FLAT.max_range_m
    )


# ----------------------------------------------------------------------------------------------------- errors


@ti.kernel
def apply_error(
    which: Const[int],
    range_m: ti.f32,
    cosine: ti.f32,
    step: ti.i32,
    config: Const[SonarConfig],
    out: ti.types.ndarray(dtype=ti.f32, ndim=3),
):
    """out[key, ray, (range, rate, brightness)] of one error for beams that would tell (range_m, 1, cos)."""
    for row, packet in ti.ndrange(out.shape[0], out.shape[1] // LANES):
        key, ray = ti.cast(row + 7, ti.u32), packet * LANES
        r, rate, bright = f16x(range_m), f16x(1.0), f16x(cosine)
        reported, speed, lit = r + 0.0, rate + 0.0, bright + 0.0
        if ti.static(which == 0):
            reported = sonar.range_noisy(r, key, step, ray, io_for(SonarIO, config))
        elif ti.static(which == 1):
            reported = sonar.missed(r, key, step, ray, io_for(SonarIO, config))
        elif ti.static(which == 2):
            reported, speed, lit = sonar.falsely_returned(
                r, rate, bright, key, step, ray, io_for(SonarIO, config)
            )
        elif ti.static(which == 3):
            reported = sonar.grazing_lost(r, bright, io_for(SonarIO, config))
        elif ti.static(which == 4):
            reported = sonar.cut_off(r, io_for(SonarIO, config))
        else:
            speed = sonar.doppler_noisy(rate, key, step, ray, io_for(SonarIO, config))
        for i in ti.static(range(LANES)):
            out[row, ray + i, 0] = reported[i]
            out[row, ray + i, 1] = speed[i]
            out[row, ray + i, 2] = lit[i]


NOISE, MISSED, FALSE, GRAZING, CUT, DOPPLER = range(6)


def reported(which, config, range_m=5.0, cosine=0.5, step=3):
    out = np.zeros((64, N_RAY, 3), np.float32)
    apply_error(which, range_m, cosine, step, config, out)
    return out


def assert_share(mask, share):
    assert abs(mask.mean() - share) < SIGMAS * np.sqrt(share * (1 - share) / mask.size)


def test_range_sigma_grows_with_range():
    config = SonarConfig(range_sigma_m=0.03, range_sigma_slope=0.01)
    for range_m in (2.0, 8.0):
        error = reported(NOISE, config, range_m)[..., 0] - range_m
        sigma = 0.03 + 0.01 * range_m
        assert abs(error.mean()) < SIGMAS * sigma / np.sqrt(error.size)
        assert error.std() == pytest.approx(sigma, rel=SIGMAS / np.sqrt(2 * error.size))
        assert abs(np.corrcoef(error[:, :-1].ravel(), error[:, 1:].ravel())[0, 1]) < SIGMAS / np.sqrt(
            error.size
        )


def test_range_noise_differs_between_steps_and_episodes_and_repeats():
    config = SonarConfig(range_sigma_m=0.03, range_sigma_slope=0.01)
    first, again, later = reported(NOISE, config), reported(NOISE, config), reported(NOISE, config, step=4)
    assert np.array_equal(first, again)
    assert abs(np.corrcoef(first[..., 0].ravel(), later[..., 0].ravel())[0, 1]) < SIGMAS / np.sqrt(
        first[..., 0].size
    )
    assert abs(np.corrcoef(first[0, :, 0], first[1, :, 0])[0, 1]) < SIGMAS / np.sqrt(N_RAY)


def test_jitter_is_exponential():
    error = reported(NOISE, SonarConfig(range_jitter_m=0.1))[..., 0] - 5.0
    assert error.min() >= 0
    assert error.mean() == pytest.approx(0.1, rel=SIGMAS / np.sqrt(error.size))
    assert_share(error > 0.1, np.exp(-1.0))


def test_missed_returns():
    assert_share(reported(MISSED, SonarConfig(missed_return=0.1))[..., 0] == FAR_M, 0.1)


def test_false_returns_are_uniform_and_still():
    out = reported(FALSE, SonarConfig(false_return=0.03))
    chosen = out[..., 1] == 0.0
    assert_share(chosen, 0.03)
    false = out[chosen]
    assert false[:, 0].mean() == pytest.approx(6.0, abs=SIGMAS * 12 / np.sqrt(12 * len(false)))
    assert np.std(false[:, 0]) == pytest.approx(12 / np.sqrt(12), rel=0.1)
    assert np.all(out[~chosen] == np.float32([5.0, 1.0, 0.5]))


def test_grazing_loss_is_sharp():
    config = SonarConfig(grazing_cosine=0.25)
    assert np.all(reported(GRAZING, config, cosine=0.24)[..., 0] == FAR_M)
    assert np.all(reported(GRAZING, config, cosine=0.26)[..., 0] == 5.0)


def test_quantum_range_limit_and_sign():
    config = SonarConfig(range_quantum_m=0.024)
    for range_m in (0.011, 3.333, 11.9):
        got = reported(CUT, config, range_m)[0, 0, 0]
        assert abs(got - range_m) <= 0.012 + 1e-6
        assert got / 0.024 == pytest.approx(round(got / 0.024), abs=1e-3)
    assert reported(CUT, config, 12.1)[0, 0, 0] == np.float32(FAR_M)
    assert reported(CUT, CLEAN, -0.1)[0, 0, 0] == 0.0
    assert reported(CUT, CLEAN, 3.333)[0, 0, 0] == np.float32(3.333)


def test_doppler_sigma_and_outliers():
    error = reported(DOPPLER, SonarConfig(doppler_sigma_m_s=0.2))[..., 1] - 1.0
    assert abs(error.mean()) < SIGMAS * 0.2 / np.sqrt(error.size)
    assert error.std() == pytest.approx(0.2, rel=SIGMAS / np.sqrt(2 * error.size))
    wild = reported(DOPPLER, SonarConfig(doppler_outlier=0.1))[..., 1]
    assert_share(wild != 1.0, 0.1)
    assert np.abs(wild).max() <= 2.0
    assert wild[wild != 1.0].std() == pytest.approx(2 / np.sqrt(3), rel=0.1)


def test_ghost_takes_the_mirrored_path(rig):
    """In an empty tank beam 32 (45 deg) bounces off y = 6, then meets x = 20 (or the range limit)."""
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (15.0, 4.0, -1.0))
    scene["vel_b"][:] = (0.3, 0.1, 0.0)
    rig.start(scene)
    out = rig.cast(LATE)
    u = np.sqrt(0.5)
    assert out["range_m"][0, 32] == pytest.approx(5.0 / u, abs=1e-4)
    assert out["doppler_m_s"][0, 32] == pytest.approx(-(0.3 + 0.1) * u, abs=1e-5)
    assert out["range_m"][0, 0] == pytest.approx(5.0, abs=1e-4), (
        "back along the axis: 5 + 20 m is out of range, the direct return stays"
    )
    moving = scenes.one_obstacle_scene(
        N_ENV, N_OBSTACLE, (10.0, 4.0, -1.0), kind=scenes.BOX, obstacle_pos=(14.5, 4.0, -1.0),
        size=(0.5, 1.0, 0.5), obstacle_vel=(-0.7, 0.2, 0.0),
    )  # fmt: skip
    rig.start(moving)
    out = rig.cast(LATE)
    assert out["range_m"][0, 32] == pytest.approx(4.0 / u, abs=1e-4), (
        "wall at (12, 6), then the box's face x = 14 at (14, 4)"
    )
    assert out["doppler_m_s"][0, 32] == pytest.approx((-0.7 - 0.2) * u, abs=1e-5)
    assert out["range_m"][0, 0] == pytest.approx(4.0, abs=1e-4)


LATE = SonarConfig(ghost=1.0, bubble_clouds_per_s=0.5, period_steps=5, latency_steps=10)
"""of three tests: one kernel"""
HARSH = load_config("pool", "harsh").sensors.sonar


def test_harsh_preset_shows_every_error_at_its_rate(rig):
    """All switches on: 125 envs in an empty tank, so near a wall that its far end is grazed, 41 pings."""
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (10.0, 2.0, -0.8))
    clean, cosine, _ = sonar_scan(scene, 0, TANK, N_RAY, 10.0)
    heard = cosine > HARSH.grazing_cosine
    rig.start(scene)
    pings = []
    for step in range(204):
        set_step(rig.clock, step)
        rig.cast(HARSH, names=())
        if rig.scan.fresh[0] == 1:
            pings.append(
                (rig.scan.hit.to_numpy(), rig.scan.range_m.to_numpy(), rig.scan.doppler_m_s.to_numpy())
            )
    assert len(pings) == 41
    hit, range_m, doppler = (np.array(column) for column in zip(*pings, strict=True))
    lost_share, false_share = HARSH.missed_return, HARSH.false_return
    assert hit[:, :, heard].mean() == pytest.approx(1 - lost_share * (1 - false_share), abs=0.01)
    assert np.any(~heard) and hit[:, :, ~heard].mean() < 0.35, (
        "grazing beams hear ghosts, clouds and clutter only"
    )
    cells = range_m[hit == 1] / HARSH.range_quantum_m
    assert np.abs(cells - np.round(cells)).max() < 1e-3
    error = (range_m - clean)[:, :, heard]
    seen = hit[:, :, heard] == 1
    body = seen & (np.abs(error) < 1.0)
    sigma = np.hypot(0.10 + 0.01 * clean[heard].mean(), 0.1)
    assert error[body].mean() == pytest.approx(HARSH.range_jitter_m, abs=0.01), (
        "the jitter is positive on average"
    )
    assert error[body].std() == pytest.approx(sigma, rel=0.15)
    clutter = false_share * np.mean((clean[heard] - 1) / 12.0)
    clouds = 0.75 * 0.5 * 2.0 * 5.5 / N_RAY * np.mean((clean[heard] - 1.5) / 11.5)
    assert np.mean(error[seen] < -1.0) == pytest.approx(clutter + clouds, rel=0.25), (
        "clutter, and clouds (three quarters formed by then)"
    )
    assert np.mean(error[seen] > 1.0) > 0.02, "ghosts"
    assert np.mean(np.abs(doppler[hit == 1]) > 1.0) == pytest.approx(HARSH.doppler_outlier * 0.5, rel=0.1), (
        "outliers within +-2 m/s"
    )


def test_bubble_clouds_come_last_and_hide_what_is_behind(rig):
    """Share of covered beams = rate x mean duration x mean width / n_ray; runs of 3-8 beams at one range."""
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (10.0, 3.0, -0.8))
    rig.start(scene)
    clean = rig.cast(CLEAN)
    rig.start(scene)
    covered, runs, lives = [], [], np.zeros((N_ENV, N_RAY), int)
    for step in range(0, 1000, 5):
        set_step(rig.clock, step)
        out = rig.cast(LATE, names=("range_m",))
        nearer = out["range_m"] < clean["range_m"] - 1e-3
        covered.append(nearer.mean())
        lives = np.where(nearer, lives + 1, 0)
        if step % 100 == 0:
            for env in range(0, N_ENV, 5):
                values, counts = np.unique(out["range_m"][env][nearer[env]], return_counts=True)
                runs += list(counts[values > 0])
    until = rig.sonar_memory.cloud_until.to_numpy()
    assert until.max() <= 995 + 150 and lives.max() >= 10 and lives.max() * 5 <= 2 * 150 + 5
    assert set(range(3, 9)) <= set(runs) and max(runs) <= 8
    # one cloud forms at a range uniform in [0.5, 12] and shows only in front of the walls
    shows = np.mean(np.clip((clean["range_m"][0] - 0.5) / 11.5, 0, 1))
    assert np.mean(covered[40:]) == pytest.approx(0.5 * 2.0 * 5.5 / N_RAY * shows, rel=0.15)


# ----------------------------------------------------------------------------------------------------- timing


def test_rate_latency_and_what_a_scan_is_labelled_with(rig):
    """Ping every 5 steps, delivered 10 steps later (two scans under way at once)."""
    scene = scenes.one_obstacle_scene(N_ENV, N_OBSTACLE, (10.0, 3.0, -0.8))
    rig.start(scene)
    fresh = {}
    for step in range(28):
        set_step(rig.clock, step)
        scene["pos"][:, 0] = 10.0 - 0.05 * step
        scenes.load(scene, rig.vehicle, rig.world)
        put(rig.ego, pos_w=step, vel_b=-step, vel_valid=step % 4 == 0, rpy=0.01 * step)
        out = rig.cast(LATE)
        assert len(set(out["fresh"])) == 1
        if out["fresh"][0]:
            fresh[step] = out["ping_step"][0]
        last = fresh[max(fresh)]
        assert np.all(out["ping_step"] == last), "between deliveries the old scan stays"
        assert out["range_m"][0, N_RAY // 2] == pytest.approx(10.0 - 0.05 * last, abs=1e-4), (
            "what was true when it was pinged"
        )
        assert np.all(rig.scan.ping_pos_w.to_numpy() == last)
        assert np.all(rig.scan.ping_vel_b.to_numpy() == -last)
        assert np.all(rig.scan.ping_vel_valid.to_numpy() == (last % 4 == 0))
        assert np.allclose(rig.scan.ping_yaw.to_numpy(), 0.01 * last)
    assert fresh == {0: 0, 15: 5, 20: 10, 25: 15}, "the first scan is delivered at once, and only then"


def test_sleeping_rows_keep_their_scan(rig, batches):
    rig.start(batches[0])
    before = rig.cast()
    rig.clock.active.from_numpy((np.arange(N_ENV) % 2).astype(np.int32))
    scenes.load(batches[1], rig.vehicle, rig.world)
    rig.clock.step.fill(1)
    after = rig.cast()
    assert all(np.array_equal(before[name][::2], after[name][::2]) for name in before)
    assert not np.array_equal(before["range_m"][1::2], after["range_m"][1::2])
    sonar.reset_sonar(rig.io(SonarIO))
    cleared = rig.scan.hit.to_numpy()
    assert np.array_equal(cleared[::2], after["hit"][::2]) and not cleared[1::2].any()


def test_envs_do_not_touch_each_other_and_a_reset_forgets_everything(rig, batches):
    """With all errors on: rows permuted give rows permuted, a run after other runs gives the same bits."""
    order = np.random.default_rng(0).permutation(N_ENV)

    def run(scene, keys):
        rig.start(scene)
        rig.episode.key.from_numpy(keys)
        for step in range(8):
            set_step(rig.clock, step)
            out = rig.cast(HARSH)
        return out

    keys = (np.arange(N_ENV) * 977).astype(np.uint32)
    first = run(batches[0], keys)
    run(batches[1], keys[::-1].copy())
    permuted = run({name: value[order] for name, value in batches[0].items()}, keys[order])
    assert all(np.array_equal(first[name][order], permuted[name]) for name in first)
