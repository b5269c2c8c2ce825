"""What a page is made of: sections of blocks. Sections are built from dicts; only ``html.py`` knows HTML."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from uuvtai.report.tables import Data, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Hover = dict[str, str]  # id of a drawn thing -> what is shown while the pointer is over it


@dataclass(frozen=True)
class Paragraph:
    text: str
    leads: bool = False  # says what matters most, in larger letters


@dataclass(frozen=True)
class Heading:
    text: str


@dataclass(frozen=True)
class Notice:
    """A paragraph that must not be overlooked."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Names and what they are."""

    items: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Code:
    """A text file, folded away."""

    title: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """What became of a claim: ``ruling`` is 'holds', 'does not hold' or 'cannot be judged'."""

    claim: str
    ruling: str
    numbers: str


@dataclass(frozen=True)
class Verdicts:
    """The claims that a run was to judge."""

    items: Sequence[Verdict]


@dataclass(frozen=True)
class Panel:
    """One pair of axes: ``draw`` fills it and says what is shown while the pointer is over which id."""

    draw: Callable[[Axes], Hover]
    width_in: float = 4.4
    height_in: float = 3.0


@dataclass(frozen=True)
class Figure:
    """Panels side by side, with the numbers drawn in them and the command that made those."""

    name: str
    panels: Sequence[Panel]
    caption: str
    data: Data
    command: str = ""


@dataclass(frozen=True)
class Media:
    """A PNG."""

    content: bytes
    caption: str
    name: str = ""  # where it lies in the run folder


@dataclass(frozen=True)
class Gallery:
    """Pictures; ``note`` says what was left out."""

    items: Sequence[Media]
    note: str = ""


@dataclass(frozen=True)
class Player:
    """Recorded episodes, each a title and blobs (``recorded.py``); ``note`` says what was left out."""

    episodes: Sequence[tuple[str, Sequence[bytes]]]
    note: str = ""


Block = Paragraph | Heading | Notice | Table | Facts | Code | Verdicts | Figure | Gallery | Player


@dataclass(frozen=True)
class PageSection:
    title: str
    blocks: Sequence[Block] = field(default_factory=list)
