"""Base of every section and the kinds of numbers they hold.

Units stand in the names: ``_m``, ``_s``, ``_m_s``, ``_rad`` and so on; angles that a person types end in
``_deg``. Numbers with neither a source nor a design page behind them are engineering choices (EC).
"""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

LARGEST, SMALLEST = 1e12, 1e-12
"""no quantity here is larger, nor smaller where it must not be 0: quotients and squares of them stay
numbers"""
MOST = 2**31 - 1
"""kernels count in 32 bits"""

Real = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Spread = Annotated[float, Field(ge=0, le=0.9)]
"""half width of a factor around 1 that must stay positive"""
Count = Annotated[int, Field(ge=0, le=MOST)]
PositiveCount = Annotated[int, Field(ge=1, le=MOST)]
Packets = Annotated[int, Field(ge=16, le=MOST, multiple_of=16)]
"""a count in whole packets of lanes"""
_SEEDS = 2**31


def folded_seed(seed: int) -> int:
    """What kernels count with for a seed of 0 and more: one below 2^31 stands for itself, any other for the
    first 31 bits of the SHA-256 of its bytes, the highest first."""
    if seed < _SEEDS:
        return seed
    told = seed.to_bytes((seed.bit_length() + 7) // 8, "big")
    return int.from_bytes(hashlib.sha256(told).digest()[:4], "big") >> 1


Seed = Annotated[int, Field(ge=0), AfterValidator(folded_seed)]
Interval = tuple[Real, Real]


def _ordered_interval(value: Interval) -> Interval:
    if value[0] > value[1]:
        raise ValueError(f"must be (low, high) with low <= high, got {value}")
    return value


OrderedInterval = Annotated[Interval, AfterValidator(_ordered_interval)]
PositiveInterval = Annotated[tuple[Positive, Positive], AfterValidator(_ordered_interval)]
Vector3 = tuple[Real, Real, Real]
NonNegative6 = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]


WRITTEN_PLACE = re.compile(r"([a-z0-9]+):(/dev/[\w./\-]+|[A-Za-z0-9.\-]{0,253})(?::(\d{1,5}))?")
"""``KIND:HOST``, ``KIND:HOST:PORT`` or ``KIND:/dev/PORT``: where an instrument is heard"""


def place_among(*kinds: str) -> AfterValidator:
    """Check of a text: nothing, or the place of an instrument of one of these kinds."""

    def checked(text: str) -> str:
        found = WRITTEN_PLACE.fullmatch(text)
        if text and (not found or found[1] not in kinds or not 0 < int(found[3] or 1) < 65536):
            example = f"{kinds[0]}:192.168.2.95"
            raise ValueError(f"write KIND:HOST or KIND:HOST:PORT, as {example}; KIND is {', '.join(kinds)}")
        return text

    return AfterValidator(checked)


class Section(BaseModel):
    """Base of every section: immutable, closed, finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    if not TYPE_CHECKING:

        def __getattr__(self, name):
            # Taichi asks every argument of every launch for an attribute that no section has: pydantic takes
            # five times as long to say so
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
