"""Numbers of the config are arguments of kernels: another compiles nothing, and gives a constant's bits."""

import dataclasses
import json
import math

import numpy as np
import pytest
import taichi as ti
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.compile.test_native import N, Scene, Source, Sums, place, started  # noqa: F401
from uuvtai.compile import launch as module
from uuvtai.compile.cache import ALL, key_of, key_with, noted, sections_in, value_of, values_of
from uuvtai.compile.launch import Number, Numbers, native, quick_launch, worked_out
from uuvtai.config import BehaviorConfig, Config, EpisodeConfig, SonarConfig
from uuvtai.envs.warm_up import calls_of
from uuvtai.kernels.core.stage import Bundle, Const, In, Out
from uuvtai.sim.sim import Sim


@dataclasses.dataclass(frozen=True, eq=False)
class RulesIO:
    """Like a stage's bundle."""

    sums: "Out[Sums]"
    source: "In[Source]"
    rules: "Const[EpisodeConfig]"


@quick_launch
@ti.kernel
def by_rules(io: Bundle[RulesIO]):
    """Numbers plain, in sums, in a vector, compared with what is known late and early; a count."""
    share = ti.static(2.0 * io.rules.ttc_s - io.rules.goal_radius_m / 3)
    for i in range(N):
        value = io.source.value[i] * io.rules.control_dt_s + share * ti.static(max(io.rules.ttc_s, 0.01))
        if ti.static(io.rules.collision_clearance_m > 0.05):
            value = ti.max(value, io.rules.collision_clearance_m) + ti.static(io.rules.horizon_steps)
        if io.source.value[i] < io.rules.ttc_closing_m_s:
            value += ti.static(math.sqrt(io.rules.ttc_s) + math.log1p(io.rules.goal_radius_m))
        io.sums.total[i] = value
        io.sums.pair[i] = ti.Vector([io.rules.ttc_s**2, -io.rules.ttc_s])
        io.sums.rest[i] = 1.0


def ruled(scene, **changes):
    """A bundle over the arrays of a scene, under other rules."""
    return RulesIO(scene.structs.sums, scene.structs.source, EpisodeConfig(**changes))


def played(io):
    by_rules(io)
    return [getattr(io.sums, name).to_numpy() for name in ("total", "pair", "rest")]


OTHER = {"ttc_s": 0.31, "control_dt_s": 0.05, "collision_clearance_m": 0.2, "ttc_closing_m_s": 0.7}


def test_another_number_compiles_nothing_and_gives_the_same_bits(place):  # noqa: F811
    scene = Scene()
    ours = started(scene, place)
    bundles = [ruled(scene), ruled(scene, **OTHER)]
    ours.adopt(bundles, scene.memory)
    for io, made in zip(bundles, ((1, 0), (1, 1)), strict=True):
        found = played(io)
        assert (ours.made, ours.found) == made
        alone = dataclasses.replace(io)  # Taichi launches it: its numbers are constants
        for one, other in zip(found, played(alone), strict=True):
            np.testing.assert_array_equal(one, other)
    assert ours.refused == 0


@pytest.mark.parametrize(
    "change", [{"collision_clearance_m": 0.01}, {"goal_radius_m": 0.5}, {"horizon_steps": 7}]
)
def test_what_decides_about_code_compiles_anew(place, change):  # noqa: F811
    """A comparison that leaves a line out, what is read there too; a function of Python's; a count."""
    scene = Scene()
    ours = started(scene, place)
    ours.adopt(bundles := [ruled(scene), ruled(scene, **change)], scene.memory)
    played(bundles[0])
    found = played(bundles[1])
    assert (ours.made, ours.found, ours.refused) == (2, 0, 0)
    for one, other in zip(found, played(dataclasses.replace(bundles[1])), strict=True):
        np.testing.assert_array_equal(one, other)
    ours.adopt([again := dataclasses.replace(bundles[0])], scene.memory)
    played(again)
    assert (ours.made, ours.found) == (2, 1), "the first code is still there"


def test_a_kernel_with_too_many_numbers_has_the_rest_as_constants(place, monkeypatch):  # noqa: F811
    monkeypatch.setattr(module, "MOST_NUMBERS", 2)
    scene = Scene()
    ours = started(scene, place)
    ours.adopt(bundles := [ruled(scene), ruled(scene, **OTHER)], scene.memory)
    played(bundles[0])
    found = played(bundles[1])
    assert (ours.made, ours.refused) == (2, 0)
    for one, other in zip(found, played(dataclasses.replace(bundles[1])), strict=True):
        np.testing.assert_array_equal(one, other)


# ------------------------------------------------------------------------------------------------- one number


def number(value, fixed=None, name="a.b"):
    return Number(Numbers((fixed if fixed is not None else []).append), name, value)


SUMS = [
    lambda x: x + 1, lambda x: 2.5 - x, lambda x: x * x, lambda x: 1 / (x + 3.0), lambda x: -x / 7,
    lambda x: x**2, lambda x: 2.0**x, lambda x: x - 0.1 * x, lambda x: (1 + x) / x,
]  # fmt: skip


@given(st.floats(0.01, 100), st.sampled_from(range(len(SUMS))))
def test_sums_are_worked_out_as_python_does(value, which):
    fixed = []
    found = SUMS[which](number(value, fixed))
    assert isinstance(found, Number) and fixed == []
    assert found.value == SUMS[which](value)
    assert worked_out(json.loads(json.dumps(found.told)), lambda name: {"a.b": value}[name]) == found.value


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (lambda x: x > 1, [">", "a.b", 1]),
        (lambda x: x != 1, ["!=", "a.b", 1]),
        (lambda x: x == 2.5, ["==", "a.b", 2.5]),
        (round, ["round", "a.b"]),
        (lambda x: round(x / 2, 1), ["round", ["/", "a.b", 2], 1]),
        (int, ["int", "a.b"]),
        (lambda x: 7 // x, ["//", 7, "a.b"]),
        (lambda x: x % 2, ["%", "a.b", 2]),
        (bool, ["bool", "a.b"]),
        (abs, ["abs", "a.b"]),
        (math.cosh, ["float", "a.b"]),
        (np.cosh, ["float", "a.b"]),
        (lambda x: np.float64(2.0) * x, ["float", "a.b"]),
        (repr, ["float", "a.b"]),
        (hash, ["float", "a.b"]),
    ],
)
def test_what_comes_of_a_decision_is_noted(function, told):
    fixed = []
    assert function(number(2.5, fixed)) == function(2.5)
    assert [json.loads(text) for text in fixed] == [told]
    assert all(type(worked_out(json.loads(t), lambda _: 2.5)) in (bool, int, float) for t in fixed)


@pytest.mark.parametrize("function", [max, np.maximum])
def test_the_larger_of_two_stays_a_number(function):
    fixed = []
    larger = function(number(2.5, fixed), 1.0)
    assert isinstance(larger, Number) and larger.told == "a.b"
    assert [json.loads(text) for text in fixed] == [["<", "a.b", 1.0]], "as long as it is the larger one"


@pytest.mark.parametrize("wrong", [lambda x: x + "1", lambda x: x < "1", list, lambda x: x[0], len])
def test_what_is_no_number_cannot_be_reckoned_with(wrong):
    with pytest.raises(TypeError):
        wrong(number(2.5))


# ---------------------------------------------------------------------------------------------- what is read


@dataclasses.dataclass(frozen=True, eq=False)
class PartsIO:
    behavior_cfg: "Const[BehaviorConfig]"
    sonar_cfg: "Const[SonarConfig]"
    all_cfg: "Const[Config]"


def parts():
    config = Config()
    return PartsIO(config.behavior, config.sensors.sonar, config)


def test_every_section_has_its_places():
    places = dict(sections_in(parts()))
    assert {
        "behavior_cfg", "sonar_cfg", "all_cfg", "all_cfg.behavior", "all_cfg.sensors.sonar",
    } <= places.keys()  # fmt: skip
    assert places["behavior_cfg"] is places["all_cfg.behavior"]


def test_what_is_read_is_noted_in_all_its_places_and_by_code_of_the_section_too():
    io = parts()
    with noted(io) as (names, _):
        assert io.behavior_cfg.n_heading == 24
        assert io.sonar_cfg.is_ring
        assert not hasattr(io.behavior_cfg, "nothing_of_that_name")
    assert names == {
        "behavior_cfg.n_heading",
        "all_cfg.behavior.n_heading",
        '["==", "sonar_cfg.horizontal_aperture_deg", 360.0]',
    }
    with noted(io) as (names, _):
        io.behavior_cfg.model_dump()
    assert f"behavior_cfg.{ALL}" in names
    assert values_of([f"behavior_cfg.{ALL}"], io, 0) == [(f"behavior_cfg.{ALL}", repr(io.behavior_cfg))]
    with noted(io) as (names, _):
        pass
    assert io.behavior_cfg.n_heading == 24 and names == set(), "nothing is noted any more"


def test_what_another_config_lacks_is_told_apart():
    io = parts()
    assert value_of(io, "sonar_cfg.nothing.at.all") is None
    assert values_of(['["/", 1.0, ["-", "sonar_cfg.max_range_m", 12.0]]', '["<", "no.such", 1]'], io, 0) == [
        ('["/", 1.0, ["-", "sonar_cfg.max_range_m", 12.0]]', ""),
        ('["<", "no.such", 1]', ""),
    ]
    assert values_of(["all_cfg.behavior"], io, 0) == [("all_cfg.behavior", "BehaviorConfig")]


# ------------------------------------------------------------------------------------- the whole simulator

SHAPES = {"depth_cfg.fov_deg", "sonar_cfg.horizontal_aperture_deg"}
"""numbers among these that are no argument: what is seen is shaped by them"""
LIMITED = {"behavior_cfg.cruise_m_s", "behavior_cfg.back_off_m_s"}
"""numbers of which the smaller of two is taken that are equal by default: 1 % more decides otherwise"""
OFTEN = ("behavior_cfg", "reward_cfg", "forecast_cfg", "sonar_cfg", "depth_cfg", "sensors_cfg.dvl",
         "sensors_cfg.imu", "sensors_cfg.pressure")  # fmt: skip
"""sections whose numbers people change"""


def test_another_number_of_the_tree_the_reward_the_forecast_or_the_noise_compiles_nothing(small):
    """Each of them in turn, 1 % more: what the kernels of a reset and a step depend on stays."""
    small.sim.observe()
    small.begin([0, 1])
    for _ in range(6):
        small.sim.step()
    tried, wrong = set(), set()
    other = Sim(small.config, small.N, small.trees["bt"])  # nothing of it was launched
    for kernel, arguments in calls_of(other):
        key, io = key_of(kernel, arguments, native[0].surroundings), arguments[0]
        store, tree = native[0].store, other.memory().tree
        ways = store.names(key)
        kept = [names for names in ways if store.get(key_with(key, names, io, tree))]
        assert kept, kernel.func.__name__
        for at, section in sections_in(io):
            for name in type(section).model_fields if at in OFTEN else ():
                leaf = f"{at}.{name}"
                if type(getattr(section, name)) is float:
                    tried.add(leaf)
                    told = [json.loads(text) for text in kept[0] if leaf in text and text.startswith("[")]
                    if any(comes_to(each, io, leaf, 1.0) != comes_to(each, io, leaf, 1.01) for each in told):
                        wrong.add(leaf)
    assert len(tried) > 100 and {leaf.partition(".")[0] for leaf in tried} >= {"behavior_cfg", "reward_cfg"}
    assert wrong == SHAPES | LIMITED


def comes_to(told, io, leaf, factor):
    """A decision where the config says ``factor`` times as much for a leaf."""
    return worked_out(told, lambda name: value_of(io, name) * (factor if name == leaf else 1.0))


def test_another_threshold_is_as_warm_as_before(small):
    """What ``uuv eval --set behavior.caution=1.3`` builds: every kernel is found."""
    small.begin([0, 1])
    small.sim.step()
    changed = {
        "behavior": small.config.behavior.model_copy(update={"caution": 1.3, "emergency_ttc_s": 0.9}),
        "reward": small.config.reward.model_copy(update={"progress": 2.0}),
    }
    other, before = Sim(small.config.model_copy(update=changed), small.N, small.trees["bt"]), native[0].made
    ones = torch.ones(small.N, dtype=torch.int32)
    other.reset(ones, ones, ones)
    for _ in range(6):
        other.step()
    assert native[0].made == before and native[0].refused == 0
