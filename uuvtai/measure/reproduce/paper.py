"""What the paper prints, as printed, and where its own figures do not add up."""

from __future__ import annotations

from typing import NamedTuple


class PrintedRow(NamedTuple):
    """A row of Table main."""

    success: float
    collision: float
    mean_time_s: float
    tts_s: float


TABLE_MAIN = {
    "ppo": PrintedRow(0.20, 0.40, 22.84, 114.2),
    "distill_20": PrintedRow(0.46, 0.20, 13.44, 67.2),
    "curriculum": PrintedRow(0.87, 0.15, 11.41, 15.8),
    "bt": PrintedRow(0.80, 0.10, 14.50, 32.5),
}
"""by the names of our presets; 25 episodes a method"""

MODERATE = {"S": 8, "D": 9, "v_m_s": 1.5}
"""largest values of the conditions over which the paper gives means"""
MODERATE_SUCCESS, MODERATE_COLLISION = 0.828, 0.011
MODERATE_CONDITIONS, WITHOUT_COLLISION = 40, 38
FEW_MOVERS, FEW_MOVERS_COLLISION = 3, 0.004
CORNER = {"S": 12, "D": 15, "v_m_s": 3.0}
LOOP_MS, BUDGET_MS = 28.63, 20.0

INCONSISTENCIES = (
    "Table main: success 0.87 and collision 0.15 of the curriculum add up to more than 1, though every "
    "episode ends in one way.",
    "Table main: 25 episodes a method (5 seeds x 5 trials) cannot give 0.46, 0.87 or 0.15: k/25 is 0.44 or "
    "0.48, 0.84 or 0.88, 0.12 or 0.16.",
    "Table main: TTS is defined as mean time over success rate; 22.84 / 0.20 = 114.2 holds, but 13.44 / 0.46 "
    "= 29.2 is printed as 67.2, 11.41 / 0.87 = 13.1 as 15.8, and 14.50 / 0.80 = 18.1 as 32.5.",
    "The schedule of lambda ends at iteration 1600, but runs last 1200 iterations: lambda never reaches 0, "
    "its last value is 0.1.",
    "The sweep counts 40 conditions with S <= 8, D <= 9, v <= 1.5; its own grid has 2 x 4 x 5 = 40 only if D "
    "= 0 counts once per speed, at which nothing moves.",
    "The ablation is announced as four variants, but no table gives results of 'LWM risk' and 'LWM'.",
)
"""found while rebuilding it; what we do instead is in docs/results.md"""
