"""The structs of planning, allocated once for all its tests, and how to fill them by hand."""

from functools import lru_cache

import numpy as np

from tests import planning_maps as maps
from tests.bundles import Stage, put
from tests.map_bits import kept, sites
from tests.oracles.voronoi import clearance_of
from uuvtai.common.enums import clearance_m
from uuvtai.config import Config
from uuvtai.kernels.planning.io import RouteIO
from uuvtai.sim.setup import load_bounds

N_ENV = 8
N_PLAN = 3
"""Fewer slots than envs, so that slots are used again within a launch."""
N_AHEAD = 31
CONFIG = Config()


@lru_cache(maxsize=1)
def stage():
    """Every struct of planning."""
    s = Stage(
        n_env=N_ENV, n_plan=N_PLAN, n_row=maps.SHAPE[0], n_col=maps.SHAPE[1],
        n_heap=maps.SHAPE[0] * maps.SHAPE[1], n_path=2048, n_way=CONFIG.route.n_way, n_ahead=N_AHEAD,
        n_trigger=4, n_planner=3, n_reason=4, n_track=2, n_forecast=26, n_ray=16,
    )  # fmt: skip
    load_bounds(s.mask, maps.OUTSIDE)
    return s


def clean():
    """Empty water, nothing seen, every env active at step 0, no route; start and goal on the centre line."""
    from uuvtai.kernels.planning.route import reset_route

    s = stage()
    put(s.clock, active=1, running=1, step=0)
    put(s.grid_map, static_occ=0, dynamic_occ=0)
    put(s.ego, vel_b=0, rpy=0)
    put(s.scan, hit=0, doppler_m_s=0, range_m=12.0)
    s.route.n_queue[None] = 0
    put(s.forecast, radius_m=-1.0, pos_w=0.0)
    put_maps([np.zeros(maps.SHAPE, bool)] * N_ENV)
    put_ends([(2.0, 3.0)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    reset_route(s.io(RouteIO))
    return s


def put_maps(occupied, layer="static_occ", max_m=2.0):
    """Occupancy of every env in one layer, and the clearance with sites that follows from it."""
    s = stage()
    getattr(s.grid_map, layer).from_numpy(kept(occupied))
    found = [clearance_of(occ | maps.OUTSIDE, maps.CELL_M, max_m) for occ in occupied]
    _, row, col = map(np.array, zip(*found, strict=True))
    put(s.clearance, site=sites(row, col))


def room_m(s):
    """Clearance of every env's cells [m]."""
    return clearance_m(s.clearance.site.to_numpy(), CONFIG)


def put_ends(starts, goals, z=-0.8):
    s = stage()
    put(s.ego, pos_w=[(*p, z) for p in starts])
    put(s.mission, goal_w=[(*p, z) for p in goals])


def plan(envs=range(N_ENV), config=CONFIG):
    """Run the Voronoi planner for these envs."""
    from uuvtai.kernels.planning.voronoi import plan_routes

    s, queue = stage(), np.zeros(N_ENV, np.int32)
    queue[: len(envs)] = list(envs)
    s.route.queue.from_numpy(queue)
    s.route.n_queue[None] = len(envs)
    plan_routes(s.io(RouteIO, config))
    return s.route


def way_of(env):
    """Waypoints (n, 2) of one env in float64."""
    route = stage().route
    return route.way_w.to_numpy()[env, : route.n_way[env]].astype(np.float64)
