"""Tables of README and the page of results say what the committed results say; whatever differs is caught."""

import json
import random
import shlex
import shutil

import pytest

from benchmarks.digest import digest
from docs import render_results
from docs.render_results import (
    BENCHMARKS,
    EVALUATIONS,
    README,
    REPRODUCTION,
    RESULTS,
    ROBUSTNESS,
    ROOT,
    SWEEPS,
)
from tests.evaluation.test_reproduce import cell, ended, minimal
from tests.repository.test_docs import fault
from uuvtai.evaluation import claims
from uuvtai.evaluation.agents import load_agents
from uuvtai.evaluation.claims import Share
from uuvtai.evaluation.reproduce import claims_of, results_page
from uuvtai.evaluation.reproduce_steps import EVALUATION_SEED, RETIRED_SEEDS
from uuvtai.evaluation.results import ORACLE


def test_the_pages_are_those_of_the_results(monkeypatch, capsys):
    found = render_results.differences()
    assert not found, "\n".join(["`python -m docs.render_results` renews the pages:", *found])
    for told, code in ((found, 0), (["a line"], 1)):
        monkeypatch.setattr(render_results, "differences", lambda told=told: told)
        assert render_results.main(["--check"]) == code
    for page, wanted in render_results.TABLES.items():
        tables = render_results.TABLE.findall((ROOT / page).read_text())
        assert [name for _head, name, _body, _foot in tables] == list(wanted)


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """Pages and results in a folder of their own."""
    for name in ("docs/data", BENCHMARKS):
        shutil.copytree(ROOT / name, tmp_path / name)
    for name in (*render_results.TABLES, RESULTS):
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


CELLS = [
    (README, "| `pool`, 6 at 0.6 m/s | ", "| `pool`, 6 at 0.6 m/s | 1"),
    (README, "of seed 9001", "of seed 8001"),
    (ROBUSTNESS, "| `pool` (6, 0.6) | ", "| `pool` (6, 0.6) | 1"),
    (RESULTS, "| does not hold |", "| holds |"),
    (ROBUSTNESS, "503/512 = 98.2 %", "512/512 = 100.0 %"),
    (ROBUSTNESS, "| `paper` | ", "| `paper` | 1"),
    (render_results.SPEEDS, "| `tick` | tree ticks, 22 nodes | ", "| `tick` | tree ticks, 22 nodes | 1"),
]


def test_cells_that_were_changed_by_hand_are_caught(copy):
    for page, before, changed in CELLS:
        text = (copy / page).read_text()
        assert before in text
        (copy / page).write_text(text.replace(before, changed, 1))
    found = "\n".join(render_results.differences(copy))
    assert all(changed in found and before in found for _page, before, changed in CELLS)


def test_results_that_move_on_leave_the_pages_behind(copy):
    document = json.loads((copy / EVALUATIONS).read_text())
    document["rows"][1]["agents"]["bt"]["outcomes"] |= {"success": 999, "collision": 1}
    (copy / EVALUATIONS).write_text(json.dumps(document))
    assert "+| `pool` (6, 0.6) | 999/1000 = 99.9 %" in "\n".join(render_results.differences(copy))
    document = json.loads((copy / REPRODUCTION).read_text())
    speed = document[min(document)]["profile"]["rows"][0]["env_steps_per_s"]
    speed["step"] = 7777.0
    (copy / REPRODUCTION).write_text(json.dumps(document))
    assert any("| 7,777 |" in line for line in render_results.differences(copy))


def test_a_seed_that_was_tuned_on_is_called_so(copy):
    document = json.loads((copy / EVALUATIONS).read_text())
    for seed, said in ((EVALUATION_SEED, "No tuning used this seed"), (90008, "was looked at while tuning")):
        (copy / EVALUATIONS).write_text(json.dumps(document | {"seed": seed}))
        assert said in render_results.measured(copy)
        assert "2026-11-30, commits 95ec97f, b96314c, c0daae9, d753341." in render_results.measured(copy)


def test_the_newest_speed_of_a_kind_is_shown_and_marked_unless_it_is_of_todays_code(copy):
    new = json.loads(next((copy / BENCHMARKS).glob("*_cpu_tick.json")).read_text())
    new |= {"date": "2099-12-01T00:00:00+0000", "commit": "abcdef0123"}
    for kept, mark in ((digest("tick"), ""), ("0" * 12, "*"), (None, "*")):
        (copy / BENCHMARKS / "2099-12-01_cpu_tick.json").write_text(json.dumps(new | {"digest": kept}))
        rows = [line for line in render_results.speeds(copy).splitlines() if line.startswith("| `tick` |")]
        assert rows and all(f"| 2099-12-01 | abcdef0{mark} | cpu |" in row for row in rows)


def test_a_sweep_is_kept_with_the_end_of_every_episode(copy, tmp_path):
    """Then rates over many cells have an interval, by episode number."""
    cells = [
        {"S": 8, "D": d, "v_m_s": v, "agent": "bt", "episodes": 40, "time_to_success_mean_s": 9.0,
         "outcomes": {"success": 39, "collision": 0, "ttc": 1, "out_of_tank": 0, "timeout": 0},
         "episode_outcomes": ["ttc", *["success"] * 39]}
        for d, v in ((0, None), (9, 0.6), (9, 1.5))
    ]  # fmt: skip
    document = {"axes": {"S": [8], "D": [0, 9], "v": [0.6, 1.5]}, "seeds": [7], "episodes_per_seed": 40}
    (tmp_path / "sweep.json").write_text(json.dumps(document | {"cells": cells}))
    record = {"git_sha": "abc", "started": "today", "hardware": {"cpu": "a"}}
    record["argv"] = ["uuv", "sweep", "--agent", "bt", "--run-dir", "runs/a b", "--json"]
    (tmp_path / "run.json").write_text(json.dumps(record))
    render_results.keep_sweep("pool", tmp_path, copy)
    kept = json.loads((copy / render_results.SWEEPS).read_text())["pool"]
    assert (kept["commit"], kept["command"]) == ("abc", "uuv sweep --agent bt")
    low, high = Share(39, 40).interval
    assert f"`bt` | 117/120 = 97.5 % [{100 * low - 1:.0f}" in render_results.grid(copy), (low, high)
    with pytest.raises(KeyError):
        render_results.keep_sweep("puddle", tmp_path, copy)


def test_every_row_says_how_its_agents_can_be_evaluated_again():
    for row in json.loads((ROOT / EVALUATIONS).read_text())["rows"]:
        first, *words = shlex.split(row["command"])
        assert first == "uuv" and fault(words) is None
        named = [words[i + 1] for i, word in enumerate(words) if word == "--agent"]
        assert named == list(row["agents"]), "those that were removed since, too, are left out"
        load_agents([name for name in named if name != ORACLE])
    for sweep in json.loads((ROOT / SWEEPS).read_text()).values():
        assert fault(shlex.split(sweep["command"])[1:]) is None


def test_the_pages_agree_on_what_a_seed_is_for():
    """What a page calls untouched no other page may call a seed for tuning."""
    said = " ".join((ROOT / "docs/evaluate.md").read_text().split())
    kept = json.loads((ROOT / EVALUATIONS).read_text())["seed"]
    assert f"nobody has tuned on: {kept} (README" in said and f"{EVALUATION_SEED} ([results]" in said
    tuned = f"90001 to {RETIRED_SEEDS[-1]}"
    assert f"and {tuned}." in said and f"1234, {tuned} (" in (ROOT / "research/LOG.md").read_text()


def evaluation(folder, n=1000):
    """A run folder as ``uuv eval`` leaves it."""
    ends = {"success": n - 3, "collision": 1, "ttc": 1, "out_of_tank": 0, "timeout": 1}
    agent = {"name": "bt", "episodes": n, "outcomes": ends, "time_mean_s": 9.0, "time_to_success_mean_s": 9.0}
    agent |= {"causes": [{"label": "late_reaction", "count": 3, "share": 1.0}], "episodes_detail": [{}] * n}
    (folder / "eval").mkdir(parents=True)
    (folder / "eval/result.json").write_text(json.dumps({"agents": [agent], "paired": []}))
    (folder / "run.json").write_text(json.dumps({"git_sha": "abc", "started": "today", "hardware": {}}))
    return folder


def test_an_evaluation_is_kept_in_its_row_alone(copy, tmp_path):
    before = json.loads((copy / EVALUATIONS).read_text())
    render_results.keep_row("pool_6", evaluation(tmp_path / "run"), copy)
    after = json.loads((copy / EVALUATIONS).read_text())
    others = [nth for nth in range(len(before["rows"])) if nth != 1]
    assert all(after["rows"][nth] == before["rows"][nth] for nth in others)
    agents = after["rows"][1]["agents"]
    assert agents["bt"]["commit"] == "abc" and "episodes_detail" not in agents["bt"]
    assert agents["best"] == before["rows"][1]["agents"]["best"]
    assert all("bt" not in (pair["a"], pair["b"]) for pair in after["rows"][1]["paired"])
    assert (
        "| `pool` (6, 0.6) | 997/1000 = 99.7 % [99.1, 99.9] | 0.2 % [0.1, 0.7] | 1/1/0/1 |"
        in (render_results.pages(copy)[ROBUSTNESS])
    )
    with pytest.raises(ValueError, match="there are pool_0"):
        render_results.keep_row("pol_0", tmp_path / "run", copy)
    with pytest.raises(ValueError, match="bt: not 1000 episodes"):
        render_results.keep_row("pool_0", evaluation(tmp_path / "short", 10), copy)


def test_reproductions_are_kept_small_and_make_the_page_that_they_made(copy, tmp_path):
    draws, found = random.Random(4), []
    for budget in ("tenfold", "paper"):
        words = ["".join(draws.choices("scxot", (75, 15, 5, 1, 4), k=500)) for _ in range(11)]
        own = [ended(word, trained_steps=614_912, return_mean=3.0) for word in words]
        document = minimal() | {"budget": budget, "sections": [{}]}
        document["mechanism"] = {"paper": [claims.training_facts([], 2.0)]}
        document |= {"table_main": {"paper": own[:5], "ppo": own[5:10], "bt": own[10:]}}
        if budget == "paper":
            document["sweep"] = {"cells": [cell(8, 6, v, success=90, collision=5) for v in (0.6, 1.5)]}
            document["sweep"]["cells"] += [one | {"agent": "paper-0"} for one in document["sweep"]["cells"]]
            document["transfer"] = {"agents": [own[0] | {"name": "paper-0"}]}
        document["claims"] = [vars(claim) for claim in claims_of(document)]
        found = [document, *found]
        (tmp_path / "reproduce.json").write_text(json.dumps(document))
        render_results.keep_reproduction(tmp_path, copy)
    assert render_results.pages(copy)[RESULTS] == results_page(*found)
    assert json.loads((copy / REPRODUCTION).read_text()).keys() == {"paper", "tenfold"}
    assert (copy / REPRODUCTION).stat().st_size < 22 * 500, "less than a letter an episode"


def test_a_folder_that_is_no_run_is_refused(tmp_path, capsys):
    assert render_results.main(["--keep", str(tmp_path)]) == 1
    assert "not kept" in capsys.readouterr().err
