"""Blocks of pictures and videos: trajectories over the occupancy map, the worst episodes first, as many as
the page may hold."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from uuvtai.files import read_bytes
from uuvtai.report.blocks import Block, Gallery, Heading, Media, PageSection
from uuvtai.tables.wording import megabytes, number

MEDIA_BYTES, PICTURE_BYTES = 6_600_000, 2_200_000
"""What all pictures and videos of a page, and the pictures of a run among them, may weigh: in base64 8.8 MB
of a page's 10 MB"""

_NAME = re.compile(r"(?P<label>.*?)_?seed(?P<seed>-?\d+)_episode(?P<episode>\d+)(?P<rest>.*)")
_SUCCESS = "success"
_OUTCOMES = {"ttc": "TTC stop", "out_of_tank": "out of the tank"}

Detail = dict[str, Any]


@dataclass(frozen=True)
class _Shown:
    """A file and the episode in it; pictures show the same episode of every method."""

    path: Path
    method: str
    episode: tuple[int, int] | None
    details: tuple[tuple[str, Detail], ...]
    """(method, how its episode went)"""
    remark: str

    @property
    def severity(self) -> tuple[bool, bool, float]:
        """Sorts the worst first: failures, then what came closest; what is not known comes last."""
        failed = any(detail["outcome"] != _SUCCESS for _, detail in self.details)
        closest = [
            detail["min_clearance_m"]
            for _, detail in self.details
            if detail.get("min_clearance_m") is not None
        ]
        return (not self.details, not failed, min(closest, default=float("inf")))


def media(folder: Path, result: dict[str, Any] | None, budget: int = MEDIA_BYTES) -> list[Block]:
    """Pictures, then videos, of a run folder; ``result`` is its ``uuv eval --json`` document, ``budget`` in
    bytes."""
    methods = (result or {}).get("methods", [])
    pictures = _worst_first(sorted([*folder.glob("pictures/*.png"), *folder.glob("explain/*.png")]), methods)
    videos = _worst_first(sorted([*folder.glob("explain/*.webm"), *folder.glob("videos/*.webm")]), methods)
    blocks: list[Block] = []
    for title, shown, mime, most in (
        ("Trajectories over the occupancy map", pictures, "image/png", PICTURE_BYTES),
        ("Videos, the worst episodes first", _once(videos), "video/webm", budget),
    ):
        if shown:
            gallery = _gallery(folder, shown, mime, min(budget, most))
            budget -= sum(len(item.content) for item in gallery.items)
            blocks += [Heading(title), gallery]
    return blocks


def _gallery(folder: Path, shown: Iterable[_Shown], mime: str, budget: int) -> Gallery:
    """As many files as the budget holds, in order; what is too big is named."""
    items, left_out = [], []
    for one in shown:
        size = one.path.lstat().st_size
        if size > budget:
            left_out.append(f"{one.path.relative_to(folder)} ({megabytes(size)})")
            continue
        budget -= size
        items.append(
            Media(mime, read_bytes(one.path, size, folder), _caption(one), str(one.path.relative_to(folder)))
        )
    return Gallery(items, _note(left_out))


def _note(left_out: Sequence[str]) -> str:
    return (
        f"Left out to keep this page small, to be found in the run folder: {', '.join(left_out)}."
        if left_out
        else ""
    )


def shared(sections: Sequence[PageSection]) -> list[PageSection]:
    """The same sections with what the page's budget [bytes] holds: pictures of every run first, then videos,
    in the page's order."""
    kept: dict[int, Gallery] = {}
    budget = MEDIA_BYTES
    galleries = [block for section in sections for block in section.blocks if isinstance(block, Gallery)]
    for gallery in sorted(
        galleries, key=lambda one: any(item.mime.startswith("video/") for item in one.items)
    ):
        kept[id(gallery)] = _trimmed(gallery, budget)
        budget -= sum(len(item.content) for item in kept[id(gallery)].items)
    return [
        replace(section, blocks=[kept.get(id(block), block) for block in section.blocks])
        for section in sections
    ]


def _trimmed(gallery: Gallery, budget: int) -> Gallery:
    items, left_out = [], []
    for item in gallery.items:
        if len(item.content) > budget:
            left_out.append(f"{item.name} ({megabytes(len(item.content))})")
            continue
        budget -= len(item.content)
        items.append(item)
    return replace(
        gallery, items=items, note=" ".join(part for part in (gallery.note, _note(left_out)) if part)
    )


def _worst_first(paths: Iterable[Path], methods: list[dict[str, Any]]) -> list[_Shown]:
    return sorted((_shown(path, methods) for path in paths), key=lambda one: one.severity)


def _once(shown: list[_Shown]) -> list[_Shown]:
    """A failure that was recorded again to explain it is shown once, with its cause."""
    explained = {(one.method, one.episode) for one in shown if one.remark}
    return [one for one in shown if one.remark or (one.method, one.episode) not in explained]


def _shown(path: Path, methods: list[dict[str, Any]]) -> _Shown:
    found = _NAME.fullmatch(path.stem)
    if found is None:
        return _Shown(path, "", None, (), path.stem)
    label, episode = found["label"], (int(found["seed"]), int(found["episode"]))
    method = _method_of(label, methods)
    remark = label.removesuffix(method).strip("_") if method else found["rest"].strip("_")
    own = [m for m in methods if not label or m["name"] == method]
    details = tuple(
        (m["name"], d) for m in own for d in m["episodes_detail"] if (d["seed"], d["episode"]) == episode
    )
    return _Shown(path, method, episode, details, remark.replace("_", " "))


def _method_of(label: str, methods: list[dict[str, Any]]) -> str:
    """The method that a file's label ends with; before it may stand why the episode failed."""
    names = [m["name"] for m in methods if label == m["name"] or label.endswith(f"_{m['name']}")]
    return max(names, key=len, default="")


def _caption(one: _Shown) -> str:
    if one.episode is None:
        return one.path.stem
    where = f"seed {one.episode[0]}, episode {one.episode[1]}"
    went = "; ".join(f"{name}: {_outcome(detail)}" for name, detail in one.details)
    said = f"{one.remark}, {where}" if one.remark else where
    return ". ".join(part for part in (said[0].upper() + said[1:], went) if part)


def _outcome(detail: Detail) -> str:
    outcome = _OUTCOMES.get(detail["outcome"], detail["outcome"])
    return (
        f"{outcome} after {number(detail['time_s'])} s, closest {number(detail.get('min_clearance_m'), 2)} m"
    )
