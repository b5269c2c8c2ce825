"""All topics of a log, one row each, in the order of the file. A new one is a row in the module of its group:
what writes, declares, reads back and documents logs follows from it."""

from __future__ import annotations

from uuvtai.logs.encode import Topic
from uuvtai.logs.topics import motion, perception, planning, sensors

TOPICS: tuple[Topic, ...] = (
    *motion.POSE_ROWS,
    *motion.INSTRUMENT_ROWS,
    *sensors.SONAR_ROWS,
    *sensors.CAMERA_ROWS,
    *perception.MAP_ROWS,
    *planning.PLAN_ROWS,
    *perception.OBSTACLE_ROWS,
    *motion.STATE_ROWS,
    *planning.AGENT_ROWS,
    *motion.EVENT_ROWS,
)
"""no two of one name"""
