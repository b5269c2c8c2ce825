"""Drive by an exported policy with NumPy alone: no torch, no Taichi, no uuvtai. ``uuv export`` puts a copy of
this file in its folder.

    from run_policy import load
    policy = load("FOLDER")               # checks the sha256 of every file
    policy.reset()                        # at the start of a mission
    decision = policy.act(observation)    # every control step: (n_obs,) in raw SI units, as policy_spec.json
    says

``python run_policy.py [FOLDER]`` replays the golden pairs, prints the differences and the latency, and exits
3 where they differ. Nothing in the folder can make this file execute code: safetensors and npz are read as
bytes of checked length, never as pickles.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import stat
import sys
import time
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SPEC, WEIGHTS, GOLDEN = "policy_spec.json", "policy.safetensors", "golden.npz"
SCHEMA = 3
"""of the folder; another one is refused"""
FILES = (WEIGHTS, GOLDEN, "policy.onnx", "README.md", "run_policy.py", "run_set_policy.py")
"""names that the spec may list; nothing else is ever opened"""
KINDS = ("set", "forecast")
"""of policies that ``run_set_policy.py`` drives by; a specification without ``kind`` is this file's"""
N_TARGET, N_ACTION = 24, 4
MAX_BYTES = 64 << 20
"""of any file of the folder: sixteen million parameters"""
CALLS = 330
"""decisions that a latency is measured with"""
MAX_STEPS, MAX_WORK = 1 << 16, 1 << 34
"""of the golden pairs, and multiplications to replay them: seconds"""

_OPEN = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_LOG_VAR = (-12.0, 6.0)  # bounds of the world model's log-variance
_MAX_DEVIATIONS = 100.0  # a residual counts as at most this many deviations
_MAX_HEADER = 1 << 20
_DTYPES = {"F32": np.dtype("<f4"), "F64": np.dtype("<f8")}

Arrays = dict[str, np.ndarray]


class PolicyError(RuntimeError):
    """A folder that cannot be used: which file, and why."""


class Decision(NamedTuple):
    """What the policy chooses, and what it thinks of the state."""

    action: np.ndarray
    """(4,) surge, sway, heave, yaw rate in parts of the limits, within [-1, 1]"""
    command_si: np.ndarray
    """(4,) the same in m/s, m/s, m/s, rad/s, body frame"""
    value: float
    """expected return"""
    residual: float
    """of the world model's last prediction, in deviations of the one-step change; 0 = none yet"""
    uncertainty: float
    """of that prediction"""


class Policy:
    """One vehicle's policy with its memory. ``act`` once per control step; ``reset`` when a mission
    begins."""

    def __init__(self, spec: dict[str, Any], arrays: Arrays) -> None:
        """``spec`` is policy_spec.json, ``arrays`` policy.safetensors. Raises PolicyError where they do not
        fit together."""
        try:
            self._network, self._limits = (
                spec["network"],
                np.array([row["limit"] for row in spec["action"]], np.float32),
            )
            self.n_obs, self.hold_steps = int(spec["observation"]["width"]), int(spec["rate"]["hold_steps"])
            self.control_dt_s = float(spec["rate"]["control_dt_s"])
            self._a = arrays
            self._nets = {
                name: layers_of(arrays, name)
                for name in ("actor", "critic", "encoder", "dynamics", "decoder")
            }
            self._check_widths()
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise PolicyError(
                f"{SPEC} and {WEIGHTS} do not fit together ({error!r}); export the policy again"
            ) from None
        self.work = sum(weight.size for layers in self._nets.values() for weight, _ in layers)
        """multiplications of a decision"""
        self.reset()

    def reset(self) -> None:
        """Forget the last step: another mission begins."""
        self._age = 0
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self._mean, self._said = np.zeros(N_ACTION, np.float32), np.zeros(3, np.float32)

    def act(self, observation: Any) -> Decision:
        """Decision for the newest observation (n_obs,), carried out: call it every control step, also while a
        decision is held."""
        obs = np.asarray(observation, np.float32)
        if obs.shape != (self.n_obs,):
            raise ValueError(
                f"the observation must have shape ({self.n_obs},), got {obs.shape}; its columns are listed "
                f"in {SPEC}"
            )
        obs = np.where(np.isfinite(obs), obs, self._a["norm.mean"][: self.n_obs])
        if self._age % self.hold_steps == 0:
            self._think(obs)
            self._last = obs, self._mean
        self._age += 1
        value, residual, uncertainty = (float(said) for said in self._said)
        action = np.clip(self._mean, -1.0, 1.0)
        return Decision(action, action * self._limits, value, residual, uncertainty)

    def _think(self, obs: np.ndarray) -> None:
        """Ask the networks: what is held until the next decision, and what they say."""
        x = np.concatenate([obs, self._features(obs)])
        scaled = self._scaled(x, "norm")
        self._mean = self._through("actor", scaled)
        value = self._a["value.mean"][0] + self._through("critic", scaled)[0] * self._a["value.std"][0]
        self._said = np.array([value, x[-2], x[-1]], np.float32)

    def _features(self, obs: np.ndarray) -> np.ndarray:
        """(2,) residual and uncertainty of the world model's prediction from the last decision; 0 where there
        is none."""
        if self._last is None or not self._nets["encoder"]:
            return np.zeros(2, np.float32)
        last, action = self._last
        a, lowest, highest = self._a, *_LOG_VAR
        latent = self._through("encoder", self._scaled(last, "world_norm"))
        ahead = self._through("dynamics", np.concatenate([latent, np.clip(action, -1.0, 1.0)]))
        mean, raw = np.split(self._through("decoder", ahead), 2)
        spread = np.float32(highest) - _softplus(
            np.float32(highest - lowest) - _softplus(raw - np.float32(lowest))
        )
        log_var = spread + 2.0 * np.log(a["target.scale"])
        base = last[:N_TARGET] if self._network["predict_change"] else a["target.base"]
        error = (obs[:N_TARGET] - (base + a["target.scale"] * mean)) / a["change.unit"]
        residual = np.sqrt(np.mean(np.clip(error, -_MAX_DEVIATIONS, _MAX_DEVIATIONS) ** 2))
        uncertainty = np.mean(np.exp(log_var - 2.0 * np.log(a["change.unit"])))
        return np.nan_to_num(np.array([residual, uncertainty], np.float32), nan=0.0, posinf=0.0, neginf=0.0)

    def _scaled(self, x: np.ndarray, name: str) -> np.ndarray:
        """Normalised columns, cut off beyond the clip."""
        limit = self._a[f"{name}.limit"][0]
        return np.clip((x - self._a[f"{name}.mean"]) * self._a[f"{name}.scale"], -limit, limit)

    def _through(self, name: str, x: np.ndarray) -> np.ndarray:
        """Output of one network, its activation after every layer but the last."""
        layers = self._nets[name]
        act = _ACTIVATIONS[self._network["activation"] if name in ("actor", "critic") else "elu"]
        for weight, bias in layers[:-1]:
            x = act(weight @ x + bias)
        weight, bias = layers[-1]
        return weight @ x + bias

    def _check_widths(self) -> None:
        """Raise ValueError where a network does not take what it is given or does not give what is read."""
        nets, n_in = self._nets, self.n_obs + 2
        wanted = {"actor": (n_in, N_ACTION), "critic": (n_in, 1)}
        if nets["encoder"]:
            latent = len(nets["encoder"][-1][1])
            wanted |= {
                "encoder": (self.n_obs, latent),
                "dynamics": (latent + N_ACTION, latent),
                "decoder": (latent, 2 * N_TARGET),
            }
        for name, (first, last) in wanted.items():
            if not nets[name] or nets[name][0][0].shape[1] != first or len(nets[name][-1][1]) != last:
                raise ValueError(f"{name} is not a network from {first} to {last}")
        if self.hold_steps < 1 or self._network["activation"] not in _ACTIVATIONS:
            raise ValueError("hold_steps or activation")


_ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
}


def _softplus(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0) + np.log1p(np.exp(-np.abs(x)))


def layers_of(arrays: Arrays, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """(weight, bias) of a network's layers in order; ValueError where one does not follow the other."""
    numbers = sorted(
        int(key[len(name) + 1 :].partition(".")[0])
        for key in arrays
        if key.startswith(f"{name}.") and key.endswith(".weight")
    )
    layers = [(arrays[f"{name}.{i}.weight"], arrays[f"{name}.{i}.bias"]) for i in numbers]
    widths = [weight.shape[1] for weight, _ in layers[1:]]
    if any(weight.ndim != 2 or bias.shape != weight.shape[:1] for weight, bias in layers) or widths != [
        len(b) for _, b in layers[:-1]
    ]:
        raise ValueError(f"layers of {name}")
    return layers


# -------------------------------------------------------------------------------------- reading without trust


def load(folder: str | Path = ".") -> Policy:
    """The policy of an exported folder, every file checked against its sha256. Raises PolicyError."""
    folder = Path(folder)
    spec = read_spec(folder)
    if kind := spec.get("kind"):
        raise PolicyError(f"{folder}: holds a policy of kind {kind!r}; drive by run_set_policy.py instead")
    if wrong := changed_files(folder, spec):
        raise PolicyError(f"{folder}: {'; '.join(wrong)}; export the policy again")
    return Policy(spec, read_safetensors(folder / WEIGHTS))


def read_spec(folder: Path) -> dict[str, Any]:
    """policy_spec.json. Raises PolicyError."""
    file = folder / SPEC
    try:
        spec = json.loads(content_of(file))
    except (ValueError, RecursionError) as error:
        raise PolicyError(f"{file}: is not JSON ({error}); export the policy again") from None
    if not isinstance(spec, dict) or spec.get("schema") != SCHEMA:
        raise PolicyError(
            f"{file}: is not the specification of an exported policy of schema {SCHEMA}; give a folder of "
            "this version's uuv export"
        )
    return spec


def changed_files(folder: Path, spec: dict[str, Any]) -> list[str]:
    """What is not as the spec says, in words; empty = every file is there and has its sha256. Raises
    PolicyError."""
    listed = spec.get("files")
    if not isinstance(listed, dict) or not {WEIGHTS, GOLDEN} <= listed.keys() <= set(FILES):
        raise PolicyError(
            f"{folder / SPEC}: lists other files than an exported policy has ({', '.join(FILES)})"
        )
    found = []
    for name, sha256 in listed.items():
        try:
            digest = hashlib.sha256(content_of(folder / name)).hexdigest()
        except PolicyError as error:
            found.append(str(error))
        else:
            if digest != sha256:
                found.append(f"{name}: has changed, its sha256 is not that of {SPEC}")
    return found


def content_of(file: Path) -> bytes:
    """Bytes of a plain file of bearable size; no link is followed and neither a pipe nor a device is waited
    for. Raises PolicyError."""
    try:
        if file.is_symlink():
            raise PolicyError(f"{file}: is missing or no plain file; give a folder of uuv export")
        with open(os.open(file, _OPEN), "rb") as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise PolicyError(f"{file}: is missing or no plain file; give a folder of uuv export")
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise PolicyError(f"{file}: is missing or no plain file; give a folder of uuv export") from None
    except (OSError, ValueError) as error:
        raise PolicyError(f"{file}: cannot be read ({error})") from None
    if len(content) > MAX_BYTES:
        raise PolicyError(f"{file}: is larger than {MAX_BYTES >> 20} MiB; no exported policy is")
    return content


def read_safetensors(file: Path) -> Arrays:
    """Arrays of a safetensors file (F32 and F64), every length checked, all finite. Raises PolicyError."""
    try:
        return _tensors(content_of(file))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise PolicyError(f"{file}: is not a safetensors file of an exported policy ({error})") from None


def _tensors(content: bytes) -> Arrays:
    """Source of the format: https://huggingface.co/docs/safetensors (8 bytes of length, JSON header, raw
    bytes without gaps)."""
    length = int.from_bytes(content[:8], "little")
    if len(content) < 8 or length > min(len(content) - 8, _MAX_HEADER):
        raise ValueError("its header is longer than the file or than any of ours")
    header, data = json.loads(content[8 : 8 + length]), memoryview(content)[8 + length :]
    header.pop("__metadata__", None)
    arrays, end = {}, 0
    for name, entry in sorted(header.items(), key=lambda pair: pair[1]["data_offsets"]):
        first, last = entry["data_offsets"]
        dtype, shape = _DTYPES[entry["dtype"]], entry["shape"]
        if (
            not all(type(n) is int and n >= 0 for n in (first, last, *shape))
            or first != end
            or last > len(data)
        ):
            raise ValueError(f"{name} lies outside the file or over another array")
        if last - first != math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{name} has {last - first} bytes, its shape {shape} needs others")
        arrays[name] = np.frombuffer(data[first:last], dtype).reshape(shape)
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} is not finite")
        end = last
    if end != len(data):
        raise ValueError("it holds more bytes than arrays")
    return arrays


def read_golden(file: Path) -> Arrays:
    """Arrays of golden.npz: members must be stored, not compressed, so that nothing unfolds. Raises
    PolicyError."""
    try:
        with zipfile.ZipFile(io.BytesIO(content_of(file))) as archive:
            return {
                member.filename.removesuffix(".npy"): _member(archive, member)
                for member in archive.infolist()
            }
    except (ValueError, zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError) as error:
        raise PolicyError(f"{file}: is not the golden pairs of an exported policy ({error})") from None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{member.filename} is compressed")
    stream = io.BytesIO(archive.read(member))
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{member.filename} is no array of version 1.0")
    shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or by_column:
        raise ValueError(f"{member.filename} holds objects or is stored by column")
    return np.frombuffer(stream.read(), dtype).reshape(shape)


# ----------------------------------------------------------------------------------------------- golden pairs


def replayed(policy: Policy, golden: Arrays) -> Arrays:
    """What the policy says to the golden observations, under the names of the golden outputs that it has.

    Raises PolicyError for golden pairs of another shape, or that would take minutes.
    """
    steps = golden["obs"].shape[:1]
    if (
        golden["obs"].shape != (*steps, policy.n_obs)
        or golden["begins"].shape != steps
        or not 0 < steps[0] <= MAX_STEPS
    ):
        raise PolicyError(f"{GOLDEN}: has no missions of this policy; export the policy again")
    if policy.work * (steps[0] // policy.hold_steps + golden["begins"].sum() + CALLS) > MAX_WORK:
        raise PolicyError(f"{GOLDEN}: would take minutes to replay; no exported policy does")
    decisions = []
    for obs, begins in zip(golden["obs"], golden["begins"], strict=True):
        if begins:
            policy.reset()
        decisions.append(policy.act(obs))
    columns = ("action", "value", "residual", "uncertainty")
    return {name: np.array([getattr(d, name) for d in decisions], np.float32) for name in columns}


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference, in parts of the largest expected number where that is beyond 1; infinite for other
    shapes or NaN."""
    if found.shape != expected.shape or not (np.isfinite(found).all() and np.isfinite(expected).all()):
        return math.inf
    return float(np.max(np.abs(found - expected), initial=0.0) / np.max(np.abs(expected), initial=1.0))


def latency_ms(step: Callable[[], Any], count: int = CALLS - 30, warm_up: int = 30) -> dict[str, float]:
    """p50 and p99 [ms] of a call, over ``count`` calls after ``warm_up``."""
    times = []
    for _ in range(warm_up + count):
        begun = time.perf_counter()
        step()
        times.append(1e3 * (time.perf_counter() - begun))
    return {
        "p50_ms": float(np.percentile(times[warm_up:], 50)),
        "p99_ms": float(np.percentile(times[warm_up:], 99)),
    }


def decision_latency_ms(policy: Policy, obs: Iterable[np.ndarray]) -> dict[str, float]:
    """p50 and p99 [ms] of a decision for the observations in turn; steps that only hold one are left out."""
    rows, turn = list(obs), 0

    def decide() -> None:
        nonlocal turn
        policy._age = 0  # due
        policy.act(rows[turn % len(rows)])
        turn += 1

    found = latency_ms(decide)
    policy.reset()
    return found


def main(arguments: list[str]) -> int:
    """Replay the golden pairs of a folder; 0 = they agree, 3 = they differ, 1 = the folder cannot be used."""
    folder = Path(arguments[0]) if arguments else Path(__file__).resolve().parent
    try:
        policy, spec, golden = load(folder), read_spec(folder), read_golden(folder / GOLDEN)
        found = replayed(policy, golden)
        worst = {name: difference(values, golden[name]) for name, values in found.items()}
        tolerance = float(spec["golden"]["tolerance"])
    except (
        PolicyError,
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        IndexError,
        ArithmeticError,
    ) as error:
        print(f"{folder}: {error}", file=sys.stderr)
        return 1
    steps = len(golden["obs"])
    for name, value in worst.items():
        print(f"{name}: largest difference {value:.2g} over {steps} steps (tolerance {tolerance:g})")
    time_ms = decision_latency_ms(policy, golden["obs"])
    print(f"decision: p50 {time_ms['p50_ms']:.3f} ms, p99 {time_ms['p99_ms']:.3f} ms")
    return 0 if max(worst.values()) <= tolerance else 3


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
