"""Adapters of the field's instruments: golden bytes, and what a network makes of them."""

import json
import math
import socket
import struct
import zlib
from functools import partial

import numpy as np
import pytest
from brping import PingMessage, definitions
from hypothesis import given
from hypothesis import strategies as st

from tests.mavlink_vehicle import Flight, free_port, link_config, plan_of
from tests.vehicle.test_sitl import StillWater, packet
from uuvtai.config.loader import load_config
from uuvtai.logs.reader import read_messages
from uuvtai.vehicle.control_loop import OnboardLoop
from uuvtai.vehicle.instruments import ping, rip2
from uuvtai.vehicle.instruments.a50 import A50
from uuvtai.vehicle.instruments.channel import Channel, InstrumentPlace, TcpChannel, UdpChannel, place_of
from uuvtai.vehicle.instruments.emulate import FakeA50, FakePing360, FakeRig, FakeSonar3D, emulated, ports_of
from uuvtai.vehicle.instruments.rig import PORTS, JsonUdp, Rig
from uuvtai.vehicle.mavlink import LinkError
from uuvtai.vehicle.messages import MOST_WAITING, DepthShot, DvlReading, Inbox, SonarPing
from uuvtai.vehicle.sitl import Instance


class Played(Channel):
    """A channel that a test fills."""

    def __init__(self, *pieces: bytes) -> None:
        self.pieces, self.sent, self.opened = list(pieces), [], 1

    def read(self, now_s: float) -> list[bytes]:
        found, self.pieces = self.pieces, []
        return found

    def write(self, data: bytes) -> bool:
        self.sent.append(data)
        return True

    def close(self) -> None:
        pass


# ------------------------------------------------------------------------------------------------------ A50


def line(**changed) -> bytes:
    said = {
        "time": 106.4, "vx": 0.3, "vy": 0.1, "vz": -0.2, "fom": 0.0016, "altitude": 0.49, "transducers": [],
        "velocity_valid": True, "status": 0, "format": "json_v3.1", "type": "velocity",
        "time_of_validity": 1638191471563017, "time_of_transmission": 1638191471752336,
    }  # fmt: skip
    return json.dumps(said | changed).encode() + b"\r\n"


def a50(*pieces: bytes, yaw_rad: float = 0.0) -> A50:
    return A50(Played(*pieces), yaw_rad, 0.1, 0.05)


def test_a_line_of_the_makers_page_is_a_velocity_in_our_axes():
    (reading,) = a50(line()).poll(20.0)
    assert np.allclose(reading.vel_b, [0.3, -0.1, 0.2])
    assert reading.time_s == pytest.approx(20.0 - 0.189319)  # transmission less validity


def test_what_a_relay_says_again_is_not_believed_again():
    assert len(a50(line(), line(vx=0.1), line(vx=0.1)).poll(1.0)) == 2
    device = sonar3d(GOLDEN, GOLDEN)
    assert len(device.poll(1.0)) == 2 and device.refused == {"the same again": 1}


def test_a_device_mounted_at_an_angle_is_turned_back():
    (reading,) = a50(line(vx=0.3, vy=0.0, vz=0.0), yaw_rad=math.pi / 2).poll(1.0)
    assert np.allclose(reading.vel_b, [0.0, 0.3, 0.0])


def test_a_firmware_without_stamps_counts_as_late_as_the_rig_says():
    told = json.loads(line())
    for name in ("type", "time_of_validity", "time_of_transmission"):
        told.pop(name)
    (reading,) = a50(json.dumps(told).encode() + b"\n").poll(3.0)
    assert reading.time_s == pytest.approx(2.95)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"velocity_valid": False}, "bottom is lost"),
        ({"velocity_valid": 1}, "without its numbers"),
        ({"fom": 0.3}, "figure of merit"),
        ({"fom": -1.0}, "figure of merit"),
        ({"vx": None}, "without its numbers"),
        ({"vx": "0.3"}, "without its numbers"),
        ({"vx": True}, "without its numbers"),
        ({"type": "position_local"}, "position_local: not used"),
    ],
)
def test_what_is_no_valid_velocity_is_counted_and_not_told(changed, why):
    dvl = a50(line(**changed), line())
    assert len(dvl.poll(1.0)) == 1
    assert any(why in reason for reason in dvl.refused)


@pytest.mark.parametrize(
    "bad", [b"{\n", b"[1]\n", b"\xff\xfe\n", b"[" * 9000 + b"\n", b'{"vx": NaN}\n', b"1" * 20000 + b"\n"]
)
def test_a_line_that_is_none_is_passed_over(bad):
    dvl = a50(bad, line())
    assert len(dvl.poll(1.0)) == 1
    assert sum(dvl.refused.values()) == 1


def test_a_line_may_come_in_pieces():
    whole, dvl = line(), a50()
    for at in range(0, len(whole), 7):
        dvl.channel.pieces = [whole[at : at + 7]]
        found = dvl.poll(1.0)
    assert len(found) == 1


def test_a_line_without_end_does_not_grow():
    dvl = a50(*[b"x" * 4096] * 8)
    assert dvl.poll(1.0) == [] and dvl._rest == b""
    dvl.channel.pieces = [b"\n" + line()]
    assert len(dvl.poll(2.0)) == 1


def test_a_piece_from_before_a_restart_is_forgotten():
    dvl = a50(line()[:50])
    dvl.poll(1.0)
    dvl.channel.opened, dvl.channel.pieces = 2, [line(time_of_validity=10, time_of_transmission=60_010)]
    (reading,) = dvl.poll(9.0)
    assert reading.time_s == pytest.approx(8.94)


# ----------------------------------------------------------------------------------------------------- ping


SONAR = load_config("pool", "ping360").sensors.sonar


def made(number: int, **fields) -> bytes:
    """A frame as the maker's own package builds it."""
    message = PingMessage(number)
    for name, value in fields.items():
        setattr(message, name, value)
    return bytes(message.pack_msg_data())


def profile(range_m: float, bin_m: float) -> bytes:
    noise = np.full(1200, 6.0)
    at = (np.arange(1200) + 0.5) * bin_m
    noise += 255.0 * np.exp(-at / 0.04) + 150.0 * np.exp(-0.5 * ((at - range_m) / 0.02) ** 2)
    return np.clip(noise, 0, 255).astype(np.uint8).tobytes()


PERIOD = 267
BIN_M = 0.5 * 25e-9 * PERIOD * 1500.0


def device_data(angle: int, range_m: float, number: int = definitions.PING360_DEVICE_DATA) -> bytes:
    data = bytearray(profile(range_m, BIN_M))
    return made(
        number, mode=1, gain_setting=1, angle=angle, transmit_duration=32, sample_period=PERIOD,
        transmit_frequency=740, number_of_samples=1200, data_length=1200, data=data,
    )  # fmt: skip


def ping360(*pieces: bytes) -> ping.Ping360:
    return ping.Ping360(Played(*pieces), SONAR, 200.0, 0.3, 1500.0)


@pytest.mark.parametrize("number", [definitions.PING360_DEVICE_DATA, definitions.PING360_AUTO_DEVICE_DATA])
def test_a_profile_of_the_makers_package_is_a_beam(number):
    (found,) = ping360(device_data(200 + 62, 3.0, number)).poll(5.0)
    assert found.first_beam == 0 and found.hit.tolist() == [1.0]  # clockwise of ahead: the right edge
    assert found.range_m[0] == pytest.approx(3.0, abs=0.02)
    assert found.time_s == pytest.approx(5.0 - 25e-9 * PERIOD * 1200)
    (ahead,) = ping360(device_data(200 - 62, 3.0, number)).poll(5.0)
    assert ahead.first_beam == SONAR.n_ray - 1


def test_a_quiet_profile_is_free_water_and_a_loud_one_is_unknown():
    (free,) = ping360(device_data(202, math.inf)).poll(1.0)
    assert free.hit.tolist() == [0.0] and free.range_m[0] == SONAR.max_range_m
    noisy = made(2300, angle=202, sample_period=PERIOD, number_of_samples=1200, data_length=1200,
                 data=bytearray(np.linspace(255, 20, 1200).astype(np.uint8).tobytes()))  # fmt: skip
    sonar = ping360(noisy)
    assert sonar.poll(1.0) == [] and any("neither" in why for why in sonar.refused)


@pytest.mark.parametrize("level", [0, 200, 255])
def test_a_transducer_that_is_dead_or_deaf_tells_of_no_free_water(level):
    assert math.isnan(ping.first_echo(np.full(1200, level, np.uint8), BIN_M, 0.3))


def test_profiles_that_come_together_were_taken_one_after_the_other():
    shapes = {"range_m": (1,), "hit": (1,), "doppler_m_s": (0,), "first_beam": ()}
    inbox, found = Inbox({f"sonar.{name}": shape for name, shape in shapes.items()}), []
    for each in ping360(*(device_data(202 + 4 * k, 3.0) for k in range(3))).poll(5.0):
        inbox.feed(each)
    while each := inbox.newest("sonar", 5.0, in_turn=True):
        found.append(each.first_beam)
    assert found == [15, 14, 13] and inbox.tallies["sonar"].late == 0


def test_an_echo_within_the_ring_down_is_none():
    assert ping.first_echo(np.frombuffer(profile(0.1, BIN_M), np.uint8), BIN_M, 0.3) == math.inf


@pytest.mark.parametrize(("period", "count"), [(PERIOD, 900), (2000, 200), (0, 1200), (65535, 10)])
def test_a_profile_that_another_program_asked_for_is_not_used(period, count):
    data = bytearray(profile(3.0, 0.5 * 25e-9 * max(period, 1) * 1500.0)[:count])
    other = made(2300, angle=202, sample_period=period, number_of_samples=count, data_length=count, data=data)
    sonar = ping360(other)
    assert sonar.poll(1.0) == [] and any("another program" in why for why in sonar.refused)


@pytest.mark.parametrize("angle", [200 + 62 + 4, 201])
def test_an_angle_that_no_beam_has_is_not_used(angle):
    sonar = ping360(device_data(angle, 3.0))
    assert sonar.poll(1.0) == [] and "an angle between the beams" in sonar.refused


def test_frames_are_found_among_pieces_wrong_sums_and_noise():
    frames, whole = ping.Frames(), device_data(202, 2.0)
    wrong = whole[:-1] + bytes([whole[-1] ^ 1])
    stream = b"BRxBR" + wrong + b"noise" + whole + b"BR\xff\xff\x00\x00\x00\x00" + whole + b"B"
    found = []
    for at in range(0, len(stream), 11):
        found += frames.take(stream[at : at + 11])
    found += frames.take(whole[1:])
    assert [number for number, _ in found] == [2300] * 3
    assert frames.broken >= 2
    sonar = ping360(wrong)
    assert sonar.poll(1.0) == [] and sonar.refused == {"a wrong sum, or a length that no frame has": 1}


def test_requests_are_those_of_the_makers_package():
    sonar = ping360()
    sonar.poll(0.0)
    (asked,) = sonar.channel.sent
    told = PingMessage(msg_data=bytearray(asked))
    assert told.verify_checksum() and told.message_id == definitions.PING360_AUTO_TRANSMIT
    assert (told.start_angle, told.stop_angle, told.num_steps, told.number_of_samples) == (138, 262, 4, 1199)
    sonar.poll(0.5)
    assert len(sonar.channel.sent) == 1
    sonar.poll(1.1)  # no answer: asked beam by beam
    told = PingMessage(msg_data=bytearray(sonar.channel.sent[-1]))
    assert told.verify_checksum() and told.message_id == definitions.PING360_TRANSDUCER
    assert told.angle == 262 and told.transmit == 1


# ---------------------------------------------------------------------------------------------- the network


def until(step, found, wanted, most=3000):
    """Steps of 20 ms of a made-up clock until so much was found."""
    for number in range(most):
        step(0.02 * number)
        if wanted(found):
            return 0.02 * number
    raise AssertionError(f"not within {most} steps: {found}")


def test_a_device_that_restarts_is_heard_again():
    fake = FakeA50("127.0.0.1", 0, lost=0.0)
    port, found = fake.port, []
    dvl = A50(TcpChannel("127.0.0.1", port), 0.0, 0.1, 0.05)

    def step(now_s):
        fake.tell(now_s, np.array([0.4, -0.1, 0.05]), 1.0)
        found.extend(dvl.poll(now_s))

    until(step, found, lambda them: len(them) >= 3)
    assert np.allclose(found[-1].vel_b, [0.4, -0.1, 0.05])
    fake.close()
    found.clear()
    fake = FakeA50("127.0.0.1", port, lost=0.0)
    until(step, found, lambda them: len(them) >= 3)
    fake.close()
    dvl.channel.close()


def test_a_device_that_lost_its_power_is_called_again():
    """It says no farewell, and its old connection stays open for ever."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        channel = TcpChannel("127.0.0.1", server.getsockname()[1])
        assert channel.read(0.0) == []
        first, _ = server.accept()
        first.send(b"old")
        found = [piece for number in range(200) for piece in channel.read(0.001 * number)]
        assert found == [b"old"] and channel.opened == 1
        assert channel.read(2.9) == []
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()
        for number in range(100):
            channel.read(3.3 + 0.02 * number)
        again, _ = server.accept()
        again.send(b"new")
        assert [piece for number in range(200) for piece in channel.read(5.4 + 0.001 * number)] == [b"new"]
        assert channel.opened == 2
        for one in (first, again, channel):
            one.close()


@pytest.mark.parametrize("own", [True, False])
def test_a_head_scans_there_and_back_and_all_around_when_asked_to(own):
    fake, found = FakePing360("127.0.0.1", 0, own=own), []
    channel = UdpChannel(InstrumentPlace("ping360", "127.0.0.1", fake.port), calls=True, longest=2048)
    sonar = ping.Ping360(channel, SONAR, 200.0, 0.3, 1500.0)

    def step(now_s, begun_s):
        fake.step(begun_s + now_s, lambda bearing: 3.0 + math.sin(bearing + 0.5))
        found.extend(sonar.poll(begun_s + now_s))

    fan, circle = set(range(SONAR.n_ray)), {gradian / 4 for gradian in range(400)}
    for begun_s, whole, beams in ((0.0, False, fan), (60.0, True, circle), (120.0, False, fan)):
        assert sonar.look_around(whole)
        found.clear()
        spent_s = until(partial(step, begun_s=begun_s), found, lambda them: len(them) >= 450)
        assert spent_s > 450 * 0.035  # a step of the head takes its time
        assert {one.first_beam for one in found} == beams  # all around as finely as it can
        for one in found:
            bearing = SONAR.first_beam_rad + one.first_beam * SONAR.beam_step_rad
            expected = 3.0 + math.sin(bearing + 0.5)
            assert one.hit[0] == 1.0 and one.range_m[0] == pytest.approx(expected, abs=0.03)
    sonar.close()
    fake.close()


def test_a_head_that_misses_a_request_while_it_scans_is_asked_again():
    fake, found = FakePing360("127.0.0.1", 0), []
    channel = UdpChannel(InstrumentPlace("ping360", "127.0.0.1", fake.port), calls=True, longest=2048)
    sonar = ping.Ping360(channel, SONAR, 200.0, 0.3, 1500.0)
    sonar.look_around(True)
    take, missed = fake._take, []
    for number in range(1500):
        if number == 400:
            sonar.look_around(False)
            fake._take = lambda *told: missed.append(told) if len(missed) < 3 else take(*told)
        fake.step(0.02 * number, lambda _bearing: 3.0)
        found += sonar.poll(0.02 * number)
    assert len(missed) == 3 and {one.first_beam for one in found[-150:]} == set(range(SONAR.n_ray))
    sonar.close()
    fake.close()


@pytest.mark.parametrize("own", [True, False])
def test_a_head_that_was_off_is_asked_the_quicker_way_again(own):
    fake, found = FakePing360("127.0.0.1", 0, own=own), []
    channel = UdpChannel(InstrumentPlace("ping360", "127.0.0.1", fake.port), calls=True, longest=2048)
    sonar = ping.Ping360(channel, SONAR, 200.0, 0.3, 1500.0)
    for off_s in (3.5, 4.5):  # in either way of asking
        sonar._by_itself, sonar._turns, sonar._asked_s, sonar._heard_s = True, 0, -math.inf, -math.inf
        for number in range(round(50 * (off_s + 6.0))):
            now_s = 0.02 * number
            if now_s >= off_s:
                fake.step(now_s, lambda _bearing: 2.0)
            found += sonar.poll(now_s)
        assert sonar._by_itself == own
    assert len(found) > 100
    sonar.close()
    fake.close()


def test_datagrams_of_others_are_not_heard():
    channel = UdpChannel(InstrumentPlace("json", "127.0.0.2", 0), calls=False, longest=64)
    other = UdpChannel(InstrumentPlace("json", "127.0.0.1", channel.port), calls=True, longest=64)
    assert other.write(b"{}")
    for _ in range(100):
        assert channel.read(0.0) == []
        if channel.strange:
            break
    assert channel.strange == 1
    channel.close()
    other.close()


def test_while_one_speaks_nobody_else_is_heard():
    """Where no host is named, and of a multicast group."""
    port = free_port()
    channel = UdpChannel(InstrumentPlace("json", "", port), calls=False, longest=64)
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for one, host in zip(senders, ("127.0.0.1", "127.0.0.2"), strict=True):
        one.bind((host, 0))

    def heard(now_s, *numbers):
        before, found = channel.strange, []
        for number in numbers:
            senders[number].sendto(str(number).encode(), ("127.0.0.1", port))
        for _ in range(1000):
            found += channel.read(now_s)
            if len(found) + channel.strange - before == len(numbers):
                return found
        raise AssertionError(f"not all has come: {found}")

    assert heard(0.0, 0, 1) == [b"0"]
    assert heard(2.9, 1, 0, 1) == [b"0"]
    assert heard(6.0, 1, 0) == [b"1"]  # the first one fell silent
    for one in (*senders, channel):
        one.close()


def test_places_are_read_as_the_help_writes_them():
    for option, ports in PORTS.items():
        for text in ("a50:192.168.2.95", "ping360:/dev/ttyUSB0", "3d15:224.0.0.96", "json::14700"):
            if text.partition(":")[0] in ports:
                place = place_of(text, f"--{option}", ports)
                assert place.host == text.split(":")[1] and place.port == ports[place.kind]


@pytest.mark.parametrize("text", ["a50", "a50:", "b60:host", "a50:host:0", "a50:host:70000", "a50:a b", ""])
def test_a_place_that_is_none_is_refused_in_a_line(text):
    if text == "a50:":
        assert place_of(text, "--dvl", {"a50": 16171}).host == ""
        return
    with pytest.raises(LinkError, match="--dvl"):
        place_of(text, "--dvl", {"a50": 16171})


@pytest.mark.parametrize("number", [definitions.PING360_TRANSDUCER, definitions.PING360_AUTO_TRANSMIT])
def test_a_request_for_too_much_does_not_end_the_emulator(number):
    fake = FakePing360("127.0.0.1", 0)
    other = UdpChannel(InstrumentPlace("ping360", "127.0.0.1", fake.port), calls=True, longest=2048)
    for samples in (65535, 1201, 0, 4):
        other.write(made(number, angle=65535, sample_period=0, number_of_samples=samples))
        for step in range(20):
            fake.step(0.02 * step, lambda _bearing: 2.0)
    fake.close()
    other.close()


def test_a_head_of_other_steps_is_refused():
    with pytest.raises(ValueError, match="gradians"):
        ping.Ping360(Played(), load_config("pool", "multibeam").sensors.sonar, 200.0, 0.3, 1500.0)
    assert struct.calcsize("<2sHHBB") == 8


# ---------------------------------------------------------------------------------------------------- 3D-15

GOLDEN = bytes.fromhex(
    "524950327f010000ee02f46d010aeb020a39747970652e676f6f676c65617069732e636f6d2f77617465726c696e6b65642e736f6e"
    "61722e70726f746f636f6c2e52616e6765496d61676512ad020a0f0a0b0880e2cfaa061080e59a771007150070ba441d0000704120"
    "809f49281030083d0000b44245000020424d6f12833a52f801d00fb410981100e012c413a8148c15f015d416b8179c188019e419c8"
    "1aac1bda0fbe10a21100ea12ce13b2149615fa15de16c217a6188a19ee19d21ab61be40fc810ac1100f412d813bc14a0158416e816"
    "cc17b0189419f819dc1ac01bee0fd210b61100fe12e213c614aa158e16f216d617ba189e19821ae61aca1bf80fdc10c011008813ec"
    "13d014b4159816fc16e017c418a8198c1af01ad41b8210e610ca11009213f613da14be15a2168617ea17ce18b219961afa1ade1b8c"
    "10f010d411009c138014e414c815ac169017f417d818bc19a01a841be81b9610fa10de1100a6138a14ee14d215b6169a17fe17e218"
    "c619aa1a8e1bf21bb53ce4ec"
)
"""16 x 8 pixels of 90 x 40 degrees, pixel (x, y) = 2 m + 0.1 x + 0.01 y, none in column 3 (wlsonar 0.5.5)"""
IMU_BATCH = bytes.fromhex(
    "524950324e0000003ff03e0a3d0a37747970652e676f6f676c65617069732e636f6d2f77617465726c696e6b65642e736f6e61722e"
    "70726f746f636f6c2e496d75426174636812021001f1059dda"
)
FAN = load_config(
    "pool",
    "multibeam",
    overrides=[
        ("sensors.sonar.horizontal_aperture_deg", 90),
        ("sensors.sonar.n_ray", 64),
        ("sensors.depth.rows", 44),
    ],
)


def test_a_packet_of_the_makers_package_is_an_image():
    image = rip2.image_of(GOLDEN)
    assert isinstance(image, rip2.RangeImage)
    y, x = np.mgrid[:8, :16]
    assert np.allclose(image.range_m, np.where(x == 3, 0.0, 2.0 + 0.1 * x + 0.01 * y), atol=1e-6)
    assert np.degrees(image.fov_rad) == pytest.approx([90.0, 40.0]) and image.max_range_m == 15.0
    assert image.sent_s == pytest.approx(1700000000.25)


def sonar3d(*packets: bytes) -> rip2.Sonar3D:
    return rip2.Sonar3D(Played(*packets), FAN)


def test_what_lies_level_is_a_scan_and_all_of_it_an_image():
    ping_, shot = sonar3d(GOLDEN).poll(8.0)
    assert ping_.time_s == shot.time_s == 8.0
    assert ping_.range_m[0] == pytest.approx(3.5, abs=0.05)  # beam 0 is the right edge, column 15
    assert ping_.range_m[-1] == pytest.approx(2.0, abs=0.05)
    empty = ping_.hit == 0.0
    assert 2 <= empty.sum() <= 6 and (ping_.range_m[empty] == FAN.sensors.sonar.max_range_m).all()
    assert shot.depth_m.shape == (44, 128)
    middle = shot.depth_m[22, 64]
    assert middle == pytest.approx(2.75, abs=0.1)
    assert shot.depth_m[22, 127] == pytest.approx(3.5 * math.cos(math.radians(45)), abs=0.1)  # to starboard
    assert shot.depth_m[0, 64] > shot.depth_m[43, 64]  # above is row 7 of the device


def test_the_preset_takes_the_rows_beside_the_middle():
    """Of an image of eight rows too, none of which is as level as the preset asks for."""
    scan, shot = rip2.Sonar3D(Played(GOLDEN), load_config("pool", "3d15")).poll(1.0)
    assert scan.range_m[0] == pytest.approx(3.53, abs=0.05) and shot.depth_m.shape == (44, 128)


def test_pieces_and_wrong_packets_are_counted_and_not_told():
    for at in (0, 3, 8, 12, len(GOLDEN) - 1):
        assert isinstance(rip2.image_of(GOLDEN[:at]), str)
    for at in range(0, len(GOLDEN), 5):
        bad = GOLDEN[:at] + bytes([GOLDEN[at] ^ 255]) + GOLDEN[at + 1 :]
        assert isinstance(rip2.image_of(bad), str)
    assert rip2.image_of(IMU_BATCH) == "ImuBatch: not used"
    device = sonar3d(GOLDEN[:-1], IMU_BATCH, GOLDEN)
    assert len(device.poll(1.0)) == 2 and sum(device.refused.values()) == 2


def packed(content: bytes, head: bytes = b"RIP2") -> bytes:
    whole = head + struct.pack("<I", len(content) + 12) + content
    return whole + struct.pack("<I", zlib.crc32(whole))


def test_a_packet_that_unfolds_without_end_is_refused_before_it_does():
    assert "unfolds" in rip2.image_of(packed(b"\xff\xff\xff\xff\x0f" + b"\x00" * 8))
    assert "no RIP2" in rip2.image_of(packed(b"\x05hello"))


@given(st.binary(max_size=200))
def test_no_bytes_break_an_adapter(data):
    assert isinstance(rip2.image_of(packed(data)), str)
    for device in (a50(data + b"\n"), ping360(data), sonar3d(data), JsonUdp(Played(data))):
        assert device.poll(1.0) == []


def test_another_view_than_the_first_is_not_used(monkeypatch):
    """Somebody else's packet must not end a flight."""
    device = sonar3d(GOLDEN)
    assert len(device.poll(1.0)) == 2
    image = rip2.image_of(GOLDEN)
    monkeypatch.setattr(rip2, "image_of", lambda _packet: image._replace(fov_rad=(0.1, 0.1)))
    device.channel.pieces = [GOLDEN + b"2"]
    assert device.poll(2.0) == [] and any("than the first" in why for why in device.refused)


def test_a_camera_that_sees_more_than_the_device_is_refused():
    wide = load_config("pool", "multibeam", overrides=[("sensors.sonar.horizontal_aperture_deg", 90)])
    with pytest.raises(ValueError, match="rows=44"):
        rip2.Sonar3D(Played(GOLDEN), wide).poll(1.0)
    with pytest.raises(ValueError, match="looks ahead"):
        rip2.Sonar3D(Played(), load_config("pool", "ping360"))


# ----------------------------------------------------------------------------------------------------- JSON


def told(**said) -> list:
    return JsonUdp(Played(json.dumps(said).encode())).poll(10.0)


def test_json_of_each_kind_is_a_message():
    (dvl,) = told(kind="dvl", age_s=0.1, vel_b=[0.1, 0.2, 0.3])
    assert dvl.time_s == pytest.approx(9.9) and dvl.vel_b.tolist() == [0.1, 0.2, 0.3]
    (beams,) = told(kind="sonar", range_m=[2.0], hit=[1], doppler_m_s=[], first_beam=7)
    assert beams.first_beam == 7 and beams.range_m.tolist() == [2.0]
    (pressure,) = told(kind="pressure", depth_m=0.7)
    assert pressure.depth_m == 0.7 and pressure.time_s == 10.0


@pytest.mark.parametrize(
    "said",
    [
        {"kind": "dvl"}, {"kind": "gps", "vel_b": [0, 0, 0]}, {"vel_b": [0, 0, 0]},
        {"kind": "dvl", "vel_b": "fast"}, {"kind": "dvl", "vel_b": [0, 0, 0], "time_s": 3},
        {"kind": "dvl", "vel_b": [0, 0, 0], "age_s": -1}, {"kind": "dvl", "vel_b": [0, 0, 0], "age_s": 60},
        {"kind": ["dvl"], "vel_b": [0, 0, 0]}, {"kind": "dvl", "vel_b": [[0], [0, 1]]},
        {"kind": "sonar", "range_m": [1], "hit": [1], "doppler_m_s": [], "first_beam": 1e400},
    ],
)  # fmt: skip
def test_json_that_is_no_message_is_counted(said):
    device = JsonUdp(Played(json.dumps(said).encode()))
    assert device.poll(1.0) == [] and sum(device.refused.values()) == 1


# -------------------------------------------------------------------------------------------- in the pilot


def test_beams_that_come_in_a_burst_are_taken_in_turn():
    inbox = Inbox(
        {"sonar.range_m": (-1,), "sonar.hit": (-1,), "sonar.doppler_m_s": (0,), "sonar.first_beam": ()}
    )
    for number, time_s in enumerate((0.10, 0.14, 0.12, 0.12)):
        inbox.feed(SonarPing(time_s, np.ones(1), np.ones(1), np.zeros(0), number))
    taken = [inbox.newest("sonar", 0.2, in_turn=True) for _ in range(4)]
    assert [one.time_s if one else None for one in taken] == [0.10, 0.12, 0.14, None]
    tally = inbox.tallies["sonar"]
    assert (tally.fed, tally.used, tally.late) == (4, 3, 1)


def test_a_flood_does_not_grow():
    inbox = Inbox({})
    for number in range(2 * MOST_WAITING):
        inbox.feed(DvlReading(1.0 + 1e-3 * number, np.zeros(3)))
    assert len(inbox._waiting["dvl"]) == MOST_WAITING and inbox.tallies["dvl"].late == MOST_WAITING
    newest = inbox.newest("dvl", 10.0)
    assert newest is not None and newest.time_s == pytest.approx(1.0 + 1e-3 * (2 * MOST_WAITING - 1))


@pytest.fixture
def rig_config():
    return load_config("pool", "ping360", overrides=[("sensors.dvl.position_b_m", [0.0, 0.0, -0.2])])


def test_a_rig_gives_velocities_about_the_centre_and_only_what_was_asked_for(rig_config):
    port = free_port()
    with Rig(rig_config, {"dvl": f"json:127.0.0.1:{port}"}) as rig:
        other = UdpChannel(InstrumentPlace("json", "127.0.0.1", port), calls=True, longest=2048)
        said = {"kind": "dvl", "vel_b": [0.5, 0.0, 0.0]}, {"kind": "pressure", "depth_m": 0.5}
        for one in said:
            other.write(json.dumps(one).encode())
        found = []
        for _ in range(200):
            found += list(rig.poll(1.0, np.array([0.0, 0.5, 0.0])))
            if found and rig.document()[f"json:127.0.0.1:{port}"]["heard"] == 2:
                break
        ((_, reading),) = found
        assert np.allclose(reading.vel_b, [0.6, 0.0, 0.0])  # less rate x lever
        assert rig.document()[f"json:127.0.0.1:{port}"]["refused"] == {"pressure: not asked for": 1}
        other.close()
    assert rig.replaced == {"dvl"}


@pytest.mark.parametrize("vel_b", [[1e6, 0, 0], [1e300, 0, 0], [0, 0]])
def test_a_velocity_that_cannot_be_is_no_reading(vel_b):
    port = free_port()
    with Rig(link_config(), {"dvl": f"json:127.0.0.1:{port}"}) as rig:
        other = UdpChannel(InstrumentPlace("json", "127.0.0.1", port), calls=True, longest=2048)
        other.write(json.dumps({"kind": "dvl", "vel_b": vel_b}).encode())
        for _ in range(1000):
            assert list(rig.poll(1.0, np.zeros(3))) == []
            if rig.document()[f"json:127.0.0.1:{port}"]["refused"]:
                break
        assert rig.document()[f"json:127.0.0.1:{port}"]["refused"]
        other.close()


def test_what_an_instrument_tells_mavlink_tells_no_more(tmp_path):
    port = free_port()
    with Rig(link_config(), {"dvl": f"json::{port}"}) as rig:
        flight = Flight(tmp_path)
        flight.loop = OnboardLoop(
            link_config(), flight.pilot, plan_of(flight.endpoint.place, flight.log.path), flight.endpoint,
            flight.log, rig=rig,
        )  # fmt: skip
        flight.run(2)
        assert flight.loop.last.action.name == "HOLD" and flight.sub.moved_by() == []
        refused = flight.loop.document()["refused"]
        assert any("--dvl names an instrument" in why for why in refused)
        other = UdpChannel(InstrumentPlace("json", "127.0.0.1", port), calls=True, longest=2048)
        good = json.dumps({"kind": "dvl", "vel_b": [0.3, 0.0, 0.0]}).encode()
        bad = json.dumps({"kind": "dvl", "vel_b": [0.0, 0.0]}).encode()
        flight.run(5, before=lambda step: (other.write(good), other.write(bad)))
        assert flight.loop.last.action.name == "DRIVE" and flight.sub.moved_by()
        told = flight.loop.document()["instruments"][f"json::{port}"]
        assert told["heard"] > 100 and told["refused"]["dvl: a velocity has three numbers"] > 100
        flight.run(5)  # the instrument is silent: it holds, whatever the autopilot says of its velocity
        assert flight.loop.last.action.name in ("HOLD", "HAND_BACK")
        other.close()
        flight.close()
    (first, *_) = read_messages(flight.log.path, ("/instruments/read",))
    assert "dvl" in str(first)


def test_when_our_clock_has_jumped_a_dvl_is_dated_anew():
    """Else each of its readings would be as old as the jump was long."""
    config, fake = link_config(), FakeA50("127.0.0.1", 0, lost=0.0)
    with Rig(config, {"dvl": f"a50:127.0.0.1:{fake.port}"}) as rig:
        ages = []
        for step in range(200):
            jump_s = 0.6 if step >= 100 else 0.0
            if step == 100:
                rig.forget_clocks()
            fake.tell(0.02 * step, np.zeros(3), 1.0)
            now_s = 0.02 * step + jump_s
            ages += [now_s - reading.time_s for _, reading in rig.poll(now_s, np.zeros(3))]
        fake.close()
    assert len(ages) > 20 and max(ages) < 0.1


def test_a_place_that_somebody_holds_is_refused_in_a_line(rig_config):
    port = free_port()
    with Rig(rig_config, {"dvl": f"json::{port}"}), pytest.raises(LinkError, match=str(port)):
        Rig(rig_config, {"dvl": f"json::{port}"})


def test_what_a_sitl_instrument_says_the_pilot_hears():
    """Water, an A50 and a Ping360 by their own protocols, and the rig of the pilot; the levers cancel."""
    mounted = [("sensors.dvl.position_b_m", [0.1, 0.0, -0.2]), ("sensors.dvl.yaw_deg", 90)]
    config = load_config("pool", "ping360", overrides=mounted)
    wide = emulated(config, ("a50", "ping360"))
    water, rates = StillWater(), np.array([0.0, 0.1, 0.3])
    told = water.value

    def value(name, row):
        ring = {"scan.range_m": np.full(400, 4.0), "scan.hit": np.ones(400, int), "ego.rate_b": rates}
        return ring[name] if name in ring else told(name, row)

    water.value = value
    ports = {"a50": free_port(), "ping360": free_port()}
    places = {
        "dvl": f"a50:127.0.0.1:{ports['a50'] + 30}",
        "sonar": f"ping360:127.0.0.1:{ports['ping360'] + 30}",
    }
    with Rig(config, places) as rig:
        fake = FakeRig(wide, ports, "127.0.0.1", 3)
        one, found = Instance(wide, water, 0, fake), []
        kinds = {order.kind for count in range(3) for order in one.answer(packet(count), 0.0)[1]}
        assert kinds == {"DISTANCE_SENSOR"}
        for count in range(3, 2400):
            one.answer(packet(count), 0.0)
            found += [reading for _, reading in rig.poll(one.time_s, rates)]
        fake.close()
    dvl = [one for one in found if isinstance(one, DvlReading)]
    beams = [one for one in found if isinstance(one, SonarPing)]
    assert len(dvl) > 20 and all(np.allclose(one.vel_b, [0.3, -0.1, 0.2], atol=1e-6) for one in dvl)
    assert len({one.first_beam for one in beams}) == config.sensors.sonar.n_ray
    assert all(one.hit[0] == 1 and abs(one.range_m[0] - 4.0) < 0.05 for one in beams)


def test_a_beam_of_a_sitl_ping360_is_as_wide_as_the_heads(monkeypatch):
    config, heard = emulated(load_config("pool", "ping360"), ("ping360",)), []
    ranges, hit = np.full(400, 4.0), np.ones(400, int)
    ranges[10], hit[13] = 2.0, 0

    def step(self, now_s, echo):
        heard.extend(echo(math.radians(0.9 * number)) for number in range(8, 14))

    monkeypatch.setattr(FakePing360, "step", step)
    fake = FakeRig(config, {"ping360": free_port()}, "127.0.0.1", 0)
    fake.step(0.0, 1.0, {"scan.range_m": ranges, "scan.hit": hit}.__getitem__)
    fake.close()
    assert heard == [4.0, 2.0, 2.0, 2.0, 4.0, 4.0]


def test_a_sitl_3d15_shows_what_its_camera_sees():
    """A wall across at 4 m, and a bar above to port that only some rows see."""
    port = free_port()
    config = emulated(FAN, ("3d15",))
    camera, told_s = config.sensors.depth, (0.0, 0.1, 0.2, 0.4)
    depth_m = np.full((camera.rows, camera.cols), 4.0)
    depth_m[: camera.rows // 5, : camera.cols // 4] = 2.0
    depth_m[:, -camera.cols // 5 :] = camera.max_range_m
    with Rig(FAN, {"sonar": f"3d15:127.0.0.1:{port}"}) as rig:
        fake, found = FakeSonar3D("127.0.0.1", port, camera), []
        for now_s in told_s:
            fake.tell(now_s, depth_m)
            found += [reading for _, reading in rig.poll(now_s, np.zeros(3))]
        fake.close()
    scans, images = ([one for one in found if isinstance(one, kind)] for kind in (SonarPing, DepthShot))
    assert len(scans) == len(images) == 3, "five a second"
    sonar = FAN.sensors.sonar
    bearing = sonar.first_beam_rad + sonar.beam_step_rad * np.arange(sonar.n_ray)
    ahead = np.abs(bearing) < np.radians(25)
    assert np.allclose(scans[0].range_m[ahead], 4.0 / np.cos(bearing[ahead]), atol=0.05)
    assert scans[0].hit[ahead].all() and not scans[0].hit[: sonar.n_ray // 8].any(), "nothing to starboard"
    seen = images[0].depth_m
    assert seen[0, 0] == pytest.approx(2.0, abs=0.05) and seen[-1, 0] == pytest.approx(4.0, abs=0.05)
    assert seen[0, -1] == FAN.sensors.depth.max_range_m


def test_a_sitl_ring_is_told_as_json():
    config, port = load_config("pool", "nominal", overrides={"sensors.sonar.doppler": False}), free_port()
    n_ray = config.sensors.sonar.n_ray
    seen = {
        "scan.fresh": 1,
        "scan.range_m": np.linspace(1.0, 5.0, n_ray + 8),
        "scan.hit": np.arange(n_ray + 8) % 3,
    }
    with Rig(config, {"sonar": f"json:127.0.0.1:{port}"}) as rig:
        fake = FakeRig(config, {"json": port - 20, "autopilot": 1}, "127.0.0.1", 2)
        assert fake.speaks == {"sonar"}
        fake.step(0.0, 1.0, seen.__getitem__)
        fake.step(0.02, 1.0, (seen | {"scan.fresh": 0}).__getitem__)
        ((_, scan),) = rig.poll(0.5, np.zeros(3))
        fake.close()
    assert np.allclose(scan.range_m, seen["scan.range_m"][:n_ray], atol=1e-3)
    assert (scan.hit == (seen["scan.hit"][:n_ray] > 0)).all() and scan.time_s == 0.5


def test_an_instrument_that_cannot_be_had_is_refused_in_a_line():
    config = load_config("pool", "ping360")
    ports = {"a50": free_port(), "ping360": free_port()}
    fake = FakeRig(config, {"a50": ports["a50"]}, "127.0.0.1", 4)
    with pytest.raises(LinkError, match=f"--as: cannot listen at port {ports['a50'] + 40}"):
        FakeRig(config, ports, "127.0.0.1", 4)
    fake.close()
    for text in ("a50,oculus", "a50:", "a50:70000", "a50:x", "a50:-1", "", "a50,"):
        with pytest.raises(LinkError, match="a50 or ping360"):
            ports_of(text)
    assert ports_of("a50:16200,3d15") == {"a50": 16200, "3d15": 4747}
