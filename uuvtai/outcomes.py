"""How an episode can end, by name: the same words in logs, results and tables. Their codes are in ``kernels/outcome.py``."""

ENDINGS = ("success", "collision", "ttc", "out_of_tank", "timeout")
"""exclusive; every finished episode has one"""
COLLIDED = ("collision", "ttc", "out_of_tank")
"""what counts as a collision in every rate: contact, a stop for the time to collision, and leaving the tank"""
FORESEEABLE = ("collision", "ttc")
"""what the risk head foresees"""
