"""Scenes of the sonar as triangle meshes for Embree, by the binding embreex."""

from __future__ import annotations

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from tests.oracles.scenes import BOX, CYLINDER, SPHERE
from uuvtai.config import TankConfig

AROUND = 32
"""Corners of a circle, and twice the bands of a sphere: chords stay within half a percent of the radius."""


class Meshes:
    """The tank's walls and the obstacles of one scene, corners on their surfaces; ``around``: faces on them
    instead, so that the mesh holds the whole body. Flat beams from inside the tank meet no floor, surface or
    lid."""

    def __init__(self, scene: dict, env: int, tank: TankConfig, around: bool = False) -> None:
        half = [0.5 * (high - low) for low, high in (tank.x_m, tank.y_m, tank.z_m)]
        middle = [0.5 * (low + high) for low, high in (tank.x_m, tank.y_m, tank.z_m)]
        parts = [_box(np.array(half)) + middle]
        for body in np.flatnonzero(scene["kind"][env]):
            kind, size, yaw = scene["kind"][env, body], scene["size"][env, body], scene["yaw"][env, body]
            rings = {BOX: _box, CYLINDER: _cylinder, SPHERE: _sphere}[kind](size)
            if around and kind != BOX:
                rings *= _swell(kind)
            turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
            parts.append(rings @ turn + scene["obstacle_pos"][env, body])
        self.scene = EmbreeScene(robust=False)
        self.mesh = TriangleMesh(self.scene, np.concatenate([_triangles(rings) for rings in parts]))

    def cast(self, start: np.ndarray, rays: np.ndarray, max_range_m: float) -> np.ndarray:
        """Range of every ray [n] in one call, ``max_range_m`` where it meets nothing; start and rays
        float32 [n, 3]."""
        return self.scene.run(start, rays, max_range_m, query="DISTANCE")


def _box(half: np.ndarray) -> np.ndarray:
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half[:2]
    return _rings(corners, [1, 1], [-half[2], half[2]])


def _cylinder(size: np.ndarray) -> np.ndarray:
    return _rings(_circle() * size[0], [1, 1], [-size[2], size[2]])


def _sphere(size: np.ndarray) -> np.ndarray:
    height = np.linspace(-0.5 * np.pi, 0.5 * np.pi, AROUND // 2 + 1)
    return _rings(_circle() * size[0], np.cos(height), np.sin(height) * size[0])


def _circle() -> np.ndarray:
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _swell(kind: int) -> np.ndarray:
    """Factors that bring the middles of the faces to where the corners were."""
    across = 1 / np.cos(np.pi / AROUND)
    return np.array([across, across, 1]) if kind == CYLINDER else np.full(3, across**2)


def _rings(outline: np.ndarray, widths: list | np.ndarray, heights: list | np.ndarray) -> np.ndarray:
    """Points [ring, corner, 3]: the outline [corner, 2], as wide and as high as each ring."""
    flat = np.asarray(widths)[:, None, None] * outline
    return np.concatenate(
        [flat, np.broadcast_to(np.asarray(heights)[:, None, None], (*flat.shape[:2], 1))], 2
    )


def _triangles(rings: np.ndarray) -> np.ndarray:
    """Two for each field between neighbours [n, 3, 3]."""
    low, high = rings[:-1], rings[1:]
    low_next, high_next = (np.roll(side, -1, axis=1) for side in (low, high))
    faces = np.stack([low, low_next, high, low_next, high_next, high], axis=2)
    return faces.reshape(-1, 3, 3).astype(np.float32)
