"""Columns of the policy over a set of bodies, the same for the twin and the simulator.

Everything is seen in the world mirrored so that the goal lies ahead and to the left at the start: four
situations that mirror each other are one to the policy.
"""

import taichi as ti

from uuvtai.kernels.core.signature import AnyTensor, FloatMatrix
from uuvtai.twin.twin_arrays import AT_FLIP, AT_GOAL, AT_LAST, AT_POS, AT_VEL, AT_YAW, N_RAY

BODY_WIDTH = 22
OWN_WIDTH = 17
EGO_COLUMNS = OWN_WIDTH + N_RAY
HULL_M = 0.22
"""hull radius and half of its half length"""


@ti.kernel
def write_set_columns(
    ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix, bodies: AnyTensor, own: FloatMatrix
):
    """``bodies`` (n, lanes, BODY_WIDTH) and ``own`` (n, EGO_COLUMNS) from rows of the vehicle
    (``twin_arrays``), tracks (n, lanes, RAW_WIDTH) and free distances (n, N_RAY) [m]."""
    for env in range(ego.shape[0]):
        fx, fy = ego[env, AT_FLIP], ego[env, AT_FLIP + 1]
        yaw = ego[env, AT_YAW]
        c, s = ti.cos(yaw), ti.sin(yaw)
        x, y, z = ego[env, AT_POS], ego[env, AT_POS + 1], ego[env, AT_POS + 2]
        vx = fx * (c * ego[env, AT_VEL] - s * ego[env, AT_VEL + 1])
        vy = fy * (s * ego[env, AT_VEL] + c * ego[env, AT_VEL + 1])
        gx, gy = fx * (ego[env, AT_GOAL] - x), fy * (ego[env, AT_GOAL + 1] - y)
        to_goal = ti.max(ti.sqrt(gx * gx + gy * gy), 1e-3)
        for lane in range(raw.shape[1]):
            for i in range(BODY_WIDTH):
                bodies[env, lane, i] = 0.0
            if raw[env, lane, 13] > 0.5:
                dx, dy = fx * (raw[env, lane, 0] - x), fy * (raw[env, lane, 1] - y)
                bx, by = fx * raw[env, lane, 2], fy * raw[env, lane, 3]
                rx, ry, radius = bx - vx, by - vy, raw[env, lane, 5]
                far = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
                when = ti.math.clamp(-(dx * rx + dy * ry) / ti.max(rx * rx + ry * ry, 1e-3), 0.0, 3.0)
                miss = ti.sqrt((dx + when * rx) ** 2 + (dy + when * ry) ** 2) - radius - HULL_M
                values = ti.Vector(
                    [
                        1.0,
                        dx / 4,
                        dy / 4,
                        rx,
                        ry,
                        bx,
                        by,
                        2 * radius,
                        ti.math.clamp(raw[env, lane, 6], 0.0, 1.6),
                        ti.math.clamp(raw[env, lane, 7], 0.0, 1.6),
                        ti.min(raw[env, lane, 8], 4.0) / 2,
                        ti.math.clamp(fx * fy * raw[env, lane, 4], -3.0, 3.0) / 2,
                        (dx + fx * raw[env, lane, 9]) / 4,
                        (dy + fy * raw[env, lane, 10]) / 4,
                        (dx + fx * raw[env, lane, 11]) / 4,
                        (dy + fy * raw[env, lane, 12]) / 4,
                        ti.min(far - radius, 8.0) / 4,
                        1.0 / (0.3 + ti.max(far - radius - HULL_M, 0.0)),
                        when,
                        ti.math.clamp(miss, -1.0, 3.0),
                        gx / to_goal,
                        gy / to_goal,
                    ]
                )
                for i in ti.static(range(BODY_WIDTH)):
                    bodies[env, lane, i] = values[i]
        values = ti.Vector(
            [
                gx / 10,
                gy / 4,
                ego[env, AT_GOAL + 2] - z,
                gx / to_goal,
                gy / to_goal,
                ti.min(to_goal, 4.0) / 4,
                vx,
                vy,
                2 * ego[env, AT_VEL + 2],
                z + 0.8,
                ego[env, AT_LAST],
                ego[env, AT_LAST + 1],
                ego[env, AT_LAST + 2],
                ti.cos(4 * yaw),
                fx * fy * ti.sin(4 * yaw),
                fy * (y - 3) / 3,
                fx * (x - 10) / 10,
            ]
        )
        for i in ti.static(range(OWN_WIDTH)):
            own[env, i] = values[i]
        for i in range(N_RAY):
            at = i
            if fx < 0.0:
                at = (N_RAY // 2 - at + N_RAY) % N_RAY
            if fy < 0.0:
                at = (N_RAY - at) % N_RAY
            own[env, OWN_WIDTH + i] = 1.0 / (0.3 + ti.math.clamp(ray[env, at] - HULL_M, 0.0, 4.0)) - 0.5
