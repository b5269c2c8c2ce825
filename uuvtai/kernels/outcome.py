"""How an episode can stand: codes and names, shared by the referee and the reward. Floor."""

import taichi as ti

RUNNING = 0
SUCCESS = 1
COLLISION = 2
TTC = 3
OUT_OF_TANK = 4
TIMEOUT = 5

OUTCOMES = ("running", "success", "collision", "ttc", "out_of_tank", "timeout")
"""Names by code: running, then ``uuvtai.outcomes.ENDINGS``."""


@ti.func
def is_failure(outcome):
    """1 for collision, time to collision and out of tank."""
    return ti.cast(outcome >= COLLISION and outcome <= OUT_OF_TANK, ti.i32)
