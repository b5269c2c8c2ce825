"""``uuv identify``: parameters with intervals, errors ahead and warnings from drives; the vehicle as YAML."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.config import VehicleConfig
from uuvtai.identify.drive_log import Drive, DriveError
from uuvtai.identify.excitation import LEAST_STRETCHES, MORE, unexcited, unstepped
from uuvtai.identify.motion_model import (
    AXES,
    GAIN,
    LAG,
    LATE,
    NET,
    SIZE,
    Stretches,
    changed,
    parameters_of,
    readings,
    stretches,
)
from uuvtai.identify.output_error import SCALE, Fit, fitted, horizon_errors
from uuvtai.shipped import preset_names

KNOWN = ("gain", "added-mass", "buoyancy")
"""what may be held: speeds and rotor speeds alone tell ratios, one force or mass has to be known"""
KINDS = ("added mass", "linear damping", "quadratic damping")
HORIZONS = (1, 10, 100)
_STRETCH_S = 5.0
_HELD_OUT = 5
"""one stretch in so many is predicted by a fit to the others"""
_MOST_SAMPLES = 150_000
"""of all stretches that are fitted, for each takes some seven kilobytes; 50 minutes at 50 Hz"""
_NOTHING = 0.02
"""share of an error ahead that is no difference: a fit is better where it is so by more at one horizon, and
worse by more at none"""
_LOOSE = 0.5
"""An interval wider than this share of the value, to either side, is warned of."""
_OTHERS = {
    NET: ("net buoyancy", "N"),
    GAIN: ("thruster gain", ""),
    LAG: ("rotor lag", "s"),
    LATE[0]: ("delay, velocity", "s"),
    LATE[1]: ("delay, yaw rate", "s"),
}
"""name and unit of what no axis has"""
_UNITS = ("kg", "N s/m", "N s2/m2"), ("kg m2", "N m s", "N m s2")


@dataclass(frozen=True)
class Identified:
    """The document of ``uuv identify --json`` and what its files are made of."""

    document: dict[str, Any]
    keys: dict[str, object]
    """of the vehicle section, as found"""
    measured: np.ndarray
    """(s, n + 1, 4) readings, NaN = none"""
    predicted: np.ndarray
    """(s, n + 1, 4) by the fitted vehicle"""
    dt_s: float


@dataclass(frozen=True)
class FittedDrives:
    """What was fitted to drives."""

    given: Stretches
    first: np.ndarray
    """(17,) of the vehicle given"""
    free: np.ndarray
    """(17,) which were fitted"""
    fit: Fit
    entries: list[dict[str, Any]]
    """of the document, one for each parameter"""
    warnings: list[str]


def fitted_drives(
    drives: list[Drive], vehicle_cfg: VehicleConfig, known: str = "gain", held: Collection[int] = ()
) -> FittedDrives:
    """Parameters with intervals, without errors ahead; as ``identified``. ``held``: places that stay as
    given. Raises DriveError."""
    if known not in KNOWN:
        raise DriveError(f"--known must be one of {', '.join(KNOWN)}, got {known!r}")
    if not drives:
        raise DriveError("the logs hold no drive: drive for five minutes")
    given = stretches(drives, vehicle_cfg, _STRETCH_S)
    count = len(given.velocity)
    if count < LEAST_STRETCHES:
        raise DriveError(
            f"the logs hold {count} stretches of {_STRETCH_S:g} s without a gap, {LEAST_STRETCHES} are "
            "needed: drive for five minutes, or give more logs"
        )
    warnings, most = [], _MOST_SAMPLES // given.wrench.shape[1]
    if count > most:
        given = given.some(np.linspace(0, count - 1, most).astype(int))
        warnings.append(f"of {count} stretches {most} are fitted, evenly spread; five minutes are enough")
    idle = unexcited(given)
    if len(idle) == len(AXES):
        raise DriveError(f"the logs excite no axis; {'; '.join(idle.values())}")
    lagless = unstepped(drives)
    first, free = parameters_of(vehicle_cfg), _free(idle, known, not lagless)
    free[list(held)] = False
    fit = fitted(given, vehicle_cfg, first, free)
    entries = [_entry(place, first, fit, bool(free[place])) for place in range(SIZE)]
    warnings += [f"{text}; its numbers stay those of the vehicle given" for text in idle.values()]
    if lagless:
        warnings.append(f"rotor lag: {lagless}; it stays that of the vehicle given")
    warnings += [text for entry in entries if (text := _warning(entry))]
    return FittedDrives(given, first, free, fit, entries, warnings)


def identified(drives: list[Drive], vehicle_cfg: VehicleConfig, known: str = "gain") -> Identified:
    """Fit a vehicle to drives; ``vehicle_cfg`` gives mass, thrusters, the ``known``, and the numbers of each
    axis in which the fit is no better on stretches that it has not seen. Raises DriveError, also where it is
    better nowhere."""
    try:
        with np.errstate(all="ignore"):
            made, horizons, kept = _judged(drives, vehicle_cfg, known)
    except np.linalg.LinAlgError:
        raise DriveError(
            "no vehicle moves as the logs say: see that the rotor speeds are in the thrusters' order and "
            "signed as their thrust, and all units are SI"
        ) from None
    given, fit = made.given, made.fit
    count = len(given.velocity)
    document: dict[str, Any] = {
        "known": known,
        "seconds": round(count * _STRETCH_S, 3),
        "stretches": count,
        "parameters": made.entries,
        "residual_rms": dict(zip(AXES, fit.noise.tolist(), strict=True)),
        "horizons": horizons,
        "warnings": [*kept, *made.warnings],
    }
    given = given.at_lag(fit.value[LAG], vehicle_cfg)
    predicted = readings(fit.value[None], fit.start[None], given, vehicle_cfg)[0]
    return Identified(document, changed(vehicle_cfg, fit.value), given.velocity, predicted, given.dt_s)


def _judged(
    drives: list[Drive], vehicle_cfg: VehicleConfig, known: str
) -> tuple[FittedDrives, dict[str, Any], list[str]]:
    """(what was fitted, its errors ahead, why numbers stay as given): what came out negative, or is worse
    than the vehicle given on stretches that were not fitted, stays, and the others are fitted anew."""
    held: set[int] = set()
    kept, given = [], []
    while True:
        made = fitted_drives(drives, vehicle_cfg, known, held)
        negative = [entry for entry in made.entries if entry["fitted"] and _is_negative(entry)]
        if negative:
            held.update(entry["place"] for entry in negative)
            kept += [
                f"{entry['name']}: came out negative ({entry['value']:.3g} {entry['unit']}) and stays that "
                f"of the vehicle given; {MORE[entry['kind']]}"
                for entry in negative
            ]
            continue
        values = made.first, made.fit.value
        horizons = _horizons(made.given, vehicle_cfg, values, made.free)
        worse = {text: places for i in range(len(AXES)) for text, places in _worse(i, horizons, made.free)}
        given += worse
        held.update(place for places in worse.values() for place in (*places, GAIN))  # what it is given for
        left = made.free.copy()
        left[list(held)] = False
        if not left[: NET + 1].any():
            raise DriveError(
                "the logs improve no number of the vehicle given, and nothing is written; on stretches that "
                f"were not fitted: {'; '.join(given) or 'no axis is left'}. Keep that vehicle, or see that "
                "the rotor speeds' order and signs are right and drive longer, on each axis, slowly and fast"
            )
        if not worse:
            kept += [f"{text} on stretches that were not fitted; the axis stays as given" for text in given]
            return made, horizons, kept


def _is_negative(entry: dict[str, Any]) -> bool:
    return entry["value"] < 0 and entry["place"] not in (NET, *LATE)


def _worse(axis: int, horizons: dict[str, Any], free: np.ndarray) -> list[tuple[str, list[int]]]:
    """[] where the fit is better on an axis than the vehicle given, or nothing of it is fitted; else how much
    worse it is, and the places of the axis."""
    places = [
        place for place in (axis, axis + 4, axis + 8, NET) if free[place] and (place != NET or axis == 2)
    ]
    pairs = [
        (steps, ours[axis], horizons["given"][steps][axis])
        for steps, ours in horizons["identified"].items()
        if steps != "1" and ours[axis] is not None
    ]
    shares = [ours / max(given, 1e-9) for _, ours, given in pairs]
    if not places or (shares and min(shares) < 1 - _NOTHING and max(shares) < 1 + _NOTHING):
        return []
    unit = "rad/s" if AXES[axis] == "yaw" else "m/s"
    said = ", ".join(
        f"{ours:.3g} against {given:.3g} {unit} {steps} steps ahead" for steps, ours, given in pairs
    )
    return [(f"{AXES[axis]} is no better ({said or 'no readings'})", places)]


def _free(idle: dict[str, str], known: str, shows_lag: bool) -> np.ndarray:
    """(17,) which parameters are fitted."""
    late = [any(axis not in idle for axis in axes) for axes in (AXES[:3], AXES[3:])]
    free = np.array([axis not in idle for _ in KINDS for axis in AXES] + [True, True, shows_lag, *late])
    if known == "gain":
        free[GAIN] = False
    elif known == "buoyancy":
        free[NET] = False
    else:
        free[: len(AXES)] = False
    return free


def _entry(place: int, first: np.ndarray, fit: Fit, is_fitted: bool) -> dict[str, Any]:
    if place < NET:
        kind, axis = KINDS[place // 4], AXES[place % 4]
        name, unit = f"{kind}, {axis}", _UNITS[axis == "yaw"][place // 4]
    else:
        name, unit = _OTHERS[place]
        kind = name.partition(",")[0]
    return {
        "name": name,
        "kind": kind,
        "place": place,
        "unit": unit,
        "given": float(first[place]),
        "value": float(fit.value[place]),
        "low": float(fit.low[place]),
        "high": float(fit.high[place]),
        "fitted": is_fitted,
    }


def _warning(entry: dict[str, Any]) -> str:
    """What is loose about a parameter, or ''."""
    if not entry["fitted"]:
        return ""
    half = 0.5 * (entry["high"] - entry["low"])
    size = max(abs(entry["value"]), abs(entry["given"]), float(SCALE[entry["place"]]))
    if half > _LOOSE * size:
        return f"{entry['name']}: known to {half:.2g} {entry['unit']} only; {MORE[entry['kind']]}"
    return ""


def _horizons(
    given: Stretches,
    vehicle_cfg: VehicleConfig,
    values: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
) -> dict[str, Any]:
    """Rms errors ahead on stretches that a fit of its own has not seen, beside the vehicle given, for which
    the instruments' delays are fitted alone. ``values``: of that vehicle, and of the fit to all stretches,
    where this one sets out."""
    held = np.arange(len(given.velocity)) % _HELD_OUT == _HELD_OUT - 1
    first, found = values
    seen, unseen, late = given.some(~held), given.some(held), free & np.isin(np.arange(SIZE), LATE)
    fits = (("identified", found, free), ("given", first, late))
    models = {name: fitted(seen, vehicle_cfg, begin, which).value for name, begin, which in fits}
    return {
        name: {str(k): v for k, v in horizon_errors(unseen, vehicle_cfg, theta, HORIZONS).items()}
        for name, theta in models.items()
    }


def vehicle_yaml(found: Identified, base: str, files: Sequence[Path]) -> str:
    """A vehicle file for ``--vehicle``: ``base`` with what was found."""
    import yaml

    told = ", ".join(file.name for file in files)
    about = f"Identified by uuv identify from {told} ({found.document['seconds']:g} s), known: "
    lines = [f"# {about}{found.document['known']}."]
    for entry in found.document["parameters"]:
        bounds = f"[{entry['low']:.4g}, {entry['high']:.4g}]" if entry["fitted"] else "as given"
        lines.append(f"# {entry['name']}: {entry['value']:.4g} {entry['unit']} {bounds}".rstrip())
    base = base if base in preset_names("vehicle") else str(Path(base).resolve())
    body = yaml.safe_dump({"extends": base, "vehicle": found.keys}, sort_keys=False, default_flow_style=None)
    return "\n".join(line.replace("\n", " ") for line in lines) + "\n" + body
