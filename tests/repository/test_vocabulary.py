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
    r"\bMethodRuns?\b|\bmethods_of\b|\bmethod_(?:inks|colours)\b": "agent",
    r"[\"']methods?[\"']": "agent",
    r"\bDrivers?Group\b|\bdriver_for\b|\bdrivers_of\b|\bOwnDriver\b": "agent",
    r"\b(?:Set|Tuned|Wave|_Trial)Pilot\b|\bPilotDecision\b|\bload_(?:set_)?pilot\b": "agent",
    r"\bPiece(?:Error|Spec|View)\b|\bOwnPiece\b|\bis_piece\b|\bpiece_spec\b": "plugin",
    r"\bat the wheel\b|\bentrants?\b": "who drives: an agent",
    # sections and their keys
    r"\bteacher_cfg\b|\bTeacher(?:Config|State|IO)\b|(?<![\w/])teacher\.[a-z]+_[a-z]": "behavior",
    r"\btwin_cfg\b|\bTwin(?:Config|Rules|Trainer|View)\b|\btwin\.[a-z]": "surrogate",
    r"\bTuner\w+|\btuner\b": "parameter_search",
    r"\bForecasterConfig\b|\bforecasters?\b": "forecast_training, forecast network",
    r"\bDistillConfig\b|\bdistill\.[a-z]|\bdistill_(?:lambda|weight)\b": "distillation",
    r"\bPoseConfig\b|\bpose_cfg\b": "localization",
    r"\bElevationConfig\b|\belevation_cfg\b|\belevation\.(?:column_share|use_camera)": "height",
    r"\bSpottingConfig\b|\bspotting_cfg\b|\bspotting\.[a-z]": "camera_tracking",
    r"\bFeaturesConfig\b|\bfeatures_cfg\b|\bfeatures\.(?:n_track|n_sector|ttc_cap_s)\b": "observation",
    r"\bbody_doubt\b": "obstacle_growth",
    r"\bbody_returns_per_m\b": "obstacle_returns_per_m",
    r"\bweight_body\b": "weight_obstacle",
    r"\bgaze\w*\b": "heading",
    r"\baskew\w*\b": "sideslip",
    r"\bsoftness\b": "temperature",
    r"\bheed_share\b": "evade_probability",
    r"\bcalm_(?:s|steps)\b": "hysteresis_s",
    r"\b(?:use|learn|forget)_habits?\b|\bHabitState\b|\bhabits\b": "turn history",
    # the world and the rows of a simulator
    r"\bbodies\b|\b(?:moving|static|resting|nearest) body\b(?! (?:frame|ax))": "obstacles",
    r"\bresting (?:bod|obstacle)": "static",
    r"\b[Yy]ardsticks?\b|\bPrivilegedStages\b": "oracle",
    r"\b[Rr]eferee\b|\bRefereeState\b": "termination",
    r"\b[Ll]edger\w*": "journal",
    r"\bawake\b|\bn_awake\b": "active",
    r"\bshipped\b|\bSHIPPED\b": "built-in",
    r"\bwrite_film\b|\bfilms?\b": "video",
    r"\bplay_episodes\b|\bepisodes? (?:is|are|was|were) played\b": "run",
    r"\bENDINGS\b": "outcomes",
    # causes of failures
    r"\bunseen_(?:below|above|beside)\b": "undetected_...",
    r"\bstart_in_danger\b": "no_escape_at_start",
    r"\bkept_away\b": "blocked_by_traffic",
    r"\bwrong_evasion\b": "failed_evasion",
    r"\bforecast_missed\b": "prediction_error",
    r"\b(?:pushed_into_static|squeezed_by_static)\b": "evaded_into_static, blocked_by_static",
    r"\bseen_late\b|\bunannounced_turn\b|\bdepth_misjudged\b|\blost_place\b": "see CAUSES",
}
"""what is refused -> what to say"""
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
    found = []
    for name in files():
        text = (ROOT / name).read_text(encoding="utf-8")
        text = TABLE.sub("", text)
        for wrong, right in NAMES.items():
            found += [
                f"{name}:{text.count(chr(10), 0, m.start()) + 1}: {m[0]!r}: say {right}"
                for m in re.finditer(wrong, text)
            ]
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
