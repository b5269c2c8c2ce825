"""Columns of the policy over a set of bodies, the same for the twin and the simulator.

Everything is seen in the world mirrored so that the goal lies ahead and to the left at the start: four
situations that mirror each other are one to the policy.
"""

import taichi as ti

from uuvtai.kernels.core.signature import AnyTensor, FloatMatrix
from uuvtai.twin.set_codes import BODY_WIDTH, N_RAY, OWN_WIDTH
from uuvtai.twin.twin_arrays import AT_FLIP, AT_GOAL, AT_LAST, AT_POS, AT_VEL, AT_YAW

HULL_M = 0.22
"""hull radius and half of its half length"""


@ti.func
def mirrored(env, ego: FloatMatrix):
    """Flips of x and y (1 or -1), then velocity [m/s] and way to the goal [m] in the mirrored frame."""
    flip = ti.Vector([ego[env, AT_FLIP], ego[env, AT_FLIP + 1]])
    c, s = ti.cos(ego[env, AT_YAW]), ti.sin(ego[env, AT_YAW])
    speed = ti.Vector(
        [
            flip[0] * (c * ego[env, AT_VEL] - s * ego[env, AT_VEL + 1]),
            flip[1] * (s * ego[env, AT_VEL] + c * ego[env, AT_VEL + 1]),
        ]
    )
    way = ti.Vector(
        [
            flip[0] * (ego[env, AT_GOAL] - ego[env, AT_POS]),
            flip[1] * (ego[env, AT_GOAL + 1] - ego[env, AT_POS + 1]),
        ]
    )
    return flip, speed, way


@ti.func
def length_of(way):
    """[m] never 0."""
    return ti.max(ti.sqrt(way[0] * way[0] + way[1] * way[1]), 1e-3)


@ti.func
def body_columns(env, lane, flip, speed, way, ego: FloatMatrix, raw: AnyTensor):
    """What the policy is told of a track; ``flip``, ``speed`` and ``way`` as ``mirrored`` gives them."""
    fx, fy, to_goal = flip[0], flip[1], length_of(way)
    dx = fx * (raw[env, lane, 0] - ego[env, AT_POS])
    dy = fy * (raw[env, lane, 1] - ego[env, AT_POS + 1])
    bx, by = fx * raw[env, lane, 2], fy * raw[env, lane, 3]
    rx, ry, radius = bx - speed[0], by - speed[1], raw[env, lane, 5]
    far = length_of(ti.Vector([dx, dy]))
    when = ti.math.clamp(-(dx * rx + dy * ry) / ti.max(rx * rx + ry * ry, 1e-3), 0.0, 3.0)
    miss = ti.sqrt((dx + when * rx) ** 2 + (dy + when * ry) ** 2) - radius - HULL_M
    return ti.Vector(
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
            way[0] / to_goal,
            way[1] / to_goal,
        ]
    )


@ti.func
def own_columns(env, flip, speed, way, ego: FloatMatrix):
    """What the policy is told of the vehicle and its goal; as ``body_columns``."""
    to_goal, yaw, z = length_of(way), ego[env, AT_YAW], ego[env, AT_POS + 2]
    return ti.Vector(
        [
            way[0] / 10,
            way[1] / 4,
            ego[env, AT_GOAL + 2] - z,
            way[0] / to_goal,
            way[1] / to_goal,
            ti.min(to_goal, 4.0) / 4,
            speed[0],
            speed[1],
            2 * ego[env, AT_VEL + 2],
            z + 0.8,
            ego[env, AT_LAST],
            ego[env, AT_LAST + 1],
            ego[env, AT_LAST + 2],
            ti.cos(4 * yaw),
            flip[0] * flip[1] * ti.sin(4 * yaw),
            flip[1] * (ego[env, AT_POS + 1] - 3) / 3,
            flip[0] * (ego[env, AT_POS] - 10) / 10,
        ]
    )


@ti.func
def mirrored_ray(i, env, ego: FloatMatrix):
    """Number of the ray that is number ``i`` in the mirrored frame."""
    at = i
    if ego[env, AT_FLIP] < 0.0:
        at = (N_RAY // 2 - at + N_RAY) % N_RAY
    if ego[env, AT_FLIP + 1] < 0.0:
        at = (N_RAY - at) % N_RAY
    return at


@ti.func
def write_columns_of(
    env, ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix, bodies: AnyTensor, own: FloatMatrix
):
    """Columns of one row, as ``write_set_columns``."""
    flip, speed, way = mirrored(env, ego)
    for lane in range(raw.shape[1]):
        columns = ti.Vector.zero(ti.f32, BODY_WIDTH)
        if raw[env, lane, 13] > 0.5:
            columns = body_columns(env, lane, flip, speed, way, ego, raw)
        for i in ti.static(range(BODY_WIDTH)):
            bodies[env, lane, i] = columns[i]
    values = own_columns(env, flip, speed, way, ego)
    for i in ti.static(range(OWN_WIDTH)):
        own[env, i] = values[i]
    for i in range(N_RAY):
        free = ray[env, mirrored_ray(i, env, ego)]
        own[env, OWN_WIDTH + i] = 1.0 / (0.3 + ti.math.clamp(free - HULL_M, 0.0, 4.0)) - 0.5


@ti.kernel
def write_set_columns(
    ego: FloatMatrix, raw: AnyTensor, ray: FloatMatrix, bodies: AnyTensor, own: FloatMatrix
):
    """``bodies`` (n, lanes, BODY_WIDTH) and ``own`` (n, EGO_COLUMNS) from rows of the vehicle
    (``twin_arrays``), tracks (n, lanes, RAW_WIDTH) and free distances (n, N_RAY) [m]."""
    for env in range(ego.shape[0]):
        write_columns_of(env, ego, raw, ray, bodies, own)
