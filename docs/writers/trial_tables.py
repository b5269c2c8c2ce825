"""Tables of what was trained, beside the tree or beside another training, on the same episodes, and of what
the trainings said of themselves (``docs/learning.md``)."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import Counts, Sources, rated
from docs.writers.learned_trials import Paired
from docs.writers.pieces import LETTERS
from uuvtai.statistics import mcnemar_p
from uuvtai.tables.table import text_table

TWIN_FILE, TWIN_FORECAST_FILE = "docs/data/twin_77001.json", "docs/data/twin_forecast_77001.json"
WARM_FILE, COLD_FILE = "docs/data/twin_warm_77001.json", "docs/data/twin_cold_77001.json"
QUICK_FILE, SHALLOW_FILE = "docs/data/quick_77601.json", "docs/data/quick_90008.json"
FINETUNE_FILE, LATE_FILE = "docs/data/finetune_77701.json", "docs/data/finetune_late.json"
BFLOAT16_FILE = "docs/data/bfloat16_77801.json"
CHOOSER_FILE = "docs/data/chooser_77001.json"
TUNED_FILE = "docs/data/tuned_77001.json"
LEARNING_FILE = "docs/data/learning_trials.json"


def twin_policy(sources: Sources) -> str:
    """The policy that learnt in the twin beside the tree, in the simulator, on the same episodes."""
    return _trial_rows(sources, TWIN_FILE, "policy")


def twin_warm(sources: Sources) -> str:
    """A policy that was warm-started from the tree beside the tree, on the same episodes."""
    return _trial_rows(sources, WARM_FILE, "policy")


def twin_cold(sources: Sources) -> str:
    """The same budget with every switch off."""
    return _trial_rows(sources, COLD_FILE, "policy")


def quick_policy(sources: Sources) -> str:
    """The policy of ``uuv train quick`` beside the tree, on the same episodes."""
    return _trial_rows(sources, QUICK_FILE, "policy")


def quick_shallow(sources: Sources) -> str:
    """The same, of the first one, which drove too near the surface."""
    return _trial_rows(sources, SHALLOW_FILE, "policy")


def quick_curve(sources: Sources) -> str:
    """Success of that policy in the twin along its training."""
    rows = [
        [f"{row['decisions'] / 1e6:.1f}", f"{row['seconds'] / 60:.0f}", f"{100 * row['pool_6_0.6']:.1f} %"]
        for row in sources.json(QUICK_FILE)["curve"]
    ]
    return text_table(["million decisions", "minutes", "pool (8, 6, 0.6)"], rows)


def chooser_trials(sources: Sources) -> str:
    """The chooser between tree and policy beside the tree, on the same episodes."""
    return _trial_rows(sources, CHOOSER_FILE, "chooser")


def tuned_trials(sources: Sources) -> str:
    """The tree with learnt numbers beside the tree as configured, on the same episodes."""
    return _trial_rows(sources, TUNED_FILE, "tuned")


def learning_trials(sources: Sources) -> str:
    """Other trials to go past the tree, on the same episodes."""
    return _trial_rows(sources, LEARNING_FILE, "trial")


def _trial_rows(sources: Sources, file: str, name: str) -> str:
    """What ``twin_trials`` has kept in a file."""
    rows = []
    for entry in sources.json(file)["rows"]:
        tree, own = entry["bt"], entry["policy"]
        counts = [_counts(who) for who in (tree, own)]
        rows.append(
            [
                entry["cell"],
                *(rated(found, ending) for ending in ("success", "collision") for found in counts),
                *_compared(tree, own),
                *_wheel(entry),
            ]
        )
    head = ["`bt`", name, "`bt`: collision", f"{name}: collision"]
    more = [f"only `bt`, only the {name} arrives", "exact McNemar p", "time where both arrive"]
    more += ["hand-overs an episode, share of the policy"] if name == "chooser" else []
    return text_table(["world (S, D, v in m/s)", *head, *more], rows)


def _counts(who: dict[str, Any]) -> Counts:
    """How the episodes of one driver ended."""
    ends = who["outcomes"]
    return Counts(len(ends), {name: ends.count(letter) for name, letter in LETTERS.items()})


def _compared(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Who alone arrives, McNemar's p, and the mean times where both arrive."""
    pairs = list(zip(one["outcomes"], other["outcomes"], strict=True))
    only = [sum(a == "s" != b for a, b in pairs), sum(b == "s" != a for a, b in pairs)]
    both = [i for i, pair in enumerate(pairs) if pair == ("s", "s")]
    times = [sum(who["times_s"][i] for i in both) / max(1, len(both)) for who in (one, other)]
    return [f"{only[0]}, {only[1]}", f"{mcnemar_p(*only):.2g}", f"{times[0]:.1f}, {times[1]:.1f} s"]


def _wheel(entry: dict[str, Any]) -> list[str]:
    counts = entry.get("chooser")
    return [f"{counts['hand_overs_mean']:.1f}, {100 * counts['policy_share']:.0f} %"] if counts else []


def bfloat16(sources: Sources) -> str:
    """Trainings with hidden layers in float32 and in bfloat16, on the same episodes."""
    found = sources.json(BFLOAT16_FILE)["rows"]
    pairs = {entry["cell"]: (entry["float32"], entry["bfloat16"]) for entry in found}
    return _side_by_side(pairs, "float32", "bfloat16")


def twin_forecast(sources: Sources) -> str:
    """The policy of the twin told the forecasts that it learnt with, and learned ones, on the same
    episodes."""
    told, learned = (
        {entry["cell"]: entry["policy"] for entry in sources.json(file)["rows"]}
        for file in (TWIN_FILE, TWIN_FORECAST_FILE)
    )
    return _side_by_side({cell: (told[cell], learned[cell]) for cell in told}, "arcs and habits", "learned")


def _side_by_side(pairs: dict[str, tuple[dict[str, Any], dict[str, Any]]], *names: str) -> str:
    """Two drivers on the same episodes of each world."""
    rows = []
    for cell, both in pairs.items():
        pair = Paired.of([both])
        rows.append([cell, str(len(pair.ends)), *pair.cells(), pair.points(), pair.times()])
    head = ["world (S, D, v in m/s)", "episodes", *names, "gains, losses, McNemar's p", "points"]
    return text_table([*head, "time where both arrive"], rows)


def finetune_policy(sources: Sources) -> str:
    """A policy of the twin before and after its fine-tuning in the simulator, beside the tree."""
    rows = []
    for entry in sources.json(FINETUNE_FILE)["rows"]:
        pair = [_counts(entry[who]) for who in ("before", "after")]
        rows.append(
            [
                entry["cell"],
                rated(_counts(entry["bt"]), "success"),
                *(rated(found, ending) for ending in ("success", "collision") for found in pair),
                *_compared(entry["before"], entry["after"]),
            ]
        )
    head = ["world (S, D, v in m/s)", "`bt`", "before", "after", "before: collision", "after: collision"]
    more = ["arrives only before, only after", "exact McNemar p", "time where both arrive"]
    return text_table([*head, *more], rows)


def finetune_curve(sources: Sources) -> str:
    """Success on held-out episodes of the simulator along the fine-tuning."""
    return _finetune_curve(sources, FINETUNE_FILE)


def finetune_late(sources: Sources) -> str:
    """The same, of a policy that had learnt longer in the twin."""
    return _finetune_curve(sources, LATE_FILE)


def _finetune_curve(sources: Sources, file: str) -> str:
    names = {"gauntlet_9_1.5": "gauntlet (8, 9, 1.5)", "pool_9_1.5": "pool (8, 9, 1.5)"}
    rows = [
        [
            f"{row['decisions'] / 1e6:.2f}",
            f"{row['seconds'] / 60:.0f}",
            *(f"{100 * row[name]:.1f} %" for name in names),
        ]
        for row in sources.json(file)["curve"]
    ]
    return text_table(["million decisions", "minutes", *names.values()], rows)


def twin_curve(sources: Sources) -> str:
    """Success in the twin along the training, on scenarios that it never learnt from."""
    names = {"gauntlet_9_1.5": "gauntlet (8, 9, 1.5)", "pool_9_1.5": "pool (8, 9, 1.5)"}
    names |= {"pool_6_0.6": "pool (8, 6, 0.6)"}
    rows = [
        [
            f"{row['decisions'] / 1e6:.1f}",
            f"{row['seconds'] / 60:.0f}",
            *(f"{100 * row[name]:.0f} %" for name in names),
        ]
        for row in sources.json(TWIN_FILE)["curve"]
    ]
    return text_table(["million decisions", "minutes", *names.values()], rows)
