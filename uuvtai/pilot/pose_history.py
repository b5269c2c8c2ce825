"""What the pilot took for its own pose in the last second and a half, step by step."""

from __future__ import annotations

import numpy as np

KEPT = 75
"""steps"""


class PoseHistory:
    """A ring of rows of numbers; the row of a step is there while the step is one of the last KEPT noted."""

    def __init__(self) -> None:
        self._rows: dict[int, dict[str, np.ndarray]] = {}

    def clear(self) -> None:
        """Forget all."""
        self._rows.clear()

    def note(self, step: int, **values: np.ndarray) -> None:
        """Keep copies of this step's values."""
        self._rows[step] = {name: np.array(value) for name, value in values.items()}
        self._rows.pop(step - KEPT, None)

    def at(self, step: int) -> dict[str, np.ndarray] | None:
        """Values of a step; None where it was not noted, or too long ago."""
        return self._rows.get(step)
