"""NumPy float64 oracle of the turn history: lists of turns per env, one track at a time, by description."""

from dataclasses import dataclass

import numpy as np

STRAIGHT_SIGMA, SETTLED = 0.4, 0.05
TURNED_COS, ALIKE_COS = 0.9, 0.94
LONGEST_S, MISFIT_M, SAME_M, MOST_WEIGHT = 4.0, 0.3, 0.4, 4.0
STRAIGHT_ODDS, ACROSS_M, ACROSS_SLOPE, OVERDUE_M, PASSED_M = 4.0, 0.25, 0.1, 0.15, 0.5


@dataclass
class Turn:
    pos: np.ndarray
    came: np.ndarray
    went: np.ndarray
    weight: float


def unit(v):
    return v / np.hypot(*v)


def expected_turn_rate(rate, rate_var, cfg, tracking):
    """No turn rate, or one from the filter's prior: by Bayes' rule with the densities of 0."""
    if not cfg.use_turn_rate or rate_var == 0:
        return 0.0
    prior = np.exp(0.0) / tracking.turn_rate_sigma_rad_s
    posterior = np.exp(-0.5 * rate**2 / rate_var) / np.sqrt(rate_var)
    return rate if prior > STRAIGHT_ODDS * posterior and rate != 0 else 0.0


def is_straight(x, P, rate, rate_var):
    """P: 4 x 4."""
    quiet = abs(rate) <= np.sqrt(rate_var)
    return 0 < rate_var < STRAIGHT_SIGMA**2 and quiet and P[2, 2] + P[3, 3] < SETTLED * (x[2:] @ x[2:])


def corner(p0, d0, p1, d1, way):
    """(corner, misfit, way before, way after): least squares of p0 + a d0 = p1 - b d1 with a + b = way."""
    # unknown: s = a - b; p1 - p0 = way / 2 (d0 + d1) + s / 2 (d0 - d1)
    s = np.linalg.lstsq(0.5 * (d0 - d1)[:, None], p1 - p0 - 0.5 * way * (d0 + d1), rcond=None)[0][0]
    a, b = 0.5 * (way + s), 0.5 * (way - s)
    here, there = p0 + a * d0, p1 - b * d1
    return 0.5 * (here + there), np.hypot(*(here - there)), a, b


def learn(turns, next_slot, leg, leg_time, x, now):
    """``leg``: (last straight state, time [s]) of a track now straight at x, or None. The next slot."""
    if leg is None or now - leg_time >= LONGEST_S:
        return next_slot
    d0, d1 = unit(leg[2:]), unit(x[2:])
    if d0 @ d1 >= TURNED_COS:
        moved = np.hypot(*x[2:]) * (now - leg_time)
        for turn in turns:
            along, across = offset(turn, x[:2], d1)
            if turn.weight > 0 and -PASSED_M - moved <= along < -PASSED_M and across < 0.5 * ACROSS_M:
                turn.weight -= 1
        return next_slot
    pos, misfit, a, b = corner(
        leg[:2], d0, x[:2], d1, 0.5 * (np.hypot(*leg[2:]) + np.hypot(*x[2:])) * (now - leg_time)
    )
    if misfit >= MISFIT_M or min(a, b) <= -MISFIT_M:
        return next_slot
    for turn in turns:
        near = np.hypot(*(turn.pos - pos)) < SAME_M
        if turn.weight > 0 and near and turn.came @ d0 > ALIKE_COS and turn.went @ d1 > ALIKE_COS:
            turn.weight = min(turn.weight + 1, MOST_WEIGHT)
            g = 1 / turn.weight
            turn.pos = turn.pos + g * (pos - turn.pos)
            turn.came, turn.went = unit((1 - g) * turn.came + g * d0), unit((1 - g) * turn.went + g * d1)
            return next_slot
    turns[next_slot] = Turn(pos, d0, d1, 1.0)
    return (next_slot + 1) % len(turns)


def offset(turn, pos, course):
    """(way ahead, distance aside) of a turn; never beside where it is taken on another course."""
    off = turn.pos - pos
    across = (
        abs(off[0] * course[1] - off[1] * course[0])
        if turn.came @ course > ALIKE_COS and turn.weight > 0
        else 1e9
    )
    return off @ course, across


def wall_ahead(pos, course, radius, tank):
    """Way to where a disc of that radius touches the wall, by marching along the course."""
    if tank.shape == "circle":
        middle, reach = np.array([sum(tank.x_m) / 2, sum(tank.y_m) / 2]), tank.radius_m - radius
        off = pos - middle
        # |off + s course| = reach
        roots = np.roots([1.0, 2 * off @ course, off @ off - reach**2])
        return max(roots.real)
    ways = []
    for axis, (low, high) in enumerate((tank.x_m, tank.y_m)):
        if abs(course[axis]) > 1e-6:
            ways.append(((high - radius if course[axis] > 0 else low + radius) - pos[axis]) / course[axis])
    return min(ways)


def next_event(turns, pos, course, radius, cfg, tank):
    """(way to the next turn, course after it)."""
    best, out = 1e6, course
    for turn in turns if cfg.use_turn_history else []:
        along, across = offset(turn, pos, course)
        if -OVERDUE_M < along < best and across < ACROSS_M + ACROSS_SLOPE * along:
            best, out = along, turn.went
    best = max(best, 0.0)
    if cfg.use_reflection and max(wall_ahead(pos, course, radius, tank), 0.0) < best:
        best, out = max(wall_ahead(pos, course, radius, tank), 0.0), -course
    return best, out


def walk(turns, x, radius, times, cfg, tank, most_legs):
    """Positions at the (increasing) times [s] and the last course, along straight legs from turn to turn."""
    pos, speed = x[:2].astype(float), np.hypot(*x[2:])
    course = x[2:] / speed
    gap, out = next_event(turns, pos, course, radius, cfg, tank)
    where, done, legs = [], 0.0, 0
    for t in times:
        way = speed * t - done
        done = speed * t
        while way > gap and legs < most_legs:
            pos, way, course, legs = pos + gap * course, way - gap, out, legs + 1
            gap, out = next_event(turns, pos, course, radius, cfg, tank)
        pos, gap = pos + way * course, gap - way
        where.append(pos)
    return np.array(where), course


TURN_ROWS = ("turn_x", "turn_y", "in_x", "in_y", "out_x", "out_y", "weight")
"""rows of ``TurnHistory.turn``"""


def turn_rows(turn):
    """Rows (n_env, n_turn) of ``TurnHistory.turn``, by their names."""
    return {name: turn[:, row].reshape(len(turn), -1).copy() for row, name in enumerate(TURN_ROWS)}


def packed_turns(rows):
    """``TurnHistory.turn`` of rows (n_env, n_turn) by their names."""
    table = np.stack([rows[name] for name in TURN_ROWS], 1)
    return table.reshape(*table.shape[:2], -1, 16).astype(np.float32)
