"""NumPy float64 oracle of obstacles followed by the camera: image to columns pixel by pixel, columns to spots
as lists, spots to tracks.

Written from the description of the method, with the product's constants passed in or restated here. A track's
correction takes both numbers of a spot at once, in matrices and Joseph's form.
"""

from dataclasses import dataclass

import numpy as np

from tests.oracles.depth import camera_rays, walls
from tests.oracles.scenes import quaternions, rotation

FAR_M = 1.0e6
NO_RETURN_SHARE = 0.999
ROW_STRIDE = 2
PRESENT = 0.95
NEWLY_SEEN_S = 0.15
BAND_M, WALL_MARGIN_M, SPLIT_M = 0.9, 0.25, 0.25
GATE_M, MAX_GATE_M, APART_M, TURN_GATE = 0.3, 1.2, 0.35, 12.0
LEAST_SPEED = 0.5
"""[m/s] a surprising body is taken to change its velocity by at least so much"""


@dataclass
class View:
    """Where the vehicle was when an image (or a scan) was taken, as estimated."""

    pos: np.ndarray
    rpy: np.ndarray

    @property
    def quat(self):
        return quaternions(np.array([self.rpy]))[0]

    def eye(self, depth):
        return self.pos + rotation(self.quat) @ np.array(depth.offset_b_m)

    def bearing(self, col, depth):
        """[rad] world bearing of an image column at the height of the optical axis."""
        x, y, _ = camera_rays(self.quat, np.array([[depth.rows / 2 - 0.5, col]]), depth)[0]
        return np.arctan2(y, x)


@dataclass
class Scan:
    range_m: np.ndarray
    hit: np.ndarray
    pos: np.ndarray
    yaw: float
    step: int


@dataclass
class Track:
    x: np.ndarray
    """x, y, vx, vy, turn rate"""
    P: np.ndarray
    radius: float
    radius_var: float
    moving: int
    seen: int
    spot: int
    present: float
    z: float = 0.0

    def place(self, late_s):
        return self.x[:2] + late_s * self.x[2:4]

    @property
    def speed(self):
        return np.hypot(*self.x[2:4])


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def unit(bearing):
    return np.array([np.cos(bearing), np.sin(bearing)])


def columns(image, view, cfg, depth, tank):
    """(distance [cols], distance in the first and last row looked at [cols], doubt [cols]) of one image
    [rows, cols].

    ``doubt`` [m] = how near any pixel that could change the answer is to a bound of range, height or wall. A
    column's wall is that along its direction at the height of the optical axis.
    """
    rows = np.arange(0, depth.rows, ROW_STRIDE)
    pixels = np.stack(np.meshgrid(rows, np.arange(depth.cols), indexing="ij"), -1).reshape(-1, 2)
    rays = camera_rays(view.quat, pixels, depth).reshape(len(rows), depth.cols, 3)
    axis = camera_rays(
        view.quat, np.stack([np.full(depth.cols, depth.rows / 2 - 0.5), np.arange(depth.cols)], -1), depth
    )
    wall = walls(view.eye(depth), axis / np.hypot(axis[:, :1], axis[:, 1:2]), tank)
    away = image[rows]
    level, height = away * np.hypot(rays[..., 0], rays[..., 1]), np.abs(away * rays[..., 2])
    margins = np.stack(
        [
            NO_RETURN_SHARE * depth.max_range_m - away,
            BAND_M - height,
            wall - WALL_MARGIN_M - level,
            cfg.range_m - level,
        ]
    )
    seen = np.where((margins > 0).all(0), level, FAR_M)
    near, edge = seen.min(0), seen[[0, -1]].min(0)
    matters = level <= np.maximum(near, edge) + 0.01
    return near, edge, np.where(matters, np.abs(margins).min(0), np.inf).min(0)


def spots_of(near, split_m):
    """(lists of neighbouring columns that belong together, doubt [m])."""
    found, doubt = [], np.inf
    for col in np.flatnonzero(near < FAR_M):
        beside = bool(found) and found[-1][-1] == col - 1
        jump = abs(near[col] - near[col - 1]) if beside else np.inf
        doubt = min(doubt, abs(jump - split_m))
        if jump <= split_m:
            found[-1].append(int(col))
        else:
            found.append([int(col)])
    return found, doubt


def explained(seen, scan, split_m, n_ray):
    """(whether one of the three beams towards a place met something as far away, doubt)."""
    away, step = seen - scan.pos[:2], 2 * np.pi / n_ray
    ray = (np.arctan2(away[1], away[0]) - scan.yaw) / step
    rays = (int(np.round(ray)) + np.array([-1, 0, 1])) % n_ray
    gap = np.abs(scan.range_m[rays] - np.hypot(*away))[scan.hit[rays] == 1]
    return bool((gap < split_m).any()), min([0.5 - abs(ray - np.round(ray)), *np.abs(gap - split_m)])


def corrected(track, offset, along, cut, cut_high, cfg):
    """Correct a track by what was seen ``offset`` off; how near the case is to being taken for a turn."""
    H = np.zeros((2, 5))
    H[:, :2] = along, (-along[1], along[0])
    loose = track.radius**2 * np.array([cut_high, cut])
    noise = cfg.sigma_m**2 + np.array([track.radius_var, 0.0]) + loose
    innovation = H[:, :2] @ offset
    surprise = (innovation**2 / (np.diag(H @ track.P @ H.T) + noise)).sum()
    P = track.P.copy()
    if surprise > TURN_GATE:
        P[[2, 3], [2, 3]] += max(track.speed, LEAST_SPEED) ** 2
        P[[0, 1], [0, 1]] += offset @ offset
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(noise))
    A = np.eye(5) - K @ H
    track.x, track.P = track.x + K @ innovation, A @ P @ A.T + K @ np.diag(noise) @ K.T
    track.present, track.moving = PRESENT, 1
    return abs(surprise / TURN_GATE - 1)


def begun(seen, along, radius, height, step, cfg, tracking):
    place, speed_var = seen + radius * along, tracking.birth_speed_sigma_m_s**2
    P = np.diag([cfg.sigma_m**2, cfg.sigma_m**2, speed_var, speed_var, 0.0])
    return Track(
        np.append(place, [0.0, 0.0, 0.0]), P, radius, tracking.min_radius_m**2 / 4, 0, step, step, PRESENT,
        height,
    )  # fmt: skip


def follow(tracks, n_track, near, edge, view, scan, step, scan_step, cfg, depth, sonar, tracking, dt_s):
    """Bring ``tracks`` {slot: Track} up to one image's columns; (what was done with each spot, doubt)."""
    late, eye, n_col = (step - scan_step) * dt_s, view.eye(depth), len(near)
    spots, doubt = spots_of(near, SPLIT_M)
    done, doubts = [], [doubt]
    for cols in spots:
        distance, highest = near[cols].min(), edge[cols].min()
        left, right = view.bearing(cols[0] - 0.5, depth), view.bearing(cols[-1] + 0.5, depth)
        opening = wrapped(left - right)
        along = unit(right + opening / 2)
        seen = eye[:2] + distance * along
        shown, unsure = explained(seen, scan, SPLIT_M, sonar.n_ray)
        doubts += [abs(opening * distance - tracking.max_width_m), unsure]
        if opening * distance >= tracking.max_width_m or shown:
            done.append("wide" if not shown else "sonar's")
            continue
        offsets, gaps = {}, {}
        for slot, track in tracks.items():
            since = (step - track.seen) * dt_s
            if (track.moving or track.spot >= 0) and since > NEWLY_SEEN_S + 1e-6 and track.spot != step:
                offsets[slot] = seen + track.radius * along - track.place(late)
                way = track.speed * (step - max(track.seen, track.spot)) * dt_s
                gaps[slot] = np.hypot(*offsets[slot]) - min(GATE_M + 2 * way, MAX_GATE_M)
        ranked = sorted(gaps.values())
        doubts += [abs(gap) for gap in ranked[:1]] + [
            ranked[1] - ranked[0] for _ in ranked[1:2] if ranked[0] < 0
        ]
        cut = cols[0] == 0 or cols[-1] == n_col - 1
        if ranked and ranked[0] < 0:
            slot = min(gaps, key=lambda s: gaps[s])
            doubts += [abs(highest - distance - SPLIT_M)]
            doubts += [corrected(tracks[slot], offsets[slot], along, cut, highest < distance + SPLIT_M, cfg)]
            tracks[slot].spot = step
            done.append("corrected")
        elif cut or scan.step < 0:
            done.append("cut")
        else:
            radius = max(opening * distance / 2, tracking.min_radius_m)
            room = [
                np.hypot(*(t.place(late) - seen - radius * along)) - t.radius - APART_M
                for t in tracks.values()
            ]
            doubts += [abs(r) for r in room]
            free = [slot for slot in range(n_track) if slot not in tracks]
            done.append("begun" if free and min([1.0, *room]) >= 0 else "known")
            if done[-1] == "begun":
                tracks[max(free)] = begun(seen, along, radius, eye[2], step, cfg, tracking)
    return done, min(doubts)
