"""A picture of one env as it stands: the tank from above, in the colours of the videos."""

from __future__ import annotations

import math
from operator import attrgetter

import numpy as np

from uuvtai.closed_form import describe_scenario
from uuvtai.kernels.core.grid import grid_origin
from uuvtai.logs.canvas import ROUTE, method_inks
from uuvtai.logs.painting import map_canvas, paint_layers, paint_truth, paint_walls, paint_water
from uuvtai.logs.scenario_document import scenario_document
from uuvtai.logs.topics.map_topics import Layer
from uuvtai.sim import Sim

_MARGINS = (12, 12, 12, 12)
"""[px] left, right, top, bottom"""


def draw_frame(sim: Sim, row: int, width_px: int = 640) -> np.ndarray:
    """(height, width, 3) uint8, red green blue: what the vehicle of this row has mapped, its route and goal,
    and the true bodies."""
    config = sim.config

    def read(name: str) -> np.ndarray:
        return sim.rows(attrgetter(name)(sim.s), [row])[0]

    scenario = scenario_document(config, describe_scenario(read), "", 0, 0)
    time_s = int(read("clock.step")) * config.episode.control_dt_s
    pos_w, cell_m = read("vehicle.pos_w"), config.mapping.cell_m
    static, dynamic = (
        Layer.of(read(occupancy), grid_origin(config.world.tank, cell_m), cell_m)
        for occupancy in ("grid_map.static_occ", "grid_map.dynamic_occ")
    )
    canvas = map_canvas(scenario["tank"], width_px, _MARGINS)
    paint_water(canvas, scenario["tank"])
    paint_layers(canvas, static, dynamic)
    paint_truth(canvas, scenario, time_s, float(pos_w[2]))
    paint_walls(canvas, scenario["tank"])
    canvas.line(read("route.way_w")[: int(read("route.n_way"))], ROUTE, 2)
    canvas.star(scenario["goal"], 12)
    canvas.vehicle([*pos_w, _yaw(read("vehicle.quat_wb"))], method_inks(["bt"])["bt"])
    return canvas.image[:, :, ::-1].copy()


def _yaw(quat_wb: np.ndarray) -> float:
    """Heading [rad] of a quaternion (w, x, y, z)."""
    w, x, y, z = quat_wb
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
