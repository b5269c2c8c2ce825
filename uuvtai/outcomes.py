"""How an episode can stand and end: codes for kernels, names for logs, results and tables."""

OUTCOMES = ("running", "success", "collision", "ttc", "out_of_tank", "timeout")
"""names by code"""
RUNNING, SUCCESS, COLLISION, TTC, OUT_OF_TANK, TIMEOUT = range(len(OUTCOMES))

ENDINGS = OUTCOMES[1:]
"""exclusive; every finished episode has one"""
COLLIDED = ("collision", "ttc", "out_of_tank")
"""what counts as a collision in every rate: contact, a stop for the time to collision, and leaving the
tank"""
LETTERS: dict[str, str] = dict(zip(ENDINGS, "scxot", strict=True))
"""of the endings, for a row of episodes as one word"""
