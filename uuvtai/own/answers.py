"""What came back from the user's code, checked: shape, kind of number, NaN; each refusal says what was
wanted."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from uuvtai.own.piece_errors import PieceError

MAX_WAYPOINTS = 10_000
_ENDS_M = 1e-4
"""a route begins and ends within this of start and goal, or they are added"""


def commands(found: Any, n: int, place: str, meaning: str, device: torch.device) -> torch.Tensor:
    """(n, 4) float32 of what a controller or policy answered. Raises PieceError."""
    values = _tensor(found, place, f"({n}, 4): {meaning}")
    if values.shape != (n, 4):
        columns = values.shape[-1] if values.dim() else 0
        wrong = (
            f"{columns} columns" if values.dim() == 2 and len(values) == n else f"shape {tuple(values.shape)}"
        )
        raise PieceError(f"{place}: gave {wrong}; wanted is shape ({n}, 4): {meaning}")
    bad = (~torch.isfinite(values)).nonzero()
    if len(bad):
        row, column = bad[0].tolist()
        raise PieceError(
            f"{place}: gave {float(values[row, column])} in row {row}, column {column} of {n} x 4 ({meaning})"
            f", and {len(bad) - 1} more that are not finite"
        )
    return values.to(device)


def command(found: Any, place: str, meaning: str) -> torch.Tensor:
    """(1, 4) float32 of what a controller answered for one env. Raises PieceError."""
    values = _tensor(found, place, f"(4,): {meaning}")
    if values.shape not in ((4,), (1, 4)):
        raise PieceError(f"{place}: gave shape {tuple(values.shape)}; wanted is shape (4,): {meaning}")
    return values.reshape(1, 4)


def waypoints(
    found: Any, ends: tuple[np.ndarray, np.ndarray], size_m: tuple[float, float], place: str
) -> np.ndarray:
    """Corners (n >= 2, 2) [m] of what a planner answered, from start to goal. Raises PieceError."""
    wanted = "waypoints (n, 2) [m] from the grid's corner, or None"
    values = _tensor(found, place, wanted).numpy()
    if values.ndim != 2 or values.shape[1] != 2 or len(values) > MAX_WAYPOINTS:
        raise PieceError(
            f"{place}: gave shape {values.shape}; wanted are {wanted}, at most {MAX_WAYPOINTS:,}"
        )
    if not np.isfinite(values).all():
        number = int(np.flatnonzero(~np.isfinite(values).all(1))[0])
        raise PieceError(
            f"{place}: waypoint {number} is {values[number].tolist()}; wanted are finite numbers"
        )
    outside = ((values < 0) | (values > size_m)).any(1)
    if outside.any():
        number = int(np.flatnonzero(outside)[0])
        raise PieceError(
            f"{place}: waypoint {number} is {np.round(values[number], 3).tolist()}, outside the grid of "
            f"{size_m[0]:g} x {size_m[1]:g} m; places are x = column * cell_m, y = row * cell_m"
        )
    start, goal = (end.astype(np.float32) for end in ends)
    if not len(values):
        return np.array([start, goal])
    before = [] if np.abs(values[0] - start).max() <= _ENDS_M else [start]
    after = [] if np.abs(values[-1] - goal).max() <= _ENDS_M and len(values) + len(before) > 1 else [goal]
    return np.array([*before, *values, *after], np.float32)


def _tensor(found: Any, place: str, wanted: str) -> torch.Tensor:
    if found is None:
        raise PieceError(f"{place}: gave None; wanted is {wanted}; does it return something on every way?")
    if isinstance(found, torch.Tensor):
        values = found.detach()
        kind = "?" if values.dtype == torch.bool else "c" if values.is_complex() else "f"
        values = values.cpu()
    else:
        try:
            array = np.asarray(found)
        except (TypeError, ValueError) as error:
            raise PieceError(
                f"{place}: gave {type(found).__name__}, no array ({error}); wanted is {wanted}"
            ) from None
        kind = array.dtype.kind
        if kind not in "fiu":
            raise PieceError(
                f"{place}: gave {type(found).__name__} of {array.dtype}; wanted are real numbers, {wanted}"
            )
        return torch.from_numpy(array.astype(np.float32))
    if kind != "f":
        raise PieceError(f"{place}: gave a tensor of {found.dtype}; wanted are real numbers, {wanted}")
    return values.to(torch.float32)
