"""Your own behaviour tree: ``patient.xml`` beside the built-in ones on the same episodes: a table.

``python examples/custom_tree.py``, which is ``uuv eval --agent examples/patient.xml,bt,planner`` from Python
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import uuvtai

TREES = (Path(__file__).with_name("patient.xml"), "bt", "planner")


def main(**options: Any) -> str:
    """The table: success with its 95 % interval, collisions, time; ``options`` of ``uuvtai.evaluate``."""
    return str(uuvtai.evaluate(TREES, "pool", **({"episodes": 128} | options)))


if __name__ == "__main__":
    print(main())
