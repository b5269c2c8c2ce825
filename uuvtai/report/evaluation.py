"""Tables of an evaluation (the document of ``uuv eval --json``): agents, pairs of them, why they failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from uuvtai.common.colours import agent_colours
from uuvtai.common.enums import FINAL_OUTCOMES
from uuvtai.report.blocks import Block, Figure, Paragraph
from uuvtai.report.figures import Line, intervals, rates_text
from uuvtai.report.tables import (
    PAGE,
    TERMINAL,
    Cell,
    Column,
    Data,
    Table,
    accidents,
    number,
    obstacles,
    percent,
    probability,
    rate,
    seconds,
    sensing,
    vehicle,
    with_interval,
)

DAGGER = "\u2020"  # marks privileged agents in the terminal

_ENDS = ("collision", "ttc", "out_of_tank", "timeout")


def _name(m: dict[str, Any]) -> Cell:
    return Cell(m["name"], f"{m['name']} {DAGGER}" if m.get("privileged") else "")


def _rate(record: dict[str, Any], key: str) -> Cell:
    """Of success or collision: as counted, else as the share says."""
    n, outcomes, share = record["episodes"], record.get("outcomes"), record.get(f"{key}_rate")
    if outcomes:
        k = outcomes["success"] if key == "success" else accidents(outcomes)
    else:
        k = None if share is None else round(share * n)
    return rate(k, n, record.get(f"{key}_ci95"))


def _ends(record: dict[str, Any]) -> Cell:
    counts = [str((record.get("outcomes") or {}).get(name, "-")) for name in _ENDS]
    return Cell(" / ".join(counts), "/".join(counts))


SUCCESS = Column("success", short="success [95 %]", of=lambda r: _rate(r, "success"))
COLLISION = Column("collision", short="collision [95 %]", of=lambda r: _rate(r, "collision"))
ENDS = Column("contact / TTC / out / timeout", 1, short="contact/ttc/\nout/timeout", of=_ends)
TIME = Column(
    "time to goal s", 2, short="time to\ngoal s", of=lambda r: number(r.get("time_to_success_mean_s"))
)
TTS = Column("TTS s", 4, of=lambda r: number(r.get("tts_s")))

_AGENTS = (
    Column("agent", left=True, of=_name),
    SUCCESS,
    COLLISION,
    ENDS,
    TIME,
    TTS,
    Column("replans", 3, only=TERMINAL, of=lambda m: number(m["replans_per_episode"])),
    Column("steps/s", 5, only=TERMINAL, of=lambda m: number(m["env_steps_per_s"], 0)),
    Column("return", only=PAGE, of=lambda m: number(m.get("return_mean"))),
    Column("closest m", only=PAGE, of=lambda m: number(m.get("min_clearance_mean_m"), 2)),
)


def milliseconds(value: float) -> str:
    """'0.018', '4.6', '450'."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _own_ms(m: dict[str, Any]) -> Cell:
    """Mean time of a decision, and the slowest; nothing where no code of the user's was called."""
    own = m.get("own") or {}
    mean_ms, slowest_ms = own.get("decision_ms"), own.get("slowest_ms")
    if mean_ms is None or slowest_ms is None:
        return Cell("-")
    mean_text, slowest_text = milliseconds(mean_ms), milliseconds(slowest_ms)
    return Cell(f"{mean_text} (slowest {slowest_text})", f"{mean_text} ({slowest_text})")


_OWN = Column("own code: ms a decision", 1, short="own code ms\n(slowest)", of=_own_ms)


def agents_table(agents: list[dict[str, Any]], title: str, **page: Any) -> Table:
    """One row an agent: rates with counts and 95 % Wilson intervals, other ends, times, own code's time."""
    columns = (*_AGENTS, _OWN) if any(m.get("own") for m in agents) else _AGENTS
    return Table(columns, agents, title, **page)


def _difference(pair: dict[str, Any]) -> str:
    return with_interval(pair.get("time_difference_mean_s"), pair.get("time_difference_ci95"))


_BOTH = Column("both arrive", of=lambda p: str(p["both"]))
_PAIRS = (
    Column("a : b", left=True, only=TERMINAL, of=lambda p: f"{p['a']} : {p['b']}"),
    Column("a", left=True, only=PAGE, of=lambda p: p["a"]),
    Column("b", left=True, only=PAGE, of=lambda p: p["b"]),
    Column("episodes", only=PAGE, of=lambda p: str(p["episodes"])),
    replace(_BOTH, only=PAGE),
    Column("only a", short="only a\narrives", of=lambda p: str(p["only_a"])),
    Column("only b", short="only b\narrives", of=lambda p: str(p["only_b"])),
    Column("McNemar's p", short="p\n(McNemar)", of=lambda p: probability(p["mcnemar_p"])),
    Column("time of a s", only=PAGE, of=lambda p: number(p.get("time_a_mean_s"), 2)),
    Column("time of b s", only=PAGE, of=lambda p: number(p.get("time_b_mean_s"), 2)),
    Column("a - b s", 1, short="time a - b, where both\narrive: s [95 %]", of=_difference),
    replace(_BOTH, only=TERMINAL, priority=2, short="both\narrive"),
)


def paired_table(pairs: list[dict[str, Any]], title: str, **page: Any) -> Table:
    """Two agents on the episodes of both: who alone arrives, how sure, difference in time of both."""
    return Table(_PAIRS, pairs, title, **page)


def limit_of_p(agents: list[dict[str, Any]]) -> str:
    """What p does not say where several policies of the user's own training are compared; '' elsewhere."""
    paths = [(m.get("checkpoint") or {}).get("path", "built-in") for m in agents]
    if sum(path != "built-in" for path in paths) < 2:
        return ""
    return (
        "p is of these policies, not of the way to train: for that, train each with several --seed, and "
        "compare success rates, one number a training."
    )


def _median(cause: dict[str, Any], key: str) -> Cell:
    return Cell(number(cause[key]), seconds(cause[key]))


_CAUSES = (
    Column("cause", left=True, of=lambda c: Cell(c["label"].replace("_", " "), c["label"])),
    Column("n", of=lambda c: str(c["count"])),
    Column("share", of=lambda c: percent(c["share"], 0)),
    Column("knew", 2, of=lambda c: percent(c["knew_share"], 0)),
    Column("unseen s", 3, short="unseen", of=lambda c: _median(c, "undetected_median_s")),
    Column("evading s", 4, short="evading", of=lambda c: _median(c, "evading_median_s")),
    Column("last chance s", 5, short="chance", of=lambda c: _median(c, "last_chance_median_s")),
    Column("worst", 1, left=True, only=TERMINAL, of=lambda c: ":".join(map(str, c["examples"][0]))),
    Column("meaning", prose=True, only=PAGE, of=lambda c: c["meaning"]),
)


def causes_table(agent: dict[str, Any], title: str) -> Table:
    """Why episodes of an agent failed, the most frequent cause first."""
    return Table(_CAUSES, agent["causes"], title)


# ---- Blocks of an evaluation (the document of ``uuv eval --json``): agents, and why they failed.

AgentSpec = dict[str, Any]


def evaluation(result: dict[str, Any], command: str = "", episodes: Sequence[Block] = ()) -> list[Block]:
    """All that an evaluation has to show: what it says, ``episodes`` (player, pictures), then tables."""
    agents = result["agents"]
    table = agents_table(agents, _SHOWN, data=evaluation_data(agents), swatches=_swatches(agents))
    blocks: list[Block] = [*_opening(agents, result.get("paired", [])), Paragraph(conditions(result))]
    blocks += [*episodes, table]
    if agents:
        blocks.append(_rates_figure(agents, command))
    blocks += _paired(result.get("paired", []))
    blocks += [Paragraph(limit)] if (limit := limit_of_p(agents)) else []
    blocks.append(Table(_PLANNING, agents, "Planning", swatches=_swatches(agents)))
    for agent in agents:
        blocks += _causes(agent)
    return blocks


_MOST_NAMED = 4  # agents in the sentence of the result


def by_success(agents: list[AgentSpec]) -> list[AgentSpec]:
    """Those that ran, the most successful first, then the fastest."""
    ran = [m for m in agents if m["episodes"] and m.get("outcomes")]
    soonest = sorted(ran, key=lambda m: m.get("time_to_success_mean_s") or 0.0)
    return sorted(soonest, key=lambda m: m["outcomes"]["success"] / m["episodes"], reverse=True)


def who_arrived(agents: list[AgentSpec]) -> str:
    """Who reached the goal how often and how soon, in a sentence; '' without episodes."""
    if not (ran := by_success(agents)):
        return ""
    first, *others = ran

    def took(m: AgentSpec, how: str = "") -> str:
        mean_s = m.get("time_to_success_mean_s")
        return "" if mean_s is None else f" ({mean_s:.1f} s{how})"

    arrived, n = first["outcomes"]["success"], first["episodes"]
    many, how = ("s", " on average") if n > 1 else ("", "")
    said = f"{first['name']} reached the goal in {arrived} of {n} episode{many}{took(first, how)}"
    for m in others[: _MOST_NAMED - 1]:
        said += f", {m['name']} in {m['outcomes']['success']}{took(m)}"
    if rest := others[_MOST_NAMED - 1 :]:
        said += f", {len(rest)} more agents in {rest[0]['outcomes']['success']} or fewer"
    return f"{said}."


def _opening(agents: list[AgentSpec], pairs: list[dict[str, Any]]) -> list[Block]:
    """Who reached the goal how often, and the two best of several episodes; [] without any."""
    if not (said := who_arrived(agents)):
        return []
    blocks: list[Block] = [Paragraph(said, leads=True)]
    best = {m["name"] for m in by_success(agents)[:2]}
    both = [pair for pair in pairs if {pair["a"], pair["b"]} == best and pair["episodes"] > 1]
    return blocks + [Paragraph(_duel(pair)) for pair in both[:1]]


def _duel(pair: dict[str, Any]) -> str:
    """A pair in words: who alone arrived, how sure that is, who was faster."""
    a, b = pair["a"], pair["b"]
    said = (
        f"Of the same {pair['episodes']} episodes {a} alone arrived in {pair['only_a']}, {b} alone in "
        f"{pair['only_b']} (McNemar's exact p = {probability(pair['mcnemar_p'])})"
    )
    gap = pair.get("time_difference_mean_s")
    if gap is None:
        return f"{said}."
    took = f"{number(abs(gap), 2)} s {'less' if gap < 0 else 'longer'}"
    sure = with_interval(gap, pair.get("time_difference_ci95"))
    return f"{said}; where both arrived, {a} took {took} (difference with its 95 % interval: {sure} s)."


_SHOWN = (
    "Agents. Collision counts contacts, TTC stops and episodes out of the tank; intervals are 95 % Wilson. "
    "Time to goal: mean over successes; TTS: mean time over success rate."
)


def conditions(result: dict[str, Any]) -> str:
    speed = f", v = {result['v_m_s']} m/s" if result["D"] else ""
    seeds = ", ".join(map(str, result["seeds"]))
    return (
        f"World {result['world']}, {obstacles(result, ' static', ' dynamic obstacles')}{speed}, "
        f"{vehicle(result)}{sensing(result)}; seeds {seeds}, {result['episodes_per_seed']} episodes each, "
        "the same ones for every agent."
    )


def _swatches(agents: list[AgentSpec]) -> list[str]:
    names = [m["name"] for m in agents]
    colours = agent_colours(names)
    return [colours[name] for name in names]


_PLAIN = (
    "success_rate", "collision_rate", "time_to_success_mean_s", "time_mean_s", "tts_s", "return_mean",
    "min_clearance_mean_m",
)  # fmt: skip


def evaluation_data(agents: list[AgentSpec]) -> Data:
    """Counts, rates, bounds and times of every agent as numbers."""
    bounds = ("success_ci95_low", "success_ci95_high", "collision_ci95_low", "collision_ci95_high")
    rows = []
    for m in agents:
        rates = [*(m["success_ci95"] or (None, None)), *(m["collision_ci95"] or (None, None))]
        counts = [m["outcomes"][name] for name in FINAL_OUTCOMES]
        rows.append([m["name"], m["episodes"], *counts, *rates, *(m.get(name) for name in _PLAIN)])
    return Data(["agent", "episodes", *FINAL_OUTCOMES, *bounds, *_PLAIN], rows)


def _rates_figure(agents: list[AgentSpec], command: str) -> Figure:
    names = [m["name"] for m in agents]
    colours = _swatches(agents)
    panels = [
        intervals(
            [_rates_line(i, m, key, colours[i]) for i, m in enumerate(agents)], names, key, "", joined=False
        )
        for key in ("success", "collision")
    ]
    caption = "Success and collision of every agent with 95 % Wilson intervals"
    return Figure("agents", panels, caption, evaluation_data(agents), command)


def _rates_line(place: int, agent: AgentSpec, key: str, colour: str) -> Line:
    """The one point of an agent; none where it ran none."""
    if agent[f"{key}_rate"] is None:
        return Line(agent["name"], [], [], [], [], colour=colour)
    name, value, (low, high) = agent["name"], agent[f"{key}_rate"], agent[f"{key}_ci95"]
    return Line(name, [place], [value], [low], [high], [f"{name}\n{rates_text(agent)}"], colour)


_PAIRED = (
    "both", "only_a", "only_b", "mcnemar_p", "time_a_mean_s", "time_b_mean_s", "time_difference_mean_s",
)  # fmt: skip


_BOUNDS = "time_difference_ci95"


def _paired(pairs: list[dict[str, Any]]) -> list[Block]:
    """[] without two agents."""
    if not pairs:
        return []
    caption = (
        "Pairs of agents on the same episodes: who alone arrives, with McNemar's exact p, and the mean "
        "times where both arrive, their difference with its 95 % bootstrap interval. The values of p are not "
        "adjusted for the number of pairs"
    )
    return [paired_table(pairs, caption, data=paired_data(pairs))]


def paired_data(pairs: list[dict[str, Any]]) -> Data:
    keys = ("a", "b", "episodes", *_PAIRED)
    rows = [[*map(pair.get, keys), *(pair.get(_BOUNDS) or (None, None))] for pair in pairs]
    return Data([*keys, f"{_BOUNDS}_low", f"{_BOUNDS}_high"], rows)


def _counts(agent: AgentSpec, key: str, *names: str) -> str:
    return " / ".join(str(agent.get(key, {}).get(name, "-")) for name in names)


_PLANNING = (
    Column("agent", left=True, of=lambda m: m["name"]),
    Column("replans an episode", of=lambda m: number(m.get("replans_per_episode"))),
    Column(
        "initial / stuck / safety / intersection",
        of=lambda m: _counts(m, "replans_by_trigger", "initial", "stuck", "safety", "intersection"),
    ),
    Column("Voronoi / RRT / own", of=lambda m: _counts(m, "planned_by", "voronoi", "rrt", "own")),
    Column("path m", of=lambda m: number(m.get("path_length_mean_m"))),
    Column("env-steps/s", of=lambda m: number(m.get("env_steps_per_s"), 0)),
)


# -------------------------------------------------------------------------------------------- causes


def _causes(agent: AgentSpec) -> list[Block]:
    if not agent.get("causes"):
        return []
    caption = (
        f"Why {len(agent['explain'])} of {agent['episodes']} episodes of {agent['name']} failed. "
        "Knew: share whose forecast of the obstacle 1 s before the end was right; times are medians before "
        "the end"
    )
    return [causes_table(agent, caption)]
