"""Explain failed episodes: play them again, label each (``causes.py``), and record the worst."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uuvtai.measure.episodes.playing import Driver, EpisodeResult, Job, Progress, run_episodes
from uuvtai.measure.explain import causes, facts
from uuvtai.measure.explain.causes import Explanation
from uuvtai.measure.explain.replay import FailureRecorder
from uuvtai.sim import Sim
from uuvtai.statistics import mean

if TYPE_CHECKING:
    from uuvtai.logs.log_recorder import PolicyNote

EXAMPLES = 3
"""Episodes named per label in the table."""


@dataclass(frozen=True, eq=False)
class Row:
    """A failed episode with its explanation."""

    result: EpisodeResult
    explanation: Explanation

    def document(self) -> dict[str, Any]:
        """One entry of ``explain`` in ``uuv eval --json``."""
        r, e = self.result, self.explanation
        shared = {
            "seed": r.seed,
            "episode": r.episode,
            "outcome": r.outcome,
            "label": e.label,
            "remarks": e.remarks,
            "log": None,
        }
        return shared | {"killer": vars(e.killer)} | e.facts


def explain_failures(
    sim: Sim,
    results: list[EpisodeResult],
    progress: Progress | None = None,
    driver: Driver | None = None,
    own_code: bool = False,
) -> list[Row]:
    """Replay the failed episodes of one method and explain them; in the order of ``results``. Raises
    RuntimeError (see ``FailureRecorder.end``). With ``own_code``, the user's, episodes that it plays
    otherwise this time are left out.

    Where a ``driver`` drives, the facts about leaves and actions are those of the tree beside it.
    """
    failed = failures(results)
    if not failed:
        return []
    recorder = FailureRecorder(sim.config, sim.tree, failed, own_code)
    run_episodes(sim, [Job(r.seed, r.episode) for r in failed], recorder, progress, driver)
    jobs = [Job(r.seed, r.episode) for r in failed]
    found = recorder.found
    return [Row(r, found[job]) for r, job in zip(failed, jobs, strict=True) if job in found]


def failures(results: list[EpisodeResult]) -> list[EpisodeResult]:
    """Everything that is no success."""
    return [r for r in results if r.outcome != "success"]


def table_of(rows: list[Row]) -> list[dict[str, Any]]:
    """Per label, most frequent first: count, share of the failures, meaning and the worst episodes."""
    counts = Counter(row.explanation.label for row in rows)
    order = list(causes.CAUSES)
    return [
        {
            "label": label,
            "count": counts[label],
            "share": counts[label] / len(rows),
            "meaning": causes.CAUSES[label],
            **_typical([row.explanation for row in rows if row.explanation.label == label]),
            "examples": [[row.result.seed, row.result.episode] for row in worst_of(rows, label)[:EXAMPLES]],
        }
        for label in sorted(counts, key=lambda label: (-counts[label], order.index(label)))
    ]


def _typical(found: list[Explanation]) -> dict[str, Any]:
    """What a label's episodes have in common; None where a label has no such fact."""
    errors = [e.facts["forecast_error_m"] for e in found if "forecast_error_m" in e.facts]
    return {
        "remarks": dict(Counter(remark for e in found for remark in e.remarks).most_common()),
        "knew_share": mean([float(error is not None and error <= causes.MISS_M) for error in errors]),
        "unseen_median_s": _median(found, "seen_ago_s", facts.WINDOW_S),
        "evading_median_s": _median(found, "evading_s", 0.0),
        "last_chance_median_s": _median(found, "last_chance_s", facts.CHANCES_S[-1]),
    }


def _median(found: list[Explanation], name: str, beyond: float) -> float | None:
    """Median of the episodes that have the fact; ``beyond`` stands for farther back than was looked."""
    values = [beyond if e.facts[name] is None else e.facts[name] for e in found if name in e.facts]
    return float(np.median(values)) if values else None


def worst_of(rows: list[Row], label: str) -> list[Row]:
    """Episodes of a label, the worst first: the hardest hits, of timeouts those that ended farthest from the
    goal."""

    def severity(row: Row) -> tuple[float, float]:
        return (row.explanation.killer.closing_m_s or 0.0, row.explanation.facts.get("goal_m", 0.0))

    return sorted((row for row in rows if row.explanation.label == label), key=severity, reverse=True)


def chosen_for_recording(rows: list[Row], wanted: int) -> list[Row]:
    """The worst episode of the most frequent label, then of the second, ...; after the last label the next
    worst of the first."""
    queues = [worst_of(rows, entry["label"]) for entry in table_of(rows)]
    rounds = [queue[i] for i in range(max(map(len, queues), default=0)) for queue in queues if i < len(queue)]
    return rounds[:wanted]


def record_worst(
    sim: Sim,
    rows: list[Row],
    folder: Path,
    world: str,
    method: str,
    note: Callable[[str], None],
    policy: PolicyNote | None = None,
    methods: Sequence[str] = (),
) -> list[Path]:
    """Play these episodes once more into ``folder``: an MCAP log each, named after the cause, with a picture
    and a video beside it.

    ``methods``: all that are compared, in order, so that each keeps its colour.
    """
    from uuvtai.logs.log_recorder import EpisodeRecorder
    from uuvtai.logs.picture import picture
    from uuvtai.logs.video import SMALL, video

    if not rows:
        return []
    jobs = [Job(row.result.seed, row.result.episode) for row in rows]
    recorder = EpisodeRecorder(folder, Path(world).stem, method, jobs, policy=policy)
    try:
        run_episodes(sim, jobs, recorder, driver=policy.pilot if policy else None)
    finally:
        recorder.abort()
    paths = [
        _renamed(recorder.paths[job], row.explanation.label) for job, row in zip(jobs, rows, strict=True)
    ]
    for path, row in zip(paths, rows, strict=True):
        note(f"drawing {path.stem}")
        label = row.explanation.label
        cause = label.replace("_", " ")
        picture(path, path.with_suffix(".png"), remark=f"{cause}: {causes.CAUSES[label]}", methods=methods)
        video(path, path.with_suffix(".webm"), remark=cause, methods=methods, **SMALL)
    return paths


def _renamed(path: Path, label: str) -> Path:
    return path.rename(path.with_name(f"{label}_{path.name}"))
