"""Least squares on the output: parameters whose motion, driven by the logged rotor speeds, comes closest to
the measured velocities (Gauss-Newton); intervals by a bootstrap over stretches.

Each stretch has an initial velocity of its own, fitted anew for each trial of the parameters. Noise of the
readings does not enter the regressors, as it does where measured velocities are differentiated. A stretch is
drawn as a whole, so errors may be correlated within it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.common.files import refuse_output, whole_file
from uuvtai.common.presets import preset_names
from uuvtai.config import VehicleConfig
from uuvtai.logs.reader import IMPORTED, read_head
from uuvtai.report.figures import Line, curves, png
from uuvtai.vehicle.identify import model
from uuvtai.vehicle.identify.ardusub_log import SUFFIXES, read_ardusub, read_imported
from uuvtai.vehicle.identify.drive_log import Drive, DriveError, read_drives

_ROUNDS = 25
_WEIGHED = (1, 3)  # rounds after which readings are weighed anew, by what is left
_NOTHING, _LITTLE, _KEPT = 0.01, 1.0, 0.1
"""falls of the sum of squares that a step promises, in units of noise: below the first it is the last one,
for no parameter moves by more than a tenth of its standard deviation; below the second it is if it keeps less
than this share of its promise, for the dead band's edges make that sum rough"""
_DRAWS = 2000
_LEVEL = (2.5, 97.5)
_NOISE = 0.02


@dataclass(frozen=True)
class Fit:
    """What least squares found."""

    value: np.ndarray  # (17,)
    low: np.ndarray  # (17,) of the 95 % interval; where nothing was fitted, the value itself
    high: np.ndarray
    start: np.ndarray  # (s, 4) initial velocity of each stretch
    noise: np.ndarray  # (4,) rms of what is left [m/s, rad/s]


def fitted(given: model.Stretches, vehicle_cfg: VehicleConfig, first: np.ndarray, free: np.ndarray) -> Fit:
    """Fit the parameters ``free`` (17, bool), from ``first`` (17,) on; the others stay."""
    value, start = first.copy(), model.first_readings(given)
    noise = np.full(len(model.AXES), _NOISE)
    fault = np.inf
    back = (value, start)
    shrink, promised = 1.0, np.inf
    for i in range(_ROUNDS):
        given = given.at_lag(value[model.LAG], vehicle_cfg)
        if i <= _WEIGHED[-1]:
            start = model.grown_starts(given, vehicle_cfg, value, noise)
        else:
            start = model.settled_starts(given, vehicle_cfg, value, start, noise)
        jacobian, own, rest = model.linearised(given, vehicle_cfg, value, start, free, noise)
        now = float(np.sum(rest**2))
        if i > _WEIGHED[-1] + 1 and promised < _LITTLE and now > fault - _KEPT * promised:
            break
        if now > fault * (1 + 1e-9) and shrink > 0.1:
            shrink *= 0.5
            value, start = (old + 0.5 * (new - old) for old, new in zip(back, (value, start), strict=True))
            continue
        fault, back, shrink = now, (value, start), 1.0
        step, moved, promised = _step(jacobian, own, rest)
        settled = promised < _NOTHING
        value = value.copy()
        value[free] += step * model.SCALE[free]
        start = start + moved
        if settled or i in _WEIGHED:
            given = given.at_lag(value[model.LAG], vehicle_cfg)
            noise = _left(given, vehicle_cfg, value, start)
            fault = np.inf
        if settled and i > _WEIGHED[-1]:
            break
    given = given.at_lag(value[model.LAG], vehicle_cfg)
    start = model.settled_starts(given, vehicle_cfg, value, start, noise)
    jacobian, own, rest = model.linearised(given, vehicle_cfg, value, start, free, noise)
    low, high = _bootstrap(jacobian, own, rest)
    apart = _left_open(given, vehicle_cfg, (value, start), noise, jacobian, own)
    low, high = low - apart, high + apart
    bounds = [value.copy(), value.copy()]
    for bound, apart in zip(bounds, (low, high), strict=True):
        bound[free] += apart * model.SCALE[free]
    return Fit(value, bounds[0], bounds[1], start, _left(given, vehicle_cfg, value, start))


def _left(
    given: model.Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, start: np.ndarray
) -> np.ndarray:
    away = given.velocity - model.readings(value[None], start[None], given, vehicle_cfg)[0]
    seen = ~np.isnan(away)
    count = np.maximum(1, seen.sum(axis=(0, 1)))
    return np.maximum(1e-5, np.sqrt(np.square(np.where(seen, away, 0.0)).sum(axis=(0, 1)) / count))


def _apart(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of each stretch, (s, k, k) and (s, k), with its initial velocity eliminated."""
    basis = np.linalg.qr(own)[0]
    turned = np.swapaxes(basis, 1, 2)
    free = jacobian - basis @ (turned @ jacobian)
    left = rest - (basis @ (turned @ rest[..., None]))[..., 0]
    across = np.swapaxes(free, 1, 2)
    return across @ free, (across @ left[..., None])[..., 0]


def _step(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(of the parameters, of the initial velocities, fall of the sum of squares that they promise)"""
    square, right = (part.sum(axis=0) for part in _apart(jacobian, own, rest))
    step = _solved(square, right)
    left = rest - (jacobian @ step)
    return step, (np.linalg.pinv(own) @ left[..., None])[..., 0], float(step @ right)


def _solved(square: np.ndarray, right: np.ndarray) -> np.ndarray:
    size = right.shape[-1]
    ridge = 1e-10 * np.trace(square, axis1=-2, axis2=-1) / max(1, size) + 1e-12
    return np.linalg.solve(square + ridge[..., None, None] * np.eye(size), right[..., None])[..., 0]


def _left_open(
    given: model.Stretches,
    vehicle_cfg: VehicleConfig,
    fit: tuple[np.ndarray, np.ndarray],
    noise: np.ndarray,
    jacobian: np.ndarray,
    own: np.ndarray,
) -> np.ndarray:
    """(k,) by how much the fit moves by the other reading of the logs, ``Drive.otherwise``: they do not say
    which is right, and no bootstrap of their stretches shows it, for it is the same in all of them."""
    other = given.otherwise(vehicle_cfg)
    if other is None:
        return np.zeros(jacobian.shape[2])
    value, start = fit
    said = [model.readings(value[None], start[None], one, vehicle_cfg)[0] for one in (given, other)]
    moved = np.where(np.isnan(given.velocity), 0.0, (said[0] - said[1]) / noise)
    square, right = _apart(jacobian, own, moved.reshape(len(moved), -1))
    return np.abs(_solved(square.sum(axis=0), right.sum(axis=0)))


def _bootstrap(jacobian: np.ndarray, own: np.ndarray, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) (k,) about the fit: a Gauss-Newton step per draw of stretches, widened for parameters."""
    square, right = _apart(jacobian, own, rest)
    count, size = right.shape
    if not size:
        return np.zeros(0), np.zeros(0)
    picked = np.random.default_rng(0).integers(0, count, (_DRAWS, count))
    weight = np.stack([np.bincount(row, minlength=count) for row in picked]).astype(float)
    draws = _solved(np.tensordot(weight, square, 1), weight @ right)
    wider = np.sqrt(count / max(1.0, count - size))
    low, high = np.percentile(draws, _LEVEL, axis=0)
    return wider * low, wider * high


def horizon_errors(
    given: model.Stretches, vehicle_cfg: VehicleConfig, theta: np.ndarray, horizons: tuple[int, ...]
) -> dict[int, list[float | None]]:
    """Rms error (surge, sway, heave, yaw) of what is predicted that many steps ahead of a reading, by
    ``theta`` (17,), whose delays tell when it was so; None where no reading stands there. Horizons longer
    than a stretch are left out."""
    steps = given.wrench.shape[1]
    assert theta.shape == (model.SIZE,)
    given = given.at_lag(theta[model.LAG], vehicle_cfg)
    inputs = ("tilt_rate", "up", "wrench", "slope")
    early = model.undelayed(given, theta)
    if not np.isnan(early).any(axis=2).all():
        given = replace(given, velocity=early)
    whole = np.asarray(~np.isnan(given.velocity).any(axis=2))
    found = {}
    for ahead in (h for h in horizons if h <= steps):
        errors, last = [], np.full(len(whole), -steps)
        ready: np.ndarray = whole[:, : steps + 1 - ahead]
        both: np.ndarray = ready & whole[:, ahead:]
        ready = both if both.any() else ready
        for begin in range(steps + 1 - ahead):
            picked = np.flatnonzero(ready[:, begin] & (begin - last >= max(ahead, steps // 10)))
            last[picked] = begin
            if len(picked):
                cut = {name: getattr(given, name)[:, begin : begin + ahead] for name in inputs}
                part = replace(given, velocity=given.velocity[:, begin : begin + ahead + 1], **cut).some(
                    picked
                )
                end = model.motion(theta[None], part.velocity[None, :, 0], part, vehicle_cfg)[0, :, -1]
                errors.append(end - part.velocity[:, -1])
        if errors:
            away = np.concatenate(errors)
            seen = ~np.isnan(away)
            count = seen.sum(axis=0)
            rms = np.sqrt(np.square(np.where(seen, away, 0.0)).sum(axis=0) / np.maximum(1, count))
            found[ahead] = [float(value) if n else None for value, n in zip(rms, count, strict=True)]
    return found


# ---- ``uuv identify``: parameters with intervals, errors ahead and warnings from drives.

KNOWN = ("gain", "added-mass", "buoyancy")
"""what may be held: speeds and rotor speeds alone tell ratios, one force or mass has to be known"""
KINDS = ("added mass", "linear damping", "quadratic damping")
HORIZONS = (1, 10, 100)
_STRETCH_S = 5.0
_HELD_OUT = 5  # one stretch in so many is predicted by a fit to the others
_MOST_SAMPLES = 150_000  # of all stretches fitted, each some seven kilobytes; 50 minutes at 50 Hz
_NOTHING_FOUND = 0.02
"""a smaller share of an error ahead is no difference: fits are compared at every horizon by it"""
_LOOSE = 0.5  # An interval wider than this share of the value, to either side, is warned of.
_OTHERS = {
    model.NET: ("net buoyancy", "N"),
    model.GAIN: ("thruster gain", ""),
    model.LAG: ("rotor lag", "s"),
    model.LATE[0]: ("delay, velocity", "s"),
    model.LATE[1]: ("delay, yaw rate", "s"),
}
"""name and unit of what no axis has"""
_UNITS = ("kg", "N s/m", "N s2/m2"), ("kg m2", "N m s", "N m s2")


@dataclass(frozen=True)
class Identified:
    """The document of ``uuv identify --json`` and what its files are made of."""

    document: dict[str, Any]
    keys: dict[str, object]  # of the vehicle section, as found
    measured: np.ndarray  # (s, n + 1, 4) readings, NaN = none
    predicted: np.ndarray  # (s, n + 1, 4) by the fitted vehicle
    dt_s: float


@dataclass(frozen=True)
class FittedDrives:
    """What was fitted to drives."""

    given: model.Stretches
    first: np.ndarray  # (17,) of the vehicle given
    free: np.ndarray  # (17,) which were fitted
    fit: Fit
    entries: list[dict[str, Any]]  # of the document, one for each parameter
    warnings: list[str]


def fitted_drives(
    drives: list[Drive], vehicle_cfg: VehicleConfig, known: str = "gain", held: Collection[int] = ()
) -> FittedDrives:
    """Parameters with intervals; as ``identified``. ``held``: places that stay. Raises DriveError."""
    if known not in KNOWN:
        raise DriveError(f"--known must be one of {', '.join(KNOWN)}, got {known!r}")
    if not drives:
        raise DriveError("the logs hold no drive: drive for five minutes")
    given = model.stretches(drives, vehicle_cfg, _STRETCH_S)
    count = len(given.velocity)
    if count < model.LEAST_STRETCHES:
        raise DriveError(
            f"the logs hold {count} stretches of {_STRETCH_S:g} s without a gap, {model.LEAST_STRETCHES} are "
            "needed: drive for five minutes, or give more logs"
        )
    warnings, most = [], _MOST_SAMPLES // given.wrench.shape[1]
    if count > most:
        given = given.some(np.linspace(0, count - 1, most).astype(int))
        warnings.append(f"of {count} stretches {most} are fitted, evenly spread; five minutes are enough")
    idle = model.unexcited(given)
    if len(idle) == len(model.AXES):
        raise DriveError(f"the logs excite no axis; {'; '.join(idle.values())}")
    lagless = model.unstepped(drives)
    first, free = model.parameters_of(vehicle_cfg), _free(idle, known, not lagless)
    free[list(held)] = False
    fit = fitted(given, vehicle_cfg, first, free)
    entries = [_entry(place, first, fit, bool(free[place])) for place in range(model.SIZE)]
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
        "residual_rms": dict(zip(model.AXES, fit.noise.tolist(), strict=True)),
        "horizons": horizons,
        "warnings": [*kept, *made.warnings],
    }
    given = given.at_lag(fit.value[model.LAG], vehicle_cfg)
    predicted = model.readings(fit.value[None], fit.start[None], given, vehicle_cfg)[0]
    return Identified(document, model.changed(vehicle_cfg, fit.value), given.velocity, predicted, given.dt_s)


def _judged(
    drives: list[Drive], vehicle_cfg: VehicleConfig, known: str
) -> tuple[FittedDrives, dict[str, Any], list[str]]:
    """(what was fitted, its errors ahead, why numbers stay as given): what came out negative, or is worse
    than the vehicle given on stretches that were not fitted, stays, and the others are fitted anew."""
    held: set[int] = set()
    kept, given = [], []
    while True:
        made = fitted_drives(drives, vehicle_cfg, known, held)
        signed = (model.NET, *model.LATE)
        negative = [e for e in made.entries if e["fitted"] and e["value"] < 0 and e["place"] not in signed]
        if negative:
            held.update(entry["place"] for entry in negative)
            kept += [
                f"{entry['name']}: came out negative ({entry['value']:.3g} {entry['unit']}) and stays that "
                f"of the vehicle given; {model.MORE[entry['kind']]}"
                for entry in negative
            ]
            continue
        values = made.first, made.fit.value
        horizons = _horizons(made.given, vehicle_cfg, values, made.free)
        worse = {
            text: places for i in range(len(model.AXES)) for text, places in _worse(i, horizons, made.free)
        }
        given += worse
        held.update(place for places in worse.values() for place in (*places, model.GAIN))
        left = made.free.copy()
        left[list(held)] = False
        if not left[: model.NET + 1].any():
            raise DriveError(
                "the logs improve no number of the vehicle given, and nothing is written; on stretches that "
                f"were not fitted: {'; '.join(given) or 'no axis is left'}. Keep that vehicle, or see that "
                "the rotor speeds' order and signs are right and drive longer, on each axis, slowly and fast"
            )
        if not worse:
            kept += [f"{text} on stretches that were not fitted; the axis stays as given" for text in given]
            return made, horizons, kept


def _worse(axis: int, horizons: dict[str, Any], free: np.ndarray) -> list[tuple[str, list[int]]]:
    """[] where the fit is better on an axis than the vehicle given, or nothing of it is fitted; else how much
    worse it is, and the places of the axis."""
    own = (axis, axis + 4, axis + 8, *([model.NET] if axis == 2 else []))
    places = [place for place in own if free[place]]
    pairs = [
        (steps, ours[axis], horizons["given"][steps][axis])
        for steps, ours in horizons["identified"].items()
        if steps != "1" and ours[axis] is not None
    ]
    shares = [ours / max(given, 1e-9) for _, ours, given in pairs]
    if not places or (shares and min(shares) < 1 - _NOTHING_FOUND and max(shares) < 1 + _NOTHING_FOUND):
        return []
    unit = "rad/s" if model.AXES[axis] == "yaw" else "m/s"
    said = ", ".join(
        f"{ours:.3g} against {given:.3g} {unit} {steps} steps ahead" for steps, ours, given in pairs
    )
    return [(f"{model.AXES[axis]} is no better ({said or 'no readings'})", places)]


def _free(idle: dict[str, str], known: str, shows_lag: bool) -> np.ndarray:
    """(17,) which parameters are fitted."""
    late = [any(axis not in idle for axis in axes) for axes in (model.AXES[:3], model.AXES[3:])]
    free = np.array([axis not in idle for _ in KINDS for axis in model.AXES] + [True, True, shows_lag, *late])
    if known == "gain":
        free[model.GAIN] = False
    elif known == "buoyancy":
        free[model.NET] = False
    else:
        free[: len(model.AXES)] = False
    return free


def _entry(place: int, first: np.ndarray, fit: Fit, is_fitted: bool) -> dict[str, Any]:
    if place < model.NET:
        kind, axis = KINDS[place // 4], model.AXES[place % 4]
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
    size = max(abs(entry["value"]), abs(entry["given"]), float(model.SCALE[entry["place"]]))
    if half > _LOOSE * size:
        return f"{entry['name']}: known to {half:.2g} {entry['unit']} only; {model.MORE[entry['kind']]}"
    return ""


def _horizons(
    given: model.Stretches,
    vehicle_cfg: VehicleConfig,
    values: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
) -> dict[str, Any]:
    """Rms errors ahead on stretches that a fit of its own has not seen, beside the vehicle given, for which
    the instruments' delays are fitted alone. ``values``: of that vehicle, and of the fit to all stretches,
    where this one sets out."""
    held = np.arange(len(given.velocity)) % _HELD_OUT == _HELD_OUT - 1
    first, found = values
    seen, unseen = given.some(~held), given.some(held)
    late = free & np.isin(np.arange(model.SIZE), model.LATE)
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


# ---- From logs to files: the vehicle as YAML, predicted against measured as a picture beside it.


def identify(
    files: Sequence[Path],
    vehicle_cfg: VehicleConfig,
    base: str,
    known: str,
    truth: bool,
    out: Path,
    force: bool = False,
    system: int | None = None,
) -> dict[str, Any]:
    """Write ``out`` (YAML that extends ``base``) and its picture; the document of ``uuv identify --json``.
    ``vehicle_cfg`` is that of ``base``; ``system``: as of ``read_ardusub``. Raises DriveError, FileError,
    LogError, OSError."""
    picture = out.with_suffix(".png")
    if not out.parent.is_dir():
        raise DriveError(f"{out.parent}: is no folder; give --out a name in a folder that is there")
    for path in (out, picture):
        refuse_output(path, files, force)
    notes: list[str] = []
    drives = [drive for file in files for drive in _drives(file, vehicle_cfg, truth, system, notes.append)]
    found = identified(drives, vehicle_cfg, known)
    picture_bytes = prediction_png(found)
    for path, content in ((out, vehicle_yaml(found, base, files).encode()), (picture, picture_bytes)):
        with whole_file(path) as (file, _):
            file.write(content)
    warnings = [*found.document["warnings"], *notes]
    named = {"files": [str(file) for file in files], "vehicle": str(out)}
    return {**found.document, "warnings": warnings, **named}


def _drives(
    file: Path, vehicle_cfg: VehicleConfig, truth: bool, system: int | None, note: Callable[[str], None]
) -> list[Drive]:
    if file.suffix.lower() in SUFFIXES:
        if truth:
            raise DriveError(f"{file}: a log of ArduSub's holds no truth; leave --truth out")
        return read_ardusub(file, vehicle_cfg, system, note)
    if file.suffix.lower() != ".csv" and IMPORTED in read_head(file).metadata:
        if truth:
            raise DriveError(f"{file}: recordings of others hold no truth; leave --truth out")
        return read_imported(file, vehicle_cfg)
    return read_drives(file, truth)


_SHOWN_S = 30.0


def prediction_png(found: Identified) -> bytes:
    """Measured speeds and those of the fitted vehicle, driven by the same rotor speeds, over the first half
    minute. The prediction begins anew with each stretch of the fit."""
    steps = found.measured.shape[1] - 1
    count = max(1, round(_SHOWN_S / (steps * found.dt_s)))
    time_s = np.arange(min(count, len(found.measured)) * steps) * found.dt_s
    panels = []
    for i, axis in enumerate(model.AXES):
        measured, predicted = (
            speeds[:count, :steps, i].ravel() for speeds in (found.measured, found.predicted)
        )
        seen = ~np.isnan(measured)
        lines = [
            Line("measured", time_s[seen].tolist(), measured[seen].tolist()),
            Line("predicted", time_s.tolist(), predicted.tolist()),
        ]
        panels.append(curves(lines, f"{axis} [{'rad/s' if axis == 'yaw' else 'm/s'}]", "time [s]"))
    return png(panels)
