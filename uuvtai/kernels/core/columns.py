"""What a group of columns of the observation is: the environment's table is read off these declarations, and
the kernels write by them."""

from typing import Any, NamedTuple


class ColumnGroup(NamedTuple):
    """A group of neighbouring columns of the observation, all of one quantity."""

    name: str
    width: int
    """columns of the env, or of each of its sectors or bodies"""
    unit: str
    frame: str
    """"level" is the body frame without roll and pitch: x along the heading, y to its left, z up"""
    meaning: str
    source: Any
    """func that returns the values of one env, or the value of one of its sectors, or the values of all
    groups of one of its bodies"""
    per: str = ""
    """'sector' or 'body': there are so many for each"""
