"""``uuv drive``: a person plays the episodes first, then whoever is to be compared with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from uuvtai.live.hand_driver import NAME, HandPiece
from uuvtai.measure.episodes.methods import Method
from uuvtai.measure.evaluate.compare import compare
from uuvtai.measure.evaluate.eval_request import Request
from uuvtai.measure.evaluate.method_run import EvaluationWatch
from uuvtai.shipped import TRAINING_TREE
from uuvtai.tree import read_tree


def drive_by_hand(request: Request, hand: HandPiece, watch: EvaluationWatch) -> tuple[dict[str, Any], Path]:
    """The document of ``uuv eval --json`` and its run folder, every episode recorded. Raises as ``compare``
    does."""
    human = Method(NAME, read_tree(TRAINING_TREE, request.config.teacher.max_node), hand=hand)
    return compare(replace(request, num_envs=1, record=request.episodes), watch, [human])
