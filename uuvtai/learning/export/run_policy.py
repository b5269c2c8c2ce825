"""Drive by an exported policy with NumPy alone: no torch, no Taichi, no uuvtai.
``uuv export`` puts a copy of this file in its folder.

    from run_policy import load
    policy = load("FOLDER")               # checks the sha256 of every file

What it is stands as ``kind`` in policy_spec.json, with every column of its inputs:

    mlp   policy.reset() at the start of a mission, policy.act(observation) at every control step
    set   said = policy.act(obstacles, own) ten times a second, and at every control step
          policy.command(said.wish, flip, yaw_rad, z_m), the hull rule

``python run_policy.py [FOLDER]`` replays the golden pairs, prints the differences and the latency, and exits
3 where they differ. Nothing in the folder can make this file execute code."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SPEC, WEIGHTS, GOLDEN = "policy_spec.json", "policy.safetensors", "golden.safetensors"
SCHEMA = 6
FILES = (WEIGHTS, GOLDEN, "policy.onnx", "README.md", "run_policy.py")
"""names that the spec may list; nothing else is ever opened"""
N_TARGET, N_ACTION = 24, 4
AT_THERE, AT_DIRECTION = 0, slice(3, 5)
"""columns: of an obstacle, 1 = there; of the vehicle's own, the unit vector to the look-ahead point"""
AT_WAYS, AT_WIDTH, AT_WATER = (slice(1, 3), slice(12, 14), slice(14, 16)), 7, slice(8, 10)
AT_SPEED = slice(6, 8)
"""of an obstacle: way to it now, in 1 and in 2 s, width, free water above and below; the vehicle's speed"""
N_RAY = 24
"""the last columns of the vehicle's own, the first of them along x"""
SUM_SCALE = 0.3
MOST_WISH = 2.0
MAX_BYTES = 64 << 20
"""of any file of the folder: sixteen million parameters"""
MOST_TRIED = 360
"""steps and directions that a safety filter may look at"""
CALLS = 330
"""decisions that a latency is measured with"""
TOLERANCE = 1e-5
"""between torch, NumPy and ONNX Runtime, in parts of the output's largest value where that is beyond 1"""
MAX_ROWS, MAX_WORK = 1 << 16, 1 << 34
"""of the golden pairs, and multiplications to replay them: seconds"""

_OPEN = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_LOG_VAR = (-12.0, 6.0)  # bounds of the world model's log-variance
_LARGEST_ERROR = 100.0  # of a target that the world model predicts
_MAX_HEADER = 1 << 20
_DTYPES = {"F32": np.dtype("<f4"), "F64": np.dtype("<f8"), "BOOL": np.dtype("?")}
_NOTHING = np.empty(0)
_MISFITS = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError)
"""what content of another form may raise"""

Array = np.ndarray
Arrays = dict[str, Array]
Layers = list[tuple[Array, Array]]
Activation = Callable[[Array], Array]


class PolicyError(RuntimeError):
    """A folder that cannot be used: which file, and why."""


class Exported(ABC):
    """What every kind can: ``said`` gives outputs for rows of inputs, by name, and remembers nothing."""

    inputs: tuple[str, ...]
    shapes: tuple[tuple[int | None, ...], ...]
    """of the inputs behind the rows; None = any size but 0"""

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        """``spec`` is policy_spec.json, ``arrays`` policy.safetensors."""
        self.work = sum(array.size for array in arrays.values())
        """multiplications of a row, of one obstacle"""

    @abstractmethod
    def said(self, given: Arrays) -> Arrays:
        """Outputs by name, one row each for rows of inputs. Raises ValueError for inputs of other shapes."""

    def _rows(self, given: Arrays) -> list[Array]:
        found = [np.asarray(given[name], np.float32) for name in self.inputs]
        for name, rows, shape in zip(self.inputs, found, self.shapes, strict=True):
            fits = rows.ndim == 1 + len(shape) and len(rows) == len(found[0])
            sizes = zip(rows.shape[1:], shape, strict=False)
            if not fits or any(n == 0 or width not in (None, n) for n, width in sizes):
                wanted = str(shape).replace("None", "n")
                raise ValueError(f"{name} must have shape {wanted}, got {rows.shape[1:]}; see {SPEC}")
        return found


class Decision(NamedTuple):
    """What the policy chooses, and what it thinks of the state."""

    action: Array
    """(4,) surge, sway, heave, yaw rate in parts of the limits, within [-1, 1]"""
    command_si: Array
    """(4,) the same in m/s, m/s, m/s, rad/s, body frame"""
    value: float
    """expected return"""
    residual: float
    """of the world model's last prediction, in deviations of the one-step change; 0 = none yet"""
    uncertainty: float
    """of that prediction"""


class Policy(Exported):
    """One vehicle's policy with its memory; ``act`` once per control step."""

    inputs = ("obs", "last_obs", "last_action", "has_last")

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        super().__init__(spec, arrays)
        self._limits = np.array([row["limit"] for row in spec["action"]], np.float32)
        self.n_obs, self.hold_steps = int(spec["observation"]["width"]), int(spec["rate"]["hold_steps"])
        self.shapes = (self.n_obs,), (self.n_obs,), (N_ACTION,), ()
        self._a, self._act = arrays, _ACTIVATIONS[spec["network"]["activation"]]
        ends = {"actor": (self.n_obs + 2, N_ACTION), "critic": (self.n_obs + 2, 1)}
        self._has_model = "encoder.0.weight" in arrays
        if self._has_model:
            latent = arrays["dynamics.0.weight"].shape[1] - N_ACTION
            ends |= {"encoder": (self.n_obs, latent), "dynamics": (latent + N_ACTION, latent)}
            ends["decoder"] = latent, 2 * N_TARGET
        self._nets = {name: _layers(arrays, name, *widths) for name, widths in ends.items()}
        if self.hold_steps < 1:
            raise ValueError("hold_steps")
        self.said({n: np.zeros((1, *shape)) for n, shape in zip(self.inputs, self.shapes, strict=True)})
        self.reset()

    def reset(self) -> None:
        """Forget the last step: another mission begins."""
        self._age, self._last = 0, (np.zeros(self.n_obs), np.zeros(N_ACTION))

    def act(self, observation: Any) -> Decision:
        """Decision for the newest observation (n_obs,); call it in every control step, held or not."""
        obs = np.asarray(observation, np.float32)
        if obs.shape != (self.n_obs,):
            raise ValueError(f"the observation must have shape ({self.n_obs},), got {obs.shape}; see {SPEC}")
        if self._age % self.hold_steps == 0:
            row = (obs, *self._last, self._age > 0)
            rows = self.said({n: np.asarray(part)[None] for n, part in zip(self.inputs, row, strict=True)})
            self._said = {name: found[0] for name, found in rows.items()}
            self._last = obs, self._said["mean_action"]
        self._age += 1
        action = np.clip(self._said["mean_action"], -1.0, 1.0)
        thought = (float(part) for part in (self._said["value"], *self._said["features"]))
        return Decision(action, action * self._limits, *thought)

    def said(self, given: Arrays) -> Arrays:
        """``mean_action`` (N, 4), not cut off, ``value`` (N,), and ``features`` (N, 2), 0 where ``has_last``
        is. What is not finite counts as its mean in training."""
        obs, last, action, has_last = self._rows(given)
        fill = self._a["norm.mean"][: self.n_obs]
        obs, last = (np.where(np.isfinite(seen), seen, fill) for seen in (obs, last))
        features = np.zeros((len(obs), 2), np.float32)
        if self._has_model:
            features = np.where(has_last[:, None] > 0, self._features(obs, last, action), features)
        x = self._scaled(np.concatenate([obs, features], 1), "norm")
        value = _through(self._nets["critic"], x, self._act)[:, 0]
        return {
            "mean_action": _through(self._nets["actor"], x, self._act),
            "value": self._a["value.mean"][0] + value * self._a["value.std"][0],
            "features": features,
        }

    def _features(self, obs: Array, last: Array, action: Array) -> Array:
        """(N, 2) residual and uncertainty of the world model's prediction from the last decision."""
        lowest, highest = map(np.float32, _LOG_VAR)
        latent = _through(self._nets["encoder"], self._scaled(last, "world_norm"), _elu)
        ahead = np.concatenate([latent, np.clip(action, -1.0, 1.0)], 1)
        ahead = _through(self._nets["dynamics"], ahead, _elu)
        mean, raw = np.split(_through(self._nets["decoder"], ahead, _elu), 2, axis=1)
        log_var = highest - _softplus(highest - lowest - _softplus(raw - lowest))
        error = np.clip(obs[:, :N_TARGET] - mean, -_LARGEST_ERROR, _LARGEST_ERROR)
        residual, uncertainty = np.sqrt(np.mean(error**2, axis=1)), np.mean(np.exp(log_var), axis=1)
        return np.nan_to_num(np.stack([residual, uncertainty], 1), nan=0.0, posinf=0.0, neginf=0.0)

    def _scaled(self, x: Array, name: str) -> Array:
        limit = self._a[f"{name}.limit"][0]
        return np.clip((x - self._a[f"{name}.mean"]) * self._a[f"{name}.scale"], -limit, limit)


class SetDecision(NamedTuple):
    """What the policy wishes."""

    wish: Array
    """(3,) ahead, left, up in the mirrored world, parts of the fastest velocity: what the filter leaves of"""
    mean_wish: Array
    """(3,) what the network says, not cut off"""


class SetPolicy(Exported):
    """A policy over a set of obstacles; it remembers nothing."""

    inputs = ("obstacles", "own")

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        super().__init__(spec, arrays)
        self.rule = spec["hull_rule"]
        self.safety = {name: float(value) for name, value in spec["safety"].items()}
        n_obstacle, n_own = (len(spec["observation"][name]["columns"]) for name in self.inputs)
        self.shapes = (None, n_obstacle), (n_own,)
        steps, tried = self.safety["horizon_s"] / self.safety["step_s"], self.safety["directions"]
        if not (0.0 <= steps <= MOST_TRIED and 1.0 <= tried <= MOST_TRIED and self.safety["lag_s"] > 0.0):
            raise ValueError("safety")
        self.kept_safe(np.zeros(3), np.ones((1, n_obstacle)), np.zeros(n_own))
        self._gain = np.float32(spec["network"]["goal_gain"])
        self._each = _layers(arrays, "actor.obstacle", n_obstacle)
        self._own = _layers(arrays, "actor.own", n_own)
        self._head = _layers(arrays, "actor.head", 2 * len(self._each[-1][1]) + len(self._own[-1][1]), 3)

    def act(self, obstacles: Any, own: Any) -> SetDecision:
        """Decision for the newest columns: obstacles (n, width), any n; own (width,). Raises ValueError for
        other shapes, numbers that are not finite, or an obstacle that begins with neither 0 nor 1."""
        rows = {"obstacles": np.asarray(obstacles)[None], "own": np.asarray(own)[None]}
        mean = self.said(rows)["mean_wish"][0]
        wish = np.clip(mean, -MOST_WISH, MOST_WISH)
        return SetDecision(self.kept_safe(wish, rows["obstacles"][0], rows["own"][0]), mean)

    def said(self, given: Arrays) -> Arrays:
        """``mean_wish`` (N, 3): maximum and sum of what the layers say of each obstacle. ValueError."""
        obstacles, own = self._rows(given)
        if not (np.isfinite(obstacles).all() and np.isfinite(own).all()):
            raise ValueError("columns are not finite; leave out obstacles that are not known")
        there = obstacles[..., AT_THERE]
        if not np.isin(there, (0.0, 1.0)).all():
            raise ValueError("the first column of obstacles is 1; where there is none all columns are 0")
        each = _relu(_through(self._each, obstacles, _relu)) * there[..., None]
        mine = _relu(_through(self._own, own, _relu))
        pooled = np.concatenate([each.max(-2), np.float32(SUM_SCALE) * each.sum(-2), mine], -1)
        mean = _through(self._head, pooled, _relu)
        mean[:, :2] += self._gain * own[:, AT_DIRECTION]
        return {"mean_wish": mean}

    def kept_safe(self, wish: Array, obstacles: Array, own: Array) -> Array:
        """(3,) the wish, or the nearest one that leads neither to a contact nor to a stop by time to
        collision within the horizon, else the one that comes least near; up stays: the safety filter."""
        rule, mine = self.safety, wish[:2] / max(1.0, math.hypot(*wish[:2]))
        if not rule["horizon_s"] or not self._lacks(mine[None], obstacles, own)[0] > 0.0:
            return wish
        angles = 2.0 * math.pi / rule["directions"] * np.arange(rule["directions"])
        around = np.stack([np.cos(angles), np.sin(angles)], 1)
        tried = np.concatenate([mine[None], around, 0.5 * around, np.zeros((1, 2))])
        cost = rule["lack_cost"] * self._lacks(tried, obstacles, own) + ((tried - mine) ** 2).sum(1)
        return np.append(tried[cost.argmin()], wish[2])

    def _lacks(self, wishes: Array, obstacles: Array, own: Array) -> Array:
        """(k,) [m] of clearance missing at the worst by wishes (k, 2), at least 0; later counts less."""
        rule, dt = self.safety, self.safety["step_s"]
        steps = np.arange(round(rule["horizon_s"] / dt) + 1)[:, None, None]
        target, t = rule["reached"] * self.rule["fastest_m_s"] * wishes[:, None, None], dt * steps[1:]
        vel = target + (own[AT_SPEED] - target) * math.exp(-dt / rule["lag_s"]) ** steps
        pos, vel = np.cumsum(0.5 * dt * (vel[:, 1:] + vel[:, :-1]), 1), vel[:, 1:]
        later, there = (1.0 - 0.5 * t / rule["horizon_s"])[..., 0], obstacles[obstacles[:, AT_THERE] > 0.5]
        place, one, two = (4.0 * there[:, at] for at in AT_WAYS)
        bend = 0.5 * (two - place) - (one - place)
        straight, over = one - place - bend, there[:, AT_WATER].min(1, initial=math.inf)
        way, coming = place + straight * t + bend * t**2 - pos, vel - straight - 2.0 * t * bend
        level = np.linalg.norm(way, axis=-1) - 0.5 * there[:, AT_WIDTH]
        clear, spare_s = np.maximum(level, 0.0), rule["ttc_s"] + rule["spare_s"]
        apart = np.where(over > 0.0, np.hypot(clear, over), level)
        coming = coming * np.where(over > 0.0, clear / np.maximum(apart, 1e-9), 1.0)[..., None]
        lacks = _lack(apart - rule["hull_m"], way, coming, rule["spare_m"], spare_s) * later
        free = 1.0 / (own[-N_RAY:] + 0.5) - 0.08
        angles, seen = 2.0 * math.pi / N_RAY * np.arange(N_RAY), free < rule["sight_m"]
        ends = (free * np.stack([np.cos(angles), np.sin(angles)])).T[seen]
        soon = slice(round(rule["wall_horizon_s"] / dt))
        way, apart = ends - pos[:, soon], np.linalg.norm(ends - pos[:, soon], axis=-1)
        walls = _lack(apart - rule["hull_m"], way, vel[:, soon], rule["wall_m"], rule["wall_s"]) * later[soon]
        return np.maximum(lacks.max((1, 2), initial=0.0), walls.max((1, 2), initial=0.0))

    def command(self, wish: Any, flip: Any, yaw_rad: float, z_m: float) -> Array:
        """(4,) surge, sway, heave, yaw rate in parts of the vehicle's limits, body frame: the hull rule. A
        diagonal of the hull turns to the motion, for there surge and sway add up; floor and surface are kept
        clear of. ``wish`` (3,) is held between decisions, ``flip`` (2,) are the signs of the way from start
        to goal along x and y (1 for 0), ``yaw_rad`` and ``z_m`` heading and height now (0 = surface)."""
        rule, (x, y, up) = self.rule, (float(part) for part in wish)
        limit, fastest, long = rule["limits_m_s"], rule["fastest_m_s"], max(1.0, math.hypot(x, y))
        ahead, left = (fastest * sign * part / long for sign, part in zip(flip, (x, y), strict=True))
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


KINDS: dict[str, type[Exported]] = {"mlp": Policy, "set": SetPolicy}
"""by ``kind`` of policy_spec.json"""


def _lack(apart: Array, way: Array, coming: Array, spare_m: float, spare_s: float) -> Array:
    """[m] that are missing to what is ``apart`` in the direction ``way`` (..., 2) and comes by ``coming``."""
    closing = (coming * way).sum(-1) / np.maximum(np.linalg.norm(way, axis=-1), 1e-3)
    return spare_m + np.maximum(closing, 0.0) * spare_s - apart


def _relu(x: Array) -> Array:
    return np.maximum(x, 0)


def _elu(x: Array) -> Array:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _softplus(x: Array) -> Array:
    return _relu(x) + np.log1p(np.exp(-np.abs(x)))


_ACTIVATIONS: dict[str, Activation] = {"elu": _elu, "tanh": np.tanh, "relu": _relu}


def _layers(arrays: Arrays, name: str, first: int, last: int | None = None) -> Layers:
    """(weight, bias) of a network's layers in order. Raises ValueError where they do not fit."""
    layers: Layers = []
    while (key := f"{name}.{2 * len(layers)}") + ".weight" in arrays:  # activations have the odd numbers
        weight, bias = arrays[f"{key}.weight"], arrays[f"{key}.bias"]
        if weight.ndim != 2 or weight.shape[1] != first or bias.shape != weight.shape[:1]:
            raise ValueError(f"{key} is a layer of {weight.shape} and {bias.shape} behind {first}")
        layers.append((weight, bias))
        first = len(bias)
    if not layers or last not in (None, first):
        raise ValueError(f"{name} has {len(layers)} layers and gives {first} instead of {last}")
    return layers


def _through(layers: Layers, x: Array, act: Activation) -> Array:
    """Output (..., n_out) of a network for x (..., n_in), ``act`` after every layer but the last."""
    for weight, bias in layers[:-1]:
        x = act(x @ weight.T + bias)
    weight, bias = layers[-1]
    return x @ weight.T + bias


def load(folder: str | Path = ".") -> Any:
    """Policy of an exported folder, every file checked against its sha256. Raises PolicyError."""
    folder = Path(folder)
    spec = read_spec(folder)
    if wrong := changed_files(folder, spec):
        raise PolicyError(f"{folder}: {'; '.join(wrong)}; export the policy again")
    return made(spec, read_safetensors(folder / WEIGHTS))


def made(spec: dict[str, Any], arrays: Arrays) -> Exported:
    """What a specification's ``kind`` stands for. Raises PolicyError, also where the arrays do not fit."""
    kind = spec.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise PolicyError(f"{SPEC}: holds {kind!r}, not one of {', '.join(KINDS)}")
    try:
        return KINDS[kind](spec, arrays)
    except _MISFITS as error:
        told = f"{SPEC} and {WEIGHTS} do not fit together ({error!r}); export the policy again"
        raise PolicyError(told) from None


def read_spec(folder: Path) -> dict[str, Any]:
    """policy_spec.json. Raises PolicyError."""
    file = folder / SPEC
    try:
        spec = json.loads(content_of(file))
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"{file}: is not JSON ({error}); export the policy again") from None
    if not isinstance(spec, dict) or spec.get("schema") != SCHEMA:
        told = f"is not the specification of an exported policy of schema {SCHEMA}"
        raise PolicyError(f"{file}: {told}; give a folder of this version's uuv export")
    return spec


def changed_files(folder: Path, spec: dict[str, Any]) -> list[str]:
    """What is not as the spec says, in words. Raises PolicyError."""
    listed = spec.get("files")
    if not isinstance(listed, dict) or not {WEIGHTS, GOLDEN} <= listed.keys() <= set(FILES):
        raise PolicyError(f"{folder / SPEC}: lists other files than a policy has ({', '.join(FILES)})")
    found = []
    for name, sha256 in listed.items():
        try:
            if hashlib.sha256(content_of(folder / name)).hexdigest() != sha256:
                found.append(f"{name}: has changed, its sha256 is not that of {SPEC}")
        except PolicyError as error:
            found.append(str(error))
    return found


def content_of(file: Path) -> bytes:
    """Bytes of a plain file of bearable size, no link, pipe or device. Raises PolicyError."""
    try:
        if file.is_symlink():
            raise FileNotFoundError
        with open(os.open(file, _OPEN), "rb") as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise FileNotFoundError
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise PolicyError(f"{file}: is missing or no plain file; give a folder of uuv export") from None
    except (OSError, ValueError) as error:
        raise PolicyError(f"{file}: cannot be read ({error})") from None
    if len(content) > MAX_BYTES:
        raise PolicyError(f"{file}: is larger than {MAX_BYTES >> 20} MiB; no exported policy is")
    return content


def read_safetensors(file: Path) -> Arrays:
    """Arrays of a safetensors file, every length checked, weights finite. Raises PolicyError."""
    content = content_of(file)
    try:
        arrays = _tensors(content)
        for name, array in arrays.items() if file.name == WEIGHTS else ():
            if not np.isfinite(array).all():
                raise ValueError(f"{name} is not finite")
    except _MISFITS as error:
        raise PolicyError(f"{file}: is not a safetensors file of an exported policy ({error})") from None
    return arrays


def _tensors(content: bytes) -> Arrays:
    """The format: https://huggingface.co/docs/safetensors (8 bytes of length, JSON header, raw bytes)."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > min(len(content) - 8, _MAX_HEADER):
        raise ValueError("its header is longer than the file or than any of ours")
    header, data = json.loads(content[8 : 8 + length]), memoryview(content)[8 + length :]
    header.pop("__metadata__", None)
    arrays, end = {}, 0
    for name, entry in sorted(header.items(), key=lambda pair: pair[1]["data_offsets"]):
        first, last = entry["data_offsets"]
        dtype, shape = _DTYPES[entry["dtype"]], entry["shape"]
        whole = all(type(n) is int and n >= 0 for n in (first, last, *shape))
        if not whole or first != end or last > len(data):
            raise ValueError(f"{name} lies outside the file or over another array")
        if last - first != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{name} has {last - first} bytes, its shape {shape} needs others")
        arrays[name], end = np.frombuffer(data[first:last], dtype).reshape(shape), last
    if end != len(data):
        raise ValueError("it holds more bytes than arrays")
    return arrays


def golden_rows(golden: Arrays, inputs: Iterable[str]) -> Arrays:
    """The golden inputs by name. Raises PolicyError where they are not as many rows each."""
    rows = {name: golden.get(f"pair_{name}", _NOTHING) for name in inputs}
    counts = {len(array) if array.ndim else 0 for array in rows.values()}
    if len(counts) != 1 or not 0 < min(counts) <= MAX_ROWS:
        raise PolicyError(f"{GOLDEN}: has no rows of this policy; export the policy again")
    return rows


def compared(
    engine: str, said: Callable[[Arrays], Arrays], rows: Arrays, golden: Arrays, at_once: int = 1
) -> dict[str, Any]:
    """An engine against the golden pairs, as JSON: the largest ``difference`` of every output (None = without
    end), whether it ``agrees``, and the latency of a call with one row, after 30 that do not count. ``said``
    gives outputs by name for inputs by name; ``at_once`` of the ``rows`` are compared together."""
    count, times = len(next(iter(rows.values()))), []

    def part(first: int, n: int) -> Arrays:
        return {name: array[first : first + n] for name, array in rows.items()}

    parts = [said(part(first, at_once)) for first in range(0, count, at_once)]
    found = {f"pair_{name}": np.concatenate([each[name] for each in parts]) for name in parts[0]}
    worst = {
        name.removeprefix("pair_"): difference(found.get(name, _NOTHING), golden.get(name, _NOTHING))
        for name in {**found, **golden}
        if name.removeprefix("pair_") not in rows
    }
    for call in range(CALLS):
        row, begun = part(call % count, 1), time.perf_counter()
        said(row)
        times.append(1e3 * (time.perf_counter() - begun))
    return {
        "engine": engine,
        "difference": {name: value if math.isfinite(value) else None for name, value in worst.items()},
        **{f"p{share}_ms": float(np.percentile(times[30:], share)) for share in (50, 99)},
        "agrees": max(worst.values(), default=math.inf) <= TOLERANCE,
    }


def difference(found: Array, expected: Array) -> float:
    """Largest difference, as ``TOLERANCE`` counts; infinite for other shapes or NaN."""
    if found.shape != expected.shape or not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return math.inf
    return float(np.max(np.abs(found - expected), initial=0.0) / np.max(np.abs(expected), initial=1.0))


def of_numpy(policy: Exported, golden: Arrays) -> dict[str, Any]:
    """As ``compared``. Raises PolicyError for golden pairs of another shape, or that would take minutes."""
    rows = golden_rows(golden, policy.inputs)
    first = rows[policy.inputs[0]]
    obstacles = first.shape[1] if first.ndim == 3 else 1
    if policy.work * obstacles * (len(first) + CALLS) > MAX_WORK:
        raise PolicyError(f"{GOLDEN}: would take minutes to replay; no exported policy does")
    try:
        return compared("NumPy", policy.said, rows, golden)
    except _MISFITS as error:
        raise PolicyError(f"{GOLDEN}: does not fit the policy ({error}); export the policy again") from None


def main(arguments: list[str]) -> int:
    """0 = the golden pairs agree, 3 = they differ, 1 = the folder cannot be used."""
    folder = Path(arguments[0]) if arguments else Path(__file__).resolve().parent
    try:
        found = of_numpy(load(folder), read_safetensors(folder / GOLDEN))
    except PolicyError as error:
        print(f"{folder}: {error}", file=sys.stderr)
        return 1
    for name, value in found["difference"].items():
        largest = math.inf if value is None else value
        print(f"{name}: largest difference {largest:.2g} (tolerance {TOLERANCE:g})")
    print(f"decision: p50 {found['p50_ms']:.3f} ms, p99 {found['p99_ms']:.3f} ms")
    return 0 if found["agrees"] else 3


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
