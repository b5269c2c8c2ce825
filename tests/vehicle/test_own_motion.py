"""Corrections of an estimate, led back to the pose of an earlier moment."""

import numpy as np
import pytest

from tests.mavlink_vehicle import link_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.vehicle.messages import Inbox, PositionFix
from uuvtai.vehicle.onboard import numbers_of
from uuvtai.vehicle.sensor_inputs import FedSensors, MotionSums, OwnPose, to_body, to_world

RPY = np.array([0.1, -0.2, 2.5])


def pose(pos=(0, 0, 0), vel=(0, 0, 0), bias=(0, 0, 0), yaw=0.0):
    return OwnPose(
        np.array(pos, float), RPY + np.array([0.0, 0.0, yaw]), np.array(vel, float), np.array(bias, float)
    )


def test_axes_there_and_back():
    vector = np.array([0.3, -0.7, 0.2])
    assert to_body(to_world(vector, RPY), RPY) == pytest.approx(vector)


def test_what_was_felt_is_summed():
    sums = MotionSums()
    for _ in range(10):
        sums.feel(np.array([0.5, 0.0, -0.1]), np.array([1.0, 2.0, 0.3]), 0.02)
    assert sums.won_b == pytest.approx([0.1, 0.0, -0.02]) and sums.risen_m == pytest.approx(0.06)


def test_an_old_pose_is_what_motion_leads_back_to():
    """Found at 0.4 s, the place and velocity of 0.1 s are those of constant acceleration backwards."""
    sums, then = MotionSums(), pose()
    noted = sums.noted()
    sums.correct(
        pose(), pose(pos=(0.2, 0.0, 0.1), vel=(0.3, -0.1, 0.0), bias=(0.05, 0.1, 0.0), yaw=0.02), 0.4
    )
    known = sums.known_now(then, noted, 0.1)
    vel_w, bias_w = to_world(np.array([0.3, -0.1, 0.0]), RPY), to_world(np.array([0.05, 0.1, 0.0]), RPY)
    assert known.vel_b == pytest.approx(to_body(vel_w + 0.3 * bias_w, RPY))
    assert known.pos_w == pytest.approx([0.2, 0.0, 0.1] - 0.3 * vel_w - 0.5 * 0.3**2 * bias_w)
    assert known.rpy == pytest.approx(RPY + np.array([0.0, 0.0, 0.02]))


def test_what_was_corrected_before_changes_nothing():
    sums = MotionSums()
    sums.correct(pose(), pose(pos=(1.0, 0.0, 0.0), vel=(0.5, 0.0, 0.0), yaw=6.2), 3.0)
    known = sums.known_now(pose(vel=(0.1, 0.0, 0.0)), sums.noted(), 3.2)
    assert known.pos_w == pytest.approx([0, 0, 0]) and known.vel_b == pytest.approx([0.1, 0, 0])
    assert sums.yaw == pytest.approx(6.2 - 2 * np.pi)


def test_a_velocity_by_positions_counts_their_own_times():
    """ArduSub tells twenty a second, two and a half steps apart."""
    vectors = "pos_w rpy imu_rpy vel_b dvl_b rate_b specific_force_b fix_vel_w"
    views = {f"ego.{name}": np.zeros((1, 3), np.float32) for name in vectors.split()}
    numbers = "clock.step ego.dvl_fresh ego.vel_valid ego.fix_valid ego.given_up ego.depth_m"
    views |= {name: np.zeros(1, np.float32) for name in numbers.split()}
    inbox, found = Inbox({}), []
    given = numbers_of(link_config(**{"sensors.localization": "truth"}), read_tree("bt"))
    sensors = FedSensors(given, views, inbox)
    for step in range(50):
        views["clock.step"][0] = step
        for time_s in np.arange(0.0, 1.0, 0.05):
            if round(time_s / 0.02 + 0.01) == step:
                inbox.feed(PositionFix(time_s, np.array([0.6 * time_s, 0.0, 0.0])))
        sensors.sense_motion(None)
        if views["ego.fix_valid"][0]:
            found.append(float(views["ego.fix_vel_w"][0, 0]))
    assert len(found) > 20 and found == pytest.approx([0.6] * len(found), rel=1e-4)
