"""A policy as an ONNX graph of whoever's: it holds our operators alone, and its size, memory and work are
reckoned before ONNX Runtime sees it (``deploy.graph_check``)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uuvtai.deploy import graph_check, onnx_session
from uuvtai.files import read_bytes
from uuvtai.learn.pilot import CHUNK
from uuvtai.own.piece_errors import PieceError
from uuvtai.own.piece_loading import content_of
from uuvtai.own.piece_spec import PieceSpec

HOLD = "hold_steps"
"""key of the graph's metadata: control steps that a decision is held for"""
_OUTPUTS = ("action", "actions", "mean_action", "mean_actions", "mean")
"""names that an action has where a graph gives more than it"""
MAX_BYTES = graph_check.MAX_BYTES


def graph_of(spec: PieceSpec) -> bytes:
    """The file, with its weights if they lie beside it, no larger than a graph may be. Raises PieceError,
    FileError."""
    if not onnx_session.is_installed():
        raise PieceError(f"{spec.option}: needs onnx and onnxruntime: pip install 'uuvtai[export]'")
    graph = content_of(spec, MAX_BYTES)

    def beside(name: str) -> bytes:
        try:
            return read_bytes(spec.path.parent / name, MAX_BYTES, spec.path.parent)
        except OSError as error:
            raise PieceError(
                f"{spec.path}: its weights are in {name}, which cannot be read ({error.strerror}); copy that "
                "file too, beside it"
            ) from None

    try:
        return graph_check.with_weights(graph, beside)
    except graph_check.GraphError as error:
        raise PieceError(f"{spec.path}: {error.reason}") from None


def onnx_policy(spec: PieceSpec, graph: bytes, n_obs: int) -> tuple[Callable[[np.ndarray], np.ndarray], int]:
    """(function from observations (n, n_obs) to actions (n, 4), control steps per decision). Raises
    PieceError for a graph that is strange, or made for another observation."""
    try:
        head = graph_check.head_of(graph)
        output = next((known for known in _OUTPUTS if known in head.outputs), head.outputs[0])
        if len(head.outputs) > 1:
            graph = graph_check.only(graph, output)
        if len(head.inputs) != 1:
            raise PieceError(
                f"{spec.path}: takes {', '.join(head.inputs) or 'nothing'}; a policy takes one input, "
                f"observations (n, {n_obs}), and keeps no state; of 'uuv export' evaluate its run"
            )
        name, (width, rows, dtype) = next(iter(head.inputs.items()))
        if dtype is None or rows == 0 or (rows or 0) > CHUNK:
            raise PieceError(
                f"{spec.path}: {name} takes no observations: a float input (n, {n_obs}) does, n "
                f"open, 1, or up to {CHUNK}"
            )
        if width not in (None, n_obs):
            raise PieceError(
                f"{spec.path}: takes observations of {width} columns, here they have {n_obs} "
                "(docs/gym.md lists them); --set features.n_track=.. and features.teacher=true add columns"
            )
        calls = -(-CHUNK // (rows or CHUNK))
        graph_check.refuse_strange(graph, {name: (rows or CHUNK, n_obs)}, calls, rows or 1)
        session = onnx_session.session(graph)
    except graph_check.GraphError as error:
        raise PieceError(f"{spec.path}: {error.reason}") from None
    except PieceError:
        raise
    except Exception as error:  # ONNX Runtime's own, which share no base class beyond this
        raise PieceError(
            f"{spec.path}: ONNX Runtime cannot use it ({' '.join(str(error).split())[:200]})"
        ) from None

    def act(obs: np.ndarray) -> np.ndarray:
        given = obs.astype(dtype, copy=False)
        if rows is None:
            return session.run([output], {name: given})[0]
        padded = np.zeros((-(-len(obs) // rows) * rows, n_obs), dtype)
        padded[: len(obs)] = given
        parts = [session.run([output], {name: part})[0] for part in np.split(padded, len(padded) // rows)]
        return np.concatenate(parts)[: len(obs)]

    return act, _hold(spec, head.metadata)


def _hold(spec: PieceSpec, metadata: dict[str, str]) -> int:
    text = metadata.get(HOLD, "1")
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= 10_000:
        raise PieceError(
            f"{spec.path}: metadata {HOLD} = {text[:40]!r}; a whole number of control steps from 1"
        )
    return int(text)
