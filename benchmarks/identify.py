"""Six random vehicles identified from five minutes of noisy simulated driving: how often the truth lies
within the 95 % interval.

Drag, added mass, net buoyancy and thruster gain differ from the vehicle that the identification is told.
The vehicles are moved by ``Plant`` (six degrees of freedom, rotor lag, inner loop); readings have white and
slowly varying errors, the DVL one reading in five steps.
"""

from __future__ import annotations

import numpy as np

from benchmarks.common import Job, Row
from uuvtai.config import Config
from uuvtai.identify.drive_log import Drive, up_axis
from uuvtai.identify.identified import KNOWN, identified
from uuvtai.identify.motion_model import GAIN, NET, SIZE, parameters_of
from uuvtai.loader import load_config
from uuvtai.measure.simulate import roll_pitch_yaw
from uuvtai.plant import Plant
from uuvtai.runtime import start_taichi

VEHICLES, MINUTES, SEED = 6, 5.0, 77001
SPREAD, GAIN_SPREAD, NET_N = 0.3, 0.1, (-4.0, 4.0)
DVL_M_S, GYRO_RAD_S, TILT_RAD, SPEED_SHARE = (0.01, 0.004), (0.003, 0.001), (0.002, 0.003), 0.01
"""standard deviations: (white, slowly varying); of the rotor speed a share, white"""
SLOW_S = 2.0
EVERY = 5
"""control steps between readings of the DVL"""


def measure(job: Job) -> list[Row]:
    """A row for each thing that is held known: the share of true values within their intervals."""
    minutes = 1.0 if job.quick else MINUTES
    config = load_config("open", vehicle="bluerov2_16v")
    truth, drives = driven(config, VEHICLES, minutes, SEED)
    rows = []
    for known in KNOWN:
        inside, widths, total = {}, {}, 0
        for i, drive in enumerate(drives):
            told = config.vehicle
            if known == "buoyancy":
                volume = (told.mass_kg + truth[i, NET] / told.gravity_m_s2) / told.water_density_kg_m3
                told = told.model_copy(update={"volume_m3": volume})
            if known == "added-mass":
                told = told.model_copy(update={"added_mass": tuple(_six(truth[i, :4], told.added_mass))})
            true = truth[i].copy()
            if known == "gain":
                told = told.model_copy(update={"thrust_scale": told.thrust_scale * true[GAIN]})
                true[GAIN] = 1.0
            found = identified([drive], told, known).document
            for entry in found["parameters"]:
                if not entry["fitted"]:
                    continue
                value = true[entry["place"]]
                name = entry["name"]
                inside.setdefault(name, []).append(entry["low"] <= value <= entry["high"])
                widths.setdefault(name, []).append(0.5 * (entry["high"] - entry["low"]))
                total += 1
        hits = int(sum(map(sum, inside.values())))
        table = {
            "within the interval": {name: float(sum(found)) for name, found in inside.items()},
            "half its width, median": {name: float(np.median(found)) for name, found in widths.items()},
        }
        rows.append(
            Row(
                f"truth within the 95 % interval, known: {known}",
                100.0 * hits / total,
                "%",
                floor=95.0,
                note=f"{hits} of {total} values, {len(drives)} vehicles, {minutes:g} minutes each",
                details={"table": table, "hits": hits, "values": total},
            )
        )
        job.say(rows[-1].note)
    return rows


def _six(four: np.ndarray, six: tuple[float, ...]) -> list[float]:
    return [*(float(v) for v in four[:3]), *six[3:5], float(four[3])]


def driven(config: Config, count: int, minutes: float, seed: int) -> tuple[np.ndarray, list[Drive]]:
    """(truth (count, 14), drives): random vehicles about ``config``'s under random commands."""
    rng = np.random.default_rng(seed)
    truth = np.tile(parameters_of(config.vehicle), (count, 1))
    truth[:, :NET] *= rng.uniform(1 - SPREAD, 1 + SPREAD, (count, NET))
    truth[:, NET] = rng.uniform(*NET_N, count)
    truth[:, GAIN] = rng.uniform(1 - GAIN_SPREAD, 1 + GAIN_SPREAD, count)
    assert truth.shape[1] == SIZE
    plant = Plant(config, start_taichi("cpu"), count)
    plant.reset()
    for i, field in enumerate(("added_mass", "linear_damping", "quadratic_damping")):
        values = np.array([_six(row[4 * i : 4 * i + 4], getattr(config.vehicle, field)) for row in truth])
        plant.write(getattr(plant.params, field), values)
    weight = config.vehicle.mass_kg * config.vehicle.gravity_m_s2
    plant.write(plant.params.buoyancy_n, weight + truth[:, NET])
    plant.write(plant.params.thruster_gain, truth[:, GAIN, None])
    steps = round(60 * minutes / config.episode.control_dt_s)
    samples = []
    for action in commands(rng, count, steps, config.episode.control_dt_s):
        samples.append(_sample(plant))
        plant.step(action)
    recorded = [np.stack(column, axis=1) for column in zip(*samples, strict=True)]
    dt_s = config.episode.control_dt_s
    return truth, [_noisy(rng, dt_s, *(column[i] for column in recorded)) for i in range(count)]


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


def _sample(plant: Plant) -> tuple[np.ndarray, ...]:
    v = plant.vehicle
    tilt = np.array([roll_pitch_yaw(q)[:2] for q in v.quat_wb.to_numpy().astype(float)])
    return v.vel_b.to_numpy(), v.rate_b.to_numpy(), tilt, v.rpm.to_numpy()


def _noisy(
    rng: np.random.Generator,
    dt_s: float,
    vel: np.ndarray,
    rate: np.ndarray,
    tilt: np.ndarray,
    rpm: np.ndarray,
) -> Drive:
    vel = vel + _errors(rng, vel.shape, DVL_M_S, dt_s)
    rate = rate + _errors(rng, rate.shape, GYRO_RAD_S, dt_s)
    tilt = tilt + _errors(rng, tilt.shape, TILT_RAD, dt_s)
    rpm = rpm * (1 + SPEED_SHARE * rng.normal(size=rpm.shape))
    vel[np.arange(len(vel)) % EVERY != 0] = np.nan
    velocity = np.column_stack([vel, rate[:, 2]])
    return Drive(dt_s, velocity, rate[:, :2], up_axis(tilt[:, 0], tilt[:, 1]), rpm)


def _errors(
    rng: np.random.Generator, shape: tuple[int, ...], sigma: tuple[float, float], dt_s: float
) -> np.ndarray:
    """White noise plus a Gauss-Markov process."""
    keep = np.exp(-dt_s / SLOW_S)
    slow = rng.normal(size=shape)
    for k in range(1, len(slow)):
        slow[k] = keep * slow[k - 1] + np.sqrt(1 - keep**2) * slow[k]
    return sigma[0] * rng.normal(size=shape) + sigma[1] * slow
