"""A potential field: pulled along the route, pushed off by what the sonar hears and by obstacles that will
come near: ``uuv eval --agent bt,examples/own_field.py``."""

import numpy as np


def act(view):
    ahead = view.in_body(view.route.lookahead - view.ego.position)  # (n, 3): ahead, left, up
    pull = 0.6 * ahead[:, :2] / np.maximum(np.linalg.norm(ahead[:, :2], axis=1), 0.3)[:, None]

    angle = np.linspace(0, 2 * np.pi, view.scan.range_m.shape[1], endpoint=False)[None]
    angle = angle + (view.scan.yaw - view.ego.rpy[:, 2])[:, None]  # the vehicle has turned since the ping
    near = np.where(view.scan.hit, np.clip(0.9 - view.scan.range_m, 0, None), 0.0)
    push = -3.0 * np.stack([near * np.cos(angle), near * np.sin(angle)], -1).mean(1)

    body = view.tracks.forecast[:, :, ::5] - view.ego.position[:, None, None, :2]  # (n, obstacles, times, 2)
    gap = np.maximum(np.linalg.norm(body, axis=-1) - view.tracks.forecast_radius[:, :, ::5], 0.1)
    close = view.tracks.moving[:, :, None] * np.clip(1 / gap - 1, 0, 4)
    away = -(close[..., None] * body / np.linalg.norm(body, axis=-1, keepdims=True).clip(0.1)).mean(2).sum(1)

    level = pull + push + 0.5 * view.in_body(away)
    turn = 1.5 * np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.column_stack([level, ahead[:, 2], turn])
