"""Every config key at its extremes: accepted with sizes told, or refused in words; no overflow."""

import math

import pytest

from uuvtai.common.errors import UserError
from uuvtai.config import Config
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import _checked, load_config, load_training
from uuvtai.sim.setup import array_sizes, check_size, memory_bytes

EXTREMES = (
    0, -1, 5e-324, 1e-6, 1e300, 1e18, math.nan, math.inf, 2**31 - 1, 2**63, 10**400, "", [], True,
)  # fmt: skip
TREE = load_training("paper").model_dump(mode="json")


def keys(tree, prefix=()):
    """Dotted key of every value."""
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            yield from keys(value, (*prefix, name))
        else:
            yield ".".join((*prefix, name))


def at(tree, key):
    for name in key.split("."):
        tree = tree[name]
    return tree


def candidates(value):
    """Extremes for a value, and in all places and the last of one that is a list of numbers."""
    yield from EXTREMES
    if isinstance(value, list) and value and all(isinstance(item, (int, float)) for item in value):
        numbers = [x for x in EXTREMES if not isinstance(x, (str, list, bool))]
        yield from ([x] * len(value) for x in numbers)
        yield from ([*value[:-1], x] for x in numbers)


def changed(tree, key, value):
    """The tree with another value at a dotted key; all else is shared, for thousands are made."""
    name, _, rest = key.partition(".")
    return tree | {name: changed(tree[name], rest, value) if rest else value}


def taken(model, key, value):
    """Config with this value, None where it is refused. UserError is the only error that there may be."""
    tree = {name: TREE[name] for name in model.model_fields}
    try:
        return _checked(model, changed(tree, key, value), {})
    except UserError:
        return None


def sized(config):
    """Whether a simulator of one env is not refused; that its sizes can be told is asserted."""
    assert all(size >= 0 for size in array_sizes(config, 1).values())
    assert memory_bytes(config, 1) > 0
    try:
        check_size(config, 1, "cpu")
    except UserError:
        return False
    return True


@pytest.mark.parametrize("section", [name for name in Config.model_fields if name != "fast"])  # as ``slow``
def test_no_extreme_of_a_simulator_s_key_overflows(section):
    accepted = refused = 0
    for key in keys(TREE[section], (section,)):
        for value in candidates(at(TREE, key)):
            config = taken(Config, key, value)
            is_sound = config is not None and sized(config)
            accepted, refused = accepted + is_sound, refused + (not is_sound)
    assert accepted and refused


@pytest.mark.parametrize("section", sorted(LearningConfig.model_fields.keys() - Config.model_fields.keys()))
def test_no_extreme_of_a_training_s_key_is_more_than_refused(section):
    found = [
        taken(LearningConfig, key, value)
        for key in keys(TREE[section], (section,))
        for value in candidates(at(TREE, key))
    ]
    assert any(found) and not all(found)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mapping.cell_m", 5e-324),
        ("mapping.cell_m", 1e-300),
        ("tracking.forecast_dt_s", 5e-324),
        ("episode.control_dt_s", 5e-324),
        ("clearance.max_m", 1e300),
        ("sensors.sonar.period_steps", 10**400),
        ("world.n_static", 10**400),
        ("vehicle.dead_band_rpm", [1e300, 1e300]),
    ],
)
def test_what_once_overflowed_is_refused_by_its_name(key, value):
    with pytest.raises(UserError, match=key.rsplit(".", maxsplit=1)[-1]):
        check_size(load_config(overrides=[(key, value)]), 1, "cpu")


def test_where_not_even_one_env_fits_no_smaller_number_is_advised(monkeypatch):
    config = load_config()
    alone = memory_bytes(config, 1)
    monkeypatch.setattr("uuvtai.sim.setup.free_memory_bytes", lambda _device: alone)
    with pytest.raises(MemoryError, match="not even one env fits"):
        check_size(config, 1, "cpu")
    monkeypatch.setattr("uuvtai.sim.setup.free_memory_bytes", lambda _device: 20 * alone)
    with pytest.raises(MemoryError, match="use --num-envs") as refused:
        check_size(config, 100_000, "cpu")
    advised = int(str(refused.value).rsplit("use --num-envs ", maxsplit=1)[-1].split()[0])
    check_size(config, advised, "cpu")
