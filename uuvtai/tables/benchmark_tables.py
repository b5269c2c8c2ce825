"""Tables of ``uuv benchmark``: the scenes, an entry's results, the checks of an entry."""

from __future__ import annotations

from typing import Any

from uuvtai.statistics import mean, rate, wilson_interval
from uuvtai.tables.method_tables import COLLISION, ENDS, SUCCESS, TIME
from uuvtai.tables.table import Cell, Column, Table
from uuvtai.tables.wording import accidents, number

_SCENES = (
    Column("benchmark", left=True, of=lambda row: row["name"]),
    Column("world", 2, left=True, of=lambda row: row["world"]),
    Column("S", of=lambda row: str(row["S"])),
    Column("D", of=lambda row: str(row["D"])),
    Column("v m/s", of=lambda row: number(row["v_m_s"])),
    Column("", prose=True, of=lambda row: row["about"]),
)


def scenes_table(document: dict[str, Any]) -> Table:
    """One row a scene."""
    title = (
        f"benchmark, version {document['version']}: {document['episodes']} episodes of seed "
        f"{document['seed']} each, paper sensing"
    )
    return Table(_SCENES, document["benchmarks"], title)


_RESULTS = (Column("benchmark", left=True, of=lambda row: row["name"]), SUCCESS, COLLISION, ENDS, TIME)


def entry_table(entry: dict[str, Any]) -> Table:
    """One row a scene that an entry has played."""
    pilot = entry["pilot"]["name"]
    kind = "" if entry["is_entry"] else " (a quick look: no entry)"
    return Table(_RESULTS, [counts_of(scene) for scene in entry["scenes"]], f"{pilot}{kind}")


def counts_of(scene: dict[str, Any]) -> dict[str, Any]:
    """Counts, rates and times of one scene of an entry, as tables of methods have them."""
    n, outcomes = len(scene["episodes"]), scene["outcomes"]
    k, collided = outcomes["success"], accidents(outcomes)
    return {
        "name": scene["name"],
        "episodes": n,
        "outcomes": outcomes,
        "success_rate": rate(k, n),
        "success_ci95": wilson_interval(k, n),
        "collision_rate": rate(collided, n),
        "collision_ci95": wilson_interval(collided, n),
        "time_to_success_mean_s": mean([row[2] for row in scene["episodes"] if row[1] == "success"]),
    }


_OK, _BAD, _TOLD = Cell("ok", style="green"), Cell("BAD", style="red"), Cell("other", style="yellow")
_CHECKS = (
    Column("", left=True, of=lambda check: _OK if check["ok"] else _TOLD if check["is_told"] else _BAD),
    Column("", left=True, of=lambda check: check["name"]),
    Column("", prose=True, of=lambda check: check["detail"]),
)


def checks_table(document: dict[str, Any]) -> Table:
    """One row a check of an entry, and one for the replay of each scene."""
    replays = [
        {
            "name": f"replay of {replay['scene']}",
            "ok": replay["agree"] == replay["episodes"],
            "is_told": False,
            "detail": _replayed(replay),
        }
        for replay in document["replays"]
    ]
    return Table(_CHECKS, [*document["checks"], *replays])


def _replayed(replay: dict[str, Any]) -> str:
    """'7 of 8 episodes agree; 12: success after .. in the entry, collision after .. here'."""
    said = f"{replay['agree']} of {replay['episodes']} episodes agree"
    first = "; ".join(
        f"{one['episode']}: {one['entry']} in the entry, {one['here']} here"
        for one in replay["differences"][:3]
    )
    return f"{said}; {first}" if first else f"{said} ({', '.join(map(str, replay['numbers']))})"
