"""Tracks as the tracker delivers them in the simulator, with what their bodies then did: to learn a forecast
from, and to judge one. The truth serves learning alone; what drives sees columns of tracks."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from uuvtai.learn.mixture_net import TIMES_S
from uuvtai.outcomes import RUNNING

if TYPE_CHECKING:
    from uuvtai.scenario import Scene
    from uuvtai.sim import Sim

EVERY_STEPS = 25
"""a track is looked at so often, in control steps"""
_BODY_M = 0.5
"""a track belongs to a moving body this close to where it is forecast now,"""
_SPEED_S = 0.3
"""the nearest of them, a m/s of difference in velocity counting as so many metres"""
_STEP_S = 0.02


class TrackMoments(NamedTuple):
    """n moments of tracks that a body is behind."""

    columns: torch.Tensor
    """(n, N_COLUMN) what a network is told"""
    frame: torch.Tensor
    """(n, 5) [m, m, -, -, m/s] place, unit course, speed of the track"""
    truth: torch.Tensor
    """(n, ANCHORS, 2) [m] where the body then was, in the track's frame"""


def path_places(path: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """(n, n_lane, t, 2) [m] of the bodies of n scenarios, ``path`` (n, n_lane, 16) as in a bank of the
    twin's, at times (n, t) [s]; NaN where there is no body."""
    n_way = path[..., 0].astype(int)[..., None]
    radius, length, phase, speed = (path[..., i, None].astype(float) for i in range(1, 5))
    way = path[..., 5:15].reshape(*path.shape[:2], 5, 2).astype(float)
    arc = np.mod(phase + speed * time_s[:, None], np.where(length > 0, length, 1.0))
    slot = np.arange(5)
    after = np.where(slot + 1 < n_way, slot + 1, 0)
    leg = np.take_along_axis(way, after[..., None], 2) - way
    leg_m = np.where(slot < n_way, np.linalg.norm(leg, axis=-1), 0.0)
    begun = np.where(slot < n_way, np.cumsum(leg_m, -1) - leg_m, np.inf)
    at = np.maximum((arc[..., None] >= begun[:, :, None]).sum(-1) - 1, 0)
    pick = lambda values: np.take_along_axis(values, at, -1)  # noqa: E731
    gone = np.minimum((arc - pick(np.where(slot < n_way, begun, 0.0))) / np.maximum(pick(leg_m), 1e-9), 1.0)
    corner, ahead = (np.take_along_axis(values, at[..., None], 2) for values in (way, leg))
    on_line = corner + gone[..., None] * ahead
    angle = arc / np.where(radius == 0, 1.0, radius)
    round_it = np.abs(radius)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    out = np.where((n_way == 0)[..., None], way[:, :, :1] + round_it, on_line)
    return np.where((speed > 0)[..., None], out, np.nan)


def watch(sim: Sim, scenes: tuple[Scene, ...], seed: int, first: int, steps: int) -> tuple[TrackMoments, int]:
    """Moments of episodes ``first`` .. of ``seed``, one in every env, the scenes dealt out in turn, driven by
    the simulator's tree for at most ``steps``; and the env steps that it took."""
    from uuvtai.twin.scenario_bank import scenario_rows

    sim.set_scenes(scenes)
    rows = torch.arange(sim.num_envs, dtype=torch.int32)
    sim.sleep()
    sim.reset(torch.ones_like(rows), torch.full_like(rows, seed), first + rows)
    path = scenario_rows(sim)[1]
    found, running, done = [], np.ones(sim.num_envs, bool), 0
    for step in range(1, steps + 1):
        done += int(running.sum())
        sim.step()
        running &= sim.rows(sim.s.referee.outcome) == RUNNING
        if not running.any():
            break
        sim.sleep_ended()
        if step % EVERY_STEPS == 0:
            found.append(_moments(sim, np.flatnonzero(running), path, step * _STEP_S))
    return joined(found), done


def joined(parts: list[TrackMoments]) -> TrackMoments:
    """All of them, one after the other."""
    return TrackMoments(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


def _moments(sim: Sim, rows: np.ndarray, path: np.ndarray, now_s: float) -> TrackMoments:
    """Of the tracks of these rows that have a forecast and a body."""
    s, envs = sim.s, [int(row) for row in rows]
    there = sim.rows(s.forecast.radius_m, envs)[..., 0] >= 0
    frame = sim.rows(s.mixture.frame, envs)
    times = np.broadcast_to(
        now_s + np.array([-0.05, 0.0, 0.05, *TIMES_S.tolist()]), (len(rows), 3 + len(TIMES_S))
    )
    bodies = path_places(path[rows], times)
    velocity = (bodies[:, :, 2] - bodies[:, :, 0]) / 0.1
    own_velocity = frame[..., 2:4] * frame[..., 4:]
    away = np.linalg.norm(bodies[:, None, :, 1] - frame[:, :, None, :2], axis=-1)
    cost = away + _SPEED_S * np.linalg.norm(velocity[:, None] - own_velocity[:, :, None], axis=-1)
    cost = np.where(away < _BODY_M, cost, np.inf)
    body = np.argmin(np.nan_to_num(cost, nan=np.inf, posinf=np.inf), -1)
    env, track = np.nonzero(there & np.isfinite(np.min(cost, -1)))
    chosen = frame[env, track]
    column = sim.rows(s.mixture.column, envs)[env, track]
    parts = (
        column,
        chosen,
        _in_frame(bodies[env, body[env, track], 3:], chosen),
    )
    return TrackMoments(*(torch.from_numpy(np.ascontiguousarray(part, np.float32)) for part in parts))


def _in_frame(place: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Places (n, ..., 2) in the world, in the frames (n, 5) of their tracks."""
    shape = (len(frame), *(1,) * (place.ndim - 2))
    x, y = place[..., 0] - frame[:, 0].reshape(shape), place[..., 1] - frame[:, 1].reshape(shape)
    c, s = frame[:, 2].reshape(shape), frame[:, 3].reshape(shape)
    return np.stack([c * x + s * y, c * y - s * x], -1)
