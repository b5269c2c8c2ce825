"""Configs: presets, files, overrides, and what is said about bad ones."""

import pytest
import yaml

from uuvtai import loader
from uuvtai.config import Config
from uuvtai.loader import ConfigError, load_config, to_yaml, validated


def write(folder, text, name="mine.yaml"):
    path = folder / name
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("world", loader.preset_names("world"))
@pytest.mark.parametrize("sensors", [None, *loader.preset_names("sensors")])
def test_every_preset_loads_and_survives_yaml(world, sensors):
    config = load_config(world, sensors)
    assert validated(yaml.safe_load(to_yaml(config))) == config


@pytest.mark.parametrize("vehicle", loader.preset_names("vehicle"))
def test_every_vehicle_loads(vehicle):
    assert isinstance(load_config("pool", vehicle=vehicle), Config)


@pytest.mark.parametrize("world", loader.preset_names("world"))
def test_no_preset_switches_the_debugging_stamp_on(world):
    for sensors in loader.preset_names("sensors"):
        assert load_config(world, sensors).mapping.stamp == 0.0


def test_paper_sensing_is_the_default_and_a_world_may_name_another():
    assert load_config("pool").sensors == load_config("pool", "paper").sensors
    assert load_config("transfer").sensors == load_config("pool", "nominal").sensors
    assert load_config("transfer", "clean").sensors == load_config("pool", "clean").sensors


def test_overrides_as_dict_and_as_typed():
    assert load_config("pool", overrides={"world.n_dynamic": 9}).world.n_dynamic == 9
    assert load_config("pool", overrides=["mapping.static_hit=3e-4"]).mapping.static_hit == 3e-4


def test_float_without_a_point_in_a_file(tmp_path):
    assert load_config(write(tmp_path, "mapping:\n  static_decay: 3e-4\n")).mapping.static_decay == 3e-4


def test_extends_a_preset_and_a_neighbour(tmp_path):
    write(tmp_path, "extends: gauntlet\nworld: {n_dynamic: 2}\n", "base.yaml")
    config = load_config(write(tmp_path, "extends: base.yaml\nworld: {n_static: 1}\n"))
    assert (config.world.n_static, config.world.n_dynamic) == (1, 2)
    assert config.world.dynamic == load_config("gauntlet").world.dynamic


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("world.n_dynmic=3", "did you mean 'n_dynamic'"),
        ("wrld.n_dynamic=3", "did you mean 'world'"),
        ("world.n_static=3.5", "world.n_static: Input should be a valid integer"),
        ("world.n_static=eight", "got 'eight'"),
        ("world.n_static=-1", "greater than or equal to 0"),
        ("world.n_static=true", "valid integer"),
        ("mapping.static_hit=.nan", "finite"),
        ("mapping.static_hit=.inf", "finite"),
        ("episode.control_dt_s='0.02'", "valid number"),
        ("world.tank.x_m=[3,1]", "low < high"),
        ("world.tank.x_m=[1,2", "not valid YAML"),
        ("world", "write key.sub=value"),
        ("=3", "write key.sub=value"),
    ],
)
def test_bad_override_is_named_with_its_reason(override, says):
    with pytest.raises(ConfigError) as error:
        load_config("pool", overrides=[override])
    assert says in str(error.value)
    assert "--set" in str(error.value) or "unknown key" in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("world:\n  n_static: 3\n  n_static: 4\n", "mine.yaml:3: not valid YAML: key 'n_static' is given twice"),
        ("world:\n  n_statics: 3\n", "mine.yaml:2: unknown key 'world.n_statics'; did you mean 'n_static'?"),
        ("world:\n  n_static: [1, 2]\n", "mine.yaml:2: world.n_static"),
        ("a: &x 1\nb: *x\n", "aliases"),
        ("world: !!python/object/apply:os.system ['true']\n", "not valid YAML"),
        ("- 1\n- 2\n", "must be a mapping"),
        ("world: {1: 2}\n", "is not a name"),
        ("extends: mine.yaml\n", "circle"),
        ("extends: [a]\n", "'extends' must be"),
        ("world:\n  fixed:\n    - {kind: box, x_m: 1, y_m: 2}\n", "a box needs half_extents_m"),
    ],
)
def test_bad_file_is_named_with_its_line(tmp_path, text, says):
    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, text))
    assert says in str(error.value)


def test_missing_unreadable_huge_and_binary_files(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'pool'"):
        load_config("pol")
    with pytest.raises(ConfigError, match="no such file"):
        load_config(str(tmp_path / "none.yaml"))
    with pytest.raises(ConfigError, match="1 MiB"):
        load_config(write(tmp_path, "#" + "x" * (1 << 20)))
    binary = tmp_path / "bin.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_config(str(binary))


def test_resolved_config_is_read_back(tmp_path):
    config = load_config("gauntlet", "nominal")
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(config))
    assert loader.load_resolved(path) == config
