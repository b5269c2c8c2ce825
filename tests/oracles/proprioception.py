"""NumPy float64 oracle of the proprioceptive sensors' noise-free part."""

import numpy as np

from tests.oracles.scenes import rotation


def roll_pitch_yaw(quat):
    """Z-Y-X angles of one quaternion, read off its matrix."""
    R = rotation(quat)
    return np.array([np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])


def specific_force(quat, acc_b, gravity):
    """[m/s^2] what an accelerometer feels: acceleration minus gravity, body axes."""
    return acc_b - rotation(quat).T @ np.array([0.0, 0.0, -gravity])


def zeroed_depth(start_z, z, bias, noise):
    """[n] depth of a pressure sensor set to the start's depth at first; z, noise [n], first = start."""
    raw = -np.asarray(z) + bias + np.asarray(noise)
    return raw - (raw[0] + start_z)


def dead_reckoned(start, quats, vels, dt):
    """[n + 1, 3] positions summed up from body velocities [n, 3] at attitudes [n, 4]."""
    moves = [rotation(q) @ v * dt for q, v in zip(quats, vels, strict=True)]
    return np.concatenate([[start], start + np.cumsum(moves, axis=0)])
