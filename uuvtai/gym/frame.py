"""A picture of one env as it stands: the tank from above, in the colours of the videos."""

from __future__ import annotations

import math

import numpy as np

from uuvtai.kernels.core.grid import grid_origin
from uuvtai.logs.canvas import ROUTE, method_inks
from uuvtai.logs.closed_form import scenario_document
from uuvtai.logs.painting import map_canvas, paint_layers, paint_truth, paint_walls, paint_water
from uuvtai.logs.recording import Layer
from uuvtai.scenario import describe_scenario
from uuvtai.sim import Sim

_MARGINS = (12, 12, 12, 12)
"""[px] left, right, top, bottom"""


def draw_frame(sim: Sim, row: int, width_px: int = 640) -> np.ndarray:
    """(height, width, 3) uint8, red green blue: what the vehicle of this row has mapped, its route and goal,
    and the true bodies."""
    s, config = sim.s, sim.config

    def read(field):
        return sim.rows(field, [row])[0]

    scenario = scenario_document(config, describe_scenario(read, s.world, s.path, s.mission), "", 0, 0)
    time_s, pos_w, cell_m = (
        int(read(s.clock.step)) * config.episode.control_dt_s,
        read(s.vehicle.pos_w),
        config.mapping.cell_m,
    )
    static, dynamic = (
        Layer(time_s, read(occupancy), grid_origin(config.world.tank, cell_m), cell_m)
        for occupancy in (s.grid_map.static_occ, s.grid_map.dynamic_occ)
    )
    canvas = map_canvas(scenario["tank"], width_px, _MARGINS)
    paint_water(canvas, scenario["tank"])
    paint_layers(canvas, static, dynamic)
    paint_truth(canvas, scenario, time_s, float(pos_w[2]))
    paint_walls(canvas, scenario["tank"])
    canvas.line(read(s.route.way_w)[: int(read(s.route.n_way))], ROUTE, 2)
    canvas.star(scenario["goal"], 12)
    canvas.vehicle([*pos_w, _yaw(read(s.vehicle.quat_wb))], method_inks(["bt"])["bt"])
    return canvas.image[:, :, ::-1].copy()


def _yaw(quat_wb: np.ndarray) -> float:
    """Heading [rad] of a quaternion (w, x, y, z)."""
    w, x, y, z = quat_wb
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
