"""A world before anything runs in it: where episodes may begin, what is told of it, its picture."""

import subprocess
import sys

import cv2
import pytest

from uuvtai.common.presets import preset_names
from uuvtai.config import WorldConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.world import scenario
from uuvtai.report import world as worlds

WALL = {"kind": "box", "x_m": 10.0, "y_m": 3.0, "half_extents_m": (0.1, 3.0)}


def config_of(**changes):
    base = load_config("pool")
    return base.model_copy(update={"world": WorldConfig.model_validate(base.world.model_dump() | changes)})


@pytest.mark.parametrize("name", preset_names("world"))
def test_in_every_built_in_world_episodes_can_begin(name):
    told, problem, _label = worlds.check(load_config(name))
    assert not problem
    assert not [line for line in told if "through a side wall" in line or "do not fit" in line]


def test_an_empty_tank_is_free_all_over():
    told, problem, label = worlds.check(config_of())
    assert not problem and label.max() == 1
    assert told[0] == "20 x 6 m, 1.6 m deep; a map of 200 x 60 cells of 0.1 m"
    assert told[1] == "obstacles: 0 fixed; drawn anew in each episode 8 static, 6 dynamic at 0.6 m/s"
    assert told[2:] == ["start and goal may be in 100% of the spawn area"]


def test_a_wall_across_parts_the_spawn_area_and_keeps_its_gap():
    told, problem, _label = worlds.check(config_of(fixed=[WALL]))
    assert not problem and told[-2] == "start and goal may be in 89% of the spawn area", "0.9 m of 16 are not"
    assert told[-1] == "look at it: no way with 0.45 m of clearance joins 2 parts of it (45%, 44%)"
    _told, problem, _label = worlds.check(config_of(fixed=[WALL], start_goal_gap_m=9.0))
    assert problem.startswith("no episode can begin: ") and " 9 m apart; widen" in problem


def test_a_gap_narrower_than_the_clearance_is_none():
    for opening, parts in ((0.9, 2), (1.5, 1)):
        half = 0.5 * (6.0 - opening)
        wall = WALL | {"y_m": half, "half_extents_m": (0.1, half)}
        told, _problem, _label = worlds.check(config_of(fixed=[wall]))
        assert ("joins 2 parts of it" in told[-1]) == (parts == 2)


def test_what_reaches_through_a_wall_or_does_not_fit_is_told():
    out = {"kind": "cylinder", "x_m": 5.0, "y_m": 0.2, "radius_m": 0.5}
    mover = {"kind": "sphere", "x_m": 5.0, "y_m": 3.0, "radius_m": 0.5}
    path = [{"x_m": 5.0, "y_m": 3.0}, {"x_m": 5.0, "y_m": 5.9}]
    told, *_ = worlds.check(config_of(fixed=[out, mover | {"path": path}]))
    assert told[2] == "look at it: fixed.0 (cylinder) reaches 0.30 m through a side wall"
    assert told[3] == "look at it: fixed.1 (sphere) reaches 0.40 m through a side wall"
    small = {"x_m": (0.0, 4.0), "y_m": (0.0, 3.0), "z_m": (-1.6, 0.0)}
    told, *_ = worlds.check(config_of(tank=small, spawn_x_m=(0.5, 3.5), spawn_y_m=(0.5, 2.5)))
    assert "look at it: circles of dynamic.circle_radius_m, 4.5 m wide, do not fit the tank" in told
    assert "look at it: lines of dynamic.line_length_m, 6 m long, do not fit the tank" in told


def test_a_spawn_range_of_no_width_counts_as_a_cell():
    told, problem, _label = worlds.check(config_of(spawn_x_m=(2.0, 9.0), spawn_y_m=(3.0, 3.0)))
    assert not problem and told[-1] == "start and goal may be in 100% of the spawn area"


def test_the_picture_shows_obstacles_where_they_are(tmp_path):
    config = config_of(fixed=[WALL, {"kind": "sphere", "x_m": 4.0, "y_m": 3.0, "radius_m": 0.5}])
    *_told, label = worlds.check(config)
    out = worlds.picture("a/mine.yaml", config.world, label, tmp_path / "new" / "mine.png")
    image = cv2.imread(str(out))
    scale = (1200 - 62 - 44) / 20.0

    def at(x, y):
        return tuple(image[round(74 + (6 - y) * scale), round(62 + x * scale)].tolist())

    dark, clear = (0x38, 0x2C, 0x26), at(15, 3)
    assert at(10, 3) == at(10, 0.3) == at(4, 3) == dark
    assert clear == at(2.5, 3) != at(0.5, 3) == at(10.5, 3) != dark


def test_it_takes_no_simulator():
    """A second, not the six that Taichi and torch take to be imported."""
    program = "import sys, uuvtai.report.world; print([n for n in ('taichi', 'torch') if n in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "[]\n"


def test_the_cells_are_those_on_which_scenarios_look_for_a_way():
    assert worlds._CELL_M == scenario.COARSE_M
