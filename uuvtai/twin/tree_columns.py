"""What the behaviour tree makes of the moment, as columns for a network that chooses between it and a policy.

Directions are in the world of ``set_columns``, mirrored so that the goal lies ahead and to the left at the
start; every number is about 1 large. Nothing here is known to the simulator alone: the tree is told no more
than the vehicle's sensors say.
"""

from __future__ import annotations

from dataclasses import dataclass

from uuvtai.env import ObservationColumn
from uuvtai.kernels.core.signature import In
from uuvtai.state import ClockState, MissionState, TeacherState, TreeTable
from uuvtai.twin.observer import SET_TABLE
from uuvtai.twin.set_codes import TREE_WIDTH


@dataclass(frozen=True, eq=False)
class TreeColumnsIO:
    """What the columns are made of."""

    clock: In[ClockState]
    mission: In[MissionState]
    teacher: In[TeacherState]
    table: In[TreeTable]


def _table():
    """Columns that a chooser looks at: those of the policy, then those of the tree."""
    stop = max(column.slice.stop for column in SET_TABLE)
    said = ObservationColumn(
        "tree", slice(stop, stop + TREE_WIDTH), "mixed", "mirrored world", "what the tree makes of the moment"
    )
    return *SET_TABLE, said


CHOOSER_TABLE = _table()
"""The observation of a chooser, for a checkpoint's manifest."""
