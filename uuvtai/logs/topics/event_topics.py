"""What happens now and then, as lines of text."""

from __future__ import annotations

import json

from uuvtai.logs.moment import Moment
from uuvtai.logs.schemas import INFO, LOG, WARNING
from uuvtai.logs.topic import EVENTS, Topic
from uuvtai.logs.topics.plan_topics import SOURCE, fallback_of, planner_of, trigger_of
from uuvtai.outcomes import OUTCOMES


def _lines(moment: Moment) -> list[bytes]:
    lines = []
    if moment.replanned:
        fallback = fallback_of(moment)
        found = f"replan ({trigger_of(moment)}): {planner_of(moment)}, {int(moment['route.n_way'])} waypoints"
        why = f"; voronoi: {fallback}" if fallback else ""
        lines.append(_line(moment, WARNING if fallback else INFO, "uuv.route", found + why))
    if moment.ended:
        outcome = OUTCOMES[int(moment["referee.outcome"])]
        lines.append(_line(moment, INFO, "uuv.episode", f"outcome: {outcome}"))
    return lines


def _line(moment: Moment, level: int, name: str, message: str) -> bytes:
    return (
        f'{{"timestamp":{moment.stamp},"level":{level},"message":{json.dumps(message)},"name":"{name}",'
        f'"file":"","line":0}}'
    ).encode()


ROWS = (Topic("/log", EVENTS, LOG, _lines, SOURCE),)
