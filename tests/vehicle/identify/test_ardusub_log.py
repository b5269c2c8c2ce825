"""ArduSub's logs as drives: axes, pulses, reversed motors, holes, damage. DataFlash and tlogs made here."""

import math
import struct
import tracemalloc

import numpy as np
import pytest

pytest.importorskip("pymavlink")

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.command import uuv
from uuvtai.config.loader import load_config
from uuvtai.vehicle.identify.ardusub_log import STEP_S, read_ardusub
from uuvtai.vehicle.identify.drive_log import DriveError
from uuvtai.vehicle.telemetry import Motors

SECONDS = 8.0
ROLL, PITCH, YAW = 0.1, -0.2, 1.0
VEHICLE = load_config("open", "clean", "bluerov2_16v").vehicle
FORMATS = {
    "PARM": (1, "QNf", "TimeUS,Name,Value"),
    "RCOU": (2, "Q" + "H" * 14, "TimeUS," + ",".join(f"C{i}" for i in range(1, 15))),
    "ATT": (3, "Qfff", "TimeUS,Roll,Pitch,Yaw"),
    "IMU": (4, "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ"),
    "VISO": (5, "Qfffff", "TimeUS,dt,PosDX,PosDY,PosDZ,conf"),
    "XKF1": (6, "QBfff", "TimeUS,C,VN,VE,VD"),
    "EV": (7, "QB", "TimeUS,Id"),
}
OLD = FORMATS | {
    "IMU": (4, "Qfff", "TimeUS,GyrX,GyrY,GyrZ"),
    "IMU2": (8, "Qfff", "TimeUS,GyrX,GyrY,GyrZ"),
    "NKF1": (6, "Qfff", "TimeUS,VN,VE,VD"),
    "NKF6": (9, "Qfff", "TimeUS,VN,VE,VD"),
}
"""before ArduSub 4.1: a message for each IMU and each core of EKF2"""
CODES = {"I": "I", "~": "f", "Q": "Q", "N": "16s", "f": "f", "H": "H", "B": "B"}


def dataflash(rows, formats=FORMATS):
    """Bytes of a DataFlash log; rows of (name, values)."""
    out = b""
    known = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"), **formats}
    for name, (number, form, columns) in known.items():
        length = 89 if name == "FMT" else 3 + struct.calcsize("<" + "".join(CODES[c] for c in form))
        texts = (name.encode(), form.encode(), columns.encode())
        out += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, *texts)
    for name, values in rows:
        number, form, _ = formats[name]
        layout = "<" + "".join(CODES[c] for c in form)
        out += b"\xa3\x95" + bytes([number]) + struct.pack(layout, *values)
    return out


def pulses(time_s):
    """[us] of 14 channels: one motor after the other."""
    found = [1500] * 6 + [0] * 8
    found[int(time_s) % 6] = 1700
    return found


def drive(velocity="VISO", hole=False, armed=(0.0, SECONDS)):
    """Rows of a log in which everything holds still but the pulses."""
    yield "PARM", (0, b"MOT_2_DIRECTION", -1.0)
    yield "PARM", (0, b"SERVO1_FUNCTION", 35.0)  # the first channel is the third motor
    yield "PARM", (0, b"SERVO3_FUNCTION", 33.0)
    for step in range(round(SECONDS / STEP_S)):
        time_s = step * STEP_S
        if hole and 3.0 < time_s < 5.0:
            continue
        now = round(1e6 * time_s)
        for at_s, event in zip(armed, (10, 11), strict=True):
            if step == round(at_s / STEP_S):
                yield "EV", (now, event)
        old = velocity == "NKF1"
        yield "IMU", (now, *[0][old:], 0.01, 0.02, 0.03)
        yield ("IMU2" if old else "IMU"), (now, *[1][old:], 9.0, 9.0, 9.0)
        if step % 5 == 0:
            yield "RCOU", (now, *pulses(time_s))
            yield "ATT", (now, *map(math.degrees, (ROLL, PITCH, YAW)))
            if velocity == "VISO":
                yield "VISO", (now, 0.1, 0.03, 0.02, 0.01, 100.0)
            else:
                yield ("NKF6" if old else "XKF1"), (now, *[1][old:], 9.0, 9.0, 9.0)
                yield velocity, (now, *[0][old:], 0.3 * math.cos(YAW), 0.3 * math.sin(YAW), 0.0)


def read(tmp_path, content, name="drive.bin"):
    path = tmp_path / name
    path.write_bytes(content)
    return read_ardusub(path, VEHICLE)


def test_dataflash_in_our_axes(tmp_path):
    (found,) = read(tmp_path, dataflash(drive()))
    assert found.dt_s == pytest.approx(STEP_S)
    seen = ~np.isnan(found.velocity[:, 0])
    assert seen[::5].all() and seen.sum() == len(seen[::5])
    np.testing.assert_allclose(found.velocity[seen][:, :3], [[0.3, -0.2, -0.1]] * seen.sum(), atol=1e-6)
    np.testing.assert_allclose(found.velocity[:, 3], -0.03, atol=1e-6)
    np.testing.assert_allclose(found.tilt_rate, [[0.01, -0.02]] * len(found.rpm), atol=1e-6)
    up = [math.sin(PITCH), math.sin(ROLL) * math.cos(PITCH), math.cos(ROLL) * math.cos(PITCH)]
    np.testing.assert_allclose(found.up, [up] * len(found.rpm), atol=1e-6)  # of a bow that is down


def test_pulses_turn_the_motors_that_they_are_for(tmp_path):
    (found,) = read(tmp_path, dataflash(drive()))
    motors = Motors(VEHICLE)
    for second in range(6):
        wanted = [1500] * 8
        motor = {0: 2, 2: 0}.get(second, second)  # channels 1 and 3 changed places
        wanted[motor] = 1300 if motor == 1 else 1700  # motor 2 is reversed
        row = round((second + 0.5) / STEP_S)
        np.testing.assert_allclose(found.rpm[row], motors.rpm(wanted), atol=1e-6)
    assert (np.abs(found.rpm[25]) > 0).sum() == 1


@pytest.mark.parametrize(("velocity", "formats"), [("XKF1", FORMATS), ("NKF1", OLD)])
def test_the_filters_velocity_where_there_is_no_dvl(velocity, formats, tmp_path):
    (found,) = read(tmp_path, dataflash(drive(velocity), formats))
    np.testing.assert_allclose(found.velocity[:, 3], -0.03, atol=1e-6)
    ahead, right, down = 0.3 * math.cos(PITCH), 0.3 * math.sin(ROLL) * math.sin(PITCH), 0.0
    down = 0.3 * math.cos(ROLL) * math.sin(PITCH)
    np.testing.assert_allclose(found.velocity[50, :3], [ahead, -right, -down], atol=1e-5)


def test_holes_and_what_was_not_armed_part_a_log(tmp_path):
    first, second = read(tmp_path, dataflash(drive(hole=True)))
    assert len(first.rpm) * STEP_S == pytest.approx(3.0, abs=0.1)
    assert len(second.rpm) * STEP_S == pytest.approx(3.0, abs=0.2)
    (found,) = read(tmp_path, dataflash(drive(armed=(2.0, 4.0))))
    assert len(found.rpm) * STEP_S == pytest.approx(2.0, abs=0.1)
    with pytest.raises(DriveError, match="never armed"):
        read(tmp_path, dataflash(drive(armed=(2.0, 2.02))))


def test_the_filter_that_steered_is_read(tmp_path):
    """Both run, each with a velocity of its own; AHRS_EKF_TYPE says which one it was."""
    formats = FORMATS | {"NKF1": (8, "QBfff", "TimeUS,C,VN,VE,VD")}
    rows = []
    for name, values in drive("XKF1"):
        rows.append((name, values))
        if name == "XKF1":
            rows.append(("NKF1", (*values[:2], 0.0, 0.0, 0.5)))
    slow, steered = ([("PARM", (0, b"AHRS_EKF_TYPE", kind)), *rows] for kind in (3.0, 2.0))
    for made, down in (
        (slow, 0.3 * math.cos(ROLL) * math.sin(PITCH)),
        (steered, 0.5 * math.cos(ROLL) * math.cos(PITCH)),
    ):
        (found,) = read(tmp_path, dataflash(made, formats))
        assert found.velocity[50, 2] == pytest.approx(-down, abs=1e-5)


def test_a_hole_takes_no_memory_and_a_parameter_that_is_no_number_says_nothing(tmp_path):
    """Two readings of each instrument eleven days apart: 48 million rows, none of them known."""
    rows = [("PARM", (0, b"SERVO1_FUNCTION", math.nan))]
    for name, values in drive():
        if name != "EV":
            rows.append(
                (name, values if values[0] < 1e6 or name == "PARM" else (values[0] + 10**12, *values[1:]))
            )
    tracemalloc.start()
    first, second = read(tmp_path, dataflash(rows))
    assert tracemalloc.get_traced_memory()[1] < 20 << 20
    tracemalloc.stop()
    assert (len(first.rpm) + len(second.rpm)) * STEP_S == pytest.approx(SECONDS, abs=0.3)


def tlog(
    boot_s=5.0, system=1, seconds=SECONDS, written_s=1.7e9, dvl=(1, 1), speed=0.3, rates=(), armed=True
):  # fmt: skip
    """A ground station's clock before every message; the DVL has none, the autopilot's has 32 bits."""
    link = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    others = {one: mavlink.MAVLink(None, srcSystem=one[0], srcComponent=one[1]) for one in (dvl, *rates)}
    out = b""
    for step in range(round(seconds / 0.1)):
        now_s = boot_s + 0.1 * step
        servos = [*pulses(0.1 * step), 0, 0]
        milli, micro = (round(units * now_s) & 0xFFFFFFFF for units in (1e3, 1e6))
        delta = [speed / 10, 0.02, 0.01]
        for message, who in (
            (mavlink.MAVLink_attitude_message(milli, ROLL, PITCH, YAW, 0.01, 0.02, 0.03), link),
            (mavlink.MAVLink_servo_output_raw_message(micro, 0, *servos[:8], *servos[8:]), link),
            (mavlink.MAVLink_heartbeat_message(12, 3, 128 * armed + 1, 4, 4, 3), link),
            (
                mavlink.MAVLink_vision_position_delta_message(77_000_000, 100_000, [0.0] * 3, delta, 90.0),
                others[dvl],
            ),
            *(
                (mavlink.MAVLink_attitude_message(9 + step, 1.0, 1.0, 1.0, 9.0, 9.0, 9.0), others[one])
                for one in rates
            ),
        ):
            out += struct.pack(">Q", round(1e6 * (written_s + 0.1 * step))) + message.pack(who)
    return out


def merged(*logs):
    """Logs of one file in the order in which they were written."""
    rows = []
    for log in logs:
        at = 0
        while at < len(log):
            size = 8 + 12 + log[at + 9]
            rows.append((log[at : at + 8], len(rows), log[at : at + size]))
            at += size
    return b"".join(row for *_, row in sorted(rows))


T0 = 1_700_000_000.0
WRAP_S = 2**32 / 1e6
TLOGS = {
    "plain": (tlog(), [8.0], ""),
    "microseconds run over": (tlog(WRAP_S - 3), [8.0], ""),
    "begun after they ran over": (tlog(WRAP_S + 60), [8.0], ""),
    "ran over twice": (tlog(2 * WRAP_S - 3), [8.0], ""),
    "milliseconds run over": (tlog(2**32 / 1e3 - 3), [8.0], ""),
    "a reboot": (tlog(500.0) + tlog(2.0, seconds=12.0, written_s=T0 + 30), [8.0, 11.6],
        "the autopilot's clock began anew 1 times; its drives are kept apart"),
    "two reboots": (b"".join(tlog(9.0 - 3 * k, written_s=T0 + 30 * k) for k in range(3)), [8.0, 7.6, 7.6],
        "began anew 2 times"),
    "another day, by a later clock": (tlog(5.0) + tlog(500.0, written_s=T0 + 86400), [8.0, 7.6],
        "began anew 1 times"),
    "a reboot without a drive": (tlog(500.0) + tlog(2.0, written_s=T0 + 30, armed=False), [8.0],
        "left out, "),
    "two vehicles": (
        merged(tlog(5.0, seconds=10.0), tlog(900.0, system=2, dvl=(2, 1), speed=0.9, written_s=T0 + 0.03)),
        [10.0],
        "holds vehicles 1, 2, of which 1 is read; --system names another",
    ),
    "a DVL of BlueOS": (tlog(dvl=(255, 0)), [8.0], ""),
    "a gimbal's attitude": (tlog(rates=[(1, 154)]), [8.0], "left out 80 ATTITUDE of 1/154"),
    "two DVLs": (
        merged(tlog(), tlog(dvl=(7, 1), speed=0.9, written_s=T0 + 0.04, system=7, boot_s=50.0, seconds=5.0)),
        [8.0],
        "left out 50 VISION_POSITION_DELTA of 7/1",
    ),
    "one late datagram": (tlog() + tlog(6.0, seconds=0.1, written_s=T0 + 8) + tlog(13.0, written_s=T0 + 8.02),
        [16.0], ""),
}  # fmt: skip


@pytest.mark.parametrize("name", TLOGS)
def test_clocks_and_senders_of_a_tlog(name, tmp_path):
    content, seconds, says = TLOGS[name]
    notes = []
    (tmp_path / "drive.tlog").write_bytes(content)
    found = read_ardusub(tmp_path / "drive.tlog", VEHICLE, note=notes.append)
    assert [STEP_S * len(one.rpm) for one in found] == pytest.approx(seconds, abs=0.35)
    assert says in "; ".join(notes) if says else not notes
    for one in found:
        seen = ~np.isnan(one.velocity[:, 0])
        assert seen.sum() == pytest.approx(10 * STEP_S * len(one.rpm), abs=4)
        np.testing.assert_allclose(one.velocity[seen][:, :3], [[0.3, -0.2, -0.1]] * seen.sum(), atol=1e-6)
        np.testing.assert_allclose(one.tilt_rate, [[0.01, -0.02]] * len(one.rpm), atol=1e-6)


def test_the_other_vehicle_of_a_tlog(tmp_path, capfd):
    path = tmp_path / "drive.tlog"
    path.write_bytes(TLOGS["two vehicles"][0])
    (found,) = read_ardusub(path, VEHICLE, 2)
    assert np.nanmax(found.velocity[:, 0]) == pytest.approx(0.9)
    code, _, err = uuv(capfd, "identify", path, "--system", "3")
    assert code == 2 and "no motors of --system 3 in it; it has those of 1, 2" in err


def test_a_dataflash_log_that_begins_anew(tmp_path):
    found = read(tmp_path, dataflash([*drive(), *drive()]))
    assert [STEP_S * len(one.rpm) for one in found] == pytest.approx([SECONDS, SECONDS], abs=0.3)


def test_tlog_in_our_axes(tmp_path):
    (found,) = read(tmp_path, tlog(), "drive.tlog")
    assert len(found.rpm) * STEP_S == pytest.approx(SECONDS, abs=0.3)
    seen = ~np.isnan(found.velocity[:, 0])
    assert seen.sum() == pytest.approx(SECONDS / 0.1, abs=3)
    np.testing.assert_allclose(found.velocity[seen][:, :3], [[0.3, -0.2, -0.1]] * seen.sum(), atol=1e-6)
    np.testing.assert_allclose(found.tilt_rate, [[0.01, -0.02]] * len(found.rpm), atol=1e-6)
    assert (found.rpm[25] != 0).sum() == 1


def without(name):
    return dataflash(row for row in drive() if row[0] != name)


BAD = {
    "text.bin": (b"no log at all", "does not begin like"),
    "empty.bin": (b"", "does not begin like"),
    "head.bin": (b"\xa3\x95\x80", "holds no pulse widths"),
    "pulses.bin": (without("RCOU"), "holds no pulse widths"),
    "angles.bin": (without("ATT"), "holds no attitude"),
    "rates.bin": (without("IMU"), "holds no rates"),
    "speeds.bin": (without("VISO"), "holds no velocity"),
    "text.tlog": (b"no log at all" * 50, "holds no pulse widths"),
    "empty.tlog": (b"", "holds no pulse widths"),
    "short.bin": (dataflash(drive()), "stretches of 5 s"),
    "form.bin": (dataflash([], {"PARM": (1, "QN~", "TimeUS,Name,Value")}),
        "is damaged (Exception: Unsupported format"),
    "ancient.bin": (dataflash([("RCOU", (0, 1500))], {"RCOU": (2, "IH", "TimeMS,Ch1")}),
        "are of a firmware that is not read (TimeUS); give a log of ArduSub 3.5 or later"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_logs_are_refused(name, tmp_path, capfd):
    content, why = BAD[name]
    path = tmp_path / name
    path.write_bytes(content)
    code, out, err = uuv(capfd, "identify", path)
    assert (code, out) == (2, "") and why in " ".join(err.split())
    assert list(tmp_path.iterdir()) == [path]


def test_a_log_of_ardusubs_has_no_truth(tmp_path, capfd):
    path = tmp_path / "drive.bin"
    path.write_bytes(dataflash(drive()))
    code, _, err = uuv(capfd, "identify", path, "--truth")
    assert code == 2 and "leave --truth out" in err
    code, _, err = uuv(capfd, "identify", tmp_path / "none.tlog")
    assert code == 2 and "cannot be read" in err


@pytest.mark.parametrize("seed", range(12))
def test_damaged_logs_are_read_as_far_as_they_go_or_refused(seed, tmp_path):
    rng = np.random.default_rng(seed)
    content, name = (dataflash(drive()), "drive.bin") if seed % 2 else (tlog(), "drive.tlog")
    bytes_of = bytearray(content[: rng.integers(len(content) // 2, len(content))])
    for place in rng.integers(700, len(bytes_of), 20):
        bytes_of[place] = rng.integers(256)
    try:
        for found in read(tmp_path, bytes(bytes_of), name):
            assert np.isfinite(found.rpm).all() and np.isfinite(found.up).all()
    except DriveError as error:
        assert name in str(error)
