"""Work for processes side by side without a simulator, in a module that other processes can import."""

import os
import time
from pathlib import Path


def square(number):
    """number^2; a negative one is an error of the work itself."""
    if number < 0:
        raise ValueError(f"{number} is negative")
    return number * number


def fall_once(place):
    """Kill the own process the first time, be done the second."""
    marker = Path(place)
    if not marker.exists():
        marker.touch()
        os._exit(9)
    return marker.name


def always_fall(_item):
    """Kill the own process."""
    os._exit(9)


def tell_and_wait(place):
    """Write the own process id, then wait for longer than any test."""
    Path(place).write_text(str(os.getpid()))
    time.sleep(600)
