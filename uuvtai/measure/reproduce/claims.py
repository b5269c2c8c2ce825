"""The paper's claims against our results: each holds, does not hold, or cannot be judged, always with the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from uuvtai.measure.reproduce import paper
from uuvtai.measure.statistics import rate, time_to_success_s, wilson_interval
from uuvtai.outcomes import COLLIDED

HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be judged"


@dataclass(frozen=True)
class Claim:
    """One claim and what became of it."""

    text: str
    theirs: str
    ours: str
    verdict: str


@dataclass(frozen=True)
class Share:
    """k of n."""

    k: int
    n: int

    @property
    def rate(self) -> float:
        """k / n; 0 of nothing."""
        return rate(self.k, self.n) or 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson; everything where there is nothing."""
        return wilson_interval(self.k, self.n) or (0.0, 1.0)

    def __str__(self) -> str:
        """k/n = p % [low, high]."""
        low, high = self.interval
        return f"{self.k}/{self.n} = {100 * self.rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def pooled(methods: Sequence[dict[str, Any]], *outcomes: str) -> Share:
    """Share of the episodes of all these entries (of ``uuv eval`` or a sweep) that ended in one of ``outcomes``."""
    return Share(sum(m["outcomes"][o] for m in methods for o in outcomes), sum(m["episodes"] for m in methods))


def larger(a: Share, b: Share) -> str:
    """Whether a's rate is the larger one: intervals apart decide, else it cannot be judged."""
    if a.interval[0] > b.interval[1]:
        return HOLDS
    return FAILS if a.interval[1] < b.interval[0] else OPEN


def at_least(a: Share, value: float) -> str:
    """Whether a's rate reaches a value: only an interval wholly on one side of it decides."""
    if a.interval[0] >= value:
        return HOLDS
    return FAILS if a.interval[1] < value else OPEN


def at_most(a: Share, value: float) -> str:
    """Whether a's rate stays below a value."""
    if a.interval[1] <= value:
        return HOLDS
    return FAILS if a.interval[0] > value else OPEN


_MARGIN = 0.1
"""how far a rate may fall behind another one that it is said to come near"""


def near(a: Share, b: Share) -> str:
    """Whether a's rate comes near b's or above (non-inferiority with a margin of 10 points)."""
    if a.interval[0] >= b.rate - _MARGIN:
        return HOLDS
    return FAILS if a.interval[1] < b.interval[0] else OPEN


# -------------------------------------------------------------------------------------------------------------- Table main


def of_table_main(by_preset: dict[str, list[dict[str, Any]]]) -> list[Claim]:
    """Claims about the four methods and the ablations; entries of ``uuv eval`` by preset, one per training seed."""
    success = {name: pooled(entries, "success") for name, entries in by_preset.items()}
    collision = {name: pooled(entries, *COLLIDED) for name, entries in by_preset.items()}
    ours, plain = success["curriculum"], success["ppo"]
    ratio = ours.rate / plain.rate if plain.k else None
    tts = {name: _tts(entries) for name, entries in by_preset.items()}
    return [
        Claim(
            "Curriculum distillation raises success over PPO without distillation",
            "0.87 against 0.20",
            f"{ours} against {plain}",
            larger(ours, plain),
        ),
        Claim(
            "Success rises by nearly a factor of four over PPO without distillation",
            f"{0.87 / 0.20:.2f}",
            "-" if ratio is None else f"{ratio:.2f}",
            OPEN if ratio is None else HOLDS if ratio >= 3.5 else FAILS,
        ),
        Claim(
            "Curriculum distillation beats a constant weight of 20 %",
            "0.87 against 0.46",
            f"{ours} against {success['distill_20']}",
            larger(ours, success["distill_20"]),
        ),
        Claim(
            "Curriculum distillation collides less than PPO without distillation",
            "0.15 against 0.40",
            f"{collision['curriculum']} against {collision['ppo']}",
            larger(collision["ppo"], collision["curriculum"]),
        ),
        Claim(
            "Time to success (mean time / success rate) falls far below that of PPO without distillation",
            "15.8 s against 114.2 s",
            f"{_seconds(tts['curriculum'])} against {_seconds(tts['ppo'])}",
            _far_below(tts["curriculum"], tts["ppo"], larger(ours, plain)),
        ),
        Claim(
            "Curriculum distillation approaches the robustness of the behaviour tree",
            "0.87 against 0.80",
            f"{ours} against {success['bt']}",
            near(ours, success["bt"]),
        ),
        *[
            Claim(text, "no table", f"{success['curriculum']} against {success[name]}", larger(success["curriculum"], success[name]))
            for name, text in _ABLATIONS.items()
        ],
    ]


_ABLATIONS = {
    "no_risk_scaling": "Scaling the distillation by the world model's uncertainty raises success (ablation 'LWM risk')",
    "no_world_model": "The world model's features raise success (ablation 'LWM')",
}


def _far_below(ours_s: float | None, theirs_s: float | None, by_success: str) -> str:
    """Less than half; None = nobody ever arrived, as slow as can be. How sure that is follows from the rates of success."""
    slower = ours_s is None or (theirs_s is not None and ours_s >= theirs_s / 2)
    return FAILS if slower else by_success


def _tts(entries: Sequence[dict[str, Any]]) -> float | None:
    n = sum(entry["episodes"] for entry in entries)
    total = sum(entry["time_mean_s"] * entry["episodes"] for entry in entries)
    return time_to_success_s(total / n if n else None, pooled(entries, "success").rate)


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} s"


# ----------------------------------------------------------------------------------------------------------------- training


def of_training(metrics: Sequence[dict[str, Any]]) -> list[Claim]:
    """Whether the world model's losses fall; rows of ``metrics.jsonl`` of the curriculum."""
    claims = []
    for key, name in (("world_model/reconstruction_loss", "Reconstruction"), ("world_model/dynamics_loss", "Dynamics")):
        values = [row[key] for row in metrics if key in row]
        part = max(1, len(values) // 5)
        if len(values) < 4:
            claims.append(Claim(f"{name} loss falls and settles", "curve", "too few iterations", OPEN))
            continue
        first, last = sum(values[:part]) / part, sum(values[-part:]) / part
        text = f"first fifth {first:.3g}, last fifth {last:.3g}"
        claims.append(Claim(f"{name} loss falls and settles", "curve", text, HOLDS if last < 0.9 * first else FAILS))
    return claims


# -------------------------------------------------------------------------------------------------------------------- sweep


def of_sweep(cells: Sequence[dict[str, Any]], method: str) -> list[Claim]:
    """Claims about the grid of conditions, for one method of a sweep."""
    own = [cell for cell in cells if cell["method"] == method]
    moderate = [cell for cell in own if all((cell[name] or 0) <= most for name, most in paper.MODERATE.items())]
    few = [cell for cell in own if cell["D"] <= paper.FEW_MOVERS]
    corner = [cell for cell in own if all(cell[name] == value for name, value in paper.CORNER.items())]
    success, collision = pooled(moderate, "success"), pooled(moderate, *COLLIDED)
    spotless = sum(not any(cell["outcomes"][o] for o in COLLIDED) for cell in moderate)
    return [
        Claim(
            f"{method}: mean success over S <= 8, D <= 9, v <= 1.5 m/s",
            f"{paper.MODERATE_SUCCESS}",
            str(success),
            at_least(success, paper.MODERATE_SUCCESS),
        ),
        Claim(
            f"{method}: mean collision there", f"{paper.MODERATE_COLLISION}", str(collision), at_most(collision, paper.MODERATE_COLLISION)
        ),
        Claim(
            f"{method}: conditions without any collision there",
            f"{paper.WITHOUT_COLLISION} of {paper.MODERATE_CONDITIONS}",
            f"{spotless} of {len(moderate)} (D = 0 once per S), {moderate[0]['episodes'] if moderate else 0} episodes each",
            HOLDS if moderate and spotless / len(moderate) >= paper.WITHOUT_COLLISION / paper.MODERATE_CONDITIONS else FAILS,
        ),
        Claim(
            f"{method}: collision for D <= 3 over all S and v",
            f"below {paper.FEW_MOVERS_COLLISION}",
            str(pooled(few, *COLLIDED)),
            at_most(pooled(few, *COLLIDED), paper.FEW_MOVERS_COLLISION),
        ),
        Claim(
            f"{method}: degrades in the corner S = 12, D = 15, v = 3.0 m/s",
            "as told",
            f"{pooled(corner, 'success')} against {success}",
            larger(success, pooled(corner, "success")),
        ),
    ]


# ------------------------------------------------------------------------------------------------------------------- timing


def of_timing(profile: dict[str, Any]) -> list[Claim]:
    """Claims about time, from ``uuv profile --json`` with one env and density."""
    rows = {row["component"]: row for row in profile["paper_latency"]}
    if "Full loop" not in rows:
        return []
    inference = sum(rows[name]["mean_ms"] for name in ("WM encoder", "WM dynamics", "WM decoder", "PPO policy"))
    stages = sum(rows[name]["mean_ms"] for name in ("Mapping update", "Global planner"))
    loop, density = rows["Full loop"]["mean_ms"], profile["paper_density"]
    claims = [
        Claim(
            "Inference is negligible beside mapping and planning",
            "0.17 against 8.55 ms",
            f"{inference:.2f} against {stages:.2f} ms",
            HOLDS if inference < 0.1 * stages else FAILS,
        ),
        Claim(
            "A loop exceeds the 20 ms of 50 Hz",
            f"{paper.LOOP_MS} ms",
            f"{loop:.2f} ms, p99 {profile['real_time']['p99_ms']:.2f} ms",
            HOLDS if loop > paper.BUDGET_MS else FAILS,
        ),
    ]
    if density:
        first, last = density[0]["loop_ms"], density[-1]["loop_ms"]
        grows = f"{density[0]['paper_loop_ms']} to {density[-1]['paper_loop_ms']} ms"
        claims.append(
            Claim(
                "Loop time grows with the number of moving obstacles",
                grows,
                f"{first:.2f} to {last:.2f} ms",
                HOLDS if last > 1.25 * first else FAILS,
            )
        )
    return claims


def of_transfer(here: dict[str, Any], there: dict[str, Any]) -> list[Claim]:
    """Whether the policy, untouched, drives in the second scene as well; entries of ``uuv eval`` of the same policy."""
    a, b = pooled([here], "success"), pooled([there], "success")
    return [
        Claim(
            "The policy transfers to another pool-style scene with other geometry and noise",
            "shown, not counted",
            f"{b} there, {a} in pool",
            near(b, a),
        )
    ]
