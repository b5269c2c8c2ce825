"""A reproduction: verdicts by hand, steps that are done once, and a page with every number."""

import itertools
import json
import random
import re
import shutil

import numpy as np
import pytest

from tests.command import Quiet
from uuvtai.common.enums import LETTERS
from uuvtai.config.loader import load_training
from uuvtai.evaluation import claims, reproduce_steps
from uuvtai.evaluation import reproduce as paper_run
from uuvtai.evaluation.claims import FAILS, HOLDS, OPEN, Share, compared, of_agent, over_seeds
from uuvtai.evaluation.reproduce import reproduce, results_page, resume
from uuvtai.learning.world_model import SKILL
from uuvtai.logs.run_folder import RunFolderError


def alone(finding):
    """The verdict of a claim that is the only one."""
    return claims.judged([claims.claim("", "", "", finding)])[0].verdict


def entry(success, n=100, collision=0, time_s=10.0, **more):
    outcomes = {"success": success, "collision": collision, "ttc": 0, "out_of_tank": 0}
    outcomes["timeout"] = n - success - collision
    times = {"time_mean_s": time_s, "time_to_success_mean_s": time_s, "return_mean": success / n}
    return {"episodes": n, "outcomes": outcomes} | times | more


def test_larger_needs_more_than_chance():
    rates = ((90, 20, HOLDS), (20, 90, FAILS), (50, 45, OPEN))
    assert all(alone(claims.larger(Share(a, 100), Share(b, 100))) == verdict for a, b, verdict in rates)
    assert alone(claims.larger(Share(0, 0), Share(5, 10))) == OPEN


def test_a_printed_value_is_reached_missed_or_open():
    assert alone(claims.at_least(Share(95, 100), 0.828)) == HOLDS
    assert alone(claims.at_least(Share(83, 100), 0.828)) == OPEN, "the interval holds it"
    assert alone(claims.at_least(Share(60, 100), 0.828)) == FAILS
    assert alone(claims.at_most(Share(0, 1000), 0.011)) == HOLDS
    assert alone(claims.at_most(Share(0, 20), 0.011)) == OPEN, "twenty without a collision prove nothing"
    assert alone(claims.at_most(Share(4, 512), 0.011)) == OPEN, "the interval of 0.8 % of 512 holds 1.1 %"
    assert alone(claims.at_most(Share(20, 100), 0.011)) == FAILS


# --------------------------------------------------------------------------------------------- training seeds


def test_methods_are_compared_by_welch_over_their_seeds():
    stats = pytest.importorskip("scipy.stats")
    a, b = (0.76, 0.81, 0.79, 0.70, 0.74), (0.20, 0.55, 0.31, 0.42, 0.08)
    assert compared(over_seeds(a), over_seeds(b)) == claims.Finding(
        HOLDS, pytest.approx(stats.ttest_ind(a, b, equal_var=False).pvalue, rel=1e-6)
    )
    assert compared(over_seeds(b), over_seeds(a)).points_to == FAILS
    scaled = stats.ttest_ind(a, [3.5 * value for value in b], equal_var=False)
    assert compared(over_seeds(a), over_seeds(b), 3.5).p == pytest.approx(scaled.pvalue, rel=1e-6)
    moved = stats.ttest_ind([value + 0.1 for value in b], a, equal_var=False)
    assert compared(over_seeds(b), over_seeds(a), margin=0.1).p == pytest.approx(moved.pvalue, rel=1e-6)
    low, high = stats.t.interval(0.95, 4, np.mean(a), stats.sem(a))
    assert str(over_seeds(a)) == f"76.0 % [{100 * low:.1f}, {100 * high:.1f}] (5 seeds)"


def test_one_seed_says_nothing_about_others_nor_do_seeds_that_agree_by_chance():
    """Five seeds of 200 episodes without any success are no proof of less than 1 %."""
    one, many = over_seeds([0.9]), over_seeds([0.1, 0.12, 0.08])
    for found in (compared(one, many), compared(many, one)):
        assert (found.points_to, found.p) == (OPEN, None) and "one training seed" in found.reason
    assert str(one) == "90.0 % (1 seed)"
    assert compared(over_seeds([0.0, 0.0]), over_seeds([0.0, 0.0])).p is None, "no seed differs from another"
    never = claims.of_method([entry(0, n=200)] * 5, "success")
    assert never.variance == pytest.approx(1 / 1002 * 1001 / 1002 / 1002) and never.freedom == 4
    assert claims.of_method(seeds(40, 60, 50, n=100), "success").variance == pytest.approx(0.01 / 3)


@pytest.mark.parametrize("spread", [0.0, 0.05, 0.15])
def test_false_alarms_at_five_seeds_are_as_rare_as_they_say(spread):
    """Two methods of one distribution, episodes hard for all agents or none: 5 %, of 2,000 trials to 0.5."""
    rng, alarms = np.random.default_rng(3), 0
    for _ in range(2000):
        skill = np.clip(rng.normal(0.6, spread, (10, 1)), 0.02, 0.98)
        won = (rng.random((10, 200)) < skill + rng.normal(0.0, 0.2, 200)).sum(axis=1).tolist()
        sides = [claims.of_method(seeds(*own, n=200), "success") for own in (won[:5], won[5:])]
        alarms += compared(*sides).p < 0.05
    assert alarms / 2000 < 0.06 and (not spread or alarms / 2000 > 0.03)


def test_coming_near_allows_ten_points():
    """Eight episodes prove nothing, neither there nor here."""
    for a, n_a, b, n_b, verdict in (
        (480, 500, 490, 500, HOLDS), (300, 500, 490, 500, FAILS), (4, 8, 8, 8, OPEN), (197, 200, 8, 8, OPEN)
    ):  # fmt: skip
        found = compared(of_agent(Share(a, n_a)), of_agent(Share(b, n_b)), margin=claims.MARGIN)
        assert alone(found) == verdict


def test_holm_decides_over_the_whole_list():
    """Of 0.01, 0.02, 0.03, 0.04 only the first decides together (4 x 0.01, then 3 x 0.02)."""
    found = [claims.Claim(str(p), "", "", HOLDS, p) for p in (0.03, 0.01, None, 0.04, 0.02)]
    answer = claims.judged(found)
    assert [c.verdict for c in answer] == [OPEN, HOLDS, HOLDS, OPEN, OPEN]
    assert [c.reason for c in answer] == ["may be chance", "", "", "may be chance", "may be chance"]
    assert claims.judged(answer) == answer, "claims can be judged again, with those of another page"
    assert [c.p_holm for c in answer] == pytest.approx([0.06, 0.04, None, 0.06, 0.06])
    assert [c.p for c in answer] == [0.03, 0.01, None, 0.04, 0.02]


def seeds(*successes, n=1000, **more):
    """Entries of a method, one a training seed."""
    return [entry(k, n=n, **more) for k in successes]


def test_claims_of_table_main_by_hand():
    main = {
        "ppo": seeds(210, 200, 190, 205, 195, collision=400, time_s=22.84),
        "constant_20": seeds(460, 470, 450, 455, 465, collision=200),
        "paper": seeds(870, 880, 860, 865, 875, collision=100, time_s=11.41),
        "bt": seeds(900, collision=100, time_s=30.0),
        "no_risk_scaling": seeds(860, 880, 850, 880, 870),
        "no_world_model": seeds(300, 310, 290, 305, 295),
        "paper_10hz": seeds(800, 810, 790, 805, 795),
        "ppo_10hz": seeds(900, 910, 890, 905, 895),
    }
    found = claims.judged(claims.of_table_main(main))
    assert [claim.verdict for claim in found] == [*[HOLDS] * 4, FAILS, *[HOLDS] * 3, OPEN, HOLDS, FAILS]
    assert (found[3].ours, found[1].ours) == ("13.1 s against 114.2 s", "4.35")
    assert (found[4].ours, found[6].ours) == ("0.2 against 0.9", "13.1 s against 33.3 s")
    swapped = claims.judged(claims.of_table_main(main | {"ppo": main["paper"], "paper": main["ppo"]}))
    assert [claim.verdict for claim in swapped[:8]] == [*[FAILS] * 4, HOLDS, *[FAILS] * 3]
    never = seeds(0, 0, 0, collision=1000, time_s=5.0)
    for paper, ppo, verdict in (
        (main["paper"], never, HOLDS),
        (never, main["paper"], FAILS),
        (never, never, OPEN),
    ):
        few = claims.of_table_main({"paper": paper, "ppo": ppo, "bt": main["bt"]})
        assert len(few) == 7 and few[3].points_to == verdict, "who never arrives takes for ever"


def ended(word, **more):
    """An entry whose episodes ended so, a letter each."""
    counts = {end: word.count(letter) for end, letter in LETTERS.items()}
    return entry(0, n=len(word)) | {"ends": word, "outcomes": counts} | more


def test_entries_of_the_same_episodes_count_by_episode_number():
    alike, apart = [ended("sssc" * 10)] * 4, [ended("sssc" * 10), ended("cs" * 20), ended("csss" * 10)]
    assert claims.pooled(alike[:1], "success").interval == Share(30, 40).interval
    four = claims.pooled(alike, "success")
    assert (four.k, four.n, four.counts()) == (120, 160, (27, 36)), "four times the same say hardly more"
    assert claims.pooled(apart, "success").design < 1.5
    outcomes = ["success", "success", "success", "collision"] * 10
    details = [{"seed": 1, "episode": i, "outcome": outcome} for i, outcome in enumerate(outcomes)]
    for form in ({"episode_outcomes": outcomes}, {"episodes_detail": details}):
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


def test_episodes_that_were_not_kept_are_not_pooled():
    with pytest.raises(ValueError, match="0 of 100 episodes say"):
        claims.pooled([entry(50), entry(70, n=200)], "success")


def cell(n_static, n_dynamic, speed, agent="best", **more):
    """Cells of one sweep, whose episodes do not go together."""
    found = entry(**more)
    word = "".join(LETTERS[end] * k for end, k in found["outcomes"].items())
    word = "".join(random.Random(f"{n_static} {n_dynamic} {speed}").sample(word, len(word)))
    return found | {"S": n_static, "D": n_dynamic, "v_m_s": speed, "agent": agent, "ends": word}


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
    for claim, word in zip(found, ("190/200", "1/200", "1 of 2", "", "5/100"), strict=True):
        assert claim.ours.startswith(word)
    assert [claim.verdict for claim in found] == [HOLDS, OPEN, OPEN, OPEN, HOLDS]
    text = results_page(minimal() | {"sweep": {"cells": [*cells[:2], cells[-1]]}})
    rows = ("in % of `best` and `bt`", "| nothing moves | v = 1.5 m/s |", "| 8 | 9 |  | 90/1, 0/100 |")
    assert all(row in text for row in rows)


def test_claims_of_timing():
    rows = dict.fromkeys(("WM encoder", "WM dynamics", "WM decoder"), 0.02) | {"PPO policy": 0.1}
    rows |= {"Mapping update": 1.0, "Global planner": 1.0, "Full loop": 3.0}
    profile = {
        "paper_latency": [{"component": name, "mean_ms": ms} for name, ms in rows.items()],
        "real_time": {"p99_ms": 4.0},
        "paper_density": [{"D": d, "loop_ms": 2.0 + 0.01 * d, "paper_loop_ms": 19.7} for d in (0, 15)],
    }
    assert [claim.points_to for claim in claims.of_timing(profile)] == [HOLDS, FAILS, FAILS]
    profile["paper_latency"][5]["mean_ms"] = None
    assert claims.of_timing(profile)[0].reason == "no step planned anything"


def test_time_to_success_is_the_papers_and_stands_beside_the_papers():
    """Mean time of all episodes / rate of success; the mean over successes stands apart, without a peer."""
    assert claims.tts_s([entry(50, time_s=10.0), entry(100, time_s=40.0)]) == pytest.approx(25.0 / 0.75)
    assert claims.tts_s([entry(0)]) is None and claims.tts_s([entry(5, time_s=None)]) is None
    one = entry(50, time_s=10.0) | {"time_to_success_mean_s": 7.0, "trained_steps": 614_912}
    document = minimal() | {"table_main": {"paper": [one, one | entry(70)]}}
    (head,) = [line for line in results_page(document).splitlines() if line.startswith("| agent | success")]
    (row,) = [line for line in results_page(document).splitlines() if line.startswith("| `paper`")]
    cells = dict(zip([c.strip() for c in head.split("|")], [c.strip() for c in row.split("|")], strict=True))
    assert (cells["TTS"], cells["the paper: TTS"]) == ("16.7 s", "15.8 s")
    assert (cells["mean time"], cells["the paper: mean time"]) == ("10.0 s", "11.41 s")
    assert (cells["mean time of successes"], cells["success by training seed"]) == ("8.5 s", "50.0, 70.0")
    assert cells["success"] == "60.0 % [0.0, 100.0] (2 seeds)"
    assert "a training: 614,912." in results_page(document)


def minimal(*found):
    """A document with claims and empty tables."""
    return {
        "budget": "quick", "seed": 90010, "started": "today", "git_sha": None, "trained_at": [],
        "hardware": {"cpu": "a", "cores": 2}, "claims": [vars(claim) for claim in claims.judged(found)],
        "commands": dict.fromkeys(("eval/main", "eval/NAME-SEED", "sweep/pool", "profile"), "uuv"),
        "table_main": {}, "mechanism": {}, "sweep": None,
        "profile": {"paper_latency": [], "paper_density": [], "rows": []},
    }  # fmt: skip


def test_the_page_tells_p_values_of_one_family_and_a_seed_that_was_tuned_on():
    """p = 0.03 decides on its own page, not beside a second test."""
    one = minimal(claims.Claim("it holds", "1", "2", HOLDS, 0.03), claims.Claim("untested", "1", "2", FAILS))
    text, both = results_page(one), results_page(one, one | {"budget": "tenfold", "seed": 90001})
    assert "| it holds | 1 | 2 | holds | 0.0300 | 0.0300 |" in text
    assert "| untested | 1 | 2 | does not hold | - | - |" in text
    assert "seed, 90010, was never trained or tuned on" in text and "90001" not in text
    assert both.count("| it holds | 1 | 2 | cannot be judged: may be chance | 0.0300 | 0.0600 |") == 2
    assert "## The paper's claims, budget tenfold" in both and "## Sweep" not in both
    assert "seed, 90001, was looked at while tuning" in both
    assert reproduce_steps.EVALUATION_SEED not in reproduce_steps.RETIRED_SEEDS


def test_losses_must_fall_in_every_training():
    losses = "world_model/reconstruction_loss", "world_model/dynamics_loss"
    falling, rising = (
        claims.training_facts(
            [
                dict(zip(losses, (10.0 + slope * i, 5.0), strict=True)) | {"distillation/scale": 1.0}
                for i in range(8)
            ],
            2.0,
        )
        for slope in (-8, 1)
    )
    assert falling["losses"] == {losses[0]: [6.0, -42.0], losses[1]: [5.0, 5.0]}
    assert [claim.points_to for claim in claims.of_training([falling, falling])] == [HOLDS, FAILS]
    found = claims.of_training([falling, rising])[0]
    assert found.points_to == FAILS and found.ours.startswith("in 1 of 2 trainings")
    assert found.text == "Reconstruction loss falls and settles"
    for few in ([], [claims.training_facts([], 2.0)], [falling, claims.training_facts([], 2.0)]):
        assert [claim.points_to for claim in claims.of_training(few)] == [OPEN, OPEN]


def test_the_mechanism_is_told_by_training_and_kind_of_target():
    depths, scales = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.7), (1.8, 2.0, 2.0, 2.0, 1.9, 1.7, 1.6, 1.5)
    rows = [
        {
            "distillation/scale": scale,
            f"{SKILL}depth_0": depth,
            f"{SKILL}depth_1": 0.0,
            f"{SKILL}tilt_0": None,
        }
        for scale, depth in zip(scales, depths, strict=True)
    ]
    found = claims.training_facts(rows, 2.0)
    assert found["scale"] == [1.8, pytest.approx(1.85), 1.5, 0.375]
    assert found["skill"] == {"depth_0": pytest.approx(0.6), "depth_1": 0.0, "tilt_0": None}
    nothing = claims.training_facts([], 2.0)
    assert nothing == {"losses": {}, "scale": None, "skill": {}}
    text = results_page(minimal() | {"mechanism": {"paper": [found, found], "paper_10hz": [nothing]}})
    assert "| `paper` | 1.80 (1.80 to 1.80) | 1.85 (1.85 to 1.85) | 1.50 (1.50 to 1.50) |" in text
    assert "| depth (2) | 0.30 (0.00 to 0.60) |\n| tilt (1) | - |" in text and "`paper_10hz`" not in text


def test_the_papers_own_time_to_success_is_as_inconsistent_as_we_say():
    found = {name: (row.mean_time_s / row.success, row.tts_s) for name, row in claims.TABLE_MAIN.items()}
    off = {name: round(ours, 1) for name, (ours, theirs) in found.items() if abs(ours - theirs) > 0.1}
    assert off == {"constant_20": 29.2, "paper": 13.1, "bt": 18.1}


# ------------------------------------------------------------------------------------------------------ steps


@pytest.mark.parametrize(("budget", "n_training", "env_steps"), [
    ("quick", 14, 61_440), ("paper", 35, 614_400), ("tenfold", 9, 6_144_000),
])  # fmt: skip
def test_every_training_has_the_budgets_env_steps(budget, n_training, env_steps, tmp_path):
    steps = reproduce_steps.steps_of(reproduce_steps.BUDGETS[budget], tmp_path)
    trained = [step for step in steps if step.command[0] == "train"]
    assert len(trained) == n_training and len({step.folder for step in steps}) == len(steps)
    for step in trained:
        preset, *words = step.command[1:]
        config = load_training(preset, [words[i + 1] for i, word in enumerate(words) if word == "--set"])
        decisions = config.train.num_envs * config.ppo.rollout_steps * config.train.iterations
        assert decisions * config.policy.hold_steps == env_steps
        assert (config.policy.hold_steps == 5) == ("_10hz" in step.folder)
        assert config.train.evaluate_every == 0, "no checkpoint is chosen by its success"
        assert step.folder.endswith(f"-{words[words.index('--seed') + 1]}")
    for step, judged in itertools.pairwise(steps):
        if step in trained:
            assert str(tmp_path / step.folder) in judged.command and step.row == judged.row
    for step in steps:
        assert step.command[0] in ("train", "profile") or {"stack=paper", "90010"} <= set(step.command)


class Uuv:
    """Stands for the command: writes what it would write."""

    def __init__(self, monkeypatch, fail_at=None):
        self.ran, self.fail_at = [], fail_at
        monkeypatch.setattr(reproduce_steps, "launch", self)

    def __call__(self, arguments):
        self.ran.append(arguments)
        code = 130 if len(self.ran) == self.fail_at else 0
        told = dict(itertools.pairwise(arguments))
        if place := told.get("--run-dir", told.get("--resume")):
            folder = reproduce_steps.Path(place)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "run.json").write_text(json.dumps({"status": "interrupted" if code else "finished"}))
            (folder / "metrics.jsonl").write_text(TRAINED)
        return type("Done", (), {"returncode": code, "stdout": json.dumps(printed(arguments)).encode()})()


TRAINED = '{"iteration": 120, "time/env_steps": 61952.0}\n'
"""metrics of a training of the budget "quick": 120 iterations and the look around before the first"""


def printed(arguments):
    names = [arguments[i + 1].rpartition("/")[2] for i, part in enumerate(arguments) if part == "--agent"]
    if arguments[0] == "eval":
        details = [{"seed": 1, "episode": i, "outcome": ("success", "timeout")[i // 50]} for i in range(100)]
        return {"agents": [entry(50, episodes_detail=details, env_steps=9, name=name) for name in names]}
    if arguments[0] == "sweep":
        return {"cells": [cell(8, 6, 0.6, agent=name, success=90) for name in names]}
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
    """A training made beforehand (``uuv train ppo --seed 1 --run-dir ROOT/train/ppo-1``) counts as done."""
    place, watch = tmp_path / "run", Quiet()
    first = Uuv(monkeypatch, fail_at=3)
    with pytest.raises(KeyboardInterrupt):
        reproduce("quick", place, watch)
    assert any(f"--resume {place}" in text for text in watch.answer)
    (made := place / "train/ppo-1").mkdir(parents=True)
    (made / "run.json").write_text('{"status": "finished", "git_sha": "abc"}')
    (made / "metrics.jsonl").write_text(TRAINED)
    second = Uuv(monkeypatch)
    document, _ = resume(place, Quiet())
    wanted = reproduce_steps.steps_of(reproduce_steps.BUDGETS["quick"], place)
    assert len(first.ran) + len(second.ran) == len(wanted), "the interrupted step again, the made one never"
    assert len(list(place.glob("rows/*.json"))) == 14
    assert document["trained_at"] == ["abc"], "the page names the commits of all trainings"
    assert (page := (place / "results.md").read_text()) == results_page(document)
    assert "| `bt` | - | 50/100 = 50.0 % [" in page and "| `ppo` | 50.0, 50.0 | 50.0 % [" in page
    assert str(place) not in json.dumps(document["commands"]), "commands are told without the machine's paths"
    third = Uuv(monkeypatch)
    assert resume(place, Quiet())[0]["claims"] == document["claims"] and third.ran == []
    assert pages == ["finished", "finished"], "a page tells how the run ended"


def test_rows_made_elsewhere_stand_for_their_trainings(tmp_path, monkeypatch):
    """A row is all that counts of a training: a folder with the rows of another machine goes on from them."""
    Uuv(monkeypatch)
    document, _ = reproduce("quick", tmp_path / "one", Quiet())
    interrupted = Uuv(monkeypatch, fail_at=1)
    with pytest.raises(KeyboardInterrupt):
        reproduce("quick", place := tmp_path / "other", Quiet())
    shutil.copytree(tmp_path / "one/rows", place / "rows")
    (place / "rows/ppo-1.json").unlink()
    right = (row := place / "rows/paper-0.json").read_text()
    wrong = {
        "619,520 env-steps and 100 episodes": right.replace("61952", "619520"),
        "61,952 env-steps and 99 episodes": re.sub(r'"ends": "\w', '"ends": "', right),
        "no row of this version": "[1]",
    }
    for what, text in wrong.items():
        row.write_text(text)
        with pytest.raises(RunFolderError, match=rf"paper-0.json: {what}, but this budget has 61,440 env-st"):
            resume(place, Quiet())
    row.write_text(right)
    second = Uuv(monkeypatch)
    again, _ = resume(place, Quiet())
    assert len(interrupted.ran) == 1 and again["table_main"] == document["table_main"]
    assert [words[:2] for words in second.ran if words[0] == "train"] == [["train", "ppo"]]
    (curves,) = [block for part in again["sections"] for block in part["blocks"] if block["kind"] == "curves"]
    assert curves["paths"] == ["train/ppo-1"], "no curves are drawn of what was not trained here"


def test_a_step_that_fails_says_which(tmp_path, monkeypatch):
    done = type("Done", (), {"returncode": 2, "stdout": b""})
    monkeypatch.setattr(reproduce_steps, "launch", lambda _arguments: done)
    with pytest.raises(RunFolderError, match="agents that are not trained: 'uuv eval"):
        reproduce("quick", tmp_path / "run", Quiet())


def test_bad_input_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="quick or paper or tenfold"):
        reproduce("slow", tmp_path / "run", Quiet())
    assert not (tmp_path / "run").exists()
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(RunFolderError, match=r"no plain file reproduce_request\.json; give the folder that"):
        resume(tmp_path, Quiet())
