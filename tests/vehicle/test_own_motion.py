"""Corrections of an estimate, led back to the pose of an earlier moment."""

import numpy as np
import pytest

from uuvtai.vehicle.sensor_inputs import MotionSums, OwnPose, to_body, to_world

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
