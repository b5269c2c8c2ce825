"""Tables of the pages sitl, vehicle and companion, from the newest results of the benchmarks ``closed_loop``,
``ardusub``, ``terminals`` and ``aboard``."""

from __future__ import annotations

import statistics
from typing import Any

from docs.writers.figure_sources import SourceError, Sources
from uuvtai.statistics import mcnemar_p, wilson_interval
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
    rows = sources.benchmark("identify")["rows"]
    cells, pooled = [], {}
    for row in rows:
        vehicles, found = row["details"]["vehicles"], row["details"]["table"]["within the interval"]
        late = {name: hits for name, hits in found.items() if name.startswith("delay")}
        own = {name: hits for name, hits in found.items() if name not in late}
        what = row["what"].rpartition("known: ")[2]
        lag = found.get("rotor lag")
        counts = [sum(own.values()), vehicles * len(own), sum(late.values()), vehicles * len(late)]
        cells.append([what, _held(*counts[:2]), "-" if lag is None else _of(lag, vehicles), _of(*counts[2:])])
        kind = what.rpartition(", ")[2]
        pooled[kind] = [a + b for a, b in zip(pooled.get(kind, [0] * 4), counts, strict=True)]
    cells += [[f"all three, {kind}", _held(*c[:2]), "-", _of(*c[2:])] for kind, c in pooled.items()]
    return text_table(
        ["known, rotor speeds", "numbers of the vehicle [95 %]", "of them the lag", "delays"], cells
    )


def identified_before(sources: Sources) -> str:
    """Commanded speeds with known buoyancy, by the fit before and after, on drives delayed either way."""
    rows = list(sources.benchmark("identify_before")["rows"])
    rows += [row for row in sources.benchmark("identify")["rows"] if row["what"].endswith(_COMPARED)]
    names = [row["what"].partition(", code ") for row in rows[:3]] + [("delays of true motion", "", "after")]
    cells = []
    for (drives, _, code), row in zip(names, rows, strict=True):
        details = row["details"]
        vehicles, found = details["vehicles"], details["table"]["within the interval"]
        timing = [hits for name, hits in found.items() if name.startswith(("rotor lag", "delay"))]
        counts = round(sum(timing)), vehicles * len(timing)
        widths, first = (a["details"]["table"][_WIDTHS] for a in (row, rows[len(cells) // 2 * 2]))
        share = statistics.median(widths[name] / first[name] for name in first)
        rest = _held(details["hits"] - counts[0], details["values"] - counts[1])
        unsettled = _of(details["unsettled"], details["stretches"]) if "unsettled" in details else "-"
        cells.append([drives, code, rest, _held(*counts), f"{share:.2f}", unsettled])
    heads = ["drives", "fit", "other numbers [95 %]", "lag, delays [95 %]", "width", "not settled"]
    return text_table(heads, cells)


_COMPARED = "known: buoyancy, speeds as commanded"
_WIDTHS = "half its width, median"


def _of(hits: float, count: int) -> str:
    return f"{hits:.0f} of {count}"


def _held(hits: float, count: int) -> str:
    low, high = wilson_interval(round(hits), count) or (0.0, 1.0)
    return f"{_of(hits, count)} = {100 * hits / count:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


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
