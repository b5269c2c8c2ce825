"""Thrust of the presets against the maker's T200 (docs/data/t200.csv: PWM [us], [rpm], [kgf])."""

import csv
from pathlib import Path

import numpy as np
import pytest

from uuvtai.config.loader import ConfigError, load_config
from uuvtai.kernels.vehicle.dynamics import KGF, edge_rpm, thrust_at, thrust_limits

TABLE = Path(__file__).parents[3] / "docs" / "data" / "t200.csv"
RMS_KGF = 0.05
STANDARD_KGF = 9.80665
"""[N] in the maker's kilogram-force; the simulator's is 0.03 % larger"""


def table(voltage):
    """(speed [rpm], thrust [N]) of one voltage."""
    with TABLE.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if float(row["voltage_v"]) == voltage]
    assert len(rows) == 29
    speed, thrust = (np.array([float(row[key]) for row in rows]) for key in ("speed_rpm", "thrust_kgf"))
    return speed, thrust * STANDARD_KGF


def thrust(vehicle, speed):
    """[N] by the formula of the kernels, in plain Python."""
    ahead = edge_rpm(vehicle.thrust_forward, vehicle.dead_band_rpm[0], 1.0)
    astern = edge_rpm(vehicle.thrust_reverse, vehicle.dead_band_rpm[1], -1.0)
    if speed >= ahead:
        return thrust_at(vehicle.thrust_forward, speed, vehicle.thrust_scale)
    if speed <= astern:
        return thrust_at(vehicle.thrust_reverse, speed, vehicle.thrust_scale)
    return 0.0


@pytest.mark.parametrize(
    ("name", "voltage"), [("bluerov2_16v", 16), *(("bluerov2", v) for v in (10, 12, 14, 16, 18, 20))]
)
def test_thrust_curve_meets_the_makers_table(name, voltage):
    vehicle = load_config("open", vehicle=name).vehicle
    speed, measured = table(voltage)
    error_kgf = (np.array([thrust(vehicle, n) for n in speed]) - measured) / STANDARD_KGF
    pushes = measured != 0
    assert np.sqrt(np.mean(error_kgf[pushes] ** 2)) <= RMS_KGF
    assert not error_kgf[~pushes].any()


def test_16_volts_push_as_hard_as_the_pack_can():
    vehicle = load_config("open", vehicle="bluerov2_16v").vehicle
    speed, measured = table(16)
    ahead, astern = thrust_limits(vehicle)
    assert abs(astern - measured[np.argmin(speed)]) < RMS_KGF * KGF
    assert 0.95 * measured.max() < ahead <= measured.max()
    assert vehicle.dead_band_rpm == (speed[speed > 0].min(), -speed[speed < 0].max())


@pytest.mark.parametrize("voltage", [10, 12, 14, 16, 18, 20])
def test_a_pack_pushes_as_hard_as_the_maker_measured(voltage):
    """One limit serves both ways, so it is the slower one's; the curve is that of 16 V."""
    settings = [("vehicle.battery_v", voltage)]
    vehicle = load_config("open", vehicle="bluerov2_16v", overrides=settings).vehicle
    speed, measured = table(voltage)
    assert vehicle.top_rpm == min(speed.max(), -speed.min())
    ahead, astern = thrust_limits(vehicle)
    slower = measured.min() if -speed.min() <= speed.max() else measured.max()
    ours = astern if -speed.min() <= speed.max() else ahead
    assert abs(ours - slower) < 0.15 * KGF, "the fit at 16 V is off by up to 0.14 kgf at other voltages"
    assert 0.9 * measured.max() < ahead <= measured.max() + RMS_KGF * KGF


def test_a_voltage_between_two_of_the_table_lies_between_them():
    speeds = [load_config("open", overrides=[("vehicle.battery_v", v)]).vehicle.top_rpm for v in (14, 15, 16)]
    assert speeds[1] == 0.5 * (speeds[0] + speeds[2])
    vehicle = load_config("open", vehicle="bluerov2_16v", overrides=["vehicle.battery_v=null"]).vehicle
    assert vehicle.top_rpm == 3900.0, "without a pack the vehicle's own limit counts"


@pytest.mark.parametrize("volts", ["9.9", "21", "nan", "full"])
def test_a_voltage_beyond_the_table_is_refused(volts):
    with pytest.raises(ConfigError, match="battery_v"):
        load_config("open", overrides=[f"vehicle.battery_v={volts}"])


def test_the_papers_vehicle_keeps_its_20_volts():
    vehicles = (load_config("open", vehicle=name).vehicle for name in ("bluerov2", "bluerov2_16v"))
    paper, ours = map(thrust_limits, vehicles)
    assert load_config("open").vehicle.rotor_max_rpm == 3900
    for strong, weak in zip(paper, ours, strict=True):
        assert 0.70 < weak / strong < 0.85
