"""Tables of an evaluation (the document of ``uuv eval --json``): methods, pairs of them, why they failed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from uuvtai.tables.table import PAGE, TERMINAL, Cell, Column, Table
from uuvtai.tables.wording import accidents, number, percent, probability, rate, seconds, with_interval

DAGGER = "\u2020"
"""marks privileged methods in the terminal"""

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

_METHODS = (
    Column("method", left=True, of=_name),
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


def methods_table(methods: list[dict[str, Any]], title: str, **page: Any) -> Table:
    """One row a method: rates with counts and 95 % Wilson intervals, how the rest ended, both times; the time
    of the user's own code where there is any."""
    columns = (*_METHODS, _OWN) if any(m.get("own") for m in methods) else _METHODS
    return Table(columns, methods, title, **page)


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
    """Every two methods on the episodes that both played (``measure.paired``): who alone arrives, how sure
    that is, and the difference in time where both do."""
    return Table(_PAIRS, pairs, title, **page)


def _median(cause: dict[str, Any], key: str) -> Cell:
    return Cell(number(cause[key]), seconds(cause[key]))


_CAUSES = (
    Column("cause", left=True, of=lambda c: Cell(c["label"].replace("_", " "), c["label"])),
    Column("n", of=lambda c: str(c["count"])),
    Column("share", of=lambda c: percent(c["share"], 0)),
    Column("knew", 2, of=lambda c: percent(c["knew_share"], 0)),
    Column("unseen s", 3, short="unseen", of=lambda c: _median(c, "unseen_median_s")),
    Column("evading s", 4, short="evading", of=lambda c: _median(c, "evading_median_s")),
    Column("last chance s", 5, short="chance", of=lambda c: _median(c, "last_chance_median_s")),
    Column("worst", 1, left=True, only=TERMINAL, of=lambda c: ":".join(map(str, c["examples"][0]))),
    Column("meaning", prose=True, only=PAGE, of=lambda c: c["meaning"]),
)


def causes_table(method: dict[str, Any], title: str) -> Table:
    """Why episodes of a method failed, the most frequent cause first."""
    return Table(_CAUSES, method["causes"], title)
