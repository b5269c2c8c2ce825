"""The weights of a learned forecast: read from a file, checked, put where the kernel reads them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from uuvtai.common.enums import N_COLUMN, N_HIDDEN, N_SAID, N_SPREAD, PACKET
from uuvtai.common.errors import UserError
from uuvtai.common.files import read_bytes
from uuvtai.common.presets import PRESET_DIR

if TYPE_CHECKING:  # a forecast is learnt without Taichi
    from uuvtai.compile.memory import Put
    from uuvtai.state import MixtureState

BUILT_IN = "built-in"  # name of the network that comes with the package
WEIGHTS = "forecast.safetensors"  # file of a run folder, and of what is built in
SHAPES = {
    "bias_in": (N_HIDDEN,), "weight_in": (N_COLUMN, N_HIDDEN),
    "bias_mid": (N_HIDDEN,), "weight_mid": (N_HIDDEN, N_HIDDEN),
    "bias_out": (N_SAID,), "weight_out": (N_HIDDEN, N_SAID),
}  # fmt: skip
"""names and shapes, in the kernel's order; rows are inputs"""
SPREADS = {"bias_spread": (N_SPREAD,), "weight_spread": (N_HIDDEN, N_SPREAD)}
"""the layer that says spreads, which the kernel does not need"""
_LARGEST_BYTES = 4 << 20
Weights = dict[str, np.ndarray]


class ForecastError(UserError, ValueError):
    """A network that cannot forecast: what, where, why, what to type next."""


def weights_file(learned: str) -> Path:
    """The file that ``forecast.learned`` names: the built-in one, that of a run folder, or a file itself."""
    if learned == BUILT_IN:
        return PRESET_DIR / "forecast" / WEIGHTS
    path = Path(learned)
    return path / WEIGHTS if path.is_dir() else path


def read_weights(learned: str) -> Weights:
    """Float32 arrays of ``SHAPES`` and ``SPREADS``. Raises ForecastError or FileError."""
    path = weights_file(learned)
    try:
        found = load(read_bytes(path, _LARGEST_BYTES))
    except FileNotFoundError:
        raise ForecastError(
            f"forecast.learned={learned}: there is no {path}; train a forecast (uuv train forecast --run-dir "
            "runs/forecast), or take the one that is built in: forecast.learned=built-in"
        ) from None
    except (SafetensorError, ValueError, KeyError) as error:
        raise ForecastError(f"{path}: is no safetensors file ({error}); take another one") from None
    for name, shape in (SHAPES | SPREADS).items():
        own = found.get(name)
        if own is None or own.shape != shape or own.dtype != np.float32:
            what = "missing" if own is None else f"{own.dtype} {list(own.shape)}"
            raise ForecastError(
                f"{path}: {name} is {what}, not float32 {list(shape)}: it was not made by this version's "
                "'uuv train forecast'; train anew or take forecast.learned=built-in"
            )
        if not np.isfinite(own).all():
            raise ForecastError(f"{path}: {name} is not finite: the training failed; take an older file")
    return {name: found[name] for name in SHAPES | SPREADS}


def packed_weights(weights: Weights) -> bytes:
    """Content of a file that ``read_weights`` reads."""
    return save({name: np.ascontiguousarray(weights[name], np.float32) for name in SHAPES | SPREADS})


def put_weights(mixture: MixtureState, weights: Weights, put: Put) -> None:
    """Into the simulator's array, in the order of ``SHAPES``."""
    put(mixture.weight, np.concatenate([weights[name].ravel() for name in SHAPES]).reshape(-1, PACKET))
