"""Frames, rotations and distances shared by the stages.

World is z-up, body is FLU, quaternions are (w, x, y, z) and rotate body into world.
"""

import taichi as ti

# kinds of a body in the per-env list
NONE = 0
SPHERE = 1
CYLINDER = 2
"""Vertical cylinder: size = (radius, radius, half height)."""
BOX = 3
"""Box turned about z: size = half extents before the turn."""

PI = 3.141592653589793
TWO_PI = 6.283185307179586
FAR_M = 1.0e6
"""A distance that stands for "nothing there"."""


@ti.func
def wrapped_angle(angle):
    """Angle in [-pi, pi)."""
    return angle - TWO_PI * ti.floor((angle + PI) / TWO_PI)


@ti.func
def rotation_wb(q):
    """Rotation matrix R_wb of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@ti.func
def quaternion_wb(roll, pitch, yaw):
    """Quaternion (w, x, y, z) of yaw-pitch-roll angles (Z-Y-X)."""
    cr, sr = ti.cos(0.5 * roll), ti.sin(0.5 * roll)
    cp, sp = ti.cos(0.5 * pitch), ti.sin(0.5 * pitch)
    cy, sy = ti.cos(0.5 * yaw), ti.sin(0.5 * yaw)
    return ti.Vector(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


@ti.func
def roll_pitch_yaw(q):
    """Z-Y-X Euler angles (roll, pitch, yaw) [rad] of a unit quaternion; pitch is clamped at +-pi/2."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    roll = ti.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = ti.asin(ti.math.clamp(2 * (w * y - z * x), -1.0, 1.0))
    yaw = ti.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return ti.Vector([roll, pitch, yaw])


@ti.func
def turned_z(v, yaw):
    """Two-vector turned by yaw about z."""
    c, s = ti.cos(yaw), ti.sin(yaw)
    return ti.Vector([c * v[0] - s * v[1], s * v[0] + c * v[1]])


@ti.func
def turned_z3(v, yaw):
    """Three-vector turned by yaw about z."""
    level = turned_z(ti.Vector([v[0], v[1]]), yaw)
    return ti.Vector([level[0], level[1], v[2]])
