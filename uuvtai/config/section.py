"""Base of every section and the kinds of numbers they hold.

Units stand in the names: ``_m``, ``_s``, ``_m_s``, ``_rad`` and so on; angles that a person types end in ``_deg``. Numbers with neither a
source nor a design page behind them are engineering choices (EC).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Spread = Annotated[float, Field(ge=0, le=0.9)]
"""half width of a factor around 1 that must stay positive"""
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(ge=1)]
Interval = tuple[float, float]


def _ordered_interval(value: Interval) -> Interval:
    if value[0] > value[1]:
        raise ValueError(f"must be (low, high) with low <= high, got {value}")
    return value


OrderedInterval = Annotated[Interval, AfterValidator(_ordered_interval)]
PositiveInterval = Annotated[tuple[Positive, Positive], AfterValidator(_ordered_interval)]
Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
NonNegative6 = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]


class Section(BaseModel):
    """Base of every section: immutable, closed, finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    if not TYPE_CHECKING:

        def __getattr__(self, name):
            # Taichi asks every argument of every launch for an attribute that no section has: pydantic takes five times as long to say so
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
