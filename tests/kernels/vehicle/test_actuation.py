"""Inner loop: a NumPy oracle, requirements on both frames, saturation, delay, dropouts, odd actions."""

import numpy as np
import pytest
import taichi as ti

from tests.oracles import actuation as oracle
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config, Thruster, VehicleConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.stage import Const
from uuvtai.kernels.vehicle.dynamics import rpm_of_thrust, thrust_limits, thrust_of_rpm
from uuvtai.logs.topics.motion import angles_of
from uuvtai.sim.plant import Plant
from uuvtai.sim.setup import allocation_matrices, controllable_axes

STEADY = 0.05
"""Share of the commanded value (or of the axis limit) that the design allows at steady state."""

TILT_DEG = 5.0
LIMITS = np.array([0.6, 0.6, 0.4, 1.0])

F32_THRUST_N = 2e-3
"""Single precision of forces of 100 N through the allocation and the curve and back; below 1 N the curve is
flat and amplifies."""

ACTIONS = np.array(
    [
        [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, -1, 0], [0, 0, 0, 1],
        [0, 0, 0, -1],
        [1, 1, 0, 0], [1, 1, 0, 1], [1, 1, 1, 1], [1, 1, -1, 1], [-1, -1, -1, -1], [-1, 1, 1, -1],
        [0.5, -0.5, 0.5, 0.5], [0, 0, 0, 0],
    ],
    dtype=np.float32,
)  # fmt: skip
N_ENV = len(ACTIONS)


@pytest.fixture(scope="module", params=["bluerov2", "bluerov2_heavy"])
def plant(request):
    """Both frames: ideal hold with 6 thrusters, hold by 8 thrusters."""
    return Plant(load_config("open", vehicle=request.param), start_taichi("cpu"), n_env=N_ENV)


def drive(plant, actions, steps):
    """Velocities (steps, n_env, 4) [u, v, w, r] and every tenth tilt (n_env) [deg] under constant actions."""
    velocity, tilt = [], []
    for step in range(steps):
        plant.step(actions)
        velocity.append(np.c_[plant.vehicle.vel_b.to_numpy(), plant.vehicle.rate_b.to_numpy()[:, 2]])
        if step % 10 == 0:
            tilt.append(
                [np.degrees(np.abs(angles_of(*q)[:2]).max()) for q in plant.vehicle.quat_wb.to_numpy()]
            )
    return np.array(velocity), np.array(tilt)


# -------------------------------------------------------------------------------------------- what it must do


@pytest.fixture(scope="module")
def response(plant):
    """Six seconds of every action from rest."""
    plant.reset()
    return (*drive(plant, ACTIONS, 300), plant.vehicle.pos_w.to_numpy())


def test_full_surge_is_reached_within_two_seconds(response):
    velocity, _, _ = response
    assert (velocity[99:, 0, 0] > (1 - STEADY) * 0.6).all()


def test_every_axis_holds_its_command(response):
    velocity, _, _ = response
    error = np.abs(velocity[250:] - ACTIONS * LIMITS) / LIMITS
    assert error.max() < STEADY


def test_steps_do_not_overshoot(response):
    velocity, _, _ = response
    assert ((np.abs(velocity) - np.abs(ACTIONS * LIMITS)) / LIMITS).max() < 2 * STEADY


def test_roll_and_pitch_stay_small(response):
    assert response[1].max() < TILT_DEG


def test_depth_is_held_under_the_net_buoyancy(response):
    assert np.abs(response[2][-1]).max() < 0.03  # left alone it would rise by 0.2 m


def test_braking_ends_at_rest(plant):
    plant.reset()
    drive(plant, ACTIONS, 150)
    velocity, tilt = drive(plant, 0 * ACTIONS, 250)
    assert (np.abs(velocity[-50:]) / LIMITS).max() < STEADY
    assert tilt.max() < TILT_DEG


# ---------------------------------------------------------------------------------------------- the equations


def set_ego(plant, vel, rate, rpy, valid=1):
    """What the vehicle senses, for all envs."""
    plant.write(plant.ego.vel_b, vel)
    plant.write(plant.ego.rate_b, rate)
    plant.write(plant.ego.rpy, rpy)
    plant.ego.vel_valid.from_numpy(np.full(N_ENV, valid, np.int32))


@pytest.mark.parametrize("valid", [1, 0, 2])
def test_loop_equals_the_oracle(plant, valid):
    rng = np.random.default_rng(5)
    cfg, gains = plant.config.vehicle, plant.config.actuation
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(cfg)
    for scale in (0.3, 1.0, 3.0):  # the last saturates forces and thrusters
        plant.reset()
        action = rng.uniform(-1, 1, (N_ENV, 4)).astype(np.float32)
        vel, rate, rpy = (rng.uniform(-0.5, 0.5, (N_ENV, 3)) * scale for _ in range(3))
        integral = rng.uniform(-5, 5, (N_ENV, 4))
        set_ego(plant, vel, rate, rpy, valid)
        plant.write(plant.actuation.integral, integral)
        plant.command(action)
        got_integral = plant.actuation.integral.to_numpy()
        got_thrust = oracle.thrust_of_rpm(plant.actuation.rpm_command.to_numpy(), cfg)
        for env in range(N_ENV):
            sensed = (vel[env], rate[env], rpy[env])
            thrust, wanted = oracle.control(
                cfg, gains, 0.02, action[env] * LIMITS, integral[env], *sensed, wrench_of_thrust,
                thrust_of_wrench, valid,
            )  # fmt: skip
            assert np.abs(got_integral[env] - wanted).max() < 1e-4
            # below the smallest thrusts the command is rounded, checked elsewhere
            smooth = np.abs(thrust) > 1.0
            assert np.abs(got_thrust[env] - thrust)[smooth].max(initial=0) < F32_THRUST_N * max(1, scale)


def test_saturation_keeps_the_direction(plant):
    """All thrusts shrink by one factor: the horizontal wrench points where it was asked to."""
    plant.reset()
    cfg = plant.config.vehicle
    set_ego(plant, [-3.0, -2.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0])
    plant.command(np.ones((N_ENV, 4), np.float32))
    thrust = oracle.thrust_of_rpm(plant.actuation.rpm_command.to_numpy()[0], cfg)
    top, bottom = thrust_limits(cfg)
    assert np.isclose(thrust.max(), top, rtol=1e-4) or np.isclose(thrust.min(), bottom, rtol=1e-4)
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(cfg)
    plain, _ = oracle.control(
        cfg, plant.config.actuation, 0.02, LIMITS, np.zeros(4), np.array([-3.0, -2.0, 0]),
        np.array([0, 0, -1.0]), np.zeros(3),
        wrench_of_thrust, thrust_of_wrench,
    )  # fmt: skip
    wanted, got = wrench_of_thrust @ plain, wrench_of_thrust @ thrust
    assert wanted @ got / np.linalg.norm(wanted) / np.linalg.norm(got) > 0.9999


@pytest.mark.parametrize("speed", [1.0, 0.2])
def test_blocked_vehicle_does_not_wind_up(plant, speed):
    """Half a minute against a wall, then free: no overshoot, six seconds at worst to forget."""
    plant.reset()
    set_ego(plant, 0.0, 0.0, 0.0)
    action = np.tile(np.array([speed, 0, 0, 0], np.float32), (N_ENV, 1))
    for _ in range(1500):
        plant.command(action)
    assert np.abs(plant.actuation.integral.to_numpy()).max() <= plant.config.actuation.max_integral_n
    velocity, _ = drive(plant, action, 350)
    if speed == 1.0:
        assert velocity[:, 0, 0].max() < (1 + 2 * STEADY) * 0.6
    assert np.abs(velocity[300:, 0, 0] - 0.6 * speed).max() < STEADY * 0.6


@pytest.mark.parametrize(("spin", "grows"), [(0.0, True), (8.0, False)])
def test_integral_does_not_grow_in_saturation(plant, spin, grows):
    """The same small surge error; a wild spin asks for more centripetal force than there is."""
    plant.reset()
    set_ego(plant, [0.55, 0.55, 0.0], [0.0, 0.0, spin], 0.0)
    for _ in range(50):
        plant.command(np.tile(np.array([1, 1, 0, 1], np.float32), (N_ENV, 1)))
    assert (
        (plant.actuation.integral.to_numpy()[:, 0] > 0.5).all()
        if grows
        else not plant.actuation.integral.to_numpy()[:, 0].any()
    )


def test_lost_dvl_freezes_the_velocity_integral(plant):
    plant.reset()
    set_ego(plant, [-0.3, 0, 0], 0.0, 0.0, valid=0)
    for _ in range(50):
        plant.command(ACTIONS)
    assert not plant.actuation.integral.to_numpy()[:, :3].any()


def test_odd_actions(plant):
    plant.reset()
    set_ego(plant, 0.0, 0.0, 0.0)
    action = np.zeros((N_ENV, 4), np.float32)
    action[0] = [np.nan, 5, -7, np.inf]
    action[1] = [-np.inf, 0.25, np.nan, -1]
    plant.command(action)
    got = plant.actuation.command.to_numpy()
    assert np.allclose(got[0], [0, 0.6, -0.4, 1.0]) and np.allclose(got[1], [-0.6, 0.15, 0, -1.0])
    assert np.isfinite(plant.actuation.rpm_command.to_numpy()).all()


def test_rows_are_independent_and_reset_is_complete(plant):
    plant.reset()
    drive(plant, ACTIONS, 20)
    straight = plant.actuation.rpm_command.to_numpy()
    other = ACTIONS.copy()
    other[3] = [0.3, 0.3, 0.3, 0.3]
    plant.reset()
    drive(plant, other, 20)
    changed = plant.actuation.rpm_command.to_numpy()
    rest = np.arange(N_ENV) != 3
    assert np.array_equal(changed[rest], straight[rest]) and not np.array_equal(changed[3], straight[3])


# ------------------------------------------------------------------------------------------ curve, allocation


@ti.kernel
def _there_and_back(
    values: ti.types.ndarray(), rpm: ti.types.ndarray(), thrust: ti.types.ndarray(), cfg: Const[VehicleConfig]
):
    for i in range(values.shape[0]):
        rpm[i] = rpm_of_thrust(values[i], cfg)
        thrust[i] = thrust_of_rpm(rpm[i], cfg)


def test_thrust_curve_and_its_inverse():
    cfg = VehicleConfig()
    wanted = np.linspace(-60, 75, 1351, dtype=np.float32)
    rpm, thrust = np.zeros_like(wanted), np.zeros_like(wanted)
    _there_and_back(wanted, rpm, thrust, cfg)
    top, bottom = thrust_limits(cfg)
    # 3-vehicle.md: +64.1 / -51.6 N
    assert np.isclose(top, 64.13, atol=0.01) and np.isclose(bottom, -51.55, atol=0.01)
    assert np.abs(thrust - oracle.thrust_of_rpm(rpm, cfg)).max() < F32_THRUST_N
    least = oracle.thrust_of_rpm(np.array([203.5, -210.5]), cfg)
    reachable = ((wanted > least[0]) & (wanted < top)) | ((wanted < least[1]) & (wanted > bottom))
    assert np.abs(thrust - wanted)[reachable].max() < F32_THRUST_N
    assert (np.abs(rpm) <= cfg.rotor_max_rpm).all() and rpm[-1] == cfg.rotor_max_rpm
    assert rpm[0] == -cfg.rotor_max_rpm
    assert not thrust[(wanted > 0.5 * least[1] + 1e-3) & (wanted < 0.5 * least[0] - 1e-3)].any()


def test_six_thrusters_cannot_pitch_and_eight_can():
    six, eight = (load_config("open", vehicle=name).vehicle for name in ("bluerov2", "bluerov2_heavy"))
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(six)
    assert np.linalg.matrix_rank(wrench_of_thrust) == 5
    assert np.allclose(wrench_of_thrust[4], -0.0725 * wrench_of_thrust[0] - 0.0025 * wrench_of_thrust[2])
    assert controllable_axes(wrench_of_thrust) == [0, 1, 2, 3, 5]
    assert np.allclose(
        (wrench_of_thrust @ thrust_of_wrench)[np.ix_([0, 1, 2, 3, 5], [0, 1, 2, 3, 5])], np.eye(5)
    )
    wrench_of_thrust, thrust_of_wrench = allocation_matrices(eight)
    assert np.allclose(wrench_of_thrust @ thrust_of_wrench, np.eye(6))


def test_a_thruster_without_direction_is_refused():
    bad = VehicleConfig(thrusters=(Thruster(position_m=(0, 0, 0), direction=(0, 0, 0)),))
    with pytest.raises(ValueError, match=r"vehicle\.thrusters\.0\.direction"):
        Plant(Config(vehicle=bad), start_taichi("cpu"))
