"""Readings carried forward: attitude by its rates, velocity by the accelerometer, vectors into the world."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uuvtai.vehicle.messages import ImuReading
from uuvtai.vehicle.sensor_inputs import acceleration_b, to_world, turned_on

G = 9.81
CASES = np.random.default_rng(0).uniform([-0.5, -0.5, -3, -1, -1, -1], [0.5, 0.5, 3, 1, 1, 1], (20, 6))


def rotation(rpy):
    """Of yaw, pitch, roll, by another library."""
    return Rotation.from_euler("ZYX", np.asarray(rpy)[::-1])


@pytest.mark.parametrize("case", CASES, ids=range(len(CASES)))
def test_attitude_goes_on_at_its_rates(case):
    rpy, rate = case[:3], case[3:]
    found = rotation(turned_on(ImuReading(0.0, rpy, rate, np.zeros(3)), 0.01))
    exact = rotation(rpy) * Rotation.from_rotvec(0.01 * rate)
    assert (found.inv() * exact).magnitude() < 2e-4
    still = turned_on(ImuReading(0.0, rpy, np.zeros(3), np.zeros(3)), 0.1)
    assert np.array_equal(still, rpy)


@pytest.mark.parametrize("case", CASES, ids=range(len(CASES)))
def test_velocity_changes_by_what_is_felt(case):
    """Of a vehicle with a known acceleration in the world: d(R'v)/dt by differences."""
    rpy, rate, h = case[:3], case[3:], 1e-5
    now, accel_w, vel_w = rotation(rpy), np.array([0.3, -0.2, 0.1]), np.array([0.5, 0.1, -0.2])
    later = now * Rotation.from_rotvec(h * rate)
    expected = (later.inv().apply(vel_w + h * accel_w) - now.inv().apply(vel_w)) / h
    imu = ImuReading(0.0, rpy, rate, now.inv().apply(accel_w + np.array([0.0, 0.0, G])))
    assert acceleration_b(imu, now.inv().apply(vel_w), G) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("case", CASES[:5], ids=range(5))
def test_a_vector_in_the_world(case):
    assert to_world(case[3:], case[:3]) == pytest.approx(rotation(case[:3]).apply(case[3:]))
