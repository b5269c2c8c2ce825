"""Drive by an exported policy over a set of obstacles, or forecast by an exported network, with NumPy alone.
``uuv export`` puts a copy of this file in its folder, beside ``run_policy.py``, which reads the files.

    from run_set_policy import load
    policy = load("FOLDER")               # checks the sha256 of every file
    said = policy.act(obstacles, own)        # ten times a second: columns as policy_spec.json says
    command = policy.command(said.wish, flip, yaw_rad, z_m)     # every control step: the hull rule

A forecast is asked by ``futures(columns, speed)``. ``python run_set_policy.py [FOLDER]`` replays the golden
pairs, prints the differences and the latency, and exits 3 where they differ.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

if __package__:
    from uuvtai.learning.export import run_policy as folders
else:
    import run_policy as folders  # pyright: ignore[reportMissingImports]

Arrays = dict[str, np.ndarray]
Layers = list[tuple[np.ndarray, np.ndarray]]

AT_THERE, AT_DIRECTION = 0, slice(3, 5)
"""columns: of an obstacle, 1 = there; of the vehicle's own, the unit vector to the look-ahead point"""
SUM_SCALE = 0.3
MOST_WISH = 2.0
LEAST_M, LOG_BOUNDS = 0.03, (-6.0, math.log(4.0))
"""of a forecast's deviations"""
_UNFIT = f"{folders.SPEC} and {folders.WEIGHTS} do not fit together ({{error!r}}); export the policy again"


class SetDecision(NamedTuple):
    """What the policy wishes."""

    wish: np.ndarray
    """(3,) ahead, left, up in the mirrored world, in parts of the fastest velocity, within +-2"""
    mean_wish: np.ndarray
    """(3,) the same, not cut off"""


class Futures(NamedTuple):
    """What may come of a track, in its frame."""

    log_weight: np.ndarray
    """(modes,) logarithm of the probability of each future"""
    place: np.ndarray
    """(modes, times, 2) [m] along and across the course"""
    sigma: np.ndarray
    """(modes, times, 2) [m] standard deviations"""


class SetPolicy:
    """A policy over a set of obstacles; it remembers nothing."""

    inputs = ("obstacles", "own")

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        """``spec`` is policy_spec.json, ``arrays`` policy.safetensors. Raises PolicyError where they do not
        fit together."""
        try:
            self.rule = spec["hull_rule"]
            columns = spec["observation"]
            self.widths = {name: len(columns[name]["columns"]) for name in columns if name != "meaning"}
            self._gain = np.float32(spec["network"]["goal_gain"])
            self._actor = _encoder(arrays, "actor", self.widths["obstacles"], self.widths["own"], 3)
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            raise folders.PolicyError(_UNFIT.format(error=error)) from None
        self.work = sum(w.size for layers in self._actor for w, _ in layers)
        """multiplications of a decision about one obstacle"""

    def act(self, obstacles: Any, own: Any) -> SetDecision:
        """Decision for the newest columns: obstacles (n, width), any n; own (width,).

        Raises ValueError for other shapes, numbers that are not finite, or a first column of an obstacle that
        is neither 0 nor 1.
        """
        given = {"obstacles": obstacles, "own": own}
        found = self.said({name: np.asarray(value, np.float32)[None] for name, value in given.items()})
        mean = found["mean_wish"][0]
        return SetDecision(np.clip(mean, -MOST_WISH, MOST_WISH), mean)

    def said(self, given: Arrays) -> Arrays:
        """Outputs by name for rows of inputs: ``mean_wish`` (N, 3). Raises ValueError as ``act``."""
        obstacles, own = (self._checked(name, given[name]) for name in self.inputs)
        mean = _pooled(self._actor, obstacles, own)
        mean[:, :2] += self._gain * own[:, AT_DIRECTION]
        return {"mean_wish": mean}

    def command(self, wish: Any, flip: Any, yaw_rad: float, z_m: float) -> np.ndarray:
        """(4,) surge, sway, heave, yaw rate in parts of the vehicle's limits, body frame: the hull rule.

        ``wish`` (3,) is held between decisions, ``flip`` (2,) are the signs of the way from start to goal
        along x and y (1 where it is 0), ``yaw_rad`` and ``z_m`` the heading and the height now (0 = surface).
        """
        rule, (x, y, up) = self.rule, (float(part) for part in wish)
        limit, long = rule["limits_m_s"], max(1.0, math.hypot(x, y))
        ahead, left = (
            rule["fastest_m_s"] * sign * part / long for sign, part in zip(flip, (x, y), strict=True)
        )
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        surge, sway = (c * ahead + s * left) / limit["surge"], (c * left - s * ahead) / limit["sway"]
        over = max(1.0, abs(surge), abs(sway))
        low, high = (end + sign * rule["gap_m"] - z_m for end, sign in zip(rule["z_m"], (1, -1), strict=True))
        rise = min(max(limit["heave"] * min(max(up, -1.0), 1.0), min(low, 0.0)), max(high, 0.0))
        turn = 0.0
        if math.hypot(ahead, left) > rule["least_speed_m_s"]:
            off, quarter = math.remainder(math.atan2(left, ahead) - yaw_rad, 2.0 * math.pi), 0.5 * math.pi
            turn = off - quarter * (math.floor(off / quarter) + 0.5)
        rate = rule["turn_gain_1_s"] * turn / rule["max_yaw_rate_rad_s"]
        out = (surge / over, sway / over, rise / limit["heave"], rate)
        return np.clip(np.array(out, np.float32), -1.0, 1.0)

    def _checked(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Float32 rows (N, width), of obstacles (N, n, width). Raises ValueError."""
        width, rank = self.widths[name], 3 if name == "obstacles" else 2
        rows = np.asarray(rows, np.float32)
        if rows.ndim != rank or rows.shape[-1] != width or 0 in rows.shape:
            wanted = f"(n, {width}) with a row of zeros for no obstacle" if rank == 3 else f"({width},)"
            raise ValueError(f"{name} must have shape {wanted}, got {rows.shape[1:]}; see {folders.SPEC}")
        if not np.isfinite(rows).all():
            raise ValueError(
                f"{name} holds numbers that are not finite; leave out obstacles that are not known"
            )
        if rank == 3 and not np.isin(rows[..., AT_THERE], (0.0, 1.0)).all():
            raise ValueError(
                "obstacles: the first column is 1 where there is an obstacle, else all columns are 0"
            )
        return rows


class TrackForecast:
    """What a tracked obstacle may do next; it remembers nothing."""

    inputs = ("columns", "speed")

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        """As ``SetPolicy``."""
        try:
            network = spec["network"]
            self._modes, self._times = int(network["modes"]), np.array(network["times_s"], np.float32)
            self.width = int(spec["observation"]["columns"]["width"])
            self._nets = [_linear(arrays, name) for name in ("into", "middle", "said", "spread")]
            self._check_widths(2 * self._modes * len(self._times))
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise folders.PolicyError(_UNFIT.format(error=error)) from None
        self.work = sum(weight.size for weight, _ in self._nets)
        """multiplications of a forecast"""

    def futures(self, columns: Any, speed: float) -> Futures:
        """Futures of one track: columns (width,), speed [m/s]. Raises ValueError for another shape or numbers
        that are not finite."""
        found = self.said({"columns": np.asarray(columns)[None], "speed": np.asarray([speed])})
        return Futures(*(found[name][0] for name in Futures._fields))

    def said(self, given: Arrays) -> Arrays:
        """The fields of ``Futures`` by name, each with an axis of tracks in front, for columns (N, width) and
        speeds (N,). Raises ValueError."""
        columns, speed = (np.asarray(given[name], np.float32) for name in self.inputs)
        if columns.ndim != 2 or columns.shape[1] != self.width or speed.shape != columns.shape[:1]:
            raise ValueError(
                f"columns must have shape ({self.width},), got {columns.shape[1:]}; speed is a number"
            )
        if not (np.isfinite(columns).all() and np.isfinite(speed).all()):
            raise ValueError("columns or speed hold numbers that are not finite")
        into, middle, told, spread = self._nets
        hidden = np.maximum(_affine(middle, np.maximum(_affine(into, columns), 0)), 0)
        said, shape = _affine(told, hidden), (-1, self._modes, len(self._times), 2)
        reach = (speed[:, None] * self._times)[:, None, :, None]
        raw = said[:, : self._modes] - said[:, : self._modes].max(-1, keepdims=True)
        part = np.exp(np.clip(_affine(spread, hidden).reshape(shape), *LOG_BOUNDS).astype(np.float32))
        return {
            "log_weight": raw - np.log(np.exp(raw).sum(-1, keepdims=True)),
            "place": said[:, self._modes :].reshape(shape) * reach,
            "sigma": np.float32(LEAST_M) + part * reach,
        }

    def _check_widths(self, n_place: int) -> None:
        into, middle, told, spread = self._nets
        wide = len(middle[1])
        wanted = (
            (into, middle[0].shape[1], self.width),
            (told, self._modes + n_place, wide),
            (spread, n_place, wide),
        )
        if any(weight.shape != (last, first) for (weight, _), last, first in wanted):
            raise ValueError("layers of the forecast")


# ----------------------------------------------------------------------------------------------------- layers


def _encoder(
    arrays: Arrays, name: str, n_obstacle: int, n_own: int, n_out: int
) -> tuple[Layers, Layers, Layers]:
    """Layers of obstacle, own and head of a set encoder; ValueError where they do not fit together."""
    obstacle, own, head = (
        folders.layers_of(arrays, f"{name}.{part}") for part in ("obstacle", "own", "head")
    )
    if not (obstacle and own and head):
        raise ValueError(f"layers of {name}")
    pooled = 2 * len(obstacle[-1][1]) + len(own[-1][1])
    for layers, first, last in ((obstacle, n_obstacle, None), (own, n_own, None), (head, pooled, n_out)):
        if layers[0][0].shape[1] != first or (last is not None and len(layers[-1][1]) != last):
            raise ValueError(f"{name} is no encoder from {n_obstacle} and {n_own} to {n_out}")
    return obstacle, own, head


def _linear(arrays: Arrays, name: str) -> tuple[np.ndarray, np.ndarray]:
    weight, bias = arrays[f"{name}.weight"], arrays[f"{name}.bias"]
    if weight.ndim != 2 or bias.shape != weight.shape[:1]:
        raise ValueError(f"layer {name}")
    return weight, bias


def _affine(layer: tuple[np.ndarray, np.ndarray], x: np.ndarray) -> np.ndarray:
    return x @ layer[0].T + layer[1]


def _pooled(net: tuple[Layers, Layers, Layers], obstacles: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(N, n_out) of a set encoder: every obstacle through the same layers, then maximum and sum over those
    that are there, so that neither their order nor their number matters."""
    body, side, head = net
    each = obstacles
    for layer in body:
        each = np.maximum(_affine(layer, each), 0)
    each = each * obstacles[..., :1]
    mine = own
    for layer in side:
        mine = np.maximum(_affine(layer, mine), 0)
    x = np.concatenate([each.max(-2), np.float32(SUM_SCALE) * each.sum(-2), mine], -1)
    for layer in head[:-1]:
        x = np.maximum(_affine(layer, x), 0)
    return _affine(head[-1], x)


# ----------------------------------------------------------------------------------------------- golden pairs


def made(spec: dict[str, Any], arrays: Arrays) -> SetPolicy | TrackForecast:
    """What a specification's ``kind`` stands for. Raises PolicyError."""
    kind = spec.get("kind")
    if kind not in folders.KINDS:
        raise folders.PolicyError(f"{folders.SPEC}: holds {kind!r}, not one of {', '.join(folders.KINDS)}")
    return TrackForecast(spec, arrays) if kind == "forecast" else SetPolicy(spec, arrays)


def load(folder: str | Path = ".") -> Any:
    """The policy or forecast of an exported folder, every file checked against its sha256. Raises
    PolicyError."""
    folder = Path(folder)
    spec = folders.read_spec(folder)
    if wrong := folders.changed_files(folder, spec):
        raise folders.PolicyError(f"{folder}: {'; '.join(wrong)}; export the policy again")
    return made(spec, folders.read_safetensors(folder / folders.WEIGHTS))


def replayed(policy: SetPolicy | TrackForecast, golden: Arrays) -> Arrays:
    """What the policy says to the golden inputs, by name. Raises PolicyError for golden pairs of another
    shape, or that would take minutes."""
    rows = {name: golden[f"pair_{name}"] for name in policy.inputs}
    first = rows[policy.inputs[0]]
    obstacles = first.shape[1] if first.ndim == 3 else 1
    count = len(first) if first.ndim else 0
    if not 0 < count <= folders.MAX_STEPS or any(len(each) != count for each in rows.values()):
        raise folders.PolicyError(f"{folders.GOLDEN}: has no rows of this policy; export the policy again")
    if policy.work * obstacles * (count + folders.CALLS) > folders.MAX_WORK:
        raise folders.PolicyError(f"{folders.GOLDEN}: would take minutes to replay; no exported policy does")
    try:
        return policy.said(rows)
    except ValueError as error:
        raise folders.PolicyError(f"{folders.GOLDEN}: {error}; export the policy again") from None


def differences(policy: SetPolicy | TrackForecast, golden: Arrays) -> dict[str, float]:
    """Largest difference of every output from the golden one."""
    found = replayed(policy, golden)
    return {name: folders.difference(values, golden[f"pair_{name}"]) for name, values in found.items()}


def latency_ms(policy: SetPolicy | TrackForecast, golden: Arrays) -> dict[str, float]:
    """p50 and p99 [ms] of a decision for the golden rows in turn."""
    rows, turn = [golden[f"pair_{name}"] for name in policy.inputs], 0

    def decide() -> None:
        nonlocal turn
        at = turn % len(rows[0])
        policy.said({name: part[at : at + 1] for name, part in zip(policy.inputs, rows, strict=True)})
        turn += 1

    return folders.latency_ms(decide)


def main(arguments: list[str]) -> int:
    """Replay the golden pairs of a folder; 0 = they agree, 3 = they differ, 1 = the folder cannot be used."""
    folder = Path(arguments[0]) if arguments else Path(__file__).resolve().parent
    try:
        policy, spec = load(folder), folders.read_spec(folder)
        golden = folders.read_golden(folder / folders.GOLDEN)
        worst, tolerance = differences(policy, golden), float(spec["golden"]["tolerance"])
    except (
        folders.PolicyError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
    ) as error:
        print(f"{folder}: {error}", file=sys.stderr)
        return 1
    for name, value in worst.items():
        print(f"{name}: largest difference {value:.2g} (tolerance {tolerance:g})")
    time_ms = latency_ms(policy, golden)
    print(f"decision: p50 {time_ms['p50_ms']:.3f} ms, p99 {time_ms['p99_ms']:.3f} ms")
    return 0 if max(worst.values()) <= tolerance else 3


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
