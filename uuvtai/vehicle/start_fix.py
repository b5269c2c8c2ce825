"""Where the vehicle begins, by the walls of the known tank that its sonar sees at rest: what was typed is
checked, corrected, or refused. And under way: whether the walls still fit. NumPy alone.

Returns of all scans are laid into one frame, whose axes are the world's as typed, by attitude and velocity
since. Of all turns and places near the typed start a histogram of these points says which lay them on the
walls (a Hough transform); least squares on what fits (P. Huber, Robust Statistics, 1981) refines the best.
Obstacles return short of the walls; nothing returns from behind them, so returns from there, and beams that a
wall should have returned and did not, speak against a place. A direction in which no wall is seen, and two
places that fit, are no fix: the operator is asked to turn the vehicle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from uuvtai.config import Config, SonarConfig, TankConfig
from uuvtai.vehicle.onboard import DvlReading, ImuReading, SensorMessage, SonarPing
from uuvtai.vehicle.sensor_inputs import to_world

MOST_M, MOST_RAD = 0.15, math.radians(3.0)  # standard deviations of a fix, at most
NEAR_M, NEAR_RAD = 1.2, math.radians(26.0)  # so far from what was typed a fix is looked for
LONGEST_S = 60.0  # from the first scan on; without a fix until then the start is refused
_LEAST_S, _EVERY_S = 1.0, 0.5  # looked at before a fix is sought, and between two searches, at first
_KEPT_S, _SCAN_RAYS = 45.0, 64
_TURN_RAD, _REST_S = math.radians(4.0), 0.5  # a scan is kept when turned or waited so much since the last
_CELL_M, _STEP_RAD = 0.05, math.radians(1.0)  # of the histograms
_SEARCH_RAYS, _FARTHEST_M = 800, 60.0
FLOOR_M, FLOOR_RAD = 0.02, math.radians(0.3)  # what a fix is never better than: errors that rays share
_SECTORS, _LOOKED = 36, 30  # of a circle; along so many a turning head has to look before a fix is sought
_INDEPENDENT = 100  # rays count as no more measurements than this
_WALL_RAYS, _WALL_M = 12, 1.5
"""a wall is seen by so many returns at least, that lie so far apart: larger than the face of an obstacle;
half as far where it stands as typed"""
_AS_TYPED_M = 0.1  # and so much off at most
_WIDE_RAD = math.radians(12.0)  # sectors that are wider are rangefinders, which measure along their axis
_NEAREST = np.array([0.0, 0.0, 0.56, 0.85, 1.03, 1.16, 1.27, 1.35, 1.42])
"""standard deviations by which the least of so many normal values falls short of their mean"""
_GRAZING = 0.4  # cosine of incidence below which a beam may stay without return
_AGREED = 0.2  # square of deviations by which typed start and heading may disagree where no wall decides
_REST_M_S, _GAP_S = 0.3, 1.0
"""faster is not at rest: what comes then is left out; and attitude or velocity that is missing for longer
(twice that) leaves unknown where the vehicle has drifted"""


@dataclass(frozen=True)
class StartFound:
    """What the walls say of the start."""

    place: tuple[float, float] = (math.nan, math.nan)  # [m] where the vehicle is at the last scan
    shift: tuple[float, float] = (0.0, 0.0)  # [m] by which the typed start was wrong
    turn_rad: float = 0.0  # to be added to the yaw as typed
    spread: tuple[float, ...] = ()  # (6,) covariance of x, y [m], heading [rad]: upper triangle
    residual_m: float = math.nan  # root mean square of what fits
    scans: int = 0
    refusal: str = ""  # why there is no fix, and what to do; '' = there is one


@dataclass(frozen=True, eq=False)
class Rays:
    """n beams in one frame; a sector that several beams share is one, between two bearings."""

    from_m: np.ndarray  # (n, 2)
    bearing: np.ndarray  # (n, 2) [rad] of its edges
    range_m: np.ndarray
    hit: np.ndarray  # (n,) whether it returned
    beams: np.ndarray  # (n,) that share it

    def some(self, which: slice) -> Rays:
        return Rays(*(part[which] for part in vars(self).values()))

    @classmethod
    def joined(cls, rows: list[Rays]) -> Rays:
        return cls(
            *(np.concatenate(parts) for parts in zip(*(vars(row).values() for row in rows), strict=True))
        )

    def ends(self) -> np.ndarray:
        """(n, 2) [m] where they end, along their middle."""
        middle = self.bearing.mean(1)
        return self.from_m + self.range_m[:, None] * np.stack([np.cos(middle), np.sin(middle)], 1)


@dataclass(frozen=True, eq=False)
class Fit:
    """How rays fit the walls at one pose (x, y, turn)."""

    pose: np.ndarray
    off_m: np.ndarray  # (n,) by which they end beyond their wall, along its normal
    slope: np.ndarray  # (n, 3) change of that with the pose, sign of a correction
    wall: np.ndarray  # (n,) number of the wall
    fits: np.ndarray
    beyond: np.ndarray  # (n,) that end behind the wall, or found none where it stands in reach
    short: np.ndarray

    @property
    def score(self) -> float:
        return float(self.fits.sum()) - float(self.beyond.sum())


def rays_of(sonar_cfg: SonarConfig, ping: SonarPing, from_m: np.ndarray, yaw: float) -> Rays:
    """A ping's beams at a place and a yaw; neighbours of one range are one sector with one return."""
    ranges, hit = np.asarray(ping.range_m, float), np.asarray(ping.hit) > 0
    beams = ping.first_beam + np.arange(len(ranges))
    bearings = yaw + sonar_cfg.first_beam_rad + sonar_cfg.beam_step_rad * beams
    new = np.ones(len(ranges), bool)
    new[1:] = (ranges[1:] != ranges[:-1]) | ~hit[1:] | ~hit[:-1]
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(ranges)) - 1
    edges = np.stack([bearings[first], bearings[last]], 1)
    wide = edges[:, 1] - edges[:, 0] > _WIDE_RAD
    edges[wide] = edges[wide].mean(1, keepdims=True)
    shared = np.where(wide, 1, last - first + 1)
    edges += sonar_cfg.half_width_rad * np.array([-1.0, 1.0])
    return Rays(np.tile(from_m, (len(first), 1)), edges, ranges[first], hit[first], shared)


def expected(tank: TankConfig, at: np.ndarray, bearing: np.ndarray) -> tuple[np.ndarray, ...]:
    """(range, inward normal x, y, number of the wall) of the walls that level beams meet from ``at``."""
    ux, uy = np.cos(bearing), np.sin(bearing)
    if tank.shape == "circle":
        off = at - np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
        along, across = off[:, 0] * ux + off[:, 1] * uy, off[:, 0] * uy - off[:, 1] * ux
        r = np.sqrt(np.maximum(tank.radius_m**2 - across**2, 0.0)) - along
        nx, ny = -(off[:, 0] + r * ux) / tank.radius_m, -(off[:, 1] + r * uy) / tank.radius_m
        return r, nx, ny, np.zeros(len(r), int)
    ux, uy = (np.where(np.abs(u) < 1e-9, 1e-9, u) for u in (ux, uy))
    to_x = (np.where(ux > 0, tank.x_m[1], tank.x_m[0]) - at[:, 0]) / ux
    to_y = (np.where(uy > 0, tank.y_m[1], tank.y_m[0]) - at[:, 1]) / uy
    is_x = to_x < to_y
    nx, ny = np.where(is_x, -np.sign(ux), 0.0), np.where(is_x, 0.0, -np.sign(uy))
    return np.minimum(to_x, to_y), nx, ny, np.where(is_x, 0 + (ux > 0), 2 + (uy > 0))


def range_sigma(sonar_cfg: SonarConfig, range_m: np.ndarray) -> np.ndarray:
    normal = sonar_cfg.range_sigma_m + sonar_cfg.range_sigma_slope * range_m
    return np.sqrt(normal**2 + sonar_cfg.range_jitter_m**2 + sonar_cfg.range_quantum_m**2 / 12.0)


def fit_at(config: Config, rays: Rays, pose: np.ndarray, gate_m: float) -> Fit:
    """Compare ``rays``, in a frame that lies at ``pose`` in the world, with the walls."""
    tank, sonar = config.world.tank, config.sensors.sonar
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = rays.from_m @ np.array([[c, s], [-s, c]])
    at = turned + pose[:2]
    sides = [expected(tank, at, rays.bearing[:, side] + pose[2]) for side in (0, 1)]
    nearer = sides[1][0] < sides[0][0]
    r, nx, ny, wall = (np.where(nearer, other, one) for one, other in zip(*sides, strict=True))
    bearing = np.where(nearer, rays.bearing[:, 1], rays.bearing[:, 0]) + pose[2]
    ux, uy = np.cos(bearing), np.sin(bearing)
    cosine = -(nx * ux + ny * uy)
    sigma = range_sigma(sonar, r)
    bias = sonar.range_jitter_m - _NEAREST[np.minimum(rays.beams, len(_NEAREST) - 1)] * sigma
    off = cosine * (rays.range_m - bias - r)
    room = gate_m + 3.0 * cosine * sigma
    reached = turned + r[:, None] * np.stack([ux, uy], 1)  # from the frame's origin
    slope = np.stack([nx, ny, ny * reached[:, 0] - nx * reached[:, 1]], 1)
    near = r + 3.0 * sigma + gate_m < sonar.max_range_m
    fits = rays.hit & (np.abs(off) < room)
    missing = ~rays.hit & near & (cosine > max(_GRAZING, sonar.grazing_cosine))
    beyond = missing | (rays.hit & near & (off >= room))
    return Fit(pose, off, slope, wall, fits, beyond, rays.hit & (off <= -room))


def refined(config: Config, rays: Rays, pose: np.ndarray) -> Fit:
    """The pose nearby at which the walls fit best, by Gauss and Newton with a gate that closes."""
    for gate_m in (0.3, 0.3, 0.2, 0.15, 0.1, 0.1, 0.1):
        fit = fit_at(config, rays, pose, gate_m)
        slope, off = fit.slope[fit.fits], fit.off_m[fit.fits]
        tied = np.diag([1e-3, 1e-3, 1e-3])
        pose = pose + np.linalg.solve(slope.T @ slope + tied, slope.T @ off)
    return fit_at(config, rays, pose, 0.1)


def candidates(tank: TankConfig, ends: np.ndarray, typed: np.ndarray) -> list[np.ndarray]:
    """Poses (x, y, turn) near ``typed`` that lay most of ``ends`` (n, 2) on walls of a rectangle."""
    turns = np.arange(-NEAR_RAD, NEAR_RAD + 1e-9, _STEP_RAD)
    shifts = np.arange(-NEAR_M, NEAR_M + 1e-9, _CELL_M)
    far = min(math.hypot(tank.x_m[1] - tank.x_m[0], tank.y_m[1] - tank.y_m[0]), _FARTHEST_M) + NEAR_M
    ends = ends[np.hypot(*ends.T) < far]
    n = 2 * int((far + 1.0) / _CELL_M) + 1
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    votes = []
    for axis, (walls, along) in enumerate(
        ((tank.x_m, c * ends[:, 0] - s * ends[:, 1]), (tank.y_m, s * ends[:, 0] + c * ends[:, 1]))
    ):
        cells = np.rint(along / _CELL_M).astype(int) + n // 2
        rows = n * np.arange(len(turns))[:, None]
        histogram = np.bincount((rows + cells).ravel(), minlength=n * len(turns)).reshape(-1, n)
        histogram = np.sum([np.roll(histogram, k, 1) * (3 - abs(k)) for k in range(-2, 3)], 0)
        places = typed[axis] + shifts
        at = [np.rint((wall - places) / _CELL_M).astype(int) + n // 2 for wall in walls]
        counted = [np.where((k >= 0) & (k < n), histogram[:, np.clip(k, 0, n - 1)], 0) for k in at]
        votes.append(counted[0] + counted[1])
    total = votes[0].max(1) + votes[1].max(1)
    found = []
    for i in np.argsort(-total, kind="stable"):
        if total[i] < 0.6 * total.max() or len(found) >= 24:
            break
        if total[i] >= total[max(i - 2, 0) : i + 3].max():
            peaks = [_peaks(vote[i]) for vote in votes]
            found += [np.array([*typed[:2] + shifts[[a, b]], turns[i]]) for a in peaks[0] for b in peaks[1]]
    return found


def _peaks(votes: np.ndarray, most: int = 3) -> list[int]:
    padded = np.pad(votes, 4, constant_values=-1)
    highest = np.lib.stride_tricks.sliding_window_view(padded, 9).max(1)
    tops = np.flatnonzero((votes == highest) & (votes >= 0.5 * votes.max()))
    return sorted(map(int, tops), key=lambda k: (-votes[k], abs(k - len(votes) // 2)))[:most]


def around(tank: TankConfig, ends: np.ndarray, typed: np.ndarray) -> list[np.ndarray]:
    """The same for a round tank, which looks alike at every turn: the best place without one."""
    reach = NEAR_M + NEAR_RAD * math.hypot(typed[0] - sum(tank.x_m) / 2, typed[1] - sum(tank.y_m) / 2)
    shifts = np.arange(-reach, reach + 1e-9, 4 * _CELL_M)
    grid = np.stack(np.meshgrid(shifts, shifts, indexing="ij"), -1).reshape(-1, 2)
    centre = np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
    off = np.linalg.norm(grid[:, None] + (typed[:2] - centre + ends[::4])[None], axis=2) - tank.radius_m
    best = np.argmax(np.maximum(0.0, 1.0 - np.abs(off) / (8 * _CELL_M)).sum(1))
    return [np.array([*typed[:2] + grid[best], 0.0])]


@dataclass
class Track:
    """Where the vehicle has gone since, by attitude and velocity, in the frame as typed."""

    time_s: float = -math.inf
    rpy: np.ndarray = field(default_factory=lambda: np.zeros(3))
    at: np.ndarray = field(default_factory=lambda: np.zeros(2))
    vel_b: np.ndarray = field(default_factory=lambda: np.zeros(3))
    vel_s: float = -math.inf
    past: deque[tuple[float, float, np.ndarray]] = field(default_factory=lambda: deque(maxlen=150))
    """(time, yaw, place)"""

    def go(self, imu: ImuReading) -> bool:
        """Whether what was seen before still lies where it was."""
        spent_s = imu.time_s - self.time_s
        if spent_s <= 0.0:
            return True
        kept = spent_s <= _GAP_S and imu.time_s - self.vel_s <= 2 * _GAP_S
        self.rpy = np.asarray(imu.rpy, float)
        if kept:
            self.at = self.at + spent_s * to_world(np.clip(self.vel_b, -1.0, 1.0), self.rpy)[:2]
        self.time_s = imu.time_s
        self.past.append((self.time_s, float(self.rpy[2]), self.at))
        return kept

    def hear(self, reading: DvlReading) -> None:
        """Since the last one the velocity changed evenly, which ``go`` could not know."""
        vel_b, middle_s = np.asarray(reading.vel_b, float), 0.5 * (self.vel_s + reading.time_s)
        if self.vel_s < reading.time_s and abs(since_s := self.time_s - middle_s) <= 2 * _GAP_S:
            changed = np.clip(vel_b, -1.0, 1.0) - np.clip(self.vel_b, -1.0, 1.0)
            self.at = self.at + since_s * to_world(changed, self.rpy)[:2]
        self.vel_b, self.vel_s = vel_b, reading.time_s

    def then(self, time_s: float) -> tuple[float, np.ndarray] | None:
        """(yaw, place) at a time; None where it is not known, or the vehicle was not at rest."""
        moves = not math.hypot(*self.vel_b) <= _REST_M_S or self.time_s - self.vel_s > 2 * _GAP_S
        if moves or not self.past or not self.past[0][0] - 0.1 <= time_s <= self.time_s + 0.1:
            return None
        times = np.array([row[0] for row in self.past])
        yaw = np.interp(time_s, times, np.unwrap([row[1] for row in self.past]))
        at = [np.interp(time_s, times, [row[2][axis] for row in self.past]) for axis in (0, 1)]
        return float(yaw), np.array(at)


class StartFix:
    """Is fed what the pilot is fed; ``result`` is there when the start is fixed, or refused."""

    def __init__(self, config: Config, typed: tuple[float, float, float]) -> None:
        """``typed``: start (x, y, z) [m] world; the attitudes fed have the heading as typed."""
        self.result: StartFound | None = None
        self.first_s = math.inf  # time of the first scan that counts
        self.waits_for = "nothing has been seen yet"
        """why there is no result yet, and what the operator may do"""
        self._config, self._typed = config, np.array(typed[:2])
        self._track, self._rays = Track(), deque[tuple[float, float, Rays]]()
        """scans that are kept: (time, yaw, rays)"""
        self._next_s, self._scans = -math.inf, 0
        self._turns_head = False  # whether a beam came from beside the fan, or from between its beams

    def feed(self, message: SensorMessage) -> None:
        """A message of the pilot's, in any order."""
        if self.result is not None:
            return
        if isinstance(message, ImuReading):
            if not self._track.go(message):
                self._rays.clear()
        elif isinstance(message, DvlReading):
            self._track.hear(message)
        elif isinstance(message, SonarPing):
            self._see(message)

    def walls(self) -> list[tuple[str, float, int]]:
        """Of each wall that returned: its name, by how much [m] it is farther away than the config says
        (NaN: what returned is no wall), and how many beams returned. From the start as found, else as
        typed."""
        if not self._rays:
            return []
        at, result = self._track.at, self.result
        rays = Rays.joined([rays for _, _, rays in self._rays])
        pose = np.array([*self._typed + at, 0.0])
        if result is not None and not result.refusal:
            pose = np.array([*result.place, result.turn_rad])
        fit, found = fit_at(self._config, replace(rays, from_m=rays.from_m - at), pose, MOST_M), []
        for wall in np.unique(fit.wall[rays.hit]):
            off = fit.off_m[rays.hit & (fit.wall == wall)]
            middle = float(np.median(off))
            is_wall = len(off) >= _WALL_RAYS and (np.abs(off - middle) < _SAME_M).mean() > 0.5
            found.append((_side(self._config.world.tank, wall), middle if is_wall else math.nan, len(off)))
        return found

    def way_round(self) -> float:
        """1 or -1 (clockwise): by which turn the nearest corner of the tank comes into view sooner."""
        tank, yaw = self._config.world.tank, float(self._track.rpy[2])
        sides = np.array([tank.x_m, tank.y_m]) - self._typed[:, None]
        x, y = np.where(np.abs(sides[:, 0]) < np.abs(sides[:, 1]), *sides.T)
        return math.copysign(1.0, math.remainder(math.atan2(y, x) - yaw, math.tau))

    def _see(self, ping: SonarPing) -> None:
        if (then := self._track.then(ping.time_s)) is None:
            return
        self.first_s = min(self.first_s, ping.time_s)
        self._keep(ping, *then)
        since_s, sonar = ping.time_s - self.first_s, self._config.sensors.sonar
        self._turns_head |= ping.first_beam % 1 > 0 or ping.first_beam >= sonar.n_ray
        if ping.time_s >= self._next_s and since_s >= max(_LEAST_S, sonar.sweep_s) and self._rays:
            self._next_s = ping.time_s + max(_EVERY_S, 0.05 * since_s)
            self.result = self._sought()
        if self.result is None and since_s > LONGEST_S:
            self.result = StartFound(scans=self._scans, refusal=self._refusal())

    def _keep(self, ping: SonarPing, yaw: float, at: np.ndarray) -> None:
        if self._rays and not self._config.sensors.sonar.mechanical:
            last_s, last_yaw, _ = self._rays[-1]
            rest_s = _REST_S if len(self._rays) < 6 else 4 * _REST_S
            if abs(math.remainder(yaw - last_yaw, math.tau)) < _TURN_RAD and ping.time_s - last_s < rest_s:
                return
        rays = rays_of(self._config.sensors.sonar, ping, at, yaw)
        every = -(-len(rays.range_m) // _SCAN_RAYS)
        self._rays.append((ping.time_s, yaw, rays.some(slice(self._scans % every, None, every))))
        self._scans += 1
        while self._rays[0][0] < ping.time_s - _KEPT_S:
            self._rays.popleft()

    def _sought(self) -> StartFound | None:
        at, tank = self._track.at, self._config.world.tank
        rays = Rays.joined([rays for _, _, rays in self._rays])
        rays = replace(rays, from_m=rays.from_m - at)
        looked = np.unique(np.rint(rays.bearing.mean(1) * (_SECTORS / math.tau)) % _SECTORS)
        if self._turns_head and len(looked) < _LOOKED:
            self.waits_for = "the sonar has not looked all around"
            return None
        if rays.hit.sum() < 2 * _WALL_RAYS:
            self.waits_for = "the sonar sees hardly anything: turn the vehicle around slowly"
            return None
        typed = np.array([*self._typed + at, 0.0])
        few = rays.some(slice(None, None, -(-len(rays.range_m) // _SEARCH_RAYS)))
        guess = around if tank.shape == "circle" else candidates
        found = [refined(self._config, few, pose) for pose in guess(tank, few.ends()[few.hit], typed)]
        best, *others = sorted(found, key=lambda fit: -fit.score)
        near = (f for f in others if _apart(f.pose, best.pose) and f.score > 0.8 * best.score)
        rival = next((f for f in near if not self._wrong(few, f, f.pose)), None)
        return self._judged(rays, refined(self._config, rays, best.pose), rival, typed)

    def _wrong(self, rays: Rays, fit: Fit, typed: np.ndarray) -> str:
        """Why a fit is none; '' = it is one."""
        _, residual = covariance_of(fit)
        return misfit(self._config, rays, fit, residual) or unseen(self._config, rays, fit, typed)

    def _judged(self, rays: Rays, fit: Fit, rival: Fit | None, typed: np.ndarray) -> StartFound | None:
        tank, at = self._config.world.tank, self._track.at
        pose, covariance, residual = fit.pose, *covariance_of(fit)
        wrong = self._wrong(rays, fit, typed)
        if tank.shape == "circle" and not wrong:
            pose, covariance, wrong = turned_by_typed(tank, pose, covariance, typed)
        deviations = np.sqrt(np.diag(covariance))
        far = math.dist(pose[:2], typed[:2]) > NEAR_M or abs(pose[2]) > NEAR_RAD
        if not wrong and rival is not None:
            wrong = f"two places fit the walls: {_told(pose)} and {_told(rival.pose)}"
        if not wrong and (deviations[:2].max() > MOST_M or deviations[2] > MOST_RAD):
            wrong = (
                f"the walls in view fix it no better than {deviations[:2].max():.2f} m and "
                f"{math.degrees(deviations[2]):.1f} degrees"
            )
        if not wrong and far:
            wrong = f"the walls fit at {_told(pose)} only, too far from what was typed"
        if wrong:
            self.waits_for = f"{wrong}: turn the vehicle around slowly"
            return None
        c, s = math.cos(pose[2]), math.sin(pose[2])
        shift = pose[:2] - np.array([c * at[0] - s * at[1], s * at[0] + c * at[1]]) - self._typed
        return StartFound(
            (float(pose[0]), float(pose[1])),
            (float(shift[0]), float(shift[1])),
            float(pose[2]),
            tuple(float(value) for value in covariance[np.triu_indices(3)]),
            residual,
            self._scans,
        )

    def _refusal(self) -> str:
        tank = self._config.world.tank
        return (
            f"the start cannot be checked by the walls of the tank (x {tank.x_m[0]:g} to {tank.x_m[1]:g} m, "
            f"y {tank.y_m[0]:g} to {tank.y_m[1]:g} m): {self.waits_for.partition(': turn')[0]}; measure "
            "again, give --start X,Y,Z and --heading (compass heading of the x axis), and turn the vehicle "
            "once around while the pilot waits; another tank: --world"
        )


def covariance_of(fit: Fit) -> tuple[np.ndarray, float]:
    """((3, 3) covariance of the pose, root mean square [m] of what fits)."""
    off, slope = fit.off_m[fit.fits], fit.slope[fit.fits]
    n = max(len(off), 1)
    residual = math.sqrt(float(off @ off) / n)
    values, vectors = np.linalg.eigh(slope.T @ slope)
    variances = max(residual, 0.03) ** 2 * max(n / _INDEPENDENT, 1.0) / np.maximum(values, 1e-9)
    floor = np.diag([FLOOR_M**2, FLOOR_M**2, FLOOR_RAD**2])
    return vectors @ np.diag(variances) @ vectors.T + floor, residual


def misfit(config: Config, rays: Rays, fit: Fit, residual: float) -> str:
    """Why the walls do not fit; '' = they do."""
    tank, sonar = config.world.tank, config.sensors.sonar
    what = f"the walls seen do not fit near {_told(fit.pose)}"
    allowed = 0.15 + sonar.missed_return + sonar.ghost + sonar.false_return
    seen, behind, before = (int(part.sum()) for part in (fit.fits, fit.beyond, fit.short))
    if seen < 0.35 * (seen + behind + before):
        return f"{what}: {seen} of {seen + behind + before} returns lie on them"
    for wall in np.unique(fit.wall):
        on, off = (int(part[fit.wall == wall].sum()) for part in (fit.fits, fit.beyond))
        if off > max(allowed * (on + off), 6):
            return f"{what}: {off} of {on + off} beams see through the wall at {_side(tank, wall)}"
    noise = float(range_sigma(sonar, rays.range_m[fit.fits]).mean())
    return f"{what}: off by {residual:.2f} m" if residual > 0.06 + 1.5 * noise else ""


def unseen(config: Config, rays: Rays, fit: Fit, typed: np.ndarray) -> str:
    """Which walls are missing for a fix; '' = none."""
    tank = config.world.tank
    as_typed = (np.abs(fit.pose - typed)[:2] < _AS_TYPED_M) & (tank.shape != "circle")
    ends = rays.ends()
    there = set()
    for wall in np.unique(fit.wall[fit.fits]):
        points = ends[fit.fits & (fit.wall == wall)]
        long = np.ptp(points, 0) if len(points) else np.zeros(2)
        sizes = tank.y_m if wall < 2 else tank.x_m
        least_m = min(_WALL_M, 0.6 * (sizes[1] - sizes[0])) / (1 + as_typed[wall // 2])
        if len(points) >= _WALL_RAYS and math.hypot(*long) >= least_m:
            there.add(int(wall))
    if tank.shape == "circle":
        return "" if there else "the wall is hardly in view"
    missing = [axis for axis, walls in (("x", {0, 1}), ("y", {2, 3})) if not there & walls]
    words = (f"{_side(tank, 0)} nor at {_side(tank, 1)}", f"{_side(tank, 2)} nor at {_side(tank, 3)}")
    told = "; ".join(f"neither the wall at {words['xy'.index(axis)]} is seen well" for axis in missing)
    return f"{told}, by a sonar to {config.sensors.sonar.max_range_m:g} m" if missing else ""


def turned_by_typed(
    tank: TankConfig, pose: np.ndarray, covariance: np.ndarray, typed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, str]:
    """In a round tank: the pose on the circle around its middle that the walls leave open, by the typed place
    and heading, which must agree with each other; with its covariance, or why not."""
    centre = np.array([sum(tank.x_m), sum(tank.y_m)]) / 2
    arm, angle = pose[:2] - centre, np.arange(-NEAR_RAD, NEAR_RAD, 1e-3)
    turn = angle - pose[2]
    c, s = np.cos(turn), np.sin(turn)
    places = centre + np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], 1)
    apart = ((places - typed[:2]) ** 2).sum(1)
    toward = (np.hypot(*(places - centre).T) - math.dist(typed[:2], centre)) ** 2  # the walls correct this
    odds = (apart - toward) / MOST_M**2 + (angle / MOST_RAD) ** 2
    best = int(np.argmin(odds))
    prior = np.diag([MOST_M**-2, MOST_M**-2, MOST_RAD**-2])
    found = np.array([*places[best], angle[best]])
    joint = np.linalg.inv(np.linalg.inv(covariance) + prior)
    if math.hypot(*arm) < MOST_M / MOST_RAD:
        return found, joint, "so near the middle of a round tank the walls say nothing of the heading"
    if odds[best] > _AGREED:
        return found, joint, "in this round tank the typed start and heading contradict each other"
    return found, joint, ""


def _apart(one: np.ndarray, other: np.ndarray) -> bool:
    return math.dist(one[:2], other[:2]) > 0.25 or abs(one[2] - other[2]) > math.radians(4.0)


def _told(pose: np.ndarray) -> str:
    return f"{pose[0]:.2f},{pose[1]:.2f} (heading off by {math.degrees(pose[2]):+.0f} degrees)"


def _side(tank: TankConfig, wall: int) -> str:
    if tank.shape == "circle":
        return "the rim"
    return f"{'xy'[wall // 2]} {(tank.x_m + tank.y_m)[wall]:g}"


# ------------------------------------------------------------------------------------------------- under way

MISFIT = 0.5  # ``WallWatch.look`` beyond which the walls do not fit
_WATCHED_S, _WATCH_STEPS = 3.0, 10  # window, and control steps between two scans that count
_SAME_M = 0.2  # returns that fall short of a wall by as much, within this, may be that wall elsewhere


class WallWatch:
    """Whether the walls still fit where the vehicle takes itself to be: ``look`` in every step."""

    def __init__(self, config: Config) -> None:
        self._config, self._dt = config, config.episode.control_dt_s
        self._sweep: list[Rays] = []
        self._swept = -(10**9)
        self._seen: deque[tuple[int, np.ndarray]] = deque()
        """(step, (4, 2) returns of each wall that fit, and that do not)"""

    def look(self, views: Mapping[str, np.ndarray], row: int = 0) -> float:
        """Share of what should lie on a wall that does not, of the worst wall over the last seconds.
        ``views``: a stack's arrays by 'struct.field'."""
        step, sonar = int(views["clock.step"][row]), self._config.sensors.sonar
        every = max(_WATCH_STEPS, round(sonar.sweep_s / self._dt))
        if step < self._swept:  # it has begun anew
            self._sweep, self._swept = [], step
            self._seen.clear()
        if views["scan.fresh"][row] and (sonar.mechanical or step >= self._swept + every):
            self._sweep.append(self._rays(views, row))
        if self._sweep and step >= self._swept + every:
            self._seen.append((step, self._counted(Rays.joined(self._sweep))))
            self._sweep, self._swept = [], step
        while self._seen and step - self._seen[0][0] > max(_WATCHED_S / self._dt, 2 * every):
            self._seen.popleft()
        fit, wrong = sum((counts for _, counts in self._seen), np.zeros((4, 2))).T
        told = fit + wrong >= 3 * _WALL_RAYS
        return float((wrong / np.maximum(fit + wrong, 1.0))[told].max(initial=0.0))

    def _rays(self, views: Mapping[str, np.ndarray], row: int) -> Rays:
        sonar, first, n = self._config.sensors.sonar, 0, self._config.sensors.sonar.n_ray
        if sonar.mechanical:
            first, n = int(views["scan.new_from"][row]), int(views["scan.new_count"][row])
        beams = (first + np.arange(n)) % sonar.n_ray
        ranges, hit = views["scan.range_m"][row][beams], views["scan.hit"][row][beams]
        place, yaw = views["scan.ping_pos_w"][row][:2], float(views["scan.ping_yaw"][row])
        ping = SonarPing(0.0, ranges, hit, np.zeros(0), first)
        return rays_of(sonar, ping, place.astype(float), yaw)

    def _counted(self, rays: Rays) -> np.ndarray:
        fit = fit_at(self._config, rays, np.zeros(3), MOST_M)
        counts, ends = np.zeros((4, 2)), rays.ends()
        for wall in range(4):
            of = fit.wall == wall
            counts[wall] = (fit.fits & of).sum(), (fit.beyond & of).sum()
            short = of & fit.short & (fit.off_m > -NEAR_M)
            off = np.sort(fit.off_m[short])
            same = np.searchsorted(off, off + _SAME_M, "right") - np.arange(len(off))
            if len(off):
                least = off[np.argmax(same)]
                moved = short & (fit.off_m >= least) & (fit.off_m <= least + _SAME_M)
                at = np.flatnonzero(moved)
                whole = len(at) >= 0.7 * of[at[0] : at[-1] + 1].sum()  # no obstacles here and there
                if whole and math.hypot(*np.ptp(ends[moved], 0)) >= _WALL_M:
                    counts[wall, 1] += moved.sum()
        return counts
