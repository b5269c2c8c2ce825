"""``uuv presets``: a sentence for each, what one states with its comments, and every key that it gives."""

import json

import pytest
import yaml

from tests.command import uuv
from uuvtai.common.presets import KINDS, built_in_file, preset_names
from uuvtai.console.views import near, sentences


def test_the_list_has_every_preset_with_its_sentence(capfd):
    code, out, _ = uuv(capfd, "presets")
    assert code == 0
    answer = " ".join(out.split())
    for kind, found in sentences().items():
        assert list(found) == preset_names(kind)
        for name, said in found.items():
            assert f"{name} {said}" in answer
    code, out, _ = uuv(capfd, "presets", "--json")
    assert code == 0 and json.loads(out) == sentences()


@pytest.mark.parametrize("kind", KINDS)
def test_show_prints_what_a_preset_states_with_units_and_sources(kind, capfd):
    for name in preset_names(kind):
        code, out, err = uuv(
            capfd, "presets", "show", f"{kind}/{name}", *(["--all"] if kind == "tree" else [])
        )
        assert code == 0, err
        assert out == built_in_file(kind, name).read_text().rstrip("\n") + "\n"
        extends = "extends:" in out and kind != "tree"
        assert ("it changes these keys of" in err) == extends


@pytest.mark.parametrize("kind", ["world", "sensors", "vehicle", "train", "grid"])
def test_json_of_show_holds_what_the_file_states(kind, capfd):
    name = preset_names(kind)[0]
    _, out, _ = uuv(capfd, "presets", "show", f"{kind}/{name}", "--json")
    assert json.loads(out) == yaml.safe_load(built_in_file(kind, name).read_text())


def test_all_prints_every_key_with_defaults_and_what_it_builds_on(capfd):
    _, out, _ = uuv(capfd, "presets", "show", "gauntlet", "--all")
    whole = yaml.safe_load(out)
    assert whole["world"]["n_dynamic"] == 6 and "tank" in whole["world"] and "sonar" in whole["sensors"]
    _, own, _ = uuv(capfd, "presets", "show", "gauntlet", "--json")
    assert "tank" not in json.loads(own)["world"]
    _, out, _ = uuv(capfd, "presets", "show", "train/ppo", "--all", "--json")
    assert json.loads(out)["ppo"]["rollout_steps"] == 64, "from the preset below the preset below it"
    _, out, _ = uuv(capfd, "presets", "show", "grid/paper", "--all")
    assert yaml.safe_load(out)["axes"]["S"] == [4, 8, 12]
    _, out, _ = uuv(capfd, "presets", "show", "tree/bt", "--all")
    assert "BTCPP_format" in out


def test_a_file_of_ones_own_is_shown(capfd, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("# mine\nextends: pool  # the base\nworld: {n_dynamic: 3}\n\x1b[2J")
    code, out, _ = uuv(capfd, "presets", "show", str(mine))
    assert code == 2 or "\x1b" not in out
    mine.write_text("# mine\nextends: pool  # the base\nworld: {n_dynamic: 3}\n")
    code, out, err = uuv(capfd, "presets", "show", str(mine))
    assert code == 0 and "# the base" in out and "changes these keys of pool" in err
    _, out, _ = uuv(capfd, "presets", "show", str(mine), "--all")
    assert "n_dynamic: 3" in out and "n_static: 8" in out


def test_a_world_of_ones_own_is_checked_and_drawn_beside_it(capfd, tmp_path):
    mine, picture = tmp_path / "mine.yaml", tmp_path / "mine.world.png"
    mine.write_text("extends: pool\nworld: {n_dynamic: 3, polygons: [[[5, 2], [6, 2], [6, 3]]]}\n")
    for _ in range(2):
        code, _, err = uuv(capfd, "presets", "show", str(mine))
        lines = err.splitlines()
        assert code == 0 and lines[1] == "20 x 6 m, 1.6 m deep; a map of 200 x 60 cells of 0.1 m"
        assert lines[2].startswith("obstacles: 3 fixed; drawn anew in each episode 8 static, 3 dynamic")
        assert lines[4:] == [
            "vehicle bluerov2, sensors paper",
            f"picture: {picture}",
            f"next: uuv eval --world {mine} --agent bt --episodes 8 --record 1 --report",
        ]
        assert picture.read_bytes()[1:4] == b"PNG"
    picture.unlink()
    mine.write_text("extends: pool\nworld: {start_goal_gap_m: 30}\n")
    code, out, err = uuv(capfd, "presets", "show", str(mine))
    assert code == 2 and "start_goal_gap_m: 30" in out and "no episode can begin" in err.splitlines()[-1]
    assert picture.exists(), "it shows why"
    mine.write_text("extends: pool\nworld: {n_dynamics: 3}\n")
    code, out, err = uuv(capfd, "presets", "show", str(mine))
    assert code == 2 and "n_dynamics: 3" in out and "mine.yaml:2: unknown key 'world.n_dynamics'" in err


def test_out_is_of_a_world_and_overwrites_nothing(capfd, tmp_path):
    out = tmp_path / "pool.png"
    assert uuv(capfd, "presets", "show", "pool", "--out", str(out))[0] == 0 and out.exists()
    code, _, err = uuv(capfd, "presets", "show", "pool", "--out", str(out))
    assert code == 2 and "is already there" in err
    assert uuv(capfd, "presets", "show", "pool", "--out", str(out), "--force")[0] == 0
    code, _, err = uuv(capfd, "presets", "show", "pool", "--out", str(tmp_path / "pool.svg"))
    assert code == 2 and ".png" in err
    for more in (["pool", "--json"], ["pool", "--all"], ["bt"]):
        code, _, err = uuv(capfd, "presets", "show", *more, "--out", str(tmp_path / "new.png"))
        assert code == 2 and "--out: is of the picture of a world" in err


def test_a_vehicle_of_ones_own_is_shown_as_it_is(capfd, tmp_path):
    mine = tmp_path / "rov.yaml"
    mine.write_text("extends: bluerov2\nvehicle: {mass_kg: 12.0}\n")
    code, out, err = uuv(capfd, "presets", "show", str(mine))
    assert code == 0 and "mass_kg: 12.0" in out and "picture" not in err
    assert not mine.with_suffix(".world.png").exists()


def test_the_nearest_name_of_any_kind_is_meant():
    assert near("gauntlt") == "; did you mean 'gauntlet' (world)?"
    assert near("nominl") == "; did you mean 'nominal' (sensors)?"
    assert near("constant_2") == "; did you mean 'constant_20' (train)?"
    assert near("zzzzzz") == ""
