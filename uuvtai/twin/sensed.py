"""The twin's kernels of sensing: what the tracker would deliver of the bodies, and the rows that actor and
critic see."""

import math

import taichi as ti

from uuvtai.kernels.core.geometry import BOX, NONE
from uuvtai.twin.motion import Seconds, Tensor2, Tensor3, body_on_path
from uuvtai.twin.tensors import MOVERS, RAYS, STATICS

FAN_SLOPE = 0.1763
"""tan of half the sonar's vertical opening"""
REACH_M, CAMERA_M, HEIGHT_M = 12.0, 4.0, 3.0
"""how far the fan sees, the camera sees, and how near a height becomes known"""
BIRTH_S, YOUNG_S = 0.15, 0.35
"""a track is born after so long; until then across its line of sight it is half known"""
KEPT_S, KEPT_KNOWN_S = 2.0, 6.0
"""a track that is not seen is lost after so long; one whose height is known later"""
POSITION_NOISE_M, SPEED_NOISE_M_S = 0.03, 0.06
_ROOM_M = 1.6


@ti.func
def is_hidden(env, x, y, dx, dy, distance, static: Tensor3):
    """1 where an obstacle stands between the vehicle and a body."""
    ux, uy, out = dx / distance, dy / distance, 0
    for i in range(STATICS):
        if static[env, i, 0] > 0.5:
            rx, ry = static[env, i, 1] - x, static[env, i, 2] - y
            along, across = rx * ux + ry * uy, ti.abs(rx * uy - ry * ux)
            if (
                along > 0.0
                and along < distance
                and across < 0.9 * ti.max(static[env, i, 3], static[env, i, 4])
            ):
                out = 1
    return out


@ti.kernel
def sense(static: Tensor3, mover: Tensor3, ego: Tensor2, track: Tensor3, noise: Tensor3, dt: Seconds):
    """Tracks of every body ``dt`` [s] later; ``noise``: (n, MOVERS, 2) standard normal."""
    for env in range(ego.shape[0]):
        x, y, z, yaw = ego[env, 0], ego[env, 1], ego[env, 2], ego[env, 6]
        for k in range(MOVERS):
            if mover[env, k, 0] > 0.5:
                at = body_on_path(mover, env, k, ego[env, 8])
                dx, dy = at[0] - x, at[1] - y
                distance = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3)
                level = ti.abs(z - mover[env, k, 1]) - mover[env, k, 3]
                in_fan = level < ti.max(distance - mover[env, k, 2], 0.0) * FAN_SLOPE
                look = ti.atan2(dy, dx) - yaw
                look -= 2.0 * math.pi * ti.floor(look / (2.0 * math.pi) + 0.5)
                in_view = ti.abs(look) < 0.25 * math.pi and distance < CAMERA_M
                if (
                    distance < REACH_M
                    and (in_fan or in_view)
                    and is_hidden(env, x, y, dx, dy, distance, static) == 0
                ):
                    if track[env, k, 5] > KEPT_S:
                        track[env, k, 4] = 0.0
                    track[env, k, 4] += dt
                    track[env, k, 5] = 0.0
                    track[env, k, 6] += mover[env, k, 8] * dt
                    if in_view and distance < HEIGHT_M:
                        track[env, k, 7] = 1.0
                    radial = (at[2] * dx + at[3] * dy) / (distance * distance)
                    share = ti.select(track[env, k, 4] < YOUNG_S, 0.5, 1.0)
                    gain = ti.select(track[env, k, 4] < 0.25, 1.0, 0.55)
                    seen_x = radial * dx + share * (at[2] - radial * dx)
                    seen_y = radial * dy + share * (at[3] - radial * dy)
                    track[env, k, 2] += gain * (
                        seen_x + SPEED_NOISE_M_S * noise[env, k, 0] - track[env, k, 2]
                    )
                    track[env, k, 3] += gain * (
                        seen_y + SPEED_NOISE_M_S * noise[env, k, 1] - track[env, k, 3]
                    )
                    track[env, k, 0] = at[0] + POSITION_NOISE_M * noise[env, k, 0]
                    track[env, k, 1] = at[1] + POSITION_NOISE_M * noise[env, k, 1]
                else:
                    track[env, k, 5] += dt
                    track[env, k, 0] += dt * track[env, k, 2]
                    track[env, k, 1] += dt * track[env, k, 3]


@ti.func
def way_free(x, y, ux, uy, env, static: Tensor3, x1, y1):
    """Free way [m] along a unit vector, to an obstacle at rest or a wall of a tank of x1 by y1."""
    out = 99.0
    if ti.abs(ux) > 1e-6:
        out = ti.min(out, ti.select(ux > 0.0, x1 - x, -x) / ux)
    if ti.abs(uy) > 1e-6:
        out = ti.min(out, ti.select(uy > 0.0, y1 - y, -y) / uy)
    for i in range(STATICS):
        kind = static[env, i, 0]
        dx, dy = static[env, i, 1] - x, static[env, i, 2] - y
        if kind > 0.5 and ti.cast(kind, ti.i32) != BOX:
            along = dx * ux + dy * uy
            disc = along * along - dx * dx - dy * dy + static[env, i, 3] ** 2
            if disc > 0.0 and along > 0.0:
                out = ti.min(out, ti.max(along - ti.sqrt(disc), 0.0))
        elif kind > 0.5:
            c, s = ti.cos(static[env, i, 5]), ti.sin(static[env, i, 5])
            ox, oy = -c * dx - s * dy, -c * dy + s * dx
            vx, vy = c * ux + s * uy, c * uy - s * ux
            vx = ti.select(ti.abs(vx) < 1e-6, 1e-6, vx)
            vy = ti.select(ti.abs(vy) < 1e-6, 1e-6, vy)
            hx, hy = static[env, i, 3], static[env, i, 4]
            a, b, p, q = (-hx - ox) / vx, (hx - ox) / vx, (-hy - oy) / vy, (hy - oy) / vy
            enter = ti.max(ti.min(a, b), ti.min(p, q))
            leave = ti.min(ti.max(a, b), ti.max(p, q))
            if leave >= enter and leave > 0.0:
                out = ti.min(out, ti.max(enter, 0.0))
    return out


@ti.func
def room_beside(over, under, known):
    """(free water above, below [m]) a body, as far as its height is known."""
    above = ti.select(over > 0.0, ti.min(over, _ROOM_M), ti.select(under > 0.0, _ROOM_M, 0.0))
    below = ti.select(under > 0.0, ti.min(under, _ROOM_M), ti.select(over > 0.0, _ROOM_M, 0.0))
    return ti.Vector([above, below]) * known


@ti.kernel
def gather_tracks(
    static: Tensor3,
    mover: Tensor3,
    ego: Tensor2,
    track: Tensor3,
    seen: Tensor3,
    ray: Tensor2,
    true: Tensor3,
    x1: Seconds,
    y1: Seconds,
):
    """Tracks as the simulator's stack would show them: ``seen`` (n, MOVERS, SEEN_COLUMNS): valid, x, y,
    vx, vy, radius, above, below, age, turn rate, way within 1 s and 2 s (x, y each); ``ray`` (n, RAYS)
    [m]; ``true`` (n, MOVERS, TRUE_COLUMNS) for the critic."""
    for env in range(ego.shape[0]):
        x, y, z, t = ego[env, 0], ego[env, 1], ego[env, 2], ego[env, 8]
        fx, fy = ego[env, 12], ego[env, 13]
        for i in range(RAYS):
            angle = i * (2.0 * math.pi / RAYS)
            ray[env, i] = way_free(x, y, ti.cos(angle), ti.sin(angle), env, static, x1, y1)
        for k in range(MOVERS):
            on = ti.cast(mover[env, k, 0], ti.i32) != NONE
            limit = ti.select(track[env, k, 7] > 0.5, KEPT_KNOWN_S, KEPT_S)
            valid = on and track[env, k, 5] < limit and track[env, k, 4] >= BIRTH_S
            over = mover[env, k, 1] - mover[env, k, 3] - z
            under = z - mover[env, k, 1] - mover[env, k, 3]
            for j in range(14):
                seen[env, k, j] = 0.0
            for j in range(10):
                true[env, k, j] = 0.0
            if on:
                here = body_on_path(mover, env, k, t)
                true[env, k, 0], true[env, k, 1] = (here[0] - x) * fx / 4.0, (here[1] - y) * fy / 4.0
                true[env, k, 2], true[env, k, 3] = 1.0, ti.math.clamp(over, -_ROOM_M, _ROOM_M)
                polyline = mover[env, k, 4] > 0.5
                known = polyline and track[env, k, 6] > mover[env, k, 6]
                turn = 0.0
                if not polyline and track[env, k, 4] > 0.8:
                    turn = mover[env, k, 8] / mover[env, k, 5]
                for j in ti.static(range(3)):
                    s = j + 1.0
                    there = body_on_path(mover, env, k, t + s)
                    true[env, k, 4 + 2 * j] = (there[0] - x) * fx / 4.0
                    true[env, k, 5 + 2 * j] = (there[1] - y) * fy / 4.0
                    if valid and ti.static(j < 2):
                        half = 0.5 * turn * s
                        chord = ti.select(ti.abs(half) > 1e-4, ti.sin(half) / half, 1.0) * s
                        vx, vy = track[env, k, 2], track[env, k, 3]
                        ax = chord * (ti.cos(half) * vx - ti.sin(half) * vy)
                        ay = chord * (ti.sin(half) * vx + ti.cos(half) * vy)
                        seen[env, k, 10 + 2 * j] = ti.select(known, there[0] - here[0], ax)
                        seen[env, k, 11 + 2 * j] = ti.select(known, there[1] - here[1], ay)
                if valid:
                    room = room_beside(over, under, track[env, k, 7])
                    seen[env, k, 0] = 1.0
                    for j in ti.static(range(4)):
                        seen[env, k, 1 + j] = track[env, k, j]
                    seen[env, k, 5] = mover[env, k, 2]
                    seen[env, k, 6], seen[env, k, 7] = room[0], room[1]
                    seen[env, k, 8], seen[env, k, 9] = track[env, k, 5], turn


@ti.kernel
def write_rows(ego: Tensor2, seen: Tensor3, ray: Tensor2, body: Tensor3, row: Tensor2):
    """What the actor sees, in the twin and in the simulator alike: ``body`` (n, MOVERS, BODY_COLUMNS) of the
    tracks ``seen``, ``row`` (n, EGO_COLUMNS) of the vehicle, goal and free ways; mirrored so that the goal
    lies towards +x, +y."""
    for env in range(ego.shape[0]):
        fx, fy = ego[env, 12], ego[env, 13]
        gx, gy = (ego[env, 9] - ego[env, 0]) * fx, (ego[env, 10] - ego[env, 1]) * fy
        far = ti.max(ti.sqrt(gx * gx + gy * gy), 1e-3)
        ux, uy = gx / far, gy / far
        own_x, own_y = ego[env, 3] * fx, ego[env, 4] * fy
        head = ti.Vector(
            [
                gx / 10.0,
                gy / 4.0,
                ego[env, 11] - ego[env, 2],
                ux,
                uy,
                ti.min(far, 4.0) / 4.0,
                own_x,
                own_y,
                2.0 * ego[env, 5],
                ego[env, 2] + 0.8,
                ego[env, 14],
                ego[env, 15],
                ego[env, 16],
                ti.cos(4.0 * ego[env, 6]),
                ti.sin(4.0 * ego[env, 6]) * fx * fy,
                (ego[env, 1] - 3.0) * fy / 3.0,
                (ego[env, 0] - 10.0) * fx / 10.0,
            ]
        )
        for j in ti.static(range(17)):
            row[env, j] = head[j]
        for i in range(RAYS):
            j = i
            if fx < 0.0:
                j = (RAYS // 2 - j + RAYS) % RAYS
            if fy < 0.0:
                j = (RAYS - j) % RAYS
            row[env, 17 + i] = 1.0 / (0.3 + ti.math.clamp(ray[env, j] - 0.22, 0.0, 4.0)) - 0.5
        for k in range(MOVERS):
            for j in range(22):
                body[env, k, j] = 0.0
            if seen[env, k, 0] > 0.5:
                dx, dy = (seen[env, k, 1] - ego[env, 0]) * fx, (seen[env, k, 2] - ego[env, 1]) * fy
                vx, vy = seen[env, k, 3] * fx, seen[env, k, 4] * fy
                rx, ry = vx - own_x, vy - own_y
                gap = ti.max(ti.sqrt(dx * dx + dy * dy), 1e-3) - seen[env, k, 5]
                soon = ti.math.clamp(-(dx * rx + dy * ry) / ti.max(rx * rx + ry * ry, 1e-3), 0.0, 3.0)
                miss = ti.sqrt((dx + soon * rx) ** 2 + (dy + soon * ry) ** 2) - seen[env, k, 5] - 0.22
                found = ti.Vector(
                    [
                        1.0,
                        dx / 4.0,
                        dy / 4.0,
                        rx,
                        ry,
                        vx,
                        vy,
                        2.0 * seen[env, k, 5],
                        seen[env, k, 6],
                        seen[env, k, 7],
                        ti.min(seen[env, k, 8], 4.0) / 2.0,
                        ti.math.clamp(seen[env, k, 9] * fx * fy, -3.0, 3.0) / 2.0,
                        (dx + seen[env, k, 10] * fx) / 4.0,
                        (dy + seen[env, k, 11] * fy) / 4.0,
                        (dx + seen[env, k, 12] * fx) / 4.0,
                        (dy + seen[env, k, 13] * fy) / 4.0,
                        ti.min(gap, 8.0) / 4.0,
                        1.0 / (0.3 + ti.max(gap - 0.22, 0.0)),
                        soon,
                        ti.math.clamp(miss, -1.0, 3.0),
                        ux,
                        uy,
                    ]
                )
                for j in ti.static(range(22)):
                    body[env, k, j] = found[j]
