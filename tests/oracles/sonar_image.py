"""What comes back to a multibeam sonar from each bearing and range.

Upwards and downwards a beam is a sinc 3 dB down at the vertical half aperture, so that whatever lies at one
range and bearing folds into one place, floor and surface included. A surface sends back Lambert's share of
what meets it: power per solid angle cos(incidence) / range^2 (two-way spreading, range^-4, over an area that
grows with range^2), less the absorption of fresh water.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from uuvtai.common.obstacle_motion import obstacle_positions
from uuvtai.config import SonarConfig
from uuvtai.config.multibeam import ABSORPTION_NP_M, elevation_pattern, elevations, heard_bearings, ray_sr

_WALL, _FLOOR, _SURFACE = -1, -2, -3


class Seen:
    """What rays meet: range [m], cosine of incidence, which surface (an obstacle's number, or below 0)."""

    def __init__(self, n: int) -> None:
        self.range_m, self.cosine, self.surface = np.full(n, np.inf), np.zeros(n), np.full(n, -9)

    def nearer(self, range_m: np.ndarray, cosine: np.ndarray, surface: int | np.ndarray) -> None:
        """Take in another surface; where it is not met its range is infinite."""
        closer = range_m < self.range_m
        self.range_m = np.where(closer, range_m, self.range_m)
        self.cosine = np.where(closer, np.abs(cosine), self.cosine)
        self.surface = np.where(closer, surface, self.surface)


def cast_rays(scenario: dict[str, Any], time_s: float, start: np.ndarray, unit: np.ndarray) -> Seen:
    """What rays (n, 3) from a place (3,) [m] in the tank of ``scenario.json`` meet at a time."""
    seen = Seen(len(unit))
    _meet_tank(seen, scenario["tank"], start, unit)
    for number, body in enumerate(scenario["obstacles"]):
        centre = obstacle_positions(body, np.array([time_s]))[0]
        size, yaw = np.array(body["size"], float), float(body["yaw"])
        if body["kind"] == "sphere":
            _meet_sphere(seen, number, start - centre, unit, size[0])
        else:
            _meet_prism(seen, number, start - centre, unit, size, yaw, body["kind"] == "box")
    return seen


def _meet_tank(seen: Seen, tank: dict[str, Any], start: np.ndarray, unit: np.ndarray) -> None:
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, name, surfaces in (
            (2, "z_m", (_FLOOR, _SURFACE)),
            (0, "x_m", (_WALL,) * 2),
            (1, "y_m", (_WALL,) * 2),
        ):
            if axis < 2 and tank["shape"] == "circle":
                continue
            low, high = tank[name]
            u = unit[:, axis]
            away = np.where(u > 0, high - start[axis], low - start[axis]) / u
            seen.nearer(np.where(u == 0, np.inf, away), u, np.where(u > 0, surfaces[1], surfaces[0]))
    if tank["shape"] == "circle":
        off = start[:2] - [0.5 * sum(tank["x_m"]), 0.5 * sum(tank["y_m"])]
        enter_leave = _quadratic(off, unit[:, :2], float(tank["radius_m"]))
        point = off + enter_leave[1][:, None] * unit[:, :2]
        seen.nearer(enter_leave[1], (point * unit[:, :2]).sum(1) / tank["radius_m"], _WALL)


def _quadratic(off: np.ndarray, unit: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave a circle or sphere about the origin; infinite where they do not meet it."""
    a, b = (unit**2).sum(1), unit @ off
    with np.errstate(divide="ignore", invalid="ignore"):
        room = b * b - a * (off @ off - radius**2)
        root = np.sqrt(np.where(room < 0, np.nan, room))
        enter, leave = (-b - root) / a, (-b + root) / a
    return np.where(np.isnan(enter), np.inf, enter), np.where(np.isnan(leave), np.inf, leave)


def _meet_sphere(seen: Seen, number: int, off: np.ndarray, unit: np.ndarray, radius: float) -> None:
    enter, _ = _quadratic(off, unit, radius)
    met = np.where(enter > 0, enter, np.inf)
    with np.errstate(invalid="ignore"):
        cosine = ((off + met[:, None] * unit) * unit).sum(1) / radius
    seen.nearer(met, np.nan_to_num(cosine), number)


def _meet_prism(
    seen: Seen, number: int, off: np.ndarray, unit: np.ndarray, size: np.ndarray, yaw: float, is_box: bool
) -> None:
    """An upright box or cylinder: the later of the entries into its outline and into its height."""
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    start, ray = turn @ off, unit @ turn.T
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-size - start) / ray, (size - start) / ray
    enters, leaves = np.fmin(one, other), np.fmax(one, other)
    cosines = np.abs(ray)
    if not is_box:
        enters[:, 0], leaves[:, 0] = _quadratic(start[:2], ray[:, :2], size[0])
        level = start[:2] + np.where(np.isfinite(enters[:, :1]), enters[:, :1], 0.0) * ray[:, :2]
        cosines[:, 0] = np.abs((level * ray[:, :2]).sum(1)) / size[0]
        leaves[:, 0] = np.where(np.isinf(enters[:, 0]), -np.inf, leaves[:, 0])
        enters[:, 1], leaves[:, 1] = -np.inf, np.inf
    last = enters.argmax(1)
    enter = enters.max(1)
    met = (enter <= leaves.min(1)) & (enter > 0)
    seen.nearer(np.where(met, enter, np.inf), cosines[np.arange(len(ray)), last], number)


# ------------------------------------------------------------------------------------------------------ image


def echo_power(
    scenario: dict[str, Any], time_s: float, start: np.ndarray, yaw: float, sonar_cfg: SonarConfig, n_bin: int
) -> tuple[np.ndarray, np.ndarray]:
    """(bearings (m,) [rad] from ahead, mean power (m, n_bin)) of each range bin, elevations folded."""
    bearing, edges = heard_bearings(sonar_cfg), elevations()
    az, el = (grid.ravel() for grid in np.meshgrid(bearing + yaw, edges, indexing="ij"))
    unit = np.column_stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)])
    seen = cast_rays(scenario, time_s, np.asarray(start, float), unit)
    lost = np.exp(-4.0 * ABSORPTION_NP_M * seen.range_m)  # amplitude, there and back, squared
    lost /= np.maximum(seen.range_m, 0.1) ** 2
    power = elevation_pattern(el, sonar_cfg) ** 2 * seen.cosine * ray_sr(el, sonar_cfg) * lost
    bins = np.minimum(seen.range_m / sonar_cfg.max_range_m * n_bin, n_bin).astype(int)
    shape = (len(bearing), len(edges))
    return bearing, _folded(bins.reshape(shape), seen.surface.reshape(shape), power.reshape(shape), n_bin)


def _folded(bins: np.ndarray, surface: np.ndarray, power: np.ndarray, n_bin: int) -> np.ndarray:
    """Power (n, n_bin) of rays (n, elevations), even between neighbours; ``bins``: ``n_bin`` = beyond."""
    half = 0.25 * (power[:, 1:] + power[:, :-1])
    one, other = bins[:, :-1], bins[:, 1:]
    same = surface[:, 1:] == surface[:, :-1]
    spread_out = np.zeros((len(bins), n_bin + 2))
    row = np.broadcast_to(np.arange(len(bins))[:, None], one.shape)
    for low, high in (
        (np.where(same, np.minimum(one, other), one), np.where(same, np.maximum(one, other), one)),
        (np.where(same, np.minimum(one, other), other), np.where(same, np.maximum(one, other), other)),
    ):
        each = half / (high - low + 1)
        np.add.at(spread_out, (row, low), each)
        np.add.at(spread_out, (row, high + 1), -each)
    return np.maximum(np.cumsum(spread_out, 1)[:, :n_bin], 0.0)
