"""Proprioception against a float64 oracle; every error source by its statistics; dead reckoning."""

import numpy as np
import pytest

from tests.bundles import Stage, put
from tests.conftest import set_step
from tests.oracles.proprioception import dead_reckoned, roll_pitch_yaw, specific_force, zeroed_depth
from tests.oracles.scenes import quaternions, rotation
from uuvtai.config import DvlConfig, EpisodeConfig, ImuConfig, PressureConfig, SensorsConfig, VehicleConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.sensors import proprioception
from uuvtai.kernels.sensors.io import ProprioceptionIO, VelocityIO

N_ENV = 2000
SIZES = {"n_env": N_ENV, "n_thruster": 6}
BODY, RULES = VehicleConfig(), EpisodeConfig()
DT = RULES.control_dt_s

ROUNDING = 2.0e-5
"""float32: angles and velocities of order one, forces of order 10 through a rotation matrix."""

SIGMAS = 5.0
"""Statistics over n draws may be off by this many standard errors; seeds are fixed, so a pass stays a
pass."""

HARSH = load_config("pool", "harsh", overrides={"sensors.localization": "dead_reckoning"}).sensors
SLOW_AND_BIASED = SensorsConfig(
    dvl=DvlConfig(sigma_m_s=0.01, scale_error=0.02, period_steps=5),
    imu=ImuConfig(accel_bias_m_s2=0.2, heading_sigma_rad=0.05), start_sigma_m=0.2,
)  # fmt: skip
LOSSY_AND_NOISY = SensorsConfig(
    dvl=DvlConfig(period_steps=5, dropout=0.017),
    imu=ImuConfig(accel_sigma_m_s2=0.05, attitude_sigma_rad=0.01),
)
DRIFTING = SensorsConfig(
    imu=ImuConfig(heading_drift_rad_s=0.001), pressure=PressureConfig(bias_m=0.5, sigma_m=0.02)
)
"""configs of several tests, for each is compiled"""
READINGS = ("vel_b", "vel_valid", "rpy", "rate_b", "specific_force_b", "depth_m", "pos_w")


class Rig(Stage):
    """One instance of the structs; rows share nothing but the motion that a test gives them."""

    sizes = SIZES

    def start(self, sensors, key=1, **truth):
        still = {
            "pos_w": (5, 3, -1), "quat_wb": (1, 0, 0, 0), "vel_b": (0, 0, 0), "rate_b": (0, 0, 0),
            "acc_b": (0, 0, 0),
        }  # fmt: skip
        put(self.vehicle, **{**still, **truth})
        put(self.episode, key=np.arange(N_ENV) * 31 + key)
        put(self.clock, active=1, step=0)
        proprioception.reset_proprioception(self.io(ProprioceptionIO, sensors))

    def sense(self, sensors, step, names=READINGS):
        set_step(self.clock, step)
        proprioception.sense_proprioception(self.io(ProprioceptionIO, sensors, BODY, RULES))
        return {name: getattr(self.ego, name).to_numpy() for name in names}

    def find(self, sensors, step):
        """(vel_b, vel_valid) of a step as the stack has them."""
        self.sense(sensors, step, ())
        proprioception.find_velocity(self.io(VelocityIO, sensors, RULES))
        return self.ego.vel_b.to_numpy(), self.ego.vel_valid.to_numpy()


rig = Rig.fixture()


def random_motion(rng):
    rpy = rng.uniform((-0.5, -0.5, -np.pi), (0.5, 0.5, np.pi), (N_ENV, 3))
    motion = {"pos_w": rng.uniform((0, 0, -1.6), (20, 6, 0), (N_ENV, 3)), "quat_wb": quaternions(rpy)}
    return {**motion, **{name: rng.normal(0, 0.5, (N_ENV, 3)) for name in ("vel_b", "rate_b", "acc_b")}}


def assert_normal(values, sigma):
    """Mean 0 and this standard deviation, within what the number of draws allows."""
    assert abs(values.mean()) < SIGMAS * sigma / np.sqrt(values.size)
    assert values.std() == pytest.approx(sigma, rel=SIGMAS / np.sqrt(2 * values.size))


def test_clean_sensors_tell_the_truth(rig):
    clean = SensorsConfig()
    truth = random_motion(np.random.default_rng(1))
    rig.start(clean, **truth)
    for step in (0, 1, 7):
        out = rig.sense(clean, step)
        assert np.abs(out["vel_b"] - truth["vel_b"]).max() < ROUNDING
        assert np.abs(out["rate_b"] - truth["rate_b"]).max() < ROUNDING
        assert np.abs(out["pos_w"] - truth["pos_w"]).max() < ROUNDING
        assert np.abs(out["depth_m"] + truth["pos_w"][:, 2]).max() < ROUNDING
        assert np.all(out["vel_valid"] == 1)
        for env in range(0, N_ENV, 50):
            angles = out["rpy"][env] - roll_pitch_yaw(truth["quat_wb"][env])
            assert np.abs((angles + np.pi) % (2 * np.pi) - np.pi).max() < ROUNDING
            force = specific_force(truth["quat_wb"][env], truth["acc_b"][env], BODY.gravity_m_s2)
            assert np.abs(out["specific_force_b"][env] - force).max() < ROUNDING


def test_a_level_vehicle_at_rest_feels_gravity_upwards(rig):
    rig.start(SensorsConfig())
    assert rig.sense(SensorsConfig(), 0)["specific_force_b"][0] == pytest.approx((0, 0, 9.81))


def test_dvl_noise_scale_and_period(rig):
    sensors = SLOW_AND_BIASED
    rig.start(sensors, vel_b=(0.0, 0.0, 0.0))
    outs = [rig.sense(sensors, step)["vel_b"] for step in range(6)]
    assert all(np.array_equal(outs[0], out) for out in outs[:5]), "a reading holds until the next"
    assert_normal(outs[0], 0.01)
    assert_normal(outs[5], 0.01)
    assert abs(np.corrcoef(outs[0].ravel(), outs[5].ravel())[0, 1]) < SIGMAS / np.sqrt(outs[0].size)
    scale = rig.ego_memory.dvl_scale.to_numpy()
    assert_normal(scale - 1.0, 0.02)
    put(rig.vehicle, vel_b=(10.0, 0.0, 0.0))
    fast = [rig.sense(sensors, step)["vel_b"][:, 0] / 10.0 for step in (10, 15)]
    assert np.abs(np.mean(fast, axis=0) - scale).max() < 6 * 0.001, (
        "the scale factor stays the same over an episode"
    )


def test_dvl_dropout_of_single_readings(rig):
    sensors = LOSSY_AND_NOISY
    rig.start(sensors)
    assert np.all(rig.sense(sensors, 0)["vel_valid"] == 1), "the bottom is in sight at the start"
    lost = []
    for step in range(1, 300):
        put(rig.vehicle, vel_b=(0.01 * step, 0, 0))
        out = rig.sense(sensors, step, ("vel_b", "vel_valid"))
        if step % 5 == 0:
            lost.append(out["vel_valid"] == 0)
            assert np.allclose(out["vel_b"][~lost[-1], 0], 0.01 * step)
            assert np.all(out["vel_b"][lost[-1], 0] < 0.01 * step - 0.04), "the last reading stays"
        else:
            assert not lost or np.array_equal(out["vel_valid"] == 0, lost[-1]), (
                "validity changes with readings only"
            )
    assert abs(np.mean(lost) - 0.017) < SIGMAS * np.sqrt(0.017 / np.size(lost))


def test_dvl_dropout_bursts_last_one_to_three_seconds(rig):
    rig.start(HARSH)
    valid = np.array([rig.sense(HARSH, step, ("vel_valid",))["vel_valid"] for step in range(0, 2000, 10)])
    runs = []
    for env in range(N_ENV):
        edges = np.flatnonzero(np.diff(np.concatenate([[1], valid[:, env], [1]])))
        runs += [b - a for a, b in zip(edges[::2], edges[1::2], strict=True) if b < len(valid)]
    seconds = np.array(runs) * 0.2
    assert seconds.min() >= 1.0 - 1e-9
    assert np.mean(seconds > 3.0 + 0.2 + 1e-9) < 0.03, "longer only where one burst begins as another ends"
    assert seconds.mean() == pytest.approx(2.0 + 0.1, abs=0.15)
    started = len(runs) / np.sum(valid == 1)
    assert started == pytest.approx(0.017, rel=0.1)


def test_gyro_noise_follows_its_density_and_turns_the_heading(rig):
    density = 3.0e-4
    sensors = SensorsConfig(imu=ImuConfig(gyro_noise_rad_s_rthz=density))
    rig.start(sensors)
    outs = [rig.sense(sensors, step) for step in range(51)]
    assert_normal(outs[0]["rate_b"], density / np.sqrt(DT))
    assert_normal(outs[50]["rate_b"], density / np.sqrt(DT))
    assert_normal(outs[50]["rpy"][:, 2], density * np.sqrt(50 * DT))
    assert np.all(outs[50]["rpy"][:, :2] == 0)


def test_heading_drifts_at_a_constant_rate(rig):
    sensors = DRIFTING
    rig.start(sensors)
    outs = [rig.sense(sensors, step)["rpy"][:, 2] for step in range(101)]
    assert np.all(outs[0] == 0)
    assert_normal(outs[100] / (100 * DT), 0.001)
    assert np.allclose(outs[100], 2 * outs[50], atol=1e-7)


def test_heading_and_place_at_the_start_are_off_for_a_whole_episode(rig):
    told = SensorsConfig(
        localization="dead_reckoning", imu=ImuConfig(heading_sigma_rad=0.05), start_sigma_m=0.2
    )
    for sensors, sigma in ((told, 0.2), (SLOW_AND_BIASED, 0.0)):
        rig.start(sensors)
        outs = [rig.sense(sensors, step) for step in (0, 50)]
        assert np.array_equal(outs[0]["rpy"], outs[1]["rpy"]) and np.array_equal(*(o["pos_w"] for o in outs))
        assert_normal(outs[0]["rpy"][:, 2], 0.05)
        off = outs[0]["pos_w"] - (5.0, 3.0, -1.0)
        assert np.abs(off[:, 2]).max() < 1e-6
        if sigma:
            assert_normal(off[:, :2], sigma)
            assert abs(np.corrcoef(off[:, 0], off[:, 1])[0, 1]) < 0.1
        else:
            assert np.abs(off).max() < 1e-6


def test_yaw_stays_wrapped_under_drift(rig):
    sensors = DRIFTING
    rig.start(sensors, quat_wb=(np.cos(np.pi / 2 - 1e-6), 0, 0, np.sin(np.pi / 2 - 1e-6)))
    yaw = [rig.sense(sensors, step)["rpy"][:, 2] for step in range(50)][-1]
    assert np.abs(yaw).max() <= np.pi + 1e-6 and yaw.min() < -3.1 and yaw.max() > 3.1


def test_accelerometer_and_attitude_noise(rig):
    rig.start(LOSSY_AND_NOISY)
    out = rig.sense(LOSSY_AND_NOISY, 0)
    assert_normal(out["specific_force_b"] - (0, 0, 9.81), 0.05)
    assert_normal(out["rpy"], 0.01)


def test_the_accelerometers_error_stays_the_same_over_an_episode(rig):
    rig.start(SLOW_AND_BIASED)
    errors = [rig.sense(SLOW_AND_BIASED, step)["specific_force_b"] - (0, 0, 9.81) for step in (0, 7)]
    assert_normal(errors[0], 0.2)
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-5)
    np.testing.assert_allclose(errors[0], rig.ego_memory.accel_bias_b.to_numpy(), atol=1e-5)


def test_pressure_bias_and_sigma(rig):
    sensors = DRIFTING
    rig.start(sensors)
    bias = rig.ego_memory.pressure_bias_m.to_numpy()
    assert np.abs(bias).max() <= 0.5 and bias.std() == pytest.approx(1 / np.sqrt(12), rel=0.05)
    errors = [rig.sense(sensors, step)["depth_m"] - 1.0 - bias for step in (0, 1)]
    assert_normal(errors[0], 0.02)
    assert abs(np.corrcoef(*errors)[0, 1]) < SIGMAS / np.sqrt(N_ENV)


def test_truth_localization_ignores_the_errors_of_the_readings(rig):
    rig.start(SLOW_AND_BIASED)
    for step in range(20):
        put(rig.vehicle, pos_w=(5 + 0.1 * step, 3, -1))
        assert np.allclose(rig.sense(SLOW_AND_BIASED, step)["pos_w"], (5 + 0.1 * step, 3, -1))


def lost(localization, **sensors):
    """Sensors of a DVL that is silent from step 1 on."""
    silent = DvlConfig(dropout=1.0, dropout_s=(90.0, 90.0))
    return SensorsConfig(localization=localization, dvl=silent, **sensors)


def test_a_given_position_tells_the_velocity_while_the_dvl_is_silent(rig):
    sensors, truth = lost("truth"), random_motion(np.random.default_rng(6))
    rig.start(sensors, **truth)
    found, valid = rig.find(sensors, 0)
    assert np.array_equal(found, rig.ego.dvl_b.to_numpy()) and np.all(valid == 1)
    vel_w = np.random.default_rng(7).normal(0, 0.5, (N_ENV, 3))
    put(rig.vehicle, pos_w=truth["pos_w"] + vel_w * DT)
    found, valid = rig.find(sensors, 1)
    want = [rotation(quat).T @ vel for quat, vel in zip(truth["quat_wb"], vel_w, strict=True)]
    assert np.all(valid == 1) and np.abs(found - want).max() < 2e-6 / DT


def test_dead_reckoning_knows_heave_alone_while_the_dvl_is_silent(rig):
    """At 0.1 m/s upwards, by a pressure sensor with 2 cm of noise, listing and pitched."""
    sensors = lost("dead_reckoning", pressure=PressureConfig(bias_m=0.5, sigma_m=0.02))
    quat = quaternions(np.tile([0.1, 0.2, 1.0], (N_ENV, 1)))
    rig.start(sensors, quat_wb=quat, vel_b=(0.3, -0.1, 0.05))
    rig.find(sensors, 0)
    for step in range(1, 151):
        put(rig.vehicle, pos_w=(5, 3, -1 + 0.1 * step * DT))
        found, valid = rig.find(sensors, step)
    assert np.all(valid == 2) and np.allclose(found[:, :2], (0.3, -0.1), atol=1e-6), "the last reading"
    rises = found @ rotation(quat[0])[2] - 0.1
    assert abs(rises.mean()) < 0.01 and 0.005 < rises.std() < 0.03


def test_dead_reckoning_with_clean_sensors_is_the_integral_of_the_motion(rig):
    sensors = SensorsConfig(localization="dead_reckoning")
    rng = np.random.default_rng(5)
    steps = 60
    rpy = np.cumsum(rng.normal(0, 0.02, (steps, 3)), axis=0)
    quats, vels = quaternions(rpy), rng.normal((0.4, 0.1, 0.0), 0.05, (steps, 3))
    path = dead_reckoned(np.array([5.0, 3.0, -1.0]), quats, vels, DT)
    rig.start(sensors)
    assert np.allclose(rig.sense(sensors, 0)["pos_w"], (5, 3, -1)), "starts at the known start"
    for step in range(1, steps + 1):
        put(rig.vehicle, pos_w=path[step], quat_wb=quats[step - 1], vel_b=vels[step - 1])
        out = rig.sense(sensors, step)
    assert np.abs(out["pos_w"] - path[-1]).max() < 1e-4


def test_dead_reckoning_coasts_without_the_bottom_and_takes_depth_from_pressure(rig):
    """Bottom lost at step 1: the estimate keeps step 0's velocity along the heading of now."""
    sensors = SensorsConfig(
        localization="dead_reckoning",
        dvl=DvlConfig(dropout=1.0, dropout_s=(10.0, 10.0)),
        pressure=PressureConfig(bias_m=0.5),
    )
    rig.start(sensors, vel_b=(0.5, 0, 0))
    rig.sense(sensors, 0)
    put(rig.vehicle, vel_b=(-1, -1, -1), quat_wb=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)), pos_w=(0, 0, -0.5))
    for step in range(1, 51):
        out = rig.sense(sensors, step)
    assert np.all(out["vel_valid"] == 0) and np.all(out["vel_b"] == np.float32((0.5, 0, 0)))
    assert np.abs(out["pos_w"][:, :2] - (5.0, 3.5)).max() < 1e-4
    assert np.abs(rig.ego_memory.pressure_bias_m.to_numpy()).max() > 0.4
    assert np.allclose(out["pos_w"][:, 2], -0.5, atol=1e-6), "the start's depth is known: the bias drops out"


def test_dead_reckoning_zeroes_the_pressure_sensor_at_the_known_start(rig):
    """Whatever the bias, depth follows the truth; only the first reading's noise stays."""
    sensors = SensorsConfig(localization="dead_reckoning", pressure=PressureConfig(bias_m=0.5, sigma_m=0.02))
    z = np.array([-1.0, -0.9, -0.4, -1.5])
    rig.start(sensors)
    bias = rig.ego_memory.pressure_bias_m.to_numpy()
    outputs = []
    for step, height in enumerate(z):
        put(rig.vehicle, pos_w=(5.0, 3.0, height))
        outputs.append(rig.sense(sensors, step))
        assert np.array_equal(outputs[-1]["pos_w"][:, 2], -outputs[-1]["depth_m"])
    depth = np.stack([out["depth_m"] for out in outputs], 1)
    assert np.allclose(depth[:, 0], 1.0, atol=1e-6)
    assert_normal(depth[:, 3] - 1.5, 0.02 * np.sqrt(2.0))
    rig.start(DRIFTING)
    raw = []
    for step, height in enumerate(z):
        put(rig.vehicle, pos_w=(5.0, 3.0, height))
        raw.append(rig.sense(DRIFTING, step)["depth_m"])
    noise = np.stack(raw, 1) + z - bias[:, None]
    expected = [zeroed_depth(-1.0, z, b, n) for b, n in zip(bias, noise, strict=True)]
    assert np.abs(depth - expected).max() < ROUNDING
    assert np.abs(np.stack(raw, 1)[:, 0] - 1.0).max() > 0.4, (
        "where the position is given the reading stays as it is"
    )


def test_zeroing_changes_no_bit_of_a_perfect_pressure_sensor(rig):
    """Nothing to zero: dead reckoning with clean sensors tells the same depths as given positions do."""
    depths = {}
    for where in ("truth", "dead_reckoning"):
        sensors = SensorsConfig(localization=where)
        rig.start(sensors, **random_motion(np.random.default_rng(8)))
        depths[where] = [rig.sense(sensors, step)["depth_m"] for step in range(3)]
    assert np.array_equal(depths["truth"], depths["dead_reckoning"])


def test_dead_reckoning_error_grows_with_scale_error_and_drift(rig):
    """5 s at 0.5 m/s: along-track = scale x distance, cross-track = drift x t x distance / 2."""
    sensors = SensorsConfig(
        localization="dead_reckoning",
        dvl=DvlConfig(scale_error=0.01),
        imu=ImuConfig(heading_drift_rad_s=0.01),
    )
    rig.start(sensors, vel_b=(0.5, 0, 0))
    for step in range(251):
        out = rig.sense(sensors, step)
    error = out["pos_w"] - (7.5, 3.0, -1.0)
    assert_normal(error[:, 1], 0.01 * 5.0 / 2 * 2.5 * 251 / 250)
    along = (rig.ego_memory.dvl_scale.to_numpy() - 1.0) * 2.5
    assert np.abs(error[:, 0] - along).max() < 0.03, "what is left is the bent track: (drift t)^2 / 6"


def test_rows_do_not_touch_each_other_and_sleepers_keep_everything(rig):
    sensors = HARSH
    order = np.random.default_rng(0).permutation(N_ENV)
    truth = random_motion(np.random.default_rng(2))

    def run(truth, keys):
        rig.start(sensors, **truth)
        rig.episode.key.from_numpy(keys)
        proprioception.reset_proprioception(rig.io(ProprioceptionIO, sensors))
        for step in range(15):
            out = rig.sense(sensors, step)
        return out

    keys = (np.arange(N_ENV) * 977).astype(np.uint32)
    first = run(truth, keys)
    permuted = run({name: value[order] for name, value in truth.items()}, keys[order])
    assert all(np.array_equal(first[name][order], permuted[name]) for name in READINGS)
    rig.clock.active.from_numpy((np.arange(N_ENV) % 2).astype(np.int32))
    put(rig.vehicle, vel_b=(3, 3, 3))
    proprioception.reset_proprioception(rig.io(ProprioceptionIO, sensors))
    after = rig.sense(sensors, 20)
    assert all(np.array_equal(permuted[name][::2], after[name][::2]) for name in READINGS)
    assert not np.array_equal(permuted["rate_b"][1::2], after["rate_b"][1::2])


@pytest.mark.parametrize("name", ["clean", "paper", "nominal", "harsh"])
def test_presets_load_and_get_worse(name):
    sensors = load_config("pool", name).sensors
    rank = ["clean", "paper", "nominal", "harsh"].index(name)
    assert (sensors.dvl.sigma_m_s > 0) == (rank >= 2)
    assert sensors.sonar.latency_steps == max(0, rank - 1)
    assert (sensors.sonar.range_sigma_m > 0) == (rank >= 1)
    assert sensors.localization == ("truth" if rank < 2 else "estimated")
