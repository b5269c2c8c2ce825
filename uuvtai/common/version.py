"""The version, apart from the package's front door, which knows the simulator."""

import time

BEGUN_NS = time.time_ns()  # when this process began to import the package [ns]
__version__ = "0.1.0"
