"""Configs: presets, files, overrides, and what is said about bad ones."""

import pytest
import yaml

from uuvtai.common.presets import preset_names
from uuvtai.config import Config, loader
from uuvtai.config.loader import ConfigError, load_config, load_training, to_yaml, validated, with_stack
from uuvtai.learning.distillation import piecewise_linear


def write(folder, text, name="mine.yaml"):
    path = folder / name
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("world", "sensors"),
    [(world, None) for world in preset_names("world")] + [("pool", name) for name in preset_names("sensors")],
)
def test_every_preset_loads_and_survives_yaml(world, sensors):
    config = load_config(world, sensors)
    assert validated(yaml.safe_load(to_yaml(config))) == config


@pytest.mark.parametrize("vehicle", loader.preset_names("vehicle"))
def test_every_vehicle_loads(vehicle):
    assert isinstance(load_config("pool", vehicle=vehicle), Config)


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
        ("world.n_static=3.5", "--set world.n_static: Input should be a valid integer"),
        ("world.n_static=eight", "got 'eight'"),
        ("world.n_static=-1", "greater than or equal to 0"),
        ("world.n_static=true", "valid integer"),
        ("mapping.static_hit=.nan", "finite"),
        ("mapping.static_hit=.inf", "finite"),
        ("episode.control_dt_s='0.02'", "valid number"),
        ("world.tank.x_m=[3,1]", "low < high"),
        ("world.tank.x_m=[1,2", "not valid YAML"),
        ("stamp=0", "; delete a key of an older version that is not among them"),
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
        (
            "world:\n  n_static: 3\n  n_static: 4\n",
            "mine.yaml:3: not valid YAML: key 'n_static' is given twice",
        ),
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
    with pytest.raises(ConfigError, match="more than the 1,048,576 that such a file may have"):
        load_config(write(tmp_path, "#" + "x" * (1 << 20)))
    binary = tmp_path / "bin.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ConfigError, match="UTF-8"):
        load_config(str(binary))


# --------------------------------------------------------------------------------------------------- training


@pytest.mark.parametrize("preset", [None, *loader.preset_names("train")])
def test_every_training_preset_loads_and_is_read_back(tmp_path, preset):
    """And a config without a training (None)."""
    config = load_training(preset) if preset else load_config("gauntlet", "nominal")
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(config))
    assert loader.load_resolved(path) == config


def test_paper_is_the_table_to_the_letter():
    """Table app_repro of the paper."""
    c = load_training("paper")
    assert (c.train.num_envs, c.train.iterations, c.episode.horizon_steps) == (8, 1200, 3000)
    assert (c.policy.hidden, c.policy.activation, c.ppo.rollout_steps) == ((256, 256), "elu", 64)
    assert (c.ppo.learning_rate, c.ppo.epochs, c.ppo.minibatches, c.ppo.clip) == (3e-4, 6, 4, 0.2)
    assert (c.ppo.gamma, c.ppo.gae_lambda, c.ppo.entropy_weight, c.ppo.value_weight, c.ppo.max_grad_norm) == (
        0.99, 0.95, 0.003, 1.5, 1.0,
    )  # fmt: skip
    assert (c.distillation.batch, c.distillation.steps, c.distillation.learning_rate) == (1024, 2, 1.5e-4)
    assert (c.world_model.latent, c.world_model.hidden, c.world_model.batch, c.world_model.steps) == (
        64, (128, 128), 2048, 2,
    )  # fmt: skip
    assert (
        c.world_model.learning_rate,
        c.world_model.reconstruction_weight,
        c.world_model.dynamics_weight,
    ) == (3e-4, 1.0, 0.2)
    assert (c.uncertainty.ema, c.uncertainty.gain, c.uncertainty.max_scale) == (0.05, 0.8, 2.0)
    assert c.sensors == load_config("pool", "paper").sensors


def test_the_paper_schedule_meets_the_equation():
    """lambda_t: 1 up to 800, 0.2 (1 - (t - 800) / 800) up to 1600, then 0 (paper)."""
    points = load_training("paper").distillation.schedule
    for t in (0, 400, 800, 801, 1000, 1199, 1500, 1600, 2000):
        expected = 1.0 if t <= 800 else 0.2 * (1 - (t - 800) / 800) if t <= 1600 else 0.0
        assert piecewise_linear(points, t / 1200) == pytest.approx(expected, abs=1e-6)


ROWS = {
    "paper": set(),
    "ppo": {"distillation.schedule", "distillation.steps"},
    "constant_20": {"distillation.schedule"},
    "no_risk_scaling": {"uncertainty.gain"},
    "no_world_model": {"world_model.as_features"},
}
"""keys in which the rows of the paper's tables differ from its training"""


def test_the_papers_rows_differ_in_one_thing_and_no_other_training_has_its_stack():
    for preset in loader.preset_names("train"):
        config = load_training(preset)
        if preset in ROWS:
            assert differing(config, load_training("paper")) == ROWS[preset]
        else:
            assert all(getattr(config, name) == getattr(Config(), name) for name in loader.STACK_SECTIONS)


# ----------------------------------------------------------------------------------------------------- stacks


def test_a_stack_is_one_word_wherever_a_config_is_made(tmp_path):
    """Below what is set itself, above the presets; a null takes it off again."""
    found = load_config("pool", overrides=["stack=paper"])
    assert (
        found == load_config("pool", overrides={"stack": "paper"}) == with_stack(load_config("pool"), "paper")
    )
    assert found.voronoi.use == "fused" and found.world == load_config("pool").world
    mine = load_config("pool", overrides=["voronoi.use=static", "stack=paper"])
    assert mine.voronoi.use == "static" and mine.clearance.inflate_m == 0.08
    assert (
        load_training("smoke", ["stack=paper"]).clearance
        == found.clearance
        == load_training("paper").clearance
    )
    assert load_training("paper", ["stack=null"]).clearance == Config().clearance
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(load_config("pool")))
    assert loader.load_resolved(path, ["stack=paper"]) == found


def test_a_users_own_stack_extends_one(tmp_path):
    path = write(tmp_path, "extends: paper\ntree: planner\nvoronoi: {min_clearance_m: 0.5}\n")
    found = load_config("pool", overrides={"stack": path})
    assert (found.voronoi.use, found.voronoi.min_clearance_m) == ("fused", 0.5)
    assert loader.tree_of_stack(path) == "planner"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("world: {n_static: 0}\n", "mine.yaml:1: a stack cannot set 'world'"),
        ("observation: {n_track: 4}\n", "a stack cannot set 'observation'"),
        ("voronoi: {usee: fused}\n", "mine.yaml:1: unknown key 'voronoi.usee'; did you mean 'use'?"),
        ("extends: papr\n", "did you mean 'paper'"),
    ],
)
def test_a_bad_stack_is_named_with_its_line(tmp_path, text, says):
    with pytest.raises(ConfigError) as error:
        load_config("pool", overrides={"stack": write(tmp_path, text)})
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("value", "says"),
    [("papr", "did you mean 'paper'"), (3, "must be the name or path of a stack preset, got 3")],
)
def test_a_stack_that_does_not_exist_is_refused(value, says):
    with pytest.raises(ConfigError, match=says):
        load_config("pool", overrides={"stack": value})


def test_a_stack_that_is_to_drive_needs_a_tree(tmp_path):
    with pytest.raises(ConfigError, match="needs 'tree:'"):
        loader.tree_of_stack(write(tmp_path, "voronoi: {use: fused}\n"))


# ------------------------------------------------------------------------------------------------------- rows


def differing(config, base):
    """Dotted keys in which two configs differ."""
    a, b = config.model_dump(), base.model_dump()
    return {f"{section}.{key}" for section in a for key in a[section] if a[section][key] != b[section][key]}


def test_a_training_preset_names_presets_and_changes_them(tmp_path):
    write(tmp_path, "world: gauntlet\nsensors: nominal\ntrain: {num_envs: 2}\n", "base.yaml")
    config = load_training(write(tmp_path, "extends: base.yaml\nworld: {n_dynamic: 2}\n"))
    assert config.world == load_config("gauntlet", overrides={"world.n_dynamic": 2}).world
    assert config.sensors == load_config("pool", "nominal").sensors
    assert config.train.num_envs == 2
    moved = load_training(str(tmp_path / "mine.yaml"), ["train.num_envs=3"], world="maze", sensors="clean")
    assert moved.world == load_config("maze", overrides={"world.n_dynamic": 2}).world
    assert moved.sensors == load_config("pool", "clean").sensors
    assert moved.train.num_envs == 3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("world: {preset: pol}\n", "did you mean 'pool'"),
        (
            "world:\n  preset: 3\n",
            "mine.yaml:2: world.preset must be the name or path of a world preset, got 3",
        ),
        ("ppo:\n  gama: 1\n", "mine.yaml:2: unknown key 'ppo.gama'; did you mean 'gamma'?"),
        ("ppo:\n  lr: 1\n", "unknown key 'ppo.lr'; there are: rollout_steps, learning_rate"),
        ("learning_rate: 1\n", "'learning_rate'; there are: ppo.learning_rate, distillation.learning_rate"),
        ("distillation: {schedule: [[1, 0], [0, 1]]}\n", "shares not falling"),
        ("train: {seed: 500000}\n", "must differ from train.seed"),
        ("extends: constnt_20\n", "did you mean 'constant_20'"),
    ],
)
def test_a_bad_training_preset_is_named_with_its_line(tmp_path, text, says):
    with pytest.raises(ConfigError) as error:
        load_training(write(tmp_path, text))
    assert says in str(error.value)


# ------------------------------------------------------------------------------------ sizes, places, files

_BOX = "{kind: box, x_m: 5.0, y_m: 2.25, half_extents_m: [0.1, 2.25]}"
_ROUND = "{kind: cylinder, radius_m: 0.2, "


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", r"w\.yaml: is empty"),
        ("# only words\n", r"w\.yaml: is empty"),
        ("vehicle: {mass_kg: 11.0}", r"w\.yaml: is no world, .* give it as --vehicle"),
        ("sensors: {localization: truth}", r"w\.yaml: is no world, .* give it as --sensors"),
        ("world:\n  tank:\n    x_m: [0, 2000]", r"w\.yaml:2: world\.tank: .*2000 x 6 x 1\.6 m.*in metres"),
        ("world: {tank: {x_m: [0, 600], y_m: [0, 400]}}", r"40,000 m\^2"),
        ("world: {tank: {z_m: [-160, 0]}}", r"depth of 100 m"),
        (
            f"world:\n  fixed:\n  - {_BOX}\n  - {_ROUND}x_m: 50, y_m: 2}}",
            r"w\.yaml:4: world\.fixed\.1: \(50, 2\) is",
        ),
        (f"world: {{fixed: [{_ROUND}x_m: 5, y_m: -0.1}}]}}", r"world\.fixed\.0: .*outside the tank"),
        (f"world: {{fixed: [{_ROUND}x_m: 5, y_m: 2, z_m: 1}}]}}", r"fixed\.0\.z_m: 1 is outside the water"),
        (
            f"world: {{fixed: [{_ROUND}x_m: 5, y_m: 2, path: [{{x_m: 5, y_m: 2}}, {{x_m: 5, y_m: 20}}]}}]}}",
            r"world\.fixed\.0\.path\.1: \(5, 20\) is outside",
        ),
        ("world: {fixed: [{kind: cylinder, radius_m: 40, x_m: 5, y_m: 2}]}", r"fixed\.0: is larger than"),
        ("mapping: {cell_m: 0.001}\nworld: {n_static: 1}", r"w\.yaml:1: mapping\.cell_m: .* cells"),
    ],
)
def test_a_world_is_checked_before_anything_is_allocated(tmp_path, text, told):
    (tmp_path / "w.yaml").write_text(text)
    with pytest.raises(ConfigError, match=told):
        load_config(str(tmp_path / "w.yaml"))


def test_a_round_tank_has_no_corners():
    pen = {"shape": "circle", "x_m": [0, 16], "y_m": [0, 16], "z_m": [-6, 0]}
    corner = [{"kind": "cylinder", "radius_m": 0.1, "x_m": 1, "y_m": 1}]
    with pytest.raises(ConfigError, match="outside the tank"):
        load_config("netpen", overrides={"world.tank": pen, "world.fixed": corner})


def test_a_large_world_is_none_too_large():
    size = {"world.tank.x_m": [0, 200], "world.tank.y_m": [0, 100]}
    assert load_config("pool", overrides=size).world.tank.x_m == (0.0, 200.0)


def test_a_world_file_is_no_vehicle(tmp_path):
    (tmp_path / "w.yaml").write_text("world: {n_static: 1}")
    with pytest.raises(ConfigError, match=r"is no vehicle, .* give it as --world"):
        load_config("pool", vehicle=str(tmp_path / "w.yaml"))


def test_explicit_obstacles_count():
    assert load_config("maze").world.obstacles == {"S": 11, "D": 6, "fixed_static": 3, "fixed_moving": 0}


# ------------------------------------------------------------------------------------------ light vehicles

_SMALL = {
    "vehicle.mass_kg": 1.2,
    "vehicle.inertia_kg_m2": [0.003, 0.006, 0.006],
    "vehicle.added_mass": [0.5, 1.2, 1.4, 0.001, 0.001, 0.001],
}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (_SMALL, r"vehicle: roll .* would diverge.* 17 times as many episode\.substeps"),
        ({**_SMALL, "episode.substeps": 20}, "roll .* would diverge"),
        ({**_SMALL, "episode.substeps": 40}, None),
        ({"vehicle.mass_kg": 1.2}, None),
        ({"vehicle.linear_damping": [4.0, 6.0, 6000.0, 0.1, 0.1, 0.1]}, "heave .* would diverge"),
        ({"vehicle.mass_kg": 0.01, "vehicle.added_mass": [0] * 6}, "heave .* would diverge"),
    ],
)
def test_a_vehicle_that_cannot_be_integrated_is_refused(changes, told):
    if told is None:
        load_config("pool", overrides=changes)
        return
    with pytest.raises(ConfigError, match=told):
        load_config("pool", overrides=changes)


def test_every_shipped_vehicle_can_be_integrated_in_twice_the_substep():
    for vehicle in preset_names("vehicle"):
        load_config("pool", vehicle=vehicle, overrides={"episode.substeps": 1})
