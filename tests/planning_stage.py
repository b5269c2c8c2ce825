"""The structs of planning, allocated once for all its tests, and how to fill them by hand."""

from functools import lru_cache
from types import SimpleNamespace

import numpy as np

from tests import planning_maps as maps
from tests.bundles import io_for
from tests.oracles.voronoi import clearance_of
from uuvtai import state
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
    """Every struct of planning by the name sim.py gives it."""
    sizes = {
        "n_env": N_ENV,
        "n_plan": N_PLAN,
        "n_row": maps.SHAPE[0],
        "n_col": maps.SHAPE[1],
        "n_heap": maps.SHAPE[0] * maps.SHAPE[1],
        "n_path": 2048,
        "n_way": CONFIG.route.n_way,
        "n_ahead": N_AHEAD,
        "n_trigger": 4,
        "n_planner": 3,
        "n_reason": 4,
        "n_track": 2,
        "n_forecast": 26,
        "n_ray": 16,
    }
    structs = {
        "voronoi": state.VoronoiState,
        "route": state.RouteState,
        "clearance": state.ClearanceState,
        "grid_map": state.MapState,
        "mask": state.GridMask,
        "mission": state.MissionState,
        "ego": state.Proprioception,
        "forecast": state.ForecastState,
        "scan": state.SonarScan,
        "clock": state.ClockState,
    }
    s = SimpleNamespace(**{name: state.allocate(struct, sizes) for name, struct in structs.items()})
    load_bounds(s.mask, maps.OUTSIDE)
    return s


def clean():
    """Empty water, nothing seen, every env active at step 0, no route; start and goal on the centre line."""
    from uuvtai.kernels.planning.route import reset_route

    s = stage()
    s.clock.active.fill(1)
    s.clock.running.fill(1)
    s.clock.step.fill(0)
    for field in (
        s.grid_map.static_occ,
        s.grid_map.dynamic_occ,
        s.ego.vel_b,
        s.ego.rpy,
        s.scan.hit,
        s.scan.doppler_m_s,
        s.route.n_queue,
    ):
        field.fill(0)
    s.scan.range_m.fill(12.0)
    s.forecast.radius_m.fill(-1.0)
    s.forecast.pos_w.fill(0.0)
    put_maps([np.zeros(maps.SHAPE, bool)] * N_ENV)
    put_ends([(2.0, 3.0)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    reset_route(io_for(RouteIO, s.route, s.clock))
    return s


def put_maps(occupied, layer="static_occ", max_m=2.0):
    """Occupancy of every env in one layer, and the clearance with sites that follows from it."""
    s = stage()
    getattr(s.grid_map, layer).from_numpy(np.array(occupied, np.float32))
    found = [clearance_of(occ | maps.OUTSIDE, maps.CELL_M, max_m) for occ in occupied]
    s.clearance.clearance_m.from_numpy(np.array([f[0] for f in found], np.float32))
    s.clearance.site_row.from_numpy(np.array([f[1] for f in found], np.int16))
    s.clearance.site_col.from_numpy(np.array([f[2] for f in found], np.int16))


def put_ends(starts, goals, z=-0.8):
    s = stage()
    s.ego.pos_w.from_numpy(np.array([(*p, z) for p in starts], np.float32))
    s.mission.goal_w.from_numpy(np.array([(*p, z) for p in goals], np.float32))


def plan(envs=range(N_ENV), config=CONFIG):
    """Run the Voronoi planner for these envs."""
    from uuvtai.kernels.planning.voronoi import plan_routes

    s, queue = stage(), np.zeros(N_ENV, np.int32)
    queue[: len(envs)] = list(envs)
    s.route.queue.from_numpy(queue)
    s.route.n_queue[None] = len(envs)
    plan_routes(io_for(RouteIO, s, config))
    return s.route


def way_of(env):
    """Waypoints (n, 2) of one env in float64."""
    route = stage().route
    return route.way_w.to_numpy()[env, : route.n_way[env]].astype(np.float64)
