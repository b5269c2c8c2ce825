"""Colours that page, figures, pictures, videos and terminal share, also for the colour-blind."""

from __future__ import annotations

from collections.abc import Sequence

_ANCHORS = ("440154", "472d7b", "3b528b", "2c728e", "21918c", "28ae80", "5ec962", "addc30", "fde725")
"""Viridis (Smith and van der Walt 2015) at every eighth: its lightness rises evenly for all eyes."""

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe and Ito 2008 without black and yellow, which a dark or a light page would swallow."""

PALETTE = (*SERIES, "#8d5524", "#6a3d9a", "#999933", "#117733")
"""Every colour that a line or a swatch can have; the page has a lighter one for each on a dark screen."""

_BLUE, _VERMILLION, _GREEN, _PURPLE, _ORANGE, _SKY, _BROWN, _VIOLET, _OLIVE, _FOREST = PALETTE
_AGENTS = {
    "bt": _BLUE,
    "planner": _ORANGE,
    "straight": _GREEN,
    "best": _PURPLE,
    "paper": _BROWN,
    "oracle": _VIOLET,
    "dwa": _OLIVE,
    "mppi": _FOREST,
}
_TRUTH = "+truth"
_SPARE = (_PURPLE, _BROWN, _VIOLET, _SKY, _GREEN, _ORANGE, _BLUE)
"""For agents without a colour, in this order. Vermillion is for moving obstacles in pictures."""

DARK, LIGHT = "#000000", "#ffffff"


def shade(share: float) -> str:
    """'#rrggbb' of a share: dark is little, bright is much. Outside [0, 1] the nearest end is taken."""
    place = min(max(share, 0.0), 1.0) * (len(_ANCHORS) - 1)
    below = min(int(place), len(_ANCHORS) - 2)
    low, high = _channels(_ANCHORS[below]), _channels(_ANCHORS[below + 1])
    return "#" + "".join(
        f"{round(a + (place - below) * (b - a)):02x}" for a, b in zip(low, high, strict=True)
    )


def agent_colours(names: Sequence[str]) -> dict[str, str]:
    """Name -> '#rrggbb'. A known agent has one colour everywhere; others take what is free, in order."""
    known = {name: colour for name in names if (colour := _known(name)) is not None}
    free = [colour for colour in _SPARE if colour not in known.values()] or list(_SPARE)
    others = list(dict.fromkeys(name for name in names if name not in known))
    return known | {name: free[i % len(free)] for i, name in enumerate(others)}


def on_page(colour: str) -> str:
    """The colour as CSS: a variable of the page, which has a lighter one for the dark."""
    return f"var(--series-{PALETTE.index(colour)}, {colour})"


def _known(name: str) -> str | None:
    return _SKY if name.endswith(_TRUTH) else _AGENTS.get(name)


def ink_on(background: str) -> str:
    """Black or white, whichever stands out more from '#rrggbb'."""
    return max((DARK, LIGHT), key=lambda ink: contrast(ink, background))


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours from 1 to 21 (WCAG 2.2)."""
    bright, dim = sorted((_luminance(one), _luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def _luminance(colour: str) -> float:
    linear = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
        for c in (x / 255 for x in _channels(colour.lstrip("#")))
    ]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _channels(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (0, 2, 4)]
