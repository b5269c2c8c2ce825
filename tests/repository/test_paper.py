"""docs/paper.md says what the code does: every difference of the preset ``paper``, both values."""

import json
import re
from pathlib import Path

import pytest

from uuvtai.config import TankConfig
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import STACK_SECTIONS, load_config, load_training, with_stack
from uuvtai.kernels.vehicle.dynamics import KGF, thrust_limits
from uuvtai.learning.world_model import LOG_VAR_BOUNDS

PAGE = (Path(__file__).parents[2] / "docs/paper.md").read_text()
SAME = {"distillation.schedule", "sensors.sonar"}
"""keys that differ in writing only (shares of a run with eight digits), or by the sensor preset that every
command takes"""


def rows(heading):
    """{key: cells} of the table under a heading, the key itself left out."""
    part = PAGE.split(f"## {heading}\n")[1].split("\n## ")[0]
    lines = [
        line.strip("|").split(" | ") for line in part.splitlines() if re.match(r"\| `\w+\.\w+` \|", line)
    ]
    return {cells[0].strip(" `"): [cell.strip() for cell in cells[1:]] for cells in lines}


def values(config):
    return {
        f"{section}.{key}": value
        for section, keys in config.model_dump(mode="json").items()
        for key, value in keys.items()
    }


def differing(a, b):
    return {key for key, value in values(a).items() if values(b)[key] != value} - SAME


CLASSICAL = rows("Where the defaults differ: the classical half")
LEARNING = rows("Where the defaults differ: learning")


def test_every_difference_is_listed_and_nothing_else():
    default, paper = LearningConfig(), load_training("paper")
    assert not CLASSICAL.keys() & LEARNING.keys()
    assert set(CLASSICAL) == differing(load_config("pool"), with_stack(load_config("pool"), "paper"))
    assert set(CLASSICAL) | set(LEARNING) == differing(default, paper)
    assert {key.partition(".")[0] for key in CLASSICAL} <= set(STACK_SECTIONS)


@pytest.mark.parametrize("key", CLASSICAL | LEARNING)
def test_both_values_are_as_listed(key):
    _paper, *cells, _why = (CLASSICAL | LEARNING)[key]
    default, paper = (json.loads(cell.strip("`")) for cell in cells)
    assert (default, paper) == (values(LearningConfig())[key], values(load_training("paper"))[key])
    if key in CLASSICAL:
        found = load_config("pool"), with_stack(load_config("pool"), "paper")
        assert [default, paper] == [values(config)[key] for config in found]


def test_values_that_the_page_names_are_those_of_the_preset():
    named = re.findall(r"`(\w+\.\w+)` = ([\d.]+)", PAGE)
    assert len(named) >= 3
    assert all(values(load_training("paper"))[key] == float(value) for key, value in named)
    v = load_training("paper").vehicle
    assert f"{thrust_limits(v)[0]:.1f} N at {v.rotor_max_rpm:.0f} rpm" in PAGE
    assert f"K_F n^2 is {4.4e-7 * v.rotor_max_rpm**2 * KGF:.1f} N" in PAGE
    tank = TankConfig()
    assert [high - low for low, high in (tank.x_m, tank.y_m, tank.z_m)] == [20, 6, 1.6]
    assert f"{LOG_VAR_BOUNDS[0]:.0f} .. {LOG_VAR_BOUNDS[1]:.0f}" in PAGE


def test_the_papers_own_numbers_are_the_presets():
    """Table app_repro, where it gives one: vehicle, tank, safety, sensing and planner map."""
    c = load_training("paper")
    v, e, sonar, camera = c.vehicle, c.episode, c.sensors.sonar, c.sensors.depth
    assert (v.gravity_m_s2, v.water_density_kg_m3, v.volume_m3, v.buoyancy_height_m) == (
        9.81, 997.0, 0.0113459, 0.01,
    )  # fmt: skip
    assert v.added_mass == (5.5, 12.7, 14.57, 0.12, 0.12, 0.12) and v.linear_damping == (
        4.03, 6.22, 5.18, 0.07, 0.07, 0.07,
    )  # fmt: skip
    assert v.quadratic_damping == (18.18, 21.66, 36.99, 1.55, 1.55, 1.55)
    assert (v.rotor_tau_s, v.rotor_max_rpm, v.thrust_scale, len(v.thrusters)) == (0.01, 3900.0, 1.0, 6)
    assert (e.control_dt_s, e.substeps, e.horizon_steps) == (0.02, 2, 3000)
    assert (e.goal_radius_m, e.collision_clearance_m, e.ttc_s) == (1.0, 0.1, 0.18)
    assert (sonar.n_ray, sonar.max_range_m) == (256, 12.0)
    assert (camera.cols, camera.rows, camera.fov_deg, camera.max_range_m) == (128, 72, 90.0, 10.0)
    assert (c.clearance.inflate_m, c.route.rrt_clearance_m, c.tracking.horizon_s) == (0.08, 0.1, 2.5)
    assert (c.disturbance, c.sensors.localization) == (LearningConfig().disturbance, "truth")
