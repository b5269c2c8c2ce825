"""Plan-view distances against outlines sampled in float64, crossing and touching shapes included."""

import numpy as np
import pytest
import taichi as ti

from tests.oracles import world as reference
from uuvtai.kernels.core import geometry
from uuvtai.kernels.core.geometry import BOX, CYLINDER

N = 512
TOL_M = 2e-3
"""outlines sampled every 5 mm overestimate by less; float32"""
ANGLE_TOL = 4e-7
"""stated by steady_direction, plus float32 rounding of the angle itself"""


@ti.kernel
def compare(kinds: ti.template(), rows: ti.template(), out: ti.template()):
    """Of obstacles 2 i and 2 i + 1: their distance; the first against a ring around the second's centre."""
    for i in out:
        a = footprint_row(2 * i, kinds, rows)
        b = footprint_row(2 * i + 1, kinds, rows)
        center = ti.Vector([b[0], b[1]])
        out[i][0] = ti.sqrt(geometry.between_squared(a, b)) - a[6] - b[6]
        out[i][1] = geometry.is_off_ring(a, center, 1.0, 0.2)
        out[i][2] = geometry.is_apart(a, b, 0.3)


@ti.func
def footprint_row(i, kinds: ti.template(), rows: ti.template()):
    pos = ti.Vector([rows[i, 0], rows[i, 1], 0.0])
    return geometry.footprint_of(kinds[i], pos, ti.Vector([rows[i, 2], rows[i, 3], 1.0]), rows[i, 4])


@ti.kernel
def turn(angles: ti.template(), out: ti.template()):
    for i in angles:
        out[i] = geometry.steady_direction(angles[i])


def test_distances_between_obstacles_and_from_rings():
    rng = np.random.default_rng(0)
    rows = np.hstack(
        [rng.uniform(0, 2.5, (2 * N, 2)), rng.uniform(0.05, 0.8, (2 * N, 2)), rng.uniform(-7, 7, (2 * N, 1))]
    )
    kinds = rng.choice([CYLINDER, BOX], 2 * N)
    # a cross: no corner of one lies in the other
    rows[:2] = [[1, 1, 1.0, 0.05, 0.0], [1, 1, 1.0, 0.05, np.pi / 2]]
    kinds[:2] = BOX
    rows = rows.astype(np.float32)
    fields = ti.field(ti.i32, 2 * N), ti.field(ti.f32, (2 * N, 5)), ti.Vector.field(3, ti.f32, N)
    fields[0].from_numpy(kinds.astype(np.int32))
    fields[1].from_numpy(rows)
    compare(*fields)
    got = fields[2].to_numpy()
    obstacles = [
        (int(kind), row[:2], row[[2, 3, 3]], float(row[4]))
        for kind, row in zip(kinds, rows.astype(float), strict=True)
    ]
    assert got[0, 0] == 0.0
    overlapping = 0
    for i in range(N):
        a, b = obstacles[2 * i], obstacles[2 * i + 1]
        gap = reference.gap(a, b)
        overlapping += gap <= 0
        if gap > 0.01:
            assert got[i, 0] == pytest.approx(gap, abs=TOL_M)
        if abs(gap - 0.3) > TOL_M:
            assert got[i, 2] == (gap > 0.3)
        ring = reference.path_points(0, b[1][None], 1.0, 2 * np.pi, spacing=0.005)
        room = reference.plan_distances(ring, *a).min() - 0.2
        if abs(room) > TOL_M:
            assert got[i, 1] == (room > 0)
    assert overlapping > 50


def test_directions_are_cosine_and_sine():
    angles = np.linspace(-8, 8, 4096).astype(np.float32)
    fields = ti.field(ti.f32, len(angles)), ti.Vector.field(2, ti.f32, len(angles))
    fields[0].from_numpy(angles)
    turn(*fields)
    expected = np.stack([np.cos(angles.astype(float)), np.sin(angles.astype(float))], axis=1)
    assert np.abs(fields[1].to_numpy() - expected).max() < 3 * ANGLE_TOL
