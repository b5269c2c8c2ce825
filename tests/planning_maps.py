"""Random maps for the tests of planning: pool-like scenes, mazes with baffles on the walls, narrow gaps."""

import numpy as np

from tests.oracles.voronoi import clearance_of, traversable
from uuvtai.config import TankConfig
from uuvtai.kernels.core.grid import grid_origin, grid_shape, outside_cells

CELL_M = 0.1
TANK = TankConfig()
SHAPE = grid_shape(TANK, CELL_M)
ORIGIN = np.array(grid_origin(TANK, CELL_M))
OUTSIDE = np.array(outside_cells(TANK, CELL_M))
_ROW, _COL = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
X = ORIGIN[0] + (_COL + 0.5) * CELL_M
Y = ORIGIN[1] + (_ROW + 0.5) * CELL_M


def cell_of(pos_w):
    col, row = np.floor((np.asarray(pos_w) - ORIGIN) / CELL_M).astype(int)
    return int(row), int(col)


def centre_of(row, col):
    return ORIGIN + (np.array([col, row]) + 0.5) * CELL_M


def disc(occ, x, y, radius):
    occ |= np.hypot(X - x, Y - y) <= radius


def box(occ, x, y, half_x, half_y, yaw=0.0):
    u, v = np.cos(yaw) * (X - x) + np.sin(yaw) * (Y - y), -np.sin(yaw) * (X - x) + np.cos(yaw) * (Y - y)
    occ |= (np.abs(u) <= half_x) & (np.abs(v) <= half_y)


def scene(rng, n_obstacle=12):
    """Discs and turned boxes, some only seen as a shell, and some false cells."""
    occ = np.zeros(SHAPE, bool)
    for _ in range(n_obstacle):
        x, y = rng.uniform(0.5, 19.5), rng.uniform(0.2, 5.8)
        if rng.random() < 0.5:
            radius = rng.uniform(0.2, 0.5)
            disc(occ, x, y, radius)
            if rng.random() < 0.5:
                occ &= np.hypot(X - x, Y - y) > radius - 0.15
        else:
            box(occ, x, y, rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6), rng.uniform(0, np.pi))
    occ |= rng.random(SHAPE) < rng.choice([0.0, 0.0, 0.002])
    return occ


def maze(rng):
    """Baffles that touch the walls, in turn or at random, with a passage of random width at the end."""
    occ = np.zeros(SHAPE, bool)
    n, alternate = rng.integers(2, 11), rng.random() < 0.5
    for i, x in enumerate(np.linspace(1.5, 18.5, n) + rng.uniform(-0.2, 0.2, n)):
        opening, thick = rng.uniform(0.6, 1.8), rng.choice([0.06, 0.2])
        low = i % 2 == 0 if alternate else rng.random() < 0.5
        half = 0.5 * (6.0 - opening)
        box(occ, x, half if low else 6.0 - half, thick, half)
    return occ


def gaps(rng):
    """Walls across the tank with one or two gaps about as wide as the vehicle: some pass, some do not."""
    occ = np.zeros(SHAPE, bool)
    for x in np.sort(rng.uniform(2.0, 18.0, rng.integers(1, 5))):
        wall = np.abs(x - X) <= rng.choice([0.06, 0.3])
        for _ in range(rng.integers(1, 3)):
            wall &= np.abs(rng.uniform(0.5, 5.5) - Y) > 0.5 * rng.uniform(0.6, 1.2)
        occ |= wall
    return occ


def random_map(seed):
    """(occupied, start_w, goal_w) anywhere in the traversable set of the kind that ``seed`` draws."""
    rng = np.random.default_rng(seed)
    while True:
        occ = (scene, maze, gaps)[seed % 3](rng)
        blocked = occ | OUTSIDE
        omega = traversable(blocked, clearance_of(blocked, CELL_M, 2.0)[0], 0.35)
        cells = np.argwhere(omega)
        if len(cells) > 200:
            a, b = cells[rng.integers(len(cells), size=2)]
            jitter = rng.uniform(-0.049, 0.049, (2, 2))
            return occ, centre_of(*a) + jitter[0], centre_of(*b) + jitter[1]
