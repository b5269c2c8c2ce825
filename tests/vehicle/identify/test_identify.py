"""``uuv identify``: a drive of the oracle's vehicle gives that vehicle back; what cannot be known is said."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.command import uuv
from tests.oracles import dynamics as oracle
from tests.oracles import logs as episode
from uuvtai.config import VehicleConfig
from uuvtai.config.loader import load_config
from uuvtai.sim.setup import allocation_matrices
from uuvtai.vehicle.identify import fit as identified_module
from uuvtai.vehicle.identify import model
from uuvtai.vehicle.identify.drive_log import Drive, DriveError, mean_wrench, read_drives
from uuvtai.vehicle.identify.fit import KNOWN, _worse, horizon_errors, identified

DT_S, SECONDS = 0.02, 65.1
NOISE = 0.004
"""[m/s, rad/s] of the readings"""
TOLD = VehicleConfig()
TRUE = oracle.Body(
    added=np.array([7.0, 10.0, 16.0, 0.12, 0.12, 0.15]),
    linear=np.array([3.0, 8.0, 6.5, 0.07, 0.07, 0.1]),
    quadratic=np.array([22.0, 18.0, 30.0, 1.55, 1.55, 1.2]),
    buoyancy=TOLD.mass_kg * TOLD.gravity_m_s2 + 3.0,
)
"""level throughout: roll and pitch are held"""


def thrust(rpm):
    """[N] of one rotor speed, by the published coefficients."""
    forward, reverse = TOLD.thrust_forward, TOLD.thrust_reverse
    if rpm > TOLD.dead_band_rpm[0]:
        return 9.81 * (forward[0] * rpm * rpm + forward[1] * rpm + forward[2])
    if rpm < -TOLD.dead_band_rpm[1]:
        return 9.81 * (reverse[0] * rpm * rpm + reverse[1] * rpm + reverse[2])
    return 0.0


def oracle_drive(seed=5, lag_s=TOLD.rotor_tau_s):
    """(times, velocities (n, 4), rotor speeds (n, 6), those commanded next (n, 6)) by Fossen and RK4."""
    rng, geometry = np.random.default_rng(seed), allocation_matrices(TOLD)[0]
    level, still, steps = np.eye(3), np.zeros(3), round(SECONDS / DT_S)
    nu, rpm, left, wanted = np.zeros(6), np.zeros(6), np.zeros(6, int), np.zeros(6)
    speeds, rotors, asked = [], [], []

    def rate(nu, rpm):
        wrench = geometry @ [thrust(n) for n in rpm]
        found = oracle.nu_dot(TRUE, level, nu, wrench, still)
        found[3:5] = 0.0
        return found

    for _ in range(steps):
        speeds.append(nu[[0, 1, 2, 5]])
        rotors.append(rpm)
        for i in np.flatnonzero(left <= 0):
            wanted[i] = rng.choice([-2300.0, -1200.0, 0.0, 1200.0, 2300.0])
            left[i] = round(rng.uniform(0.5, 3.0) / DT_S)
        left -= 1
        asked.append(wanted.copy())
        middle, end = (wanted + (rpm - wanted) * math.exp(-share * DT_S / lag_s) for share in (0.5, 1))
        a = rate(nu, rpm)
        b = rate(nu + 0.5 * DT_S * a, middle)
        c = rate(nu + 0.5 * DT_S * b, middle)
        d = rate(nu + DT_S * c, end)
        nu, rpm = nu + DT_S / 6 * (a + 2 * b + 2 * c + d), end
    noisy = np.array(speeds) + NOISE * rng.normal(size=(steps, 4))
    return np.arange(steps) * DT_S, noisy, np.array(rotors), np.array(asked)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A CSV of the drive, rotor speeds as turned."""
    times, speeds, rotors, _ = oracle_drive()
    return written(tmp_path_factory.mktemp("identify") / "drive.csv", "rpm", times, speeds, rotors)


def written(path, kind, times, speeds, rotors):
    """A CSV; the DVL reads at every fifth row."""
    lines = ["t,u,v,w,r," + ",".join(f"{kind}_{i}" for i in range(1, 7))]
    for k, (t, (u, v, w, r), rpm) in enumerate(zip(times, speeds, rotors, strict=True)):
        seen = f"{u:.5f},{v:.5f},{w:.5f}" if k % 5 == 0 else ",,"
        lines.append(f"{t:.2f},{seen},{r:.5f},{','.join(f'{n:.2f}' for n in rpm)}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_the_oracles_vehicle_comes_back_within_its_intervals(table, capfd):
    out = table.with_name("mine.yaml")
    code, text, err = uuv(capfd, "identify", table, "--vehicle", "bluerov2", "--out", out, "--json")
    assert code == 0, err
    document = json.loads(text)
    assert document["stretches"] == 13 and document["known"] == "gain"
    inside = 0
    for entry, value in zip(document["parameters"], true_row(), strict=False):
        inside += entry["low"] <= value <= entry["high"]
        assert entry["fitted"] and entry["low"] < entry["value"] < entry["high"]
        assert entry["low"] - (entry["high"] - entry["low"]) < value < 2 * entry["high"] - entry["low"], entry
    assert inside >= 11
    gain, lag = (document["parameters"][place] for place in (model.GAIN, model.LAG))
    assert not gain["fitted"] and gain["value"] == 1.0
    assert not lag["fitted"] and lag["value"] == TOLD.rotor_tau_s, "a log of turned speeds does not show it"
    (warning,) = [text for text in document["warnings"] if text.startswith("rotor lag")]
    assert "asked_1" in warning and "it stays that of the vehicle given" in warning
    ours, given = (document["horizons"][name]["100"] for name in ("identified", "given"))
    assert all(a < b for a, b in zip(ours, given, strict=True))
    found = load_config("open", vehicle=str(out)).vehicle
    assert abs(found.added_mass[0] - TRUE.added[0]) < 0.5 and found.added_mass[3] == TOLD.added_mass[3]
    assert abs(model.parameters_of(found)[model.NET] - 3.0) < 0.2
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    code, _, err = uuv(capfd, "identify", table, "--out", out)
    assert code == 2 and "already there" in err


def test_one_force_or_mass_has_to_be_known(table):
    """Twice the masses, drags, buoyancy and gain move alike: each choice holds one of them."""
    drives = read_drives(table)
    steady = VehicleConfig(volume_m3=TRUE.buoyancy / TOLD.gravity_m_s2 / TOLD.water_density_kg_m3)
    found = identified(drives, steady, "buoyancy").document["parameters"]
    assert not found[model.NET]["fitted"] and found[model.GAIN]["fitted"]
    assert found[model.GAIN]["low"] < 1.0 < found[model.GAIN]["high"]
    with pytest.raises(DriveError, match="gain, added-mass, buoyancy"):
        identified(drives, TOLD, "mass")
    assert KNOWN == ("gain", "added-mass", "buoyancy")


def test_the_rotors_lag_comes_back_from_commanded_speeds(tmp_path, capfd):
    lag_s = 0.06
    times, speeds, _, asked = oracle_drive(lag_s=lag_s)
    speeds[2:, 3] = speeds[:-2, 3]  # a gyro that is filtered for 40 ms
    path = written(tmp_path / "drive.csv", "asked", times, speeds, asked)
    code, text, err = uuv(capfd, "identify", path, "--vehicle", "bluerov2", "--json")
    assert code == 0, err
    entries = json.loads(text)["parameters"]
    for place, true in ((model.LAG, lag_s), (model.LATE[0], 0.0), (model.LATE[1], 0.04)):
        entry, width = entries[place], entries[place]["high"] - entries[place]["low"]
        assert entry["fitted"] and width < 0.02
        assert entry["low"] - width < true < entry["high"] + width, entry
    inside = sum(entries[i]["low"] <= value <= entries[i]["high"] for i, value in enumerate(true_row()))
    assert inside >= 11
    made = load_config("open", vehicle=str(path.with_suffix(".vehicle.yaml"))).vehicle
    assert made.rotor_tau_s == pytest.approx(entries[model.LAG]["value"], abs=1e-4)


def true_row():
    picked = [0, 1, 2, 5]
    return [*TRUE.added[picked], *TRUE.linear[picked], *TRUE.quadratic[picked], 3.0]


def test_commands_that_change_slowly_do_not_show_the_lag():
    n = 3000
    slow = np.tile(2000 * np.sin(np.arange(n) * DT_S)[:, None], (1, 6))
    still = np.zeros((n, 4)), np.zeros((n, 2)), np.tile([0.0, 0.0, 1.0], (n, 1))
    assert "jump 0 times by 300 rpm" in model.unstepped([Drive(DT_S, *still, slow, command="held")])
    steps = np.where(np.arange(n)[:, None] // 500 % 2 == 0, 1000.0, -1000.0) * np.ones(6)
    assert "jump 5 times" in model.unstepped([Drive(DT_S, *still, steps, command="held")])
    often = np.where(np.arange(n)[:, None] // 25 % 2 == 0, 1000.0, -1000.0) * np.ones(6)
    assert model.unstepped([Drive(DT_S, *still, often, command="held")]) == ""


@pytest.mark.parametrize("lag_s", [0.004, 0.03, 0.2])
def test_thrust_of_a_lagging_rotor_against_small_steps(lag_s):
    """First order: the mean of each step, and that weighted by the time left of it."""
    asked = np.array([0.0, 2000.0, 2000.0, -1500.0, 800.0, 800.0])[:, None] * np.ones(6)
    blank = np.zeros((6, 4)), np.zeros((6, 2)), np.zeros((6, 3))
    found = mean_wrench(Drive(DT_S, *blank, asked, command="held"), TOLD, np.array([lag_s]))[:, 0]
    turned, fine = 0.0, 2000
    left = 1 - (np.arange(fine) + 0.5) / fine
    for k in range(5):
        pushes = []
        for _ in range(fine):
            middle = asked[k, 0] + (turned - asked[k, 0]) * math.exp(-0.5 * DT_S / fine / lag_s)
            turned = asked[k, 0] + (turned - asked[k, 0]) * math.exp(-DT_S / fine / lag_s)
            pushes.append(thrust(middle))
        assert found[0, k] == pytest.approx(np.mean(pushes), abs=0.25), k
        assert found[1, k] == pytest.approx(np.average(pushes, weights=left), abs=0.35), k


def test_a_rotor_never_quite_arrives_at_the_edge_of_its_dead_band():
    """Told the edge from standstill it does not push, however long that lasts; told it from above it does."""
    edge = TOLD.dead_band_rpm[0] * np.ones(200)
    asked = np.stack([np.r_[0.0, edge], np.r_[2000.0, edge]], axis=1)
    blank = np.zeros((201, 4)), np.zeros((201, 2)), np.zeros((201, 3))
    found = mean_wrench(Drive(DT_S, *blank, asked, command="held"), TOLD, np.array([0.01]))[0, 0]
    assert (found[:, 0] == 0.0).all()
    assert found[150:, 1] == pytest.approx(thrust(TOLD.dead_band_rpm[0] + 1e-6), abs=1e-3)


def test_speeds_as_turned_run_as_the_lag_has_it_or_straight():
    """Thrust is taken on either way from one sample to the next, so that an interval can hold both."""
    turned = np.array([600.0, 2200.0, 2300.0])[:, None] * np.ones(6)
    drive = Drive(DT_S, np.zeros((3, 4)), np.zeros((3, 2)), np.zeros((3, 3)), turned)
    other = drive.otherwise()
    assert other is not None and other.straight
    quick, straight = (mean_wrench(one, TOLD, np.array([0.05]))[0, 0, 0, 0] for one in (drive, other))
    times = (np.arange(2000) + 0.5) / 2000
    kept = np.exp(-times * DT_S / TOLD.rotor_tau_s)
    lagged = 1 - (1 - kept) / (1 - math.exp(-DT_S / TOLD.rotor_tau_s))
    for found, way in ((quick, 1 - lagged), (straight, times)):
        assert found == pytest.approx(np.mean([thrust(600.0 + 1600.0 * share) for share in way]), rel=0.02)
    held = Drive(DT_S, np.zeros((3, 4)), np.zeros((3, 2)), np.zeros((3, 3)), turned, command="held")
    assert held.otherwise() is None


def test_a_delay_shifts_what_its_instrument_says(table):
    given = model.stretches(read_drives(table), TOLD, 5.0)
    theta, start = model.parameters_of(TOLD), np.full((1, len(given.velocity), 4), 0.1)
    true = model.motion(theta[None], start, given, TOLD)[0]
    theta[list(model.LATE)] = 3 * DT_S, 0.5 * DT_S
    late = model.readings(theta[None], start, given, TOLD)[0]
    assert np.allclose(late[:, 3:, :3], true[:, :-3, :3])
    yaw = true[..., 3]
    halfway = (9 * (yaw[:, 2:-2] + yaw[:, 1:-3]) - yaw[:, 3:-1] - yaw[:, :-4]) / 16
    assert np.allclose(late[:, 2:-2, 3], halfway)
    assert np.isnan(given.velocity[:, :8]).all(), "what a delay may have from before the stretch"


def test_initial_velocities_of_an_unstable_vehicle_are_found(table):
    """At 0.6 m/s its yaw runs away (Munk's moment): one unsettled stretch outweighs all others."""
    whole = model.stretches(read_drives(table), TOLD, 5.0)
    ahead = np.zeros_like(whole.wrench)
    ahead[..., 0] = 9.0
    value = model.parameters_of(TOLD)
    value[model.NET], value[[0, 1]] = 0.0, (1.0, 25.0)
    still = replace(whole, wrench=ahead, up=np.zeros_like(whole.up), tilt_rate=np.zeros_like(whole.tilt_rate))
    rng = np.random.default_rng(3)
    true = np.array([0.6, 0.0, 0.0, 0.0]) + 0.1 * rng.normal(size=(len(whole.velocity), 4))
    seen = model.readings(value[None], true[None], still, TOLD)[0]
    seen[:, np.arange(seen.shape[1]) % 5 != 0, :3] = np.nan
    cuts = tuple((replace(whole.cuts[0][0], velocity=row), 0) for row in np.roll(seen, 5, axis=1))
    given = replace(still, velocity=np.where(np.isnan(whole.velocity), np.nan, seen), cuts=cuts)
    found = model.grown_starts(given, TOLD, value, np.array([0.01, 0.01, 0.01, 0.003]))
    assert np.abs(model.first_readings(given) - true).max() > 0.1
    assert np.abs(found - true).max() < 1e-3


def still_drive(**moving):
    """Four minutes at rest but for what ``moving`` says: axis -> speed [n]."""
    n = round(240 / DT_S)
    velocity = np.zeros((n, 4))
    for axis, speed in moving.items():
        velocity[:, int(axis[1:])] = speed(np.arange(n) * DT_S)
    return Drive(DT_S, velocity, np.zeros((n, 2)), np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros((n, 6)))


def test_a_log_that_excites_nothing_is_refused_with_what_to_drive():
    with pytest.raises(DriveError, match=r"excite no axis; surge stayed below 0.00 m/s .* forth and back"):
        identified([still_drive()], TOLD)


def test_axes_that_rest_are_named():
    drive = still_drive(a0=lambda t: 0.4 * np.sin(t), a3=lambda t: 0.5 * np.sin(0.7 * t))
    assert set(model.unexcited(model.stretches([drive], TOLD, 5.0))) == {"sway", "heave"}


def test_short_logs_and_other_thrusters_are_refused():
    drive = still_drive()
    short = Drive(DT_S, *(a[:501] for a in (drive.velocity, drive.tilt_rate, drive.up, drive.rpm)))
    with pytest.raises(DriveError, match="2 stretches of 5 s without a gap, 12 are needed"):
        identified([short], TOLD)
    heavy = load_config("open", vehicle="bluerov2_heavy").vehicle
    with pytest.raises(DriveError, match="6 thrusters, the vehicle 8: name the one"):
        identified([drive], heavy)
    with pytest.raises(DriveError, match="identify them apart"):
        model.stretches([drive, Drive(0.1, drive.velocity, drive.tilt_rate, drive.up, drive.rpm)], TOLD, 5.0)


def test_the_vehicle_given_is_kept_where_no_fit_is_better(table, capfd):
    """It is the one that was driven."""
    picked = {"added_mass": TRUE.added, "linear_damping": TRUE.linear, "quadratic_damping": TRUE.quadratic}
    volume = TRUE.buoyancy / TOLD.gravity_m_s2 / TOLD.water_density_kg_m3
    text = json.dumps({"vehicle": {"volume_m3": volume, **{name: list(row) for name, row in picked.items()}}})
    given, out = table.with_name("given.yaml"), table.with_name("new.yaml")
    given.write_text(text)
    code, _, err = uuv(capfd, "identify", table, "--vehicle", given, "--out", out)
    said = " ".join(err.split())
    assert code == 2 and "improve no number of the vehicle given, and nothing is written" in said
    assert all(f"{axis} is no better (" in said for axis in model.AXES)
    assert not out.exists() and not out.with_suffix(".png").exists()


AHEAD = {
    "better": ((0.9, 0.5), True),
    "a little better": ((0.99, 0.99), False),
    "better at one, hardly worse at the other": ((1.01, 0.5), True),
    "worse at ten": ((1.1, 0.5), False),
    "worse at a hundred": ((0.5, 1.1), False),
    "no number": ((math.nan, 0.5), False),
    "no reading": ((None, None), False),
    "one horizon": ((None, 0.5), True),
}
"""errors 10 and 100 steps ahead, in those of the vehicle given: whether the fit is kept"""


@pytest.mark.parametrize(("shares", "is_better"), AHEAD.values(), ids=AHEAD)
def test_a_fit_has_to_be_better_ahead(shares, is_better):
    rows = dict(zip(("1", "10", "100"), ((9.0,) * 4, *((share,) * 4 for share in shares)), strict=True))
    horizons = {"identified": rows, "given": dict.fromkeys(rows, (1.0,) * 4)}
    free = np.ones(17, bool)
    for axis, places in enumerate(([0, 4, 8], [1, 5, 9], [2, 6, 10, model.NET], [3, 7, 11])):
        found = [places for _, places in _worse(axis, horizons, free)]
        assert found == ([] if is_better else [places])
    assert _worse(0, horizons, ~free) == []


def test_numbers_that_come_out_negative_stay_as_given_and_the_others_are_fitted_anew(table, monkeypatch):
    """A first fit has negative numbers; the next one is told to hold them."""
    held, real = [], identified_module.fitted

    def wrong(given, vehicle_cfg, first, free):
        fit, low = real(given, vehicle_cfg, first, free), np.zeros(17)
        low[[0, 4, model.LAG]] = -30.0, -5.0, -1.0
        held.append(~free[[0, 4, model.LAG]])
        return replace(fit, value=np.where(free, fit.value + low, fit.value))

    monkeypatch.setattr(identified_module, "fitted", wrong)
    found = identified(read_drives(table), TOLD)
    assert found.keys["added_mass"][0] == TOLD.added_mass[0]
    assert found.keys["linear_damping"][0] == TOLD.linear_damping[0]
    assert [row.tolist() for row in held] == [[False, False, True], *[[True] * 3] * 3]
    said = [text for text in found.document["warnings"] if "came out negative (" in text]
    assert [text.partition(":")[0] for text in said] == ["added mass, surge", "linear damping, surge"]


@pytest.mark.parametrize("every", [1, 5, 7])
def test_errors_ahead_begin_and_end_at_readings(every, table):
    (drive,) = read_drives(table)
    seen = drive.velocity.copy()
    seen[np.arange(len(seen)) % every != 0, :3] = np.nan
    seen[np.isnan(seen)] = np.where(np.arange(len(seen)) % every == 0, 0.1, np.nan)[:, None].repeat(4, 1)[
        np.isnan(seen)
    ]
    given = model.stretches([replace(drive, velocity=seen)], TOLD, 5.0)
    found = horizon_errors(given, TOLD, model.parameters_of(TOLD), (every, 10 * every))
    assert all(value is not None for row in found.values() for value in row)


def test_a_vehicle_file_has_its_own_trim():
    found = model.parameters_of(TOLD)
    found[[model.NET, model.GAIN]] = 1.5, 0.9
    keys = model.changed(TOLD, found)
    assert keys["thrust_scale"] == 0.9
    again = VehicleConfig(**keys)
    assert abs(model.parameters_of(again)[model.NET] - 1.5) < 1e-3


BAD_TABLES = {
    "t,u,v,w\n0,0,0,0\n": "missing: r, rpm_1",
    "t,u,v,w,r,rpm_1\n": "has no rows",
    "t,u,v,w,r,rpm_1\n0,0,0,0,0\n": "line 2 must hold 6 numbers",
    "t,u,v,w,r,rpm_1\n0,0,0,0,x,0\n": "line 2 must hold 6 numbers",
    "t,u,v,w,r,rpm_1\n0,0,0,0,inf,0\n": "line 2 must hold 6 numbers",
    "t,u,v,w,r,rpm_1\n0,0,0,0,0,\n1,0,0,0,0,0\n": "only u, v, w and r may have empty cells",
    "t,u,v,w,r,rpm_1\n1,0,0,0,0,0\n1,0,0,0,0,0\n": "times must rise",
    "t,u,v,w,r,rpm_1,asked_1\n0,0,0,0,0,0,0\n": "give one of the two",
    "t,u,v,w,r,rpm_1\n" + "".join(f"{k}000,0,0,0,0,0\n" for k in range(9)): "a sample every 1000 s",
    "": "missing: t, u, v, w, r, rpm_1",
    "t,u,v,w,r,rpm_1\n0,0,0,0,0," + "1" * 200_000 + "\n": "is no table (field larger than field limit",
    "t,u,v,w,r,rpm_1\n0,0,0,0,0,\0\n": "line 2 must hold 6 numbers",
    "\ufeff": "missing: t, u, v, w, r, rpm_1",
}


@pytest.mark.parametrize("text", BAD_TABLES, ids=range(len(BAD_TABLES)))
def test_bad_tables_are_refused(text, tmp_path, capfd):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    code, out, err = uuv(capfd, "identify", path)
    assert (code, out) == (2, "") and BAD_TABLES[text] in " ".join(err.split())
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["none.csv", "none.mcap", ".", "utf16.csv", "x" * 999 + ".csv"])
def test_what_is_no_log_is_refused(name, tmp_path, capfd):
    (tmp_path / "utf16.csv").write_text("t,u,v,w,r,rpm_1", encoding="utf-16")
    code, out, err = uuv(capfd, "identify", tmp_path / name)
    assert (code, out) == (2, "") and str(tmp_path) in err


def test_a_folder_that_is_not_there_is_refused_before_the_work(table, capfd):
    out = table.parent / "none" / "mine.yaml"
    code, _, err = uuv(capfd, "identify", table, "--out", out)
    assert code == 2 and "is no folder" in err


def test_a_gap_parts_a_table(tmp_path):
    path = tmp_path / "gap.csv"
    rows = [f"{t:.1f},0,0,0,0,0" for t in [*np.arange(0, 3, 0.1), *np.arange(9, 11, 0.1)]]
    path.write_text("\n".join(["t,u,v,w,r,rpm_1", *rows]))
    assert [len(drive.rpm) for drive in read_drives(path)] == [30, 20]


def test_a_mark_of_utf8_hides_no_column(tmp_path):
    """As Excel writes it."""
    (tmp_path / "a.csv").write_text("t,u,v,w,r,rpm_1\n0,1,,,,5\n0.1,2,,,,6\n", encoding="utf-8-sig")
    (found,) = read_drives(tmp_path / "a.csv")
    assert found.dt_s == 0.1 and found.velocity[:, 0].tolist() == [1.0, 2.0]


def test_a_long_table_is_refused_before_it_fills_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("uuvtai.vehicle.identify.drive_log.MAX_SAMPLES", 50)
    (tmp_path / "a.csv").write_text("t,u,v,w,r,rpm_1\n" + "".join(f"{k},,,,,0\n" for k in range(51)))
    with pytest.raises(DriveError, match="more than 50 samples; cut it"):
        read_drives(tmp_path / "a.csv")


def test_our_logs_are_read_by_their_instruments_or_by_the_truth(tmp_path):
    path = episode.record(tmp_path / "a.mcap", 20, maps=False)
    taken = list(episode.snapshots(20, maps=False))
    (drive,), (exact,) = read_drives(path), read_drives(path, truth=True)
    assert exact.velocity.shape == (21, 4) and abs(exact.dt_s - episode.DT) < 1e-9
    true, rate, rpm = (np.array([s[f"vehicle.{name}"] for s in taken]) for name in ("vel_b", "rate_b", "rpm"))
    assert np.allclose(exact.velocity, np.column_stack([true, rate[:, 2]]), atol=1e-6)
    assert np.allclose(exact.rpm, rpm) and np.allclose(np.linalg.norm(exact.up, axis=1), 1, atol=1e-6)
    said, valid = (np.array([s[f"ego.{name}"] for s in taken]) for name in ("vel_b", "vel_valid"))
    held = ~valid.astype(bool) | np.r_[False, (said[1:] == said[:-1]).all(axis=1)]
    assert np.isnan(drive.velocity[held, :3]).all()
    assert np.allclose(drive.velocity[~held, :3], said[~held], atol=1e-6)
