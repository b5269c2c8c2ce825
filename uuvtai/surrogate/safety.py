"""The safety filter between a policy over a set of obstacles and the hull: a wish that, by what the policy is
told, leads to a contact or to a stop by time to collision gives way to the nearest one that does not, or to
the one that comes least near it. It looks at tracks and rays alone."""

import math

import taichi as ti

from uuvtai.common.enums import N_RAY, OWN_WIDTH, Safety
from uuvtai.kernels.core.geometry import TWO_PI
from uuvtai.kernels.core.stage import AnyTensor, Bundle, FloatMatrix, IntVector
from uuvtai.surrogate.arrays import Rules
from uuvtai.surrogate.motion import carried_out, part


@ti.func
def lack_of(clearance_m, way, vel, spare_m, spare_s):
    """[m] of clearance that is missing to what lies ``clearance_m`` away on ``way`` and comes by ``vel``."""
    closing = vel.dot(way) / ti.max(way.norm(), 1e-3)
    return spare_m + ti.max(closing, 0.0) * spare_s - clearance_m


@ti.func
def moved(pos, vel, target):
    """(place, velocity) (x, y) of the hull after a step towards a velocity."""
    new = target + (vel - target) * ti.static(math.exp(-Safety.STEP_S / Safety.LAG_S))
    return pos + 0.5 * Safety.STEP_S * (vel + new), new


@ti.func
def lack_to_obstacle(env, lane, vel, target, horizon_s, obstacles: AnyTensor, io: Bundle[Rules]):
    """[m] of clearance that is missing at the worst to an obstacle as forecast; what is later counts less."""
    place = 4.0 * ti.Vector([obstacles[env, lane, 1], obstacles[env, lane, 2]])
    one = 4.0 * ti.Vector([obstacles[env, lane, 12], obstacles[env, lane, 13]]) - place
    two = 4.0 * ti.Vector([obstacles[env, lane, 14], obstacles[env, lane, 15]]) - place
    bend, over = 0.5 * two - one, ti.min(obstacles[env, lane, 8], obstacles[env, lane, 9])
    out, pos = 0.0, ti.Vector([0.0, 0.0])
    for k in range(ti.cast(horizon_s / Safety.STEP_S + 0.5, ti.i32)):  # type: ignore[arg-type]
        t = (k + 1) * Safety.STEP_S
        pos, vel = moved(pos, vel, target)
        way = place + (one - bend) * t + bend * (t * t) - pos
        apart, share = way.norm() - 0.5 * obstacles[env, lane, 7], 1.0
        if over > 0.0:  # above or below: the nearest point lies that way
            level = ti.max(apart, 0.0)
            apart = ti.sqrt(level * level + over * over)
            share = level / apart
        coming, spare_s = share * (vel - (one - bend) - 2.0 * t * bend), io.episode_cfg.ttc_s + Safety.SPARE_S
        lack = lack_of(apart - Safety.HULL_M, way, coming, Safety.SPARE_M, spare_s)
        out = ti.max(out, lack * (1.0 - 0.5 * t / horizon_s))
    return out


@ti.func
def worst_lack(env, wish, horizon_s, obstacles: AnyTensor, own: FloatMatrix, io: Bundle[Rules]):
    """[m] of clearance that is missing at the worst on the way of the hull by a wish (x, y), not below 0."""
    fastest = ti.sqrt(io.vehicle_cfg.max_surge_m_s**2 + io.vehicle_cfg.max_sway_m_s**2)
    target, vel, out = Safety.REACHED * fastest * wish, ti.Vector([own[env, 6], own[env, 7]]), 0.0
    for lane in range(obstacles.shape[1]):
        if obstacles[env, lane, 0] > 0.5:
            out = ti.max(out, lack_to_obstacle(env, lane, vel, target, horizon_s, obstacles, io))
    soon_s = horizon_s if horizon_s < Safety.WALL_HORIZON_S else Safety.WALL_HORIZON_S
    for i in range(N_RAY):
        free = 1.0 / (own[env, OWN_WIDTH + i] + 0.5) - 0.08  # as observation.write_columns_of wrote it
        if free < Safety.SIGHT_M:
            angle = i * (TWO_PI / N_RAY)
            end, pos, now = free * ti.Vector([ti.cos(angle), ti.sin(angle)]), ti.Vector([0.0, 0.0]), vel
            for k in range(ti.cast(soon_s / Safety.STEP_S + 0.5, ti.i32)):  # type: ignore[arg-type]
                pos, now = moved(pos, now, target)
                way = end - pos
                lack = lack_of(way.norm() - Safety.HULL_M, way, now, Safety.WALL_M, Safety.WALL_S)
                out = ti.max(out, lack * (1.0 - 0.5 * (k + 1) * Safety.STEP_S / horizon_s))
    return out


@ti.func
def tried_wish(number):
    """(x, y) of one of the wishes that are tried: the last one stops."""
    angle = number * (TWO_PI / Safety.DIRECTIONS)
    speed = 1.0 - 0.5 * (number // Safety.DIRECTIONS)
    return speed * ti.Vector([ti.cos(angle), ti.sin(angle)])


@ti.kernel
def filter_wishes(
    io: Bundle[Rules], horizon_s: float, due: IntVector,
    obstacles: AnyTensor, own: FloatMatrix, wish: FloatMatrix,
):  # fmt: skip
    """Replace, where ``due`` is 1, wishes (n, 3) that are unsafe by ``obstacles`` and ``own``, but for up."""
    for env in range(wish.shape[0]):
        if due[env] == 1:
            said = carried_out(part(wish, env, 0, 3))
            mine = ti.Vector([said[0], said[1]])
            best, chosen = Safety.LACK_COST * worst_lack(env, mine, horizon_s, obstacles, own, io), mine
            if best > 0.0:
                for number in range(2 * Safety.DIRECTIONS + 1):
                    other = tried_wish(number)
                    lack = worst_lack(env, other, horizon_s, obstacles, own, io)
                    change = other - mine
                    cost = Safety.LACK_COST * lack + change.dot(change)  # type: ignore[misc]
                    if cost < best:
                        best, chosen = cost, other
                for i in ti.static(range(2)):
                    wish[env, i] = chosen[i]  # type: ignore[index]
