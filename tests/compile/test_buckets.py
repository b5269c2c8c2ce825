"""Few sizes are ever compiled: other batches, obstacles and speeds find the machine code that is there."""

import json
import sys
from typing import get_type_hints

import numpy as np
import pytest
import torch

from tests.command import uuv
from uuvtai.compile.launch import native
from uuvtai.config.loader import load_config
from uuvtai.sim.behavior_tree import read_tree
from uuvtai.sim.setup import LENGTHENED, array_sizes, rank, rows_for
from uuvtai.sim.sim import Sim
from uuvtai.sim.stages import SimState
from uuvtai.state import bytes_of

STEPS = 12


def played(n_env, seed, **world):
    """Positions after some steps of ``n_env`` episodes of a world; rows beyond them must stay inactive."""
    overrides = {"world.dynamic_capacity": 9} | {f"world.{key}": value for key, value in world.items()}
    sim = Sim(load_config("pool", "paper", overrides=overrides), n_env, read_tree("bt"))
    observation, action = sim.observe(), sim.action
    assert observation.shape[0] == action.shape[0] == sim.reward.shape[0] == n_env
    ones = torch.ones(n_env, dtype=torch.int32)
    sim.reset(ones, seed * ones, torch.arange(n_env, dtype=torch.int32))
    for _ in range(STEPS):
        sim.step()
    pos_w = sim.rows(sim.s.vehicle.pos_w)
    assert pos_w.shape == (n_env, 3)
    active = sim.s.clock.active.to_numpy()
    assert active[:n_env].all() and not active[n_env:].any()
    return pos_w


@pytest.mark.parametrize(
    ("sensors", "overrides"),
    [
        ("clean", {}),
        ("harsh", {}),
        ("multibeam_image", {}),
        ("ping360", {}),
        ("nominal", {"forecast.learned": "built-in"}),
        ("nominal", {"baselines.mppi.horizon_s": 1.0}),
    ],
)
def test_other_sensors_and_forecasts_lengthen_only_what_lies_last(sensors, overrides):
    """What lies before keeps its place, and the machine code for it holds."""
    usual = array_sizes(load_config("pool", "nominal"), 8)
    other = array_sizes(load_config("pool", sensors, overrides=overrides), 8)
    changed = {axis for axis in usual if usual[axis] != other[axis]}
    assert changed <= set(LENGTHENED)
    kinds = get_type_hints(SimState).values()
    first = [kind for kind in kinds if not rank(kind)]
    assert len(first) > len(kinds) / 2
    assert all(bytes_of(kind, usual) == bytes_of(kind, other) for kind in first)


def test_sizes_are_few_and_never_too_small():
    rows = [rows_for(n) for n in range(1, 5000)]
    assert all(n <= row for n, row in enumerate(rows, 1)) and rows == sorted(rows)
    assert sorted(set(rows)) == [1, 8, 64, 256, 512, 1024, 2048, 4096, 8192]
    config = load_config("pool", "paper")
    assert array_sizes(config, 3) == array_sizes(config, 8) != array_sizes(config, 9)


def test_kernels_do_not_see_how_many_obstacles_a_scene_has():
    seen = {
        load_config("pool", "paper", overrides={
            "world.n_static": s, "world.n_dynamic": d, "world.dynamic_speed_m_s": v,
        }).world.compiled()
        for s, d, v in ((0, 0, 0.0), (1, 8, 0.6), (12, 15, 1.5), (3, 0, 3.0))
    }  # fmt: skip
    assert len(seen) == 1 and seen.pop().dynamic_slots == 16
    more = load_config("pool", "paper", overrides={"world.n_dynamic": 17}).world
    assert (more.static_slots, more.dynamic_slots) == (16, 32)


@pytest.mark.skipif(sys.platform != "linux", reason="own machine code is for Linux")
def test_other_batches_obstacles_and_speeds_compile_nothing_and_change_nothing():
    """The first batch may compile; the others find its code, and an episode is the same in every batch."""
    whole = played(6, 4, n_dynamic=6)
    made = native[0].made
    np.testing.assert_array_equal(played(2, 4, n_dynamic=6), whole[:2])
    fewer = played(7, 4, n_dynamic=3, n_static=5, dynamic_speed_m_s=1.1)
    assert not np.array_equal(fewer[:6], whole)
    assert native[0].made == made


def test_warm_makes_what_another_process_finds(capfd):
    """The session's small simulator is compiled already: every kernel is found."""
    options = ("--num-envs", "8", "--sensors", "paper", "--set", "world.dynamic_capacity=9", "--json")
    code, out, _ = uuv(capfd, "doctor", "--compile", *options)
    (shape,) = json.loads(out)["shapes"]
    assert code == 0 and (shape["sensors"], shape["num_envs"]) == ("paper", 8)
    assert shape["compiled"] + shape["found"] > 30
