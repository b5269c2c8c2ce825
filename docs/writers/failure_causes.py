"""Causes of failure that ``uuv eval --explain`` knows, from the code that finds them."""

from __future__ import annotations

from uuvtai.evaluation.failure_causes import CAUSES, REMARKS
from uuvtai.report.tables import text_table


def page() -> str:
    """All causes with their meaning, in the order in which they are asked for; then the remarks."""
    causes = [[f"`{label}`", meaning] for label, meaning in CAUSES.items()]
    parts = [
        "# Causes of failure",
        "`uuv eval --explain` runs every failed episode again and gives it one cause, the first of these "
        "that holds. *It* is what the termination check stopped the episode for. Forecasts, and whether "
        "there was "
        "a way out, are judged 1 s before the end.",
        text_table(["cause", "meaning"], causes),
        "Remarks say what may have contributed, where it moves; any number of them may hold: "
        + ", ".join(REMARKS)
        + ".",
    ]
    return "\n\n".join(parts) + "\n"
