"""Eighteen random vehicles identified from five minutes of noisy simulated driving: how often the truth lies
within the 95 % interval.

Drag, added mass, net buoyancy, thruster gain and rotor lag differ from the vehicle that the identification
is told. The vehicles are moved by ``Plant`` (six degrees of freedom, rotor lag, inner loop) in steps far
shorter than the log's, so that a delay is one of true motion, not of samples; readings have delays, and white
and slowly varying errors, the DVL one reading in five steps. Each drive is identified twice: from a log of
the rotor speeds as turned, with errors, and from one of those that were commanded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.common import Job, Row
from uuvtai.common.statistics import wilson_interval
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config, VehicleConfig
from uuvtai.config.loader import load_config
from uuvtai.logs.topics.motion import angles_of
from uuvtai.sim.plant import Plant
from uuvtai.vehicle.identify.drive_log import Drive, up_axis
from uuvtai.vehicle.identify.fit import KNOWN, fitted_drives
from uuvtai.vehicle.identify.model import GAIN, LAG, LATE, NET, SIZE, parameters_of

LONGEST_S = 3600
VEHICLES, MINUTES, SEED = 18, 5.0, 77301
SPREAD, GAIN_SPREAD, NET_N = 0.3, 0.1, (-4.0, 4.0)
DVL_M_S, GYRO_RAD_S, TILT_RAD, SPEED_SHARE = (0.01, 0.004), (0.003, 0.001), (0.002, 0.003), 0.01
"""standard deviations: (white, slowly varying); of the rotor speed a share, white"""
LAG_S, LATE_S = (0.01, 0.1), ((0.0, 0.1), (0.0, 0.02))
"""ranges of the rotors' lag, and of the delays of DVL and gyro"""
SLOW_S = 2.0
EVERY = 5
"""control steps between readings of the DVL"""
POINTS = 8
"""of the true motion in a control step"""


def measure(job: Job) -> list[Row]:
    """A row for each thing that is held known and each kind of log: the share of true values within their
    intervals."""
    count, minutes = (2, 1.5) if job.quick else (VEHICLES, MINUTES)
    config = load_config("open", vehicle="bluerov2_16v")
    truth, turned, asked = driven(config, count, minutes, SEED)
    rows = []
    for kind, drives in (("turned", turned), ("commanded", asked)):
        for known in KNOWN:
            rows.append(_row(f"known: {known}, speeds as {kind}", known, config, truth, drives))
            job.say(f"{rows[-1].what}: {rows[-1].note}; {rows[-1].details['table']}")
    return rows


def _row(what: str, known: str, config: Config, truth: np.ndarray, drives: list[Drive]) -> Row:
    inside: dict[str, list[bool]] = {}
    widths: dict[str, list[float]] = {}
    missed = []
    for i, (row, drive) in enumerate(zip(truth, drives, strict=True)):
        told, true = told_of(config, row, known)
        for entry in fitted_drives([drive], told, known).entries:
            if not entry["fitted"]:
                continue
            value, name = float(true[entry["place"]]), entry["name"]
            half = 0.5 * (entry["high"] - entry["low"])
            inside.setdefault(name, []).append(entry["low"] <= value <= entry["high"])
            widths.setdefault(name, []).append(half)
            if not inside[name][-1]:
                missed.append([i, name, round((entry["value"] - value) / half, 2)])
    hits, total = sum(map(sum, inside.values())), sum(map(len, inside.values()))
    low, high = wilson_interval(hits, total) or (0.0, 1.0)
    table = {
        "within the interval": {name: float(sum(found)) for name, found in inside.items()},
        "half its width, median": {name: float(np.median(found)) for name, found in widths.items()},
    }
    return Row(
        f"truth within the 95 % interval, {what}",
        100.0 * hits / total,
        "%",
        floor=95.0,
        note=f"{hits} of {total} values [{100 * low:.1f}, {100 * high:.1f}], {len(drives)} vehicles",
        details={
            "table": table,
            "hits": hits,
            "values": total,
            "vehicles": len(drives),
            "missed (vehicle, number, error in half widths)": missed,
        },
    )


def told_of(config: Config, truth: np.ndarray, known: str) -> tuple[VehicleConfig, np.ndarray]:
    """(the vehicle that the identification is told, the true values by its measure)"""
    told, true = config.vehicle, truth.copy()
    if known == "buoyancy":
        volume = (told.mass_kg + truth[NET] / told.gravity_m_s2) / told.water_density_kg_m3
        return told.model_copy(update={"volume_m3": volume}), true
    if known == "added-mass":
        return told.model_copy(update={"added_mass": tuple(_six(truth[:4], told.added_mass))}), true
    true[GAIN] = 1.0
    return told.model_copy(update={"thrust_scale": told.thrust_scale * truth[GAIN]}), true


def _six(four: np.ndarray, six: tuple[float, ...]) -> list[float]:
    return [*(float(v) for v in four[:3]), *six[3:5], float(four[3])]


def driven(
    config: Config, count: int, minutes: float, seed: int
) -> tuple[np.ndarray, list[Drive], list[Drive]]:
    """(truth (count, 17), drives, drives): random vehicles about ``config``'s under random commands, with the
    rotor speeds as turned, and as commanded."""
    rng = np.random.default_rng(seed)
    truth = np.tile(parameters_of(config.vehicle), (count, 1))
    truth[:, :NET] *= rng.uniform(1 - SPREAD, 1 + SPREAD, (count, NET))
    truth[:, NET] = rng.uniform(*NET_N, count)
    truth[:, GAIN] = rng.uniform(1 - GAIN_SPREAD, 1 + GAIN_SPREAD, count)
    truth[:, LAG] = rng.uniform(*LAG_S, count)
    for place, bounds in zip(LATE, LATE_S, strict=True):
        truth[:, place] = rng.uniform(*bounds, count)
    assert truth.shape[1] == SIZE
    dt_s = config.episode.control_dt_s
    actions = commands(rng, count, round(60 * minutes / dt_s), dt_s)
    arch, turned, asked = start_taichi("cpu"), [], []
    for i, row in enumerate(truth):
        vehicle = config.vehicle.model_copy(update={"rotor_tau_s": float(row[LAG])})
        moved = _moved(
            Plant(config.model_copy(update={"vehicle": vehicle}), arch, 1), row, actions[:, i : i + 1]
        )
        vel, rate, tilt, rpm, command = moved
        late = [
            _delayed(values, row[place] * POINTS / dt_s)
            for values, place in zip((vel, rate), LATE, strict=True)
        ]
        drive = _noisy(rng, dt_s, (late[0], late[1][:, 2:]), rate[::POINTS], tilt, rpm)
        turned.append(drive)
        asked.append(replace(drive, rpm=command, command="held"))
    return truth, turned, asked


def _moved(plant: Plant, truth: np.ndarray, actions: np.ndarray) -> list[np.ndarray]:
    """(n POINTS, 3) velocity, (n POINTS, 3) rates, (n, 2) roll and pitch, (n, 6) rotor speeds, (n, 6)
    commands until the next sample."""
    plant.reset()
    vehicle_cfg = plant.config.vehicle
    for i, field in enumerate(("added_mass", "linear_damping", "quadratic_damping")):
        values = _six(truth[4 * i : 4 * i + 4], getattr(vehicle_cfg, field))
        plant.write(getattr(plant.params, field), np.array([values]))
    weight = vehicle_cfg.mass_kg * vehicle_cfg.gravity_m_s2
    plant.write(plant.params.buoyancy_n, np.array([weight + truth[NET]]))
    plant.write(plant.params.thruster_gain, np.full((1, len(vehicle_cfg.thrusters)), truth[GAIN]))
    point_s = plant.config.episode.control_dt_s / POINTS
    motion, samples = [], []
    for action in actions:
        sample = _sample(plant)
        for point in range(POINTS):
            motion.append((plant.read(plant.vehicle.vel_b), plant.read(plant.vehicle.rate_b)))
            plant.step(None if point else action, substeps=1, dt_s=point_s)
        samples.append((*sample, plant.read(plant.actuation.rpm_command)))
    return [np.concatenate(column) for rows in (motion, samples) for column in zip(*rows, strict=True)]


def _delayed(values: np.ndarray, points: float) -> np.ndarray:
    """(n, 3) at each sample what was so many points before."""
    at = np.arange(len(values), dtype=float)
    return np.stack([np.interp(at[::POINTS] - points, at, column) for column in values.T], axis=1)


def commands(rng: np.random.Generator, count: int, steps: int, dt_s: float) -> np.ndarray:
    """(steps, count, 4) what to drive: each axis takes a random level, slow or fast, forth or back or none,
    for half a second to four seconds."""
    out = np.zeros((steps, count, 4), np.float32)
    for env in range(count):
        for axis in range(4):
            at = 0
            while at < steps:
                until = at + round(rng.uniform(0.5, 4.0) / dt_s)
                level = rng.choice([0.0, 0.2, 0.5, 1.0]) * rng.choice([-1.0, 1.0])
                out[at:until, env, axis] = level * rng.uniform(0.7, 1.0)
                at = until
    return out


def _sample(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    tilt = np.array([angles_of(*q)[:2] for q in plant.read(plant.vehicle.quat_wb).astype(float)])
    return tilt, plant.read(plant.vehicle.rpm)


def _noisy(
    rng: np.random.Generator,
    dt_s: float,
    read: tuple[np.ndarray, np.ndarray],
    rate: np.ndarray,
    tilt: np.ndarray,
    rpm: np.ndarray,
) -> Drive:
    """``read``: velocity (n, 3) and yaw rate (n, 1) as the instruments have them."""
    vel = read[0] + _errors(rng, read[0].shape, DVL_M_S, dt_s)
    turn = read[1] + _errors(rng, read[1].shape, GYRO_RAD_S, dt_s)
    rate = rate + _errors(rng, rate.shape, GYRO_RAD_S, dt_s)
    tilt = tilt + _errors(rng, tilt.shape, TILT_RAD, dt_s)
    rpm = rpm * (1 + SPEED_SHARE * rng.normal(size=rpm.shape))
    vel[np.arange(len(vel)) % EVERY != 0] = np.nan
    up = up_axis(tilt[:, 0], tilt[:, 1])
    return Drive(dt_s, np.column_stack([vel, turn]), rate[:, :2], up, rpm)


def _errors(
    rng: np.random.Generator, shape: tuple[int, ...], sigma: tuple[float, float], dt_s: float
) -> np.ndarray:
    """White noise plus a Gauss-Markov process."""
    keep = np.exp(-dt_s / SLOW_S)
    slow = rng.normal(size=shape)
    for k in range(1, len(slow)):
        slow[k] = keep * slow[k - 1] + np.sqrt(1 - keep**2) * slow[k]
    return sigma[0] * rng.normal(size=shape) + sigma[1] * slow
