"""Tables of the pages sitl, vehicle and companion, from the newest results of the benchmarks ``closed_loop``,
``ardusub``, ``terminals`` and ``aboard``."""

from __future__ import annotations

from typing import Any

from docs.writers.figure_sources import SourceError, Sources
from uuvtai.statistics import mcnemar_p
from uuvtai.tables.table import text_table


def real_ardusub(sources: Sources) -> str:
    """What ArduSub itself did in our water."""
    return _tried(sources, "ardusub")


def _tried(sources: Sources, benchmark: str) -> str:
    rows = [row for row in sources.benchmark(benchmark)["rows"] if "parameters" not in row["details"]]
    driven = [row for row in rows if "endings" in row["details"]]
    told = {driven[0]["what"]: f"; {_paired(driven)}"} if len(driven) == 2 else {}
    cells = [[row["what"], _result(row), row["note"] + told.get(row["what"], "")] for row in rows]
    return text_table(["tried", "result", "more"], cells)


def terminals(sources: Sources) -> str:
    """Water, ArduSub and pilot as three processes."""
    return _tried(sources, "terminals")


def ardusub_identified(sources: Sources) -> str:
    """What ``uuv identify`` made of ArduSub's own logs, beside the true numbers."""
    found = {
        row["what"].rpartition(" ")[2]: row["details"]["parameters"]
        for row in sources.benchmark("ardusub_logs")["rows"]
        if "parameters" in row["details"]
    }
    if len(found) != 2:
        raise SourceError("the benchmark ardusub_logs was run without ArduSub")
    names = next(iter(found.values()))
    cells = [
        [name, f"{names[name][3]:.3g}", *(_interval(entries[name]) for entries in found.values())]
        for name in names
    ]
    return text_table(["number", "true", *(f"from `{ending}`" for ending in found)], cells)


def identified_vehicles(sources: Sources) -> str:
    """Of how many true values of random vehicles the intervals hold the truth."""
    cells = []
    for row in sources.benchmark("identify")["rows"]:
        found = row["details"]["table"]["within the interval"]
        late = {name: hits for name, hits in found.items() if name.startswith("delay")}
        own = {name: hits for name, hits in found.items() if name not in late}
        count = _VEHICLES * len(own)
        lag = found.get("rotor lag")
        cells.append(
            [
                row["what"].rpartition("known: ")[2],
                f"{sum(own.values()):.0f} of {count} = {100 * sum(own.values()) / count:.1f} %",
                "-" if lag is None else f"{lag:.0f} of {_VEHICLES}",
                f"{sum(late.values()):.0f} of {_VEHICLES * len(late)}",
            ]
        )
    return text_table(["known, rotor speeds", "numbers of the vehicle", "of them the lag", "delays"], cells)


_VEHICLES = 6


def _interval(entry: list[float]) -> str:
    value, low, high, true = entry
    return f"{value:.3g} [{low:.3g}, {high:.3g}]" + ("" if low <= true <= high else ": not within")


def _result(row: dict[str, Any]) -> str:
    if row["unit"] == "1 = yes":
        return "yes" if row["ours"] else "no"
    return f"{row['ours']:.3g} {row['unit']}"


def closed_loop(sources: Sources) -> str:
    """The same episodes by the interfaces and in the simulator's own loop, paired."""
    rows = sources.benchmark("closed_loop")["rows"]
    if len(rows) != 2:
        raise SourceError(f"the benchmark closed_loop has {len(rows)} rows, not two")
    told = [_paired(rows), ""]
    cells = [
        [row["what"].removeprefix("closed loop, "), f"{row['ours']:.1f} %", row["note"], more]
        for row, more in zip(rows, told, strict=True)
    ]
    return text_table(["driven", "success", "of episodes [95 %], and the others", "paired"], cells)


def aboard(sources: Sources) -> str:
    """Exported stacks beside what was decided at their export."""
    rows = [row for row in sources.benchmark("aboard")["rows"] if row["ours"] is not None]
    cells = [
        [row["what"], f"{row['details']['equal']} of {row['details']['steps']}", row["note"]] for row in rows
    ]
    return text_table(["machine and stack", "commands equal to the last bit", "more"], cells)


def _paired(rows: list[dict[str, Any]]) -> str:
    """The first row's episodes beside the second's."""
    arrived = [[end == "success" for end in row["details"]["endings"]] for row in rows]
    pairs = list(zip(*arrived, strict=True))
    first, second = (sum(pair == kind for pair in pairs) for kind in ((True, False), (False, True)))
    p = mcnemar_p(first, second)
    return f"only this arrives: {first}, only the other: {second}; exact McNemar p {p:.2g}"
