"""The motion that is fitted: Fossen's equation in surge, sway, heave and yaw, with measured roll, pitch and
thrust as inputs (T. Fossen, Handbook of Marine Craft, 2011); many parameter sets at once, in float64.

What an instrument says at a moment is what was so a little earlier (filters, averages, transport), so each of
the two, of velocity and of yaw rate, has a delay of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uuvtai.compile.runtime import start_taichi
from uuvtai.config import VehicleConfig
from uuvtai.kernels.vehicle.stretches import move_stretches
from uuvtai.sim.setup import allocation_matrices
from uuvtai.vehicle.identify.drive_log import LEAST_LAG_S, Drive, DriveError, mean_wrench

AXES = ("surge", "sway", "heave", "yaw")
_OF_SIX = (0, 1, 2, 5)  # where those stand among six
NET, GAIN = 12, 13  # places of net buoyancy and gain, behind added mass and damping of the four axes
LAG, LATE = 14, (15, 16)  # of the rotors' lag, and of the delays of velocity and yaw rate [s]
SIZE = 17
_LONGEST_STEP_S = 0.025
_LAG_STEP_S = 1e-3
_LATEST_S = 0.15  # readings at the begin of a stretch that a delay may have from before it; they are left out
_FORGOTTEN_S = 1.0
"""begin of a drive with commanded speeds that is left out: how the rotors turned before it is not known"""
_READ = (slice(0, 3), slice(3, 4))  # axes of the two instruments


@dataclass(frozen=True)
class Stretches:
    """Stretches of equal length cut from drives: s of them, n steps each."""

    dt_s: float
    velocity: np.ndarray  # (s, n + 1, 4), NaN = no reading
    tilt_rate: np.ndarray  # (s, n, 2) in the middle of each step
    up: np.ndarray  # (s, n, 3) likewise
    wrench: np.ndarray
    """(s, n, 2, 4) of each step by the vehicle's own thrust curve [N, N m], with the lag ``lag_s``: its mean,
    and that weighted by the time left of the step"""
    slope: np.ndarray  # (s, n, 2, 4) its change with the lag [N/s, N m/s]
    lag_s: float
    after: np.ndarray  # (s, n + 1, 2) [s] by how much later than their sample velocity and yaw rate were read
    cuts: tuple[tuple[Drive, int], ...]  # where each was cut from, and at which step it begins

    def some(self, which: np.ndarray) -> Stretches:
        names = ("velocity", "tilt_rate", "up", "wrench", "slope", "after")
        kept = np.arange(len(self.velocity))[which]
        cuts = tuple(self.cuts[i] for i in kept.tolist())
        return replace(self, cuts=cuts, **{name: getattr(self, name)[kept] for name in names})

    def begins(self, steps: int) -> Stretches:
        of_steps = {name: getattr(self, name)[:, :steps] for name in ("tilt_rate", "up", "wrench", "slope")}
        of_samples = {name: getattr(self, name)[:, : steps + 1] for name in ("velocity", "after")}
        return replace(self, **of_steps, **of_samples)

    def otherwise(self, vehicle_cfg: VehicleConfig) -> Stretches | None:
        """The same by the other reading of the logs, ``Drive.otherwise``; None = they leave nothing open."""
        made = {id(drive): drive.otherwise() for drive, _ in self.cuts}
        if not any(made.values()):
            return None
        cuts = tuple((made[id(drive)] or drive, begin) for drive, begin in self.cuts)
        found = _wrenches(cuts, self.wrench.shape[1], self.lag_s, vehicle_cfg)
        return replace(self, wrench=found[0], slope=found[1], cuts=cuts)

    def at_lag(self, lag_s: float, vehicle_cfg: VehicleConfig) -> Stretches:
        lag_s = max(lag_s, LEAST_LAG_S)
        if lag_s == self.lag_s or not any(drive.is_asked for drive, _ in self.cuts):
            return self
        found = _wrenches(self.cuts, self.wrench.shape[1], lag_s, vehicle_cfg)
        return replace(self, wrench=found[0], slope=found[1], lag_s=lag_s)


def parameters_of(vehicle_cfg: VehicleConfig) -> np.ndarray:
    """(17,) of a vehicle; instruments without delay."""
    rows = (vehicle_cfg.added_mass, vehicle_cfg.linear_damping, vehicle_cfg.quadratic_damping)
    net = vehicle_cfg.gravity_m_s2 * (
        vehicle_cfg.water_density_kg_m3 * vehicle_cfg.volume_m3 - vehicle_cfg.mass_kg
    )
    return np.array([*(row[i] for row in rows for i in _OF_SIX), net, 1.0, vehicle_cfg.rotor_tau_s, 0.0, 0.0])


def changed(vehicle_cfg: VehicleConfig, found: np.ndarray) -> dict[str, object]:
    """Keys of the vehicle section that ``found`` (17,) changes."""
    keys: dict[str, object] = {}
    for row, name in enumerate(("added_mass", "linear_damping", "quadratic_damping")):
        values = list(getattr(vehicle_cfg, name))
        for i, place in enumerate(_OF_SIX):
            values[place] = round(float(found[4 * row + i]), 5)
        keys[name] = values
    heavy = vehicle_cfg.mass_kg + float(found[NET]) / vehicle_cfg.gravity_m_s2
    keys["volume_m3"] = round(heavy / vehicle_cfg.water_density_kg_m3, 8)
    keys["thrust_scale"] = round(vehicle_cfg.thrust_scale * float(found[GAIN]), 5)
    if found[LAG] != vehicle_cfg.rotor_tau_s:
        keys["rotor_tau_s"] = round(max(LEAST_LAG_S, float(found[LAG])), 5)
    return keys


def stretches(drives: list[Drive], vehicle_cfg: VehicleConfig, seconds: float) -> Stretches:
    """All whole stretches of ``seconds`` in the drives. Raises DriveError."""
    dt_s = drives[0].dt_s
    n = max(2, round(seconds / dt_s))
    parts: list[tuple[np.ndarray, ...]] = []
    cuts: list[tuple[Drive, int]] = []
    for drive in drives:
        if abs(drive.dt_s / dt_s - 1) > 0.02:
            raise DriveError(
                f"one log has a sample every {dt_s:g} s, another every {drive.dt_s:g} s: identify them apart"
            )
        if drive.rpm.shape[1] != len(vehicle_cfg.thrusters):
            raise DriveError(
                f"the log has {drive.rpm.shape[1]} thrusters, the vehicle {len(vehicle_cfg.thrusters)}: name "
                "the one that was driven, --vehicle NAME"
            )
        after = np.zeros((len(drive.rpm), 2)) if drive.after is None else drive.after
        middle = [0.5 * (a[1:] + a[:-1]) for a in (drive.tilt_rate, drive.up)]
        first = round(_FORGOTTEN_S / dt_s) if drive.is_asked else 0
        for begin in range(first, len(drive.rpm) - n, n):
            cut = slice(begin, begin + n)
            whole = slice(begin, begin + n + 1)
            seen = drive.velocity[whole].copy()
            seen[: 1 + round(_LATEST_S / dt_s)] = np.nan
            parts.append((after[whole], seen, *(a[cut] for a in middle)))
            cuts.append((drive, begin))
    if not parts:
        raise DriveError(f"no log lasts {seconds:g} s without a gap: drive for five minutes")
    lag_s = vehicle_cfg.rotor_tau_s
    wrench, slope = _wrenches(tuple(cuts), n, lag_s, vehicle_cfg)
    late, velocity, tilt_rate, up = (np.stack(row) for row in zip(*parts, strict=True))
    return Stretches(dt_s, velocity, tilt_rate, up, wrench, slope, lag_s, late, tuple(cuts))


def _wrenches(
    cuts: tuple[tuple[Drive, int], ...], steps: int, lag_s: float, vehicle_cfg: VehicleConfig
) -> tuple[np.ndarray, np.ndarray]:
    """(s, n, 2, 4) and (s, n, 2, 4): the means of each step, and their change with the lag."""
    geometry, _ = allocation_matrices(vehicle_cfg)
    across = geometry[list(_OF_SIX)].T
    of_drive = {}
    for drive, _ in cuts:
        if id(drive) not in of_drive:
            thrust = mean_wrench(drive, vehicle_cfg, np.array([lag_s, lag_s + _LAG_STEP_S]))
            of_drive[id(drive)] = np.moveaxis(thrust @ across, 0, 2)
    rows = np.stack([of_drive[id(drive)][:, begin : begin + steps] for drive, begin in cuts], axis=1)
    slope = (rows[1] - rows[0]) / _LAG_STEP_S
    return rows[0], slope if any(drive.is_asked for drive, _ in cuts) else np.zeros_like(slope)


def motion(theta: np.ndarray, start: np.ndarray, given: Stretches, vehicle_cfg: VehicleConfig) -> np.ndarray:
    """Velocities (runs, s, n + 1, 4) of each parameter set ``theta`` (runs, 17), from ``start`` (runs, s, 4)
    on. Lags near that of ``given``."""
    start_taichi("cpu")
    six, spin = vehicle_cfg.added_mass, vehicle_cfg.inertia_kg_m2
    munk, rolling = theta[:, 1] - theta[:, 0], np.full(len(theta), spin[1] + six[4] - spin[0] - six[3])
    told = np.column_stack([theta, munk, rolling])
    told[:, :4] += [vehicle_cfg.mass_kg] * 3 + [spin[2]]
    told[:, LAG] -= given.lag_s
    loads = np.stack([given.wrench, given.slope], axis=2)
    turns = np.concatenate([given.tilt_rate, given.up], axis=2)
    out = np.empty((len(theta), *given.velocity.shape))
    parts = max(1, int(np.ceil(given.dt_s / _LONGEST_STEP_S)))
    told, start, loads, turns = map(np.ascontiguousarray, (told, start, loads, turns))
    move_stretches(told, start, loads, turns, given.dt_s / parts, parts, out)
    return out


def readings(
    theta: np.ndarray, start: np.ndarray, given: Stretches, vehicle_cfg: VehicleConfig
) -> np.ndarray:
    """What the instruments say of ``motion``, (runs, s, n + 1, 4): each late by its delay."""
    out = motion(theta, start, given, vehicle_cfg)
    for place, after, axes in zip(LATE, np.moveaxis(given.after, 2, 0), _READ, strict=True):
        for run, late_s in enumerate(theta[:, place].tolist()):
            if late_s != 0.0 or after.any():
                out[run, :, :, axes] = _earlier(out[run, :, :, axes], (late_s - after) / given.dt_s)
    return out


def undelayed(given: Stretches, theta: np.ndarray) -> np.ndarray:
    """(s, n + 1, 4) readings at the samples at which it was so, by the delays in ``theta``; NaN = none."""
    found = np.full_like(given.velocity, np.nan)
    for place, axes in zip(LATE, _READ, strict=True):
        steps, count = round(float(theta[place]) / given.dt_s), found.shape[1]
        to, begin = max(0, -steps), max(0, steps)
        length = max(0, count - abs(steps))
        found[:, to : to + length, axes] = given.velocity[:, begin : begin + length, axes]
    return found


def _earlier(rows: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """(s, n, k) as they were so many steps (s, n) before: cubics through four samples, for straight lines
    would smooth what a quick instrument sees."""
    at = np.arange(rows.shape[1]) - steps
    first = np.clip(np.floor(at).astype(int) - 1, 0, rows.shape[1] - 4)
    x = (at - first)[..., None]
    weights = (
        -(x - 1) * (x - 2) * (x - 3) / 6,
        x * (x - 2) * (x - 3) / 2,
        -x * (x - 1) * (x - 3) / 2,
        x * (x - 1) * (x - 2) / 6,
    )
    found = np.zeros_like(rows)
    for i, weight in enumerate(weights):
        found += weight * np.take_along_axis(rows, first[..., None] + i, axis=1)
    return found


# ---- Derivatives of the readings with respect to parameters and initial velocities, by differences.

SCALE = np.array(
    [1.0] * 3 + [0.05] + [1.0] * 3 + [0.05] + [5.0] * 3 + [0.3] + [0.5, 0.1] + [0.02, 0.01, 0.01]
)
"""size of a step of each parameter"""


def linearised(
    given: Stretches,
    vehicle_cfg: VehicleConfig,
    value: np.ndarray,
    start: np.ndarray,
    free: np.ndarray,
    noise: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(s, readings, free), (s, readings, 4), (s, readings): derivatives and rest, in units of noise."""
    places = np.flatnonzero(free)
    runs = 1 + len(places) + len(AXES)
    theta, begin = np.tile(value, (runs, 1)), np.tile(start, (runs, 1, 1))
    small = 1e-4
    for i, place in enumerate(places):
        theta[1 + i, place] += small * SCALE[place]
    for axis in range(len(AXES)):
        begin[1 + len(places) + axis, :, axis] += small
    moved = readings(theta, begin, given, vehicle_cfg) / noise
    seen = ~np.isnan(given.velocity)
    rest = np.where(seen, np.nan_to_num(given.velocity) / noise - moved[0], 0.0)
    slopes = np.where(seen, (moved[1:] - moved[0]) / small, 0.0)
    count = len(given.velocity)
    flat = np.moveaxis(slopes.reshape(runs - 1, count, -1), 0, 2)
    return flat[..., : len(places)], flat[..., len(places) :], rest.reshape(count, -1)


# ---- The velocity that each stretch begins with: a first guess, and the one that suits the readings best.

_TRIES = 12
_SHARES = (0.2, 0.5, 1.0)
_DAMPING, _LESS, _MORE, _MOST = 1e-3, 0.1, 10.0, 1e9
_NOTHING = 1e-3  # fall of the sum of squares, in units of noise, that is not worth a step


def first_readings(given: Stretches) -> np.ndarray:
    """(s, 4) the first reading of each axis from the begin of each stretch on; 0 where there is none."""
    steps = given.wrench.shape[1]
    read = np.stack([drive.velocity[begin : begin + steps + 1] for drive, begin in given.cuts])
    first = np.argmax(~np.isnan(read), axis=1)
    return np.nan_to_num(np.take_along_axis(read, first[:, None], axis=1)[:, 0])


def grown_starts(
    given: Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(s, 4) as ``settled_starts``, from the first readings on: fitted to the begin of each stretch, then to
    more and more of it. Where motion is unstable, a first reading is too far away for all of it at once."""
    start, steps = first_readings(given), given.wrench.shape[1]
    for share in _SHARES:
        start = settled_starts(given.begins(round(share * steps)), vehicle_cfg, value, start, noise)
    return start


def settled_starts(
    given: Stretches, vehicle_cfg: VehicleConfig, value: np.ndarray, start: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """(s, 4) initial velocities that suit the readings best with the parameters ``value`` (17,), from
    ``start`` on: steps of Levenberg and Marquardt, each stretch damped by itself. A vehicle that moves ahead
    is unstable in yaw (Munk's moment): undamped steps of a few stretches run away, and those few then
    outweigh all others."""
    count = len(start)
    best, fault, damping = start.copy(), np.full(count, np.inf), np.full(count, _DAMPING)
    square, right = np.zeros((count, len(AXES), len(AXES))), np.zeros((count, len(AXES)))
    trial, at_hand = start.copy(), np.arange(count)
    for _ in range(_TRIES):
        part = given.some(at_hand)
        _, own, rest = linearised(part, vehicle_cfg, value, trial[at_hand], np.zeros(SIZE, bool), noise)
        now = np.square(rest).sum(axis=1)
        better = now < fault[at_hand]
        won, lost = at_hand[better], at_hand[~better]
        best[won], fault[won] = trial[won], now[better]
        across = np.swapaxes(own[better], 1, 2)
        square[won], right[won] = across @ own[better], (across @ rest[better][..., None])[..., 0]
        damping[won] *= _LESS
        damping[lost] *= _MORE
        heavier = 1.0 + damping[:, None, None] * np.eye(len(AXES))
        step = np.linalg.solve(square * heavier + 1e-9 * np.eye(len(AXES)), right[..., None])[..., 0]
        trial = best + step
        at_hand = at_hand[((step * right).sum(axis=1) > _NOTHING)[at_hand] & (damping[at_hand] < _MOST)]
        if not len(at_hand):
            break
    return best


# ---- What a log must hold for an axis to be identified, and what to drive where it does not.

_FAST_SHARE = (0.12, 0.12, 0.12, 0.15)  # [m/s, m/s, m/s, rad/s] that a tenth of the readings must exceed
_VARIED = (0.05, 0.05, 0.05, 0.08)  # standard deviation that the speed must have
_LEAST_READINGS = 200
_STEP_S, _STEP_RPM, _LEAST_STEPS = 0.1, 300.0, 20  # jumps of a commanded speed that show the rotors' lag
LEAST_STRETCHES = 12  # a bootstrap over fewer says nothing


def unexcited(given: Stretches) -> dict[str, str]:
    """Axes that the readings do not excite: name -> what was driven and what to drive."""
    found = {}
    for i, axis in enumerate(AXES):
        speed = given.velocity[..., i]
        speed = speed[~np.isnan(speed)]
        unit, full = ("rad/s", "1.0") if axis == "yaw" else ("m/s", "0.5")
        if len(speed) < _LEAST_READINGS:
            found[axis] = f"{axis} has {len(speed)} readings: log its speed"
            continue
        fast, varied = float(np.percentile(np.abs(speed), 90)), float(speed.std())
        if fast < _FAST_SHARE[i] or varied < _VARIED[i]:
            found[axis] = (
                f"{axis} stayed below {fast:.2f} {unit} for nine tenths of the log: drive it forth and back, "
                f"each leg one to four seconds, at speeds from {_FAST_SHARE[i]:g} to {full} {unit}"
            )
    return found


def unstepped(drives: list[Drive]) -> str:
    """Why the drives do not show the rotors' lag, '' = they do."""
    asked = [drive for drive in drives if drive.is_asked]
    if not asked:
        return (
            "the log holds rotor speeds as turned (rpm_1, ..), which lag behind nothing: log those that were "
            "commanded (asked_1, ..)"
        )
    steps = 0
    for drive in asked:
        width = max(1, round(_STEP_S / drive.dt_s))
        risen = np.abs(drive.rpm[width::width] - drive.rpm[:-width:width][: len(drive.rpm[width::width])])
        steps += int((risen > _STEP_RPM).any(axis=1).sum())
    if steps >= _LEAST_STEPS:
        return ""
    return (
        f"the commanded speeds jump {steps} times by {_STEP_RPM:g} rpm within {_STEP_S:g} s, {_LEAST_STEPS} "
        "are needed: push the sticks forth and back at once, not slowly"
    )


MORE = {
    "added mass": "start, stop and turn round more often",
    "linear damping": "add slow legs (a fifth of full speed)",
    "quadratic damping": "add fast legs (full speed, held for three seconds)",
    "net buoyancy": "hover and heave up and down",
    "rotor lag": "log the commands 50 times a second, and push the sticks forth and back at once",
    "delay": "start, stop and turn round more often",
    "thruster gain": "drive for longer; with --known buoyancy, hang on a weight whose net force is known",
}
"""what narrows the interval of a parameter"""
