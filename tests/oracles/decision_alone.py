"""Redo the evasions of a log from its messages, by the oracle that the kernels are tested against."""

import copy
import math
from types import SimpleNamespace

import numpy as np

from tests.oracles import behavior as oracle
from tests.oracles.log_alone import grid_values


def decisions(log):
    """Every decision of the log that looked for an evasion, with what it was taken from."""
    asked, seen, grids = (
        {log.step(time): data for time, data in log.messages[topic]}
        for topic in ("/action", "/futures", "/map/clearance")
    )
    found = []
    for step, (_, data) in zip(log.steps("/evasion"), log.messages["/evasion"], strict=True):
        own = SimpleNamespace(
            **{key: np.array(value, float) for key, value in data.items() if value is not None}
        )
        own.asked = np.array(asked[step - 1]["asked"] if step > 0 else [0.0, 0.0, 0.0])
        own.tracks, own.grid = seen[step]["tracks"], grids.get(step)
        c, s = math.cos(own.yaw), math.sin(own.yaw)
        own.vel = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ own.own_velocity
        own.low, own.high = band(log, float(own.z_variance), asked[step]["given_up"] != 0)
        found.append(own)
    return found


def band(log, z_variance, lost):
    """(lowest, highest) z that is steered for; ``lost``: with a dead vertical thruster."""
    t, (floor, surface) = log.config["behavior"], log.scenario["tank"]["z_m"]
    edge = max(t["edge_gap_m"], t["lost_edge_gap_m"] if lost else 0)
    gap = min(edge + t["place_sigmas"] * math.sqrt(z_variance), (surface - floor) / 2)
    return floor + gap, surface - gap


def numbers(log, own):
    """(the tree's numbers, tank, vehicle) as the oracle takes them, for this decision."""
    t = SimpleNamespace(**log.config["behavior"])
    t.caution, t.closing_s, t.edge_gap_m = t.caution * own.patience, t.closing_s * own.patience, 0.0
    tank = SimpleNamespace(z_m=(own.low, own.high))
    return t, tank, SimpleNamespace(**log.config["vehicle"])


def candidates(log, own):
    """(velocities (n, 3), how long each is commanded (n,))."""
    t, tank, vehicle = numbers(log, own)
    return oracle.candidates(own.follow, own.asked, own.yaw, own.position[2], t, vehicle, tank)


def mean_of_the_best(log, own, velocities):
    """(3,) mean of the candidates by their logged costs."""
    return oracle.mean_velocity(velocities, own.costs, log.config["behavior"]["temperature"])


def costs(log, own, velocities, lasts):
    """(n,) costs by the logged tracks, and by the clearance of the decision's own step where it is logged."""
    t, tank, _ = numbers(log, own)
    still = copy.copy(t)  # the own place is not sure of what stands still
    still.hull_reach_m += t.place_sigmas * math.sqrt(own.place_variance)
    grid, cell_m = np.full((1, 1), np.inf), 1.0
    origin = np.zeros(2)
    if own.grid is not None:
        grid, cell_m = grid_values(own.grid), own.grid["cell_size"]["x"]
        origin = np.array([own.grid["pose"]["position"][axis] for axis in "xy"])
    forecast = list(zip(*map(track_of, own.tracks), strict=True)) or [[]] * 6
    return np.array(
        [
            oracle.cost(
                own.position, own.vel, velocity, last, own.follow, own.asked, forecast, grid, origin, cell_m,
                t, tank, log.config["tracking"]["forecast_dt_s"], still,
            )[0]
            for velocity, last in zip(velocities, lasts, strict=True)
        ]
    )  # fmt: skip


def track_of(track):
    """A logged track as the oracle takes it."""
    *others, forecast = (np.array([path["x"], path["y"]]).T for path in track["hypotheses"])
    ends = (far if track[side] is None else track[side] for side, far in (("above", 1e6), ("below", -1e6)))
    shares = [path["weight"] for path in track["hypotheses"][:-1]]
    return forecast, np.array(track["radius"]), *ends, others, shares
