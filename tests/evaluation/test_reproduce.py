"""A reproduction: verdicts by hand, steps that are done once, and a page with every number."""

import json
import math
import random

import pytest

from tests.command import Quiet
from tests.report_samples import robustness_sweep
from uuvtai.common.presets import preset_names
from uuvtai.evaluation import claims, reproduce_steps
from uuvtai.evaluation import reproduce as paper_run
from uuvtai.evaluation.claims import FAILS, HOLDS, OPEN, Share
from uuvtai.evaluation.reproduce import _sweep_lines, reproduce, results_page, resume
from uuvtai.logs.run_folder import RunFolderError
from uuvtai.report.tables import text_table


def alone(finding):
    """The verdict of a claim that is the only one."""
    return claims.judged([claims.claim("", "", "", finding)])[0].verdict


def entry(success, n=100, collision=0, time_s=10.0, **more):
    outcomes = {
        "success": success, "collision": collision, "ttc": 0, "out_of_tank": 0,
        "timeout": n - success - collision,
    }  # fmt: skip
    return {
        "episodes": n, "outcomes": outcomes, "time_mean_s": time_s, "time_to_success_mean_s": time_s,
    } | more  # fmt: skip


@pytest.mark.parametrize(
    ("a", "b", "verdict"),
    [
        ((90, 100), (20, 100), HOLDS),
        ((20, 100), (90, 100), FAILS),
        ((50, 100), (45, 100), OPEN),
        ((0, 0), (5, 10), OPEN),
    ],
)
def test_larger_needs_more_than_chance(a, b, verdict):
    assert alone(claims.larger(Share(*a), Share(*b))) == verdict


def test_a_printed_value_is_reached_missed_or_open():
    assert alone(claims.at_least(Share(95, 100), 0.828)) == HOLDS
    assert alone(claims.at_least(Share(83, 100), 0.828)) == OPEN, "the interval holds it"
    assert alone(claims.at_least(Share(60, 100), 0.828)) == FAILS
    assert alone(claims.at_most(Share(0, 1000), 0.011)) == HOLDS
    assert alone(claims.at_most(Share(0, 20), 0.011)) == OPEN, (
        "twenty episodes without a collision prove nothing"
    )
    assert alone(claims.at_most(Share(4, 512), 0.011)) == OPEN, (
        "0.8 % of 512 is not below 1.1 %: its interval holds that"
    )
    assert alone(claims.at_most(Share(20, 100), 0.011)) == FAILS


def test_coming_near_allows_ten_points():
    assert alone(claims.near(Share(480, 500), Share(490, 500))) == HOLDS
    assert alone(claims.near(Share(4, 8), Share(8, 8))) == OPEN, "eight episodes prove nothing"
    assert alone(claims.near(Share(197, 200), Share(8, 8))) == OPEN, "neither do eight to compare with"
    assert alone(claims.near(Share(300, 500), Share(490, 500))) == FAILS
    # by hand: 481/502 and 491/502, z = (0.9582 - 0.9781 + 0.1) / sqrt(0.9582 0.0418 / 502 + 0.9781 0.0219 /
    # 502)
    z = (481 / 502 - 491 / 502 + 0.1) / math.sqrt((481 * 21 + 491 * 11) / 502**3)
    assert claims.near(Share(480, 500), Share(490, 500)).p == pytest.approx(math.erfc(z / math.sqrt(2)))


def test_a_ratio_is_tested_on_its_logarithm():
    assert alone(claims.times_as_large(Share(870, 1000), Share(200, 1000), 3.5)) == HOLDS
    assert alone(claims.times_as_large(Share(87, 100), Share(24, 100), 3.5)) == OPEN, (
        "3.6 times, but of a hundred"
    )
    assert alone(claims.times_as_large(Share(300, 1000), Share(200, 1000), 3.5)) == FAILS
    assert claims.times_as_large(Share(5, 10), Share(0, 10), 3.5) == claims.Finding(OPEN, None)
    z = math.log(4.35 / 3.5) / math.sqrt(0.13 / 870 + 0.8 / 200)
    assert claims.times_as_large(Share(870, 1000), Share(200, 1000), 3.5).p == pytest.approx(
        math.erfc(z / math.sqrt(2))
    )


def test_holm_decides_over_the_whole_list():
    """Of 0.01, 0.02, 0.03, 0.04 only the first decides together (4 x 0.01, then 3 x 0.02)."""
    found = [claims.Claim(str(p), "", "", HOLDS, p) for p in (0.03, 0.01, None, 0.04, 0.02)]
    answer = claims.judged(found)
    assert [c.verdict for c in answer] == [OPEN, HOLDS, HOLDS, OPEN, OPEN]
    assert [c.p_holm for c in answer] == pytest.approx([0.06, 0.04, None, 0.06, 0.06])
    assert [c.p for c in answer] == [0.03, 0.01, None, 0.04, 0.02]


def verdicts(found):
    return {claim.text: claim.verdict for claim in found}


def test_claims_of_table_main_by_hand():
    table_main = {
        "ppo": [entry(20, collision=40, time_s=22.84)],
        "distill_20": [entry(46, collision=20)],
        "curriculum": [entry(87, collision=10, time_s=11.41)],
        "bt": [entry(80, collision=10)],
        "no_risk_scaling": [entry(86)],
        "no_world_model": [entry(30)],
    }
    found = claims.judged(claims.of_table_main(table_main))
    assert [claim.verdict for claim in found] == [HOLDS, OPEN, HOLDS, HOLDS, HOLDS, HOLDS, OPEN, HOLDS]
    assert "13.1 s against 114.2 s" in [claim.ours for claim in found]
    swapped = claims.judged(
        claims.of_table_main(table_main | {"ppo": table_main["curriculum"], "curriculum": table_main["ppo"]})
    )
    assert [claim.verdict for claim in swapped[:6]] == [FAILS] * 6


def test_who_never_arrives_takes_for_ever():
    arriving, never = [entry(87, time_s=11.0)], [entry(0, collision=100, time_s=5.0)]
    table_main = dict.fromkeys(("distill_20", "bt", "no_risk_scaling", "no_world_model"), arriving)
    assert claims.of_table_main(table_main | {"curriculum": arriving, "ppo": never})[4].verdict == HOLDS
    assert claims.of_table_main(table_main | {"curriculum": never, "ppo": arriving})[4].verdict == FAILS
    assert claims.of_table_main(table_main | {"curriculum": never, "ppo": never})[4].verdict == FAILS


def ended(word, **more):
    """An entry whose episodes ended so, a letter each."""
    return entry(word.count("s"), n=len(word), collision=word.count("c")) | {"ends": word} | more


def test_entries_of_the_same_episodes_count_by_episode_number():
    alike, apart = [ended("sssc" * 10)] * 4, [ended("sssc" * 10), ended("cs" * 20), ended("csss" * 10)]
    assert claims.pooled(alike[:1], "success").interval == Share(30, 40).interval
    four = claims.pooled(alike, "success")
    assert (four.k, four.n, four.counts()) == (120, 160, (27, 36)), "four times the same say hardly more"
    assert claims.pooled(apart, "success").design < 1.5
    for form in (
        {"episode_outcomes": ["success", "success", "success", "collision"] * 10},
        {"episodes_detail": [{"seed": 1, "episode": i, "outcome": "collision" if i % 4 == 3 else "success"}
         for i in range(40)]},
    ):  # fmt: skip
        told = [{k: v for k, v in e.items() if k != "ends"} | form for e in alike]
        assert claims.pooled(told, "success") == four


def test_the_same_episodes_again_decide_nothing():
    """Tests over a grid that count each cell for itself would decide all of these."""
    word = "s" * 29 + "c"
    once, often = claims.pooled([ended(word)], "success"), claims.pooled([ended(word)] * 32, "success")
    for test in (claims.at_least, claims.at_most):
        assert test(Share(often.k, often.n), 0.9).p < 1e-9 and test(often, 0.9).p > 0.1
    other = claims.pooled([ended("s" * 27 + "ccc")] * 32, "success")
    assert claims.larger(Share(often.k, often.n), Share(other.k, other.n)).p < 1e-6
    assert claims.larger(often, other).p == pytest.approx(claims.larger(once, Share(27, 30)).p, rel=0.3)
    assert claims.near(other, often).p > 0.1 > claims.near(Share(other.k, other.n), Share(often.k, often.n)).p


def test_episodes_that_were_not_kept_allow_neither_interval_nor_test():
    lost = claims.pooled([entry(50), entry(70, n=200)], "success")
    assert str(lost) == "120/300 = 40.0 %" and lost.interval is None and lost.counts() is None
    found = [claims.larger(lost, Share(9, 10)), claims.near(lost, Share(5, 10)), claims.at_least(lost, 0.3)]
    found += [claims.at_most(lost, 0.3), claims.times_as_large(lost, Share(1, 10), 2.0)]
    assert found == [claims.Finding(OPEN, None)] * 5


def cell(n_static, n_dynamic, speed, agent="best", **more):
    """Cells of one sweep, whose episodes do not go together."""
    found = entry(**more)
    ends = ["success"] * found["outcomes"]["success"] + ["collision"] * found["outcomes"]["collision"]
    ends += ["timeout"] * found["outcomes"]["timeout"]
    shuffled = random.Random(f"{n_static} {n_dynamic} {speed}").sample(ends, len(ends))
    return found | {
        "S": n_static, "D": n_dynamic, "v_m_s": speed, "agent": agent, "episode_outcomes": shuffled
    }  # fmt: skip


def test_claims_of_the_sweep_take_the_papers_conditions():
    cells = [
        cell(4, 0, None, success=100),
        cell(8, 9, 1.5, success=90, collision=1),
        cell(8, 9, 3.0, success=0, collision=100),  # too fast for the mean
        cell(12, 9, 1.5, success=0, collision=100),  # too many
        cell(12, 15, 3.0, success=5, collision=95),
        cell(8, 9, 1.5, agent="bt", success=0, collision=100),
    ]
    found = claims.judged(claims.of_sweep(cells, "best"))
    assert found[0].ours.startswith("190/200")
    assert found[1].ours.startswith("1/200")
    assert found[2].ours.startswith("1 of 2")
    assert found[4].ours.startswith("5/100")
    assert [claim.verdict for claim in found] == [HOLDS, OPEN, OPEN, OPEN, HOLDS]


def test_claims_of_timing():
    rows = {
        "WM encoder": 0.02, "WM dynamics": 0.02, "WM decoder": 0.02, "PPO policy": 0.1, "Mapping update": 1.0,
        "Global planner": 1.0, "Full loop": 3.0,
    }  # fmt: skip
    profile = {
        "paper_latency": [{"component": name, "mean_ms": ms} for name, ms in rows.items()],
        "real_time": {"p99_ms": 4.0},
        "paper_density": [{"D": d, "loop_ms": 2.0 + 0.01 * d, "paper_loop_ms": 19.7} for d in (0, 15)],
    }
    assert [claim.verdict for claim in claims.of_timing(profile)] == [HOLDS, FAILS, FAILS]
    profile["paper_latency"][5]["mean_ms"] = None
    assert claims.of_timing(profile)[0].verdict == OPEN, "no step planned anything"


def test_time_to_success_is_the_papers_and_stands_beside_the_papers():
    """Mean time of all episodes / rate of success; the mean over successes stands apart, without a peer."""
    assert claims.tts_s([entry(50, time_s=10.0), entry(100, time_s=40.0)]) == pytest.approx(25.0 / 0.75)
    assert claims.tts_s([entry(0)]) is None and claims.tts_s([entry(5, time_s=None)]) is None
    document = minimal() | {
        "table_main": {"curriculum": [entry(50, time_s=10.0) | {"time_to_success_mean_s": 7.0}]}
    }
    (head,) = [line for line in results_page(document).splitlines() if line.startswith("| agent | training")]
    (row,) = [line for line in results_page(document).splitlines() if line.startswith("| `curriculum`")]
    cells = dict(zip([c.strip() for c in head.split("|")], [c.strip() for c in row.split("|")], strict=True))
    assert (cells["TTS"], cells["the paper: TTS"]) == ("20.0 s", "15.8 s")
    assert (cells["mean time"], cells["the paper: mean time"]) == ("10.0 s", "11.41 s")
    assert cells["mean time of successes"] == "7.0 s"


def minimal():
    """A document with one claim and empty tables."""
    profile = {"paper_latency": [], "paper_density": [], "rows": []}
    found = claims.judged(
        [claims.Claim("it holds", "1", "2", HOLDS, 0.00001), claims.Claim("untested", "1", "2", FAILS)]
    )
    return {
        "budget": "quick",
        "seed": 90009,
        "started": "today",
        "git_sha": None,
        "hardware": {"cpu": "a", "cores": 2},
        "commands": {"eval/main": "uuv eval", "eval/ceilings": "uuv eval", "profile": "uuv profile"},
        "claims": [vars(claim) for claim in found],
        "table_main": {},
        "ceilings": {"agents": []},
        "sweeps": {},
        "profile": profile,
        "inconsistencies": [],
    }


def test_the_page_tells_p_values_and_an_evaluation_seed_that_was_tuned_on():
    text = results_page(minimal())
    assert "| it holds | 1 | 2 | holds | < 0.0001 | < 0.0001 |" in text
    assert "| untested | 1 | 2 | does not hold | - | - |" in text
    assert "seed, 90009, was never trained or tuned on" in text
    assert "seed, 90001, was looked at while tuning" in results_page(minimal() | {"seed": 90001})
    assert reproduce_steps.EVALUATION_SEED not in reproduce_steps.RETIRED_SEEDS


def test_losses_must_fall():
    falling = [
        {"world_model/reconstruction_loss": 10 - i, "world_model/dynamics_loss": 5.0} for i in range(8)
    ]
    assert [claim.verdict for claim in claims.of_training(falling)] == [HOLDS, FAILS]
    assert [claim.verdict for claim in claims.of_training([])] == [OPEN, OPEN]


def test_the_papers_own_time_to_success_is_as_inconsistent_as_we_say():
    off = {
        name: round(row.mean_time_s / row.success, 1)
        for name, row in claims.TABLE_MAIN.items()
        if abs(row.mean_time_s / row.success - row.tts_s) > 0.1
    }
    assert off == {"distill_20": 29.2, "curriculum": 13.1, "bt": 18.1}


# ------------------------------------------------------------------------------------------------------ steps


@pytest.mark.parametrize("budget", list(reproduce_steps.BUDGETS))
def test_steps_have_folders_of_their_own_and_known_presets(budget, tmp_path):
    found = reproduce_steps.steps_of(reproduce_steps.BUDGETS[budget], tmp_path)
    assert len({step.folder for step in found}) == len(found)
    trained = [step.command[1] for step in found if step.command[0] == "train"]
    assert set(trained) <= set(preset_names("train"))
    assert len(trained) == len(reproduce_steps.TRAINED) * reproduce_steps.BUDGETS[budget].training_seeds
    grids = [step.command[step.command.index("--grid") + 1] for step in found if "--grid" in step.command]
    assert set(grids) <= set(preset_names("grid"))


class Uuv:
    """Stands for the command: writes what it would write."""

    def __init__(self, monkeypatch, fail_at=None):
        self.ran, self.fail_at = [], fail_at
        monkeypatch.setattr(reproduce_steps, "launch", self)

    def __call__(self, arguments):
        self.ran.append(arguments)
        code = 130 if len(self.ran) == self.fail_at else 0
        place = next(
            (arguments[i + 1] for i, part in enumerate(arguments) if part in ("--run-dir", "--resume")), None
        )
        if place:
            folder = reproduce_steps.Path(place)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "run.json").write_text(json.dumps({"status": "interrupted" if code else "finished"}))
            (folder / "metrics.jsonl").write_text("")
        return type("Done", (), {"returncode": code, "stdout": json.dumps(printed(arguments)).encode()})()


def printed(arguments):
    names = [arguments[i + 1].rpartition("/")[2] for i, part in enumerate(arguments) if part == "--agent"]
    if arguments[0] == "eval":
        details = [
            {"seed": 1, "episode": i, "outcome": "success" if i < 50 else "timeout"} for i in range(100)
        ]
        return {"agents": [entry(50) | {"name": name, "episodes_detail": details} for name in names]}
    if arguments[0] == "sweep":
        cells = [cell(8, 6, 0.6, agent=name, success=90) for name in names]
        return {"axes": {"S": [8], "D": [6], "v": [0.6]}, "cells": cells}
    if arguments[0] == "profile":
        row = {"num_envs": 1, "env_steps_per_s": {"step": 1.0, "step_inference": 1.0, "train": 1.0}}
        return {"paper_latency": [], "paper_density": [], "rows": [row], "real_time": None}
    return {}


@pytest.fixture(autouse=True)
def pages(monkeypatch):
    """How the run stood whenever a page was made; stand-ins write no run folders to draw one from."""
    states = []

    def page(folders):
        states.append(json.loads((folders[0] / "run.json").read_text())["status"])
        return type("Report", (), {"page": folders[0] / "report.html"})()

    monkeypatch.setattr(paper_run, "report", page)
    return states


def test_an_interrupted_reproduction_goes_on_and_runs_no_step_twice(tmp_path, monkeypatch, pages):
    place, watch = tmp_path / "run", Quiet()
    first = Uuv(monkeypatch, fail_at=3)
    with pytest.raises(KeyboardInterrupt):
        reproduce("quick", place, watch)
    assert any(f"--resume {place}" in text for text in watch.answer)
    second = Uuv(monkeypatch)
    document, _ = resume(place, Quiet())
    wanted = reproduce_steps.steps_of(reproduce_steps.BUDGETS["quick"], place)
    assert len(first.ran) + len(second.ran) == len(wanted) + 1, "the interrupted step alone runs again"
    assert (place / "results.md").read_text() == results_page(document)
    assert str(place) not in json.dumps(document["commands"]), "commands are told without the machine's paths"
    third = Uuv(monkeypatch)
    assert resume(place, Quiet())[0]["claims"] == document["claims"]
    assert third.ran == []
    assert pages == ["finished", "finished"], "a page tells how the run ended"


def test_a_step_that_fails_says_which(tmp_path, monkeypatch):
    monkeypatch.setattr(
        reproduce_steps, "launch", lambda _arguments: type("Done", (), {"returncode": 2, "stdout": b""})()
    )
    with pytest.raises(RunFolderError, match="train ppo, seed 0: 'uuv train ppo"):
        reproduce("quick", tmp_path / "run", Quiet())


def test_bad_input_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="quick or full"):
        reproduce("slow", tmp_path / "run", Quiet())
    assert not (tmp_path / "run").exists()
    with pytest.raises(RunFolderError, match="give the folder"):
        resume(tmp_path, Quiet())


def test_a_sweep_of_one_axis_at_a_time_is_a_row_a_change():
    lines = _sweep_lines(robustness_sweep()).splitlines()
    assert lines[2] == "| changed | bt | best |"
    assert lines[4:7] == [
        "| nothing | 100 / 0 | 94 / 0 |",
        "| D = 9 | 94 / 6 | 88 / 6 |",
        "| disturbance.current_m_s = [0.0, 0.2, 0.0] | 88 / 12 | 81 / 12 |",
    ]


def test_tables_are_markdown():
    assert text_table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
