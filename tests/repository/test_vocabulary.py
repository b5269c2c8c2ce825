"""One word for one thing: names and phrases that have a better one are refused wherever they are read."""

import re
import subprocess
from pathlib import Path

import pytest

from uuvtai.config.behavior import BehaviorConfig
from uuvtai.config.learning import LearningConfig
from uuvtai.config.loader import RENAMED, ConfigError, load_config, load_training
from uuvtai.evaluation.failure_causes import CAUSES
from uuvtai.learning.checkpoint import CheckpointError, refused

ROOT = Path(__file__).resolve().parents[2]
NAMES = {
    # who drives: agents and plugins
    r"MethodRuns?\b|methods_of\b|method_(?:inks|colours)\b": "agent",
    r"(?<=[\"'])methods?[\"']": "agent",
    r"Drivers?Group\b|driver_for\b|drivers_of\b|OwnDriver\b": "agent",
    r"(?:Set|Tuned|Wave|_Trial)Pilot\b|PilotDecision\b|load_(?:set_)?pilot\b": "agent",
    r"Piece(?:Error|Spec|View)\b|OwnPiece\b|is_piece\b|piece_spec\b": "plugin",
    r"at the wheel\b|entrants?\b": "who drives: an agent",
    # sections and their keys
    r"teacher_cfg\b|Teacher(?:Config|State|IO)\b|(?<![\w/])teacher\.[a-z]+_[a-z]": "behavior",
    r"twin_cfg\b|Twin(?:Config|Rules|Trainer|View)\b|twin\.[a-z]": "surrogate",
    r"Tuner\w+|tuner\b": "parameter_search",
    r"ForecasterConfig\b|forecasters?\b": "forecast_training, forecast network",
    r"DistillConfig\b|distill\.[a-z]|distill_(?:lambda|weight)\b": "distillation",
    r"PoseConfig\b|pose_cfg\b": "localization",
    r"ElevationConfig\b|elevation_cfg\b|elevation\.(?:column_share|use_camera)": "height",
    r"SpottingConfig\b|spotting_cfg\b|spotting\.[a-z]": "camera_tracking",
    r"FeaturesConfig\b|features_cfg\b|features\.(?:n_track|n_sector|ttc_cap_s)\b": "observation",
    r"body_doubt\b": "obstacle_growth",
    r"body_returns_per_m\b": "obstacle_returns_per_m",
    r"weight_body\b": "weight_obstacle",
    r"gaze\w*\b": "heading",
    r"askew\w*\b": "sideslip",
    r"softness\b": "temperature",
    r"heed_share\b": "evade_probability",
    r"calm_(?:s|steps)\b": "hysteresis_s",
    r"(?:use|learn|forget)_habits?\b|HabitState\b|habits\b": "turn history",
    # the world and the rows of a simulator
    r"bodies\b|(?:moving|static|resting|nearest) body\b(?! (?:frame|ax))": "obstacles",
    r"resting (?:bod|obstacle)": "static",
    r"[Yy]ardsticks?\b|PrivilegedStages\b": "oracle",
    r"[Rr]eferee\b|RefereeState\b": "termination",
    r"[Ll]edger\w*": "journal",
    r"awake\b|n_awake\b": "active",
    r"shipped\b|SHIPPED\b": "built-in",
    r"write_film\b|films?\b": "video",
    r"play_episodes\b|episodes? (?:is|are|was|were) played\b": "run",
    r"ENDINGS\b": "outcomes",
    # causes of failures
    r"unseen_(?:below|above|beside)\b": "undetected_...",
    r"start_in_danger\b": "no_escape_at_start",
    r"kept_away\b": "blocked_by_traffic",
    r"wrong_evasion\b": "failed_evasion",
    r"forecast_missed\b": "prediction_error",
    r"(?:pushed_into_static|squeezed_by_static)\b": "evaded_into_static, blocked_by_static",
    r"seen_late\b|unannounced_turn\b|depth_misjudged\b|lost_place\b": "see CAUSES",
}
"""what is refused, from the beginning of a word on -> what to say"""
FOLDERS = ("uuvtai", "docs", "examples", "benchmarks", "README.md", "CONTRIBUTING.md")
TABLE = re.compile(r"(?ms)^RENAMED = \{.*?^\}")
"""the one place where old keys stand: they are refused by it"""


def files():
    """Files that people read: code, presets, pages, results."""
    listed = subprocess.run(
        ["git", "-C", ROOT, "ls-files", "--", *FOLDERS], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    read = (".py", ".md", ".yaml", ".xml", ".json", ".j2", ".csv", ".ipynb")
    return [name for name in listed if name.endswith(read) and not name.startswith("benchmarks/results/")]


def test_names_that_have_a_better_one_are_nowhere():
    found, wrong = [], re.compile(rf"\b(?:{'|'.join(NAMES)})")
    for name in files():
        text = TABLE.sub("", (ROOT / name).read_text(encoding="utf-8"))
        for m in wrong.finditer(text):
            right = next(right for one, right in NAMES.items() if re.compile(one).match(text, m.start()))
            found.append(f"{name}:{text.count(chr(10), 0, m.start()) + 1}: {m[0]!r}: say {right}")
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("teacher.softness", "behavior.temperature"),
        ("behavior.body_doubt", "behavior.obstacle_growth"),
        ("features.teacher", "observation.behavior"),
        ("pose.use_walls", "localization.use_walls"),
        ("behavior.edge_sigmas", "behavior.place_sigmas"),
    ],
)
def test_an_old_key_is_refused_with_its_new_name(old, new):
    with pytest.raises(ConfigError, match=f"'{old}'; renamed to '{new}'"):
        load_config("pool", overrides={old: 1})


def test_old_keys_of_a_training_and_of_a_stack_too(tmp_path):
    with pytest.raises(ConfigError, match=r"'tuner.scenes'; renamed to 'parameter_search.scenes'"):
        load_training("smoke", overrides={"tuner.scenes": []})
    (tmp_path / "old.yaml").write_text("teacher: {cruise_m_s: 0.6}\n")
    with pytest.raises(ConfigError, match="cannot set 'teacher'; renamed to 'behavior'"):
        load_config("pool", overrides={"stack": str(tmp_path / "old.yaml")})


def test_an_old_checkpoint_is_refused_with_the_new_name(tmp_path):
    with pytest.raises(CheckpointError, match=r"twin: .*; renamed to 'surrogate'"), refused(tmp_path / "m"):
        LearningConfig.model_validate_json('{"twin": {}}', strict=True)


def test_the_table_of_old_keys_leads_to_keys_that_there_are():
    keys = {*LearningConfig.model_fields, *BehaviorConfig.model_fields, "use_turn_history", "weight_obstacle"}
    keys |= {"obstacle_hidden", "obstacle_returns_per_m"}
    assert set(RENAMED.values()) <= keys and not set(RENAMED) & set(LearningConfig.model_fields)


def test_causes_need_no_legend():
    assert all(re.fullmatch(r"[a-z]+(?:_[a-z]+)*", label) for label in CAUSES) and len(CAUSES) == 34
