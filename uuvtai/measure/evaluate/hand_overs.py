"""How often a chooser hands the wheel over, and how much its policy drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from uuvtai.measure.episodes.playing import EpisodeResult, Job

if TYPE_CHECKING:
    from uuvtai.sim import Sim


class HandOvers:
    """Counts of the episodes that are played now."""

    def __init__(self, pilot: Any) -> None:
        """``pilot``: a ``learn.chooser.ChooserPilot``."""
        self._pilot, self._counts = pilot, dict[Job, tuple[int, int]]()

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """An episode has just been reset in this row."""

    def step(self, sim: Sim) -> None:
        """A control step has been done."""

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """The episode of this row is over."""
        counts = int(self._pilot.hand_overs[row]), int(self._pilot.driven[row])
        self._counts[Job(result.seed, result.episode)] = counts

    def entry(self, results: list[EpisodeResult], dt_s: float) -> dict[str, Any]:
        """Mean number of hand-overs in an episode, and the share of the time in which the policy drove;
        nothing where some of the results come from an earlier, interrupted command."""
        found = [self._counts.get(Job(result.seed, result.episode)) for result in results]
        counts = [pair for pair in found if pair is not None]
        if len(counts) < len(results) or not results:
            return {}
        steps = sum(round(result.time_s / dt_s) for result in results)
        return {
            "chooser": {
                "hand_overs_mean": sum(pair[0] for pair in counts) / len(results),
                "policy_share": sum(pair[1] for pair in counts) / max(1, steps),
            }
        }


def hand_overs_of(pilot: Any) -> HandOvers | None:
    """Counts for a chooser; None for another pilot."""
    return HandOvers(pilot) if hasattr(pilot, "hand_overs") else None


def told(entry: dict[str, Any]) -> str:
    """One line about a method's counts; empty where there are none."""
    counts = entry.get("chooser")
    if not counts:
        return ""
    return (
        f"{entry['name']}: {counts['hand_overs_mean']:.1f} hand-overs an episode; the policy drives "
        f"{100 * counts['policy_share']:.0f} % of the time, the tree the rest"
    )
