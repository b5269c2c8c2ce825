"""Methods compared on the same episodes: who alone arrives, how sure that is, and the difference in time
where both do."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

from uuvtai.statistics import bootstrap_interval, mcnemar_p, mean

Episode = dict[str, Any]
"""an entry of ``episodes_detail``: seed, episode, outcome, time_s at least"""


def paired(methods: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Every pair of methods (entries of ``uuv eval --json``): only_a and only_b arrive, McNemar's exact p,
    times where both arrive.

    ``time_difference_mean_s`` is a's time minus b's, with a bootstrap interval over episodes.
    """
    return [_compared(a, b) for a, b in itertools.combinations(methods, 2)]


def _compared(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    pairs = _pairs(a["episodes_detail"], b["episodes_detail"])
    arrived = [tuple(e["outcome"] == "success" for e in pair) for pair in pairs]
    times = [
        (one["time_s"], other["time_s"])
        for (one, other), both in zip(pairs, arrived, strict=True)
        if all(both)
    ]
    only_a, only_b = arrived.count((True, False)), arrived.count((False, True))
    differences = [one - other for one, other in times]
    interval = bootstrap_interval(differences)
    return {
        "a": a["name"],
        "b": b["name"],
        "episodes": len(pairs),
        "both": len(times),
        "only_a": only_a,
        "only_b": only_b,
        "mcnemar_p": mcnemar_p(only_a, only_b),
        "time_a_mean_s": mean([one for one, _other in times]),
        "time_b_mean_s": mean([other for _one, other in times]),
        "time_difference_mean_s": mean(differences),
        "time_difference_ci95": None if interval is None else list(interval),
    }


def _pairs(a: list[Episode], b: list[Episode]) -> list[tuple[Episode, Episode]]:
    """Entries of the same (seed, episode), in the order of ``a``."""
    of_b = {(e["seed"], e["episode"]): e for e in b}
    return [(e, of_b[key]) for e in a if (key := (e["seed"], e["episode"])) in of_b]
