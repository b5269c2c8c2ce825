"""The paper's claims against our results: each holds, does not hold, or cannot be judged, always with the
numbers.

A claim about a method of training counts training seeds: another seed is what another reader would train.
Rates of success of two methods are compared by Welch's t (1947) over their seeds, which has 5 % of false
alarms at five seeds; a bootstrap over so few has twice as many, whatever it resamples within them. All seeds
meet the same episodes, so what is common to them cancels, and what is not is part of the spread over seeds.
A claim about one agent, which is there once, counts its episodes.

All tests of a page are one family, and Holm's adjustment (``judged``) bounds the chance that any of its
verdicts is a false alarm by ``LEVEL``. Claims that set one number beside another have no test and no p value.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median
from typing import Any, NamedTuple

from uuvtai.common.enums import COLLIDED, LETTERS
from uuvtai.common.errors import SettingError
from uuvtai.common.statistics import (
    binomial_p,
    design_effect,
    fisher_p,
    holm_adjusted,
    rate,
    student95,
    student_p,
    time_to_success_s,
    wilson_interval,
)
from uuvtai.report.tables import seconds

# ---- What the paper prints, as printed, and where its own figures do not add up.


class PrintedRow(NamedTuple):
    success: float
    collision: float
    episode_return: float
    mean_time_s: float
    tts_s: float


TABLE_MAIN = {
    "ppo": PrintedRow(0.20, 0.40, 197.3, 22.84, 114.2),
    "constant_20": PrintedRow(0.46, 0.20, 173.4, 13.44, 67.2),
    "paper": PrintedRow(0.87, 0.15, 176.4, 11.41, 15.8),
    "bt": PrintedRow(0.80, 0.10, 40.0, 14.50, 32.5),
}
"""by the names of our presets; 25 episodes an agent"""

MODERATE = {"S": 8, "D": 9, "v_m_s": 1.5}  # largest values of the conditions over which the paper gives means
MODERATE_SUCCESS, MODERATE_COLLISION = 0.828, 0.011
MODERATE_CONDITIONS, WITHOUT_COLLISION = 40, 38
FEW_MOVERS, FEW_MOVERS_COLLISION = 3, 0.004
CORNER = {"S": 12, "D": 15, "v_m_s": 3.0}
LOOP_MS, BUDGET_MS = 28.63, 20.0

INCONSISTENCIES = (
    "Table main: success 0.87 and collision 0.15 of the curriculum add up to more than 1, though every "
    "episode ends in one way.",
    "Table main: 25 episodes an agent (5 seeds x 5 trials) cannot give 0.46, 0.87 or 0.15: k/25 is 0.44 or "
    "0.48, 0.84 or 0.88, 0.12 or 0.16.",
    "Table main: TTS is defined as mean time over success rate; 22.84 / 0.20 = 114.2 holds, but 13.44 / 0.46 "
    "= 29.2 is printed as 67.2, 11.41 / 0.87 = 13.1 as 15.8, and 14.50 / 0.80 = 18.1 as 32.5.",
    "The curriculum collides in 0.15 of the episodes of Table main, but in 0.011 of those of the sweep with "
    "S <= 8, D <= 9, v <= 1.5.",
    "The schedule of lambda ends at iteration 1600, but runs last 1200 iterations: lambda never reaches 0, "
    "its last value is 0.1.",
    "The sweep counts 40 conditions with S <= 8, D <= 9, v <= 1.5; its own grid has 2 x 4 x 5 = 40 only if D "
    "= 0 counts once per speed, at which nothing moves.",
    "The ablation is announced as four variants, but no table gives results of 'LWM risk' and 'LWM'.",
)
"""found while rebuilding it; what we do instead is in docs/results.md"""


HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be judged"
LEVEL = 0.05  # of all tests of a reproduction together


@dataclass(frozen=True)
class Finding:
    """Which way the numbers point, and how probable that is by chance; p = None: nothing was tested."""

    points_to: str
    p: float | None
    reason: str = ""
    """why it cannot be judged"""


@dataclass(frozen=True)
class Claim:
    """One claim and what became of it."""

    text: str
    theirs: str
    ours: str
    points_to: str
    p: float | None = None  # of the claim's own test
    reason: str = ""
    """why it cannot be judged"""
    verdict: str = ""  # by ``judged``
    p_holm: float | None = None  # adjusted for all tests of the page


def claim(text: str, theirs: str, ours: str, finding: Finding) -> Claim:
    return Claim(text, theirs, ours, finding.points_to, finding.p, finding.reason)


def judged(claims: Sequence[Claim]) -> list[Claim]:
    """The claims with verdicts: a test decides where its Holm-adjusted p is below ``LEVEL``."""
    adjusted = iter(holm_adjusted([c.p for c in claims if c.p is not None]))
    return [replace(c, verdict=c.points_to) if c.p is None else _judged(c, next(adjusted)) for c in claims]


def _judged(c: Claim, p_holm: float) -> Claim:
    if p_holm < LEVEL:
        return replace(c, p_holm=p_holm, verdict=c.points_to, reason="")
    return replace(c, p_holm=p_holm, verdict=OPEN, reason="may be chance")


@dataclass(frozen=True)
class Share:
    """k of n."""

    k: int
    n: int
    design: float = 1.0
    """how many times fewer independent episodes would say as much"""

    @property
    def rate(self) -> float:
        """k / n; 0 of nothing."""
        return rate(self.k, self.n) or 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % Wilson of the independent episodes; everything for nothing."""
        return wilson_interval(self.k / self.design, self.n / self.design) or (0.0, 1.0)

    def counts(self, against: float | None = None) -> tuple[int, int]:
        """(k, n) of as few independent episodes, rounded towards the rate ``against``."""
        n = math.floor(self.n / self.design + 1e-9)
        k, nearest = self.rate * n, round(self.rate * n)
        if against is None or abs(k - nearest) < 1e-9:
            return nearest, n
        return (math.ceil(k) if self.rate < against else math.floor(k)), n

    def __str__(self) -> str:
        """k/n = p % [low, high]."""
        low, high = self.interval
        return f"{self.k}/{self.n} = {100 * self.rate:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def pooled(agents: Sequence[dict[str, Any]], *outcomes: str) -> Share:
    """Share of the episodes of these entries (of ``uuv eval`` or a sweep) that ended in ``outcomes``. Raises
    ValueError for several entries without the end of every episode."""
    k, n = sum(m["outcomes"][o] for m in agents for o in outcomes), sum(m["episodes"] for m in agents)
    return Share(k, n, _design(agents, outcomes) if len(agents) > 1 else 1.0)


def _design(agents: Sequence[dict[str, Any]], outcomes: Sequence[str]) -> float:
    """Of entries that share episodes by their numbers."""
    won, ran = Counter[Hashable](), Counter[Hashable]()
    for agent in agents:
        ends = ends_of(agent)
        if len(ends) != agent["episodes"]:
            raise SettingError(f"{len(ends)} of {agent['episodes']} episodes say how they ended")
        ran.update(ends.keys())
        won.update(key for key, end in ends.items() if end in outcomes)
    return design_effect([won[key] for key in ran], list(ran.values()))


def ends_of(entry: dict[str, Any]) -> dict[Hashable, str]:
    """How every episode of an entry ended, by its number; {} where that was not kept."""
    if details := entry.get("episodes_detail"):
        return {(e["seed"], e["episode"]): e["outcome"] for e in details}
    names = {letter: name for name, letter in LETTERS.items()}
    return dict(enumerate(entry.get("episode_outcomes") or [names[c] for c in entry.get("ends") or ""]))


def larger(a: Share, b: Share) -> Finding:
    """Whether a's rate is the larger one (Fisher's exact test)."""
    return Finding(HOLDS if a.rate > b.rate else FAILS, fisher_p(*a.counts(), *b.counts()))


def at_least(a: Share, value: float) -> Finding:
    """Whether a's rate reaches a value (exact binomial test)."""
    return Finding(HOLDS if a.rate >= value else FAILS, binomial_p(*a.counts(value), value))


def at_most(a: Share, value: float) -> Finding:
    """Whether a's rate stays below a value (exact binomial test)."""
    return Finding(HOLDS if a.rate <= value else FAILS, binomial_p(*a.counts(value), value))


@dataclass(frozen=True)
class Estimate:
    """A mean with the variance of this mean, and the degrees of freedom of that."""

    mean: float
    variance: float
    freedom: float
    """0 = of one training seed, which says nothing about others"""
    shown: str

    def __str__(self) -> str:
        return self.shown


def over_seeds(values: Sequence[float], least: float = 0.0) -> Estimate:
    """Of a method, one value a training seed, with Student's interval; ``least``: variance of the mean that
    there is in any case."""
    n, middle = len(values), fmean(values)
    if n < 2:
        return Estimate(middle, least, 0.0, f"{100 * middle:.1f} % (1 seed)")
    variance = max(least, sum((value - middle) ** 2 for value in values) / (n - 1) / n)
    half = student95(n - 1) * math.sqrt(variance)
    low, high = 100 * max(0.0, middle - half), 100 * min(1.0, middle + half)
    shown = f"{100 * middle:.1f} % [{low:.1f}, {high:.1f}] ({n} seeds)"
    return Estimate(middle, variance, n - 1.0, shown)


def of_method(entries: Sequence[dict[str, Any]], *outcomes: str) -> Estimate:
    """Rate of a method's episodes that ended in ``outcomes``; an entry of ``uuv eval`` a training seed. The
    seeds of a rate near 0 or 1 may agree by chance: their episodes vary at the least."""
    shares = [pooled([entry], *outcomes) for entry in entries]
    all_of_them = Share(sum(share.k for share in shares), sum(share.n for share in shares))
    return over_seeds([share.rate for share in shares], _softened(all_of_them))


def of_agent(share: Share) -> Estimate:
    """Rate of one agent over episodes (variance of Agresti and Caffo 2000, which is none too small for one-
    sided samples)."""
    return Estimate(share.rate, _softened(share), max(1.0, share.n - 1.0), str(share))


def _softened(share: Share) -> float:
    """Variance of a rate with one success and one failure more."""
    p = (share.k + 1) / (share.n + 2)
    return p * (1.0 - p) / (share.n + 2)


MARGIN = 0.1  # how far a rate may fall behind another one that it is said to come near


def compared(a: Estimate, b: Estimate, factor: float = 1.0, margin: float = 0.0) -> Finding:
    """Whether a > factor b - margin, by Welch's t."""
    if not a.freedom or not b.freedom:
        return Finding(OPEN, None, "one training seed says nothing about others")
    of_a, of_b = a.variance, factor * factor * b.variance
    if not of_a + of_b:
        return Finding(OPEN, None, "none of the training seeds differ")
    ahead = a.mean - factor * b.mean + margin
    freedom = (of_a + of_b) ** 2 / (of_a**2 / a.freedom + of_b**2 / b.freedom)
    return Finding(HOLDS if ahead > 0.0 else FAILS, student_p(ahead / math.sqrt(of_a + of_b), freedom))


# ------------------------------------------------------------------------------------------------- Table main


def of_table_main(by_method: dict[str, list[dict[str, Any]]]) -> list[Claim]:
    """Claims about methods and ablations; entries of ``uuv eval`` by method, one per training seed."""
    success = {name: of_method(entries, "success") for name, entries in by_method.items()}
    collision = {name: of_method(entries, *COLLIDED) for name, entries in by_method.items()}
    ours, plain = success["paper"], success["ppo"]
    times = [seconds(tts_s(by_method[name])) for name in ("paper", "ppo")]
    returns = [over_seeds([entry["return_mean"] for entry in by_method[name]]) for name in ("ppo", "paper")]
    without = "over PPO without distillation"
    return [
        claim(
            f"Curriculum distillation raises success {without}",
            "0.87 against 0.20",
            f"{ours} against {plain}",
            compared(ours, plain),
        ),
        claim(
            f"Success rises by nearly a factor of four (3.5 at least) {without}",
            f"{0.87 / 0.20:.2f}",
            f"{ours.mean / plain.mean:.2f}" if plain.mean else "-",
            compared(ours, plain, _NEARLY_FOUR),
        ),
        claim(
            "Curriculum distillation collides less than PPO without distillation",
            "0.15 against 0.40",
            f"{collision['paper']} against {collision['ppo']}",
            compared(collision["ppo"], collision["paper"]),
        ),
        claim(
            "Time to success (mean time / success rate) falls far below (under half) that of PPO without "
            "distillation",
            "15.8 s against 114.2 s",
            " against ".join(times),
            compared(_quickness(by_method["paper"]), _quickness(by_method["ppo"]), 2.0),
        ),
        claim(
            "PPO without distillation collects more return than curriculum distillation (by our weights)",
            "197.3 against 176.4",
            " against ".join(f"{estimate.mean:.1f}" for estimate in returns),
            compared(returns[0], returns[1]),
        ),
        *_beside_tree(by_method["paper"], by_method["bt"]),
        *[
            claim(text, theirs, f"{success[a]} against {success[b]}", compared(success[a], success[b]))
            for a, b, text, theirs in _PAIRS
            if a in success and b in success
        ],
    ]


def _beside_tree(method: list[dict[str, Any]], tree: list[dict[str, Any]]) -> list[Claim]:
    """The distilled policy beside its teacher, whose mean time counts as exact."""
    ours, theirs = of_method(method, "success"), of_agent(pooled(tree, "success"))
    quick, at = _quickness(tree), theirs.mean or 1.0
    quick = replace(quick, variance=theirs.variance * (quick.mean / at) ** 2, freedom=theirs.freedom)
    return [
        claim(
            "Curriculum distillation approaches the robustness of the behavior tree (within 10 points)",
            "0.87 against 0.80",
            f"{ours} against {theirs}",
            compared(ours, theirs, margin=MARGIN),
        ),
        claim(
            "Curriculum distillation is more efficient than the behavior tree (mean time / success rate)",
            "15.8 s against 32.5 s",
            f"{seconds(tts_s(method))} against {seconds(tts_s(tree))}",
            compared(_quickness(method), quick),
        ),
    ]


_NEARLY_FOUR = 3.5
_PAIRS = (
    ("paper", "constant_20", "Curriculum distillation beats a constant weight of 20 %", "0.87 against 0.46"),
    (
        "paper",
        "no_risk_scaling",
        "Scaling the distillation by the world model's uncertainty raises success (ablation 'LWM risk')",
        "no table",
    ),
    ("paper", "no_world_model", "The world model's features raise success (ablation 'LWM')", "no table"),
    (
        "paper_10hz",
        "ppo_10hz",
        "Curriculum distillation raises success over PPO without distillation, decisions at 10 Hz",
        "not tried",
    ),
)


def _quickness(entries: Sequence[dict[str, Any]]) -> Estimate:
    """1 / TTS by training seed: 0 where nobody arrives."""
    times = [tts_s([entry]) for entry in entries]
    return over_seeds([1.0 / time if time else 0.0 for time in times])


def tts_s(entries: Sequence[dict[str, Any]]) -> float | None:
    """The paper's TTS [s] of these entries: mean time of all / rate of success; None without either."""
    n = sum(entry["episodes"] for entry in entries)
    times = [entry["time_mean_s"] for entry in entries]
    if not n or any(time is None for time in times):
        return None
    total = sum(time * entry["episodes"] for time, entry in zip(times, entries, strict=True))
    return time_to_success_s(total / n, sum(entry["outcomes"]["success"] for entry in entries) / n)


# --------------------------------------------------------------------------------------------------- training


def training_facts(rows: Sequence[dict[str, Any]], limit: float) -> dict[str, Any]:
    """What the rows of a training's ``metrics.jsonl`` say of its mechanism: ``losses`` of the world model
    (means of the first and the last quarter), ``scale`` s_t (first, median, last, share of the iterations at
    its ``limit``), and the world model's ``skill``, target by target: the median over the last quarter. Of
    what the method does not have, nothing."""
    losses = {}
    for key in LOSSES:
        curve = [row[key] for row in rows if row.get(key) is not None]
        if (quarter := len(curve) // 4) > 0:
            losses[key] = [fmean(curve[:quarter]), fmean(curve[-quarter:])]
    scales = [row["distillation/scale"] for row in rows if "distillation/scale" in row]
    full = fmean(value >= limit - 1e-9 for value in scales) if scales else 0.0
    late, skill = rows[-max(1, len(rows) // 4) :], {}
    for key in [key for key in (late[-1] if late else {}) if key.startswith(_SKILL)]:
        found = [row[key] for row in late if row.get(key) is not None]
        skill[key.removeprefix(_SKILL)] = median(found) if found else None
    scale = [scales[0], median(scales), scales[-1], full] if scales else None
    return {"losses": losses, "scale": scale, "skill": skill}


LOSSES = {"world_model/reconstruction_loss": "Reconstruction", "world_model/dynamics_loss": "Dynamics"}
_SKILL = "world_model/skill/"  # that of learning.world_model, which takes torch to import


def of_training(trainings: Sequence[dict[str, Any]]) -> list[Claim]:
    """Whether the world model's losses fall; ``training_facts`` of the method's trainings."""
    claims = []
    for key, name in LOSSES.items():
        ends = [facts["losses"][key] for facts in trainings if key in facts["losses"]]
        text = f"{name} loss falls and settles"
        if not ends or len(ends) < len(trainings):
            claims.append(Claim(text, "curve", "-", OPEN, reason="too few iterations"))
            continue
        fallen = sum(last < first - 0.1 * abs(first) for first, last in ends)
        first, last = (fmean(values) for values in zip(*ends, strict=True))
        shown = f"in {fallen} of {len(ends)} trainings; first quarter {first:.3g}, last {last:.3g}"
        claims.append(Claim(text, "curve", shown, HOLDS if fallen == len(ends) else FAILS))
    return claims


# ------------------------------------------------------------------------------------------------------ sweep


def of_sweep(cells: Sequence[dict[str, Any]], agent: str) -> list[Claim]:
    """Claims about the grid of conditions, for one agent of a sweep."""
    own = [cell for cell in cells if cell["agent"] == agent]
    moderate = [cell for cell in own if all((cell[name] or 0) <= most for name, most in MODERATE.items())]
    few = [cell for cell in own if cell["D"] <= FEW_MOVERS]
    corner = [cell for cell in own if all(cell[name] == value for name, value in CORNER.items())]
    success, collision = pooled(moderate, "success"), pooled(moderate, *COLLIDED)
    spotless = sum(not any(cell["outcomes"][o] for o in COLLIDED) for cell in moderate)
    return [
        claim(
            f"{agent}: mean success over S <= 8, D <= 9, v <= 1.5 m/s",
            f"{MODERATE_SUCCESS}",
            str(success),
            at_least(success, MODERATE_SUCCESS),
        ),
        claim(
            f"{agent}: mean collision there",
            f"{MODERATE_COLLISION}",
            str(collision),
            at_most(collision, MODERATE_COLLISION),
        ),
        claim(
            f"{agent}: conditions without any collision there",
            f"{WITHOUT_COLLISION} of {MODERATE_CONDITIONS}",
            f"{spotless} of {len(moderate)} (D = 0 once per S), {moderate[0]['episodes'] if moderate else 0} "
            "episodes each",
            Finding(OPEN, None, "more episodes a cell leave fewer such cells, and theirs are not printed"),
        ),
        claim(
            f"{agent}: collision for D <= 3 over all S and v",
            f"below {FEW_MOVERS_COLLISION}",
            str(pooled(few, *COLLIDED)),
            at_most(pooled(few, *COLLIDED), FEW_MOVERS_COLLISION),
        ),
        claim(
            f"{agent}: degrades in the corner S = 12, D = 15, v = 3.0 m/s",
            "as told",
            f"{pooled(corner, 'success')} against {success}",
            larger(success, pooled(corner, "success")),
        ),
    ]


# ----------------------------------------------------------------------------------------------------- timing


def of_timing(profile: dict[str, Any]) -> list[Claim]:
    """Claims about time, from ``uuv profile --json``. Means of one machine: nothing is tested."""
    rows = {row["component"]: row["mean_ms"] for row in profile["paper_latency"]}
    if "Full loop" not in rows:
        return []
    inference = sum(rows[name] for name in ("WM encoder", "WM dynamics", "WM decoder", "PPO policy"))
    planner, loop, density = rows["Global planner"], rows["Full loop"], profile["paper_density"]
    stages = None if planner is None else rows["Mapping update"] + planner
    claims = [
        Claim(
            "Inference is negligible beside mapping and planning (under a tenth, in a step that plans)",
            "0.17 against 8.55 ms",
            f"{inference:.2f} against {'-' if stages is None else f'{stages:.2f}'} ms",
            OPEN if stages is None else HOLDS if inference < 0.1 * stages else FAILS,
            reason="no step planned anything" if stages is None else "",
        ),
        Claim(
            "A loop exceeds the 20 ms of 50 Hz",
            f"{LOOP_MS} ms",
            f"{loop:.2f} ms, p99 {profile['real_time']['p99_ms']:.2f} ms",
            HOLDS if loop > BUDGET_MS else FAILS,
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
    """Whether the same policy, untouched, drives in the second scene too; entries of ``uuv eval``."""
    a, b = pooled([here], "success"), pooled([there], "success")
    return [
        claim(
            "The policy transfers to another pool-style scene with other geometry and noise (within 10 "
            "points)",
            "shown, not counted",
            f"{b} there, {a} in pool",
            compared(of_agent(b), of_agent(a), margin=MARGIN),
        )
    ]
