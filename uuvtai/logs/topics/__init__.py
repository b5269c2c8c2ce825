"""All topics of a log, one row each, in the order of the file. A new one is a row in the module of its group:
what writes, declares, reads back and documents logs follows from it."""

from __future__ import annotations

from uuvtai.logs.topic import Topic
from uuvtai.logs.topics import (
    body_topics,
    camera_topics,
    driver_topics,
    event_topics,
    instrument_topics,
    map_topics,
    plan_topics,
    pose_topics,
    sonar_topics,
    state_topics,
)

TOPICS: tuple[Topic, ...] = (
    *pose_topics.ROWS,
    *instrument_topics.ROWS,
    *sonar_topics.ROWS,
    *camera_topics.ROWS,
    *map_topics.ROWS,
    *plan_topics.ROWS,
    *body_topics.ROWS,
    *state_topics.ROWS,
    *driver_topics.ROWS,
    *event_topics.ROWS,
)
"""no two of one name"""
