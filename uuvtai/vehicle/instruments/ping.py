"""Blue Robotics' Ping360: the ping-protocol.

A frame: ``BR``, payload length u16, message number u16, source u8, destination u8, payload, sum of all before
u16, little endian. Source: docs.bluerobotics.com/ping-protocol.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np

from uuvtai.common.errors import SettingError
from uuvtai.config import SonarConfig
from uuvtai.vehicle.instruments.channel import Channel, Instrument
from uuvtai.vehicle.messages import SensorMessage, SonarPing

PORT = 9092
BAUD = 115200
TRANSDUCER, AUTO_TRANSMIT, MOTOR_OFF = 2601, 2602, 2903
DEVICE_DATA, AUTO_DEVICE_DATA = 2300, 2301
_HEAD, _SUM = struct.Struct("<2sHHBB"), struct.Struct("<H")
LONGEST = 1300  # [bytes] of a payload: 1,200 samples and what is said of them
MOST_SAMPLES = 1200  # of a profile
TICK_S = 25e-9  # a sample period is counted in


def frame(number: int, payload: bytes = b"", source: int = 0, to: int = 0) -> bytes:
    """Bytes of a message."""
    content = _HEAD.pack(b"BR", len(payload), number, source, to) + payload
    return content + _SUM.pack(sum(content) & 0xFFFF)


class Frames:
    """Finds frames in pieces of a stream; what is none is passed over byte by byte."""

    def __init__(self) -> None:
        self._rest = b""
        self.broken = 0  # wrong sums, and lengths that no frame has

    def take(self, piece: bytes) -> list[tuple[int, bytes]]:
        """(number, payload) of the frames that are whole now."""
        data, at, found = self._rest + piece, 0, []
        while (at := data.find(b"BR", at)) >= 0 and len(data) - at >= _HEAD.size:
            _, size, number, _, _ = _HEAD.unpack_from(data, at)
            end = at + _HEAD.size + size
            if size <= LONGEST and len(data) < end + _SUM.size:
                break
            if size > LONGEST or sum(data[at:end]) & 0xFFFF != _SUM.unpack_from(data, end)[0]:
                self.broken, at = self.broken + 1, at + 2
                continue
            found.append((number, data[at + _HEAD.size : end]))
            at = end + _SUM.size
        self._rest = data[at:] if at >= 0 else data[-1:]
        return found

    def forget(self) -> None:
        """The stream was cut."""
        self._rest = b""


# ---- Where a profile of echo strengths first stands out of its surroundings (CFAR, greatest of: the
# ring-down of the transducer hides what lies in it and is no echo).

_SMOOTH_M, _GUARD_M, _AROUND_M = 0.02, 0.06, 0.30
_FACTOR, _ABOVE = 1.5, 12.0  # an echo is so many times its surroundings, and so much of 255 above them
_RINGS_M = 0.5  # a transducer may ring so far; a profile that is loud beyond, without an echo, tells nothing
_ALIVE, _DEAF = 50, 80  # nor does one that does not ring so loud, or in whose noise an echo may not stand out


def first_echo(profile: np.ndarray, bin_m: float, blind_m: float) -> float:
    """[m] to the first echo beyond ``blind_m`` of a profile (n,) of u8 with bins of ``bin_m``; infinite where
    the whole profile is quiet, NaN where it is neither: then nobody knows."""
    n, total = len(profile), np.concatenate([[0.0], np.cumsum(profile, dtype=float)])
    smooth, guard, around = (max(1, round(m / bin_m)) for m in (_SMOOTH_M, _GUARD_M, _AROUND_M))
    at = np.arange(n)

    def mean(first: np.ndarray, stop: np.ndarray) -> np.ndarray:
        first, stop = np.clip(first, 0, n), np.clip(stop, 0, n)
        count = stop - first
        return np.where(count > around // 3, (total[stop] - total[first]) / np.maximum(count, 1), 0.0)

    low, high = np.maximum(at - smooth // 2, 0), np.minimum(at + smooth // 2 + 1, n)
    level = (total[high] - total[low]) / (high - low)
    around_it = np.maximum(
        mean(at - guard - around, at - guard), mean(at + guard + 1, at + guard + 1 + around)
    )
    stands = (level > _FACTOR * around_it + _ABOVE) & (at >= blind_m / bin_m)
    if stands.any():
        first = int(np.argmax(stands))
        ends = first + int(np.argmin(np.append(stands[first:], False)))
        return (first + int(np.argmax(level[first:ends])) + 0.5) * bin_m
    beyond = level[at >= blind_m / bin_m]
    if not len(beyond):
        return math.nan
    loud = np.flatnonzero(beyond > np.median(beyond) + _ABOVE)
    is_quiet = blind_m + bin_m * (loud.max(initial=-1) + 1) <= max(_RINGS_M, 2.0 * blind_m)
    is_quiet &= profile[: round(_RINGS_M / bin_m)].max() >= _ALIVE and np.median(beyond) <= _DEAF
    return math.inf if is_quiet else math.nan


class Ping360(Instrument):
    """A mechanical head: it is asked to scan the config's beams there and back by itself (2602); a firmware
    that does not is asked beam by beam (2601)."""

    _SILENT_S = 1.0  # without an answer it is asked anew, in turns in both ways
    _MOST_ASTRAY = 20  # so many beams, and it is asked anew: while it scans, a request may be lost

    def __init__(
        self, channel: Channel, sonar_cfg: SonarConfig, zero_gradian: float, blind_m: float, sound_m_s: float
    ) -> None:
        """``zero_gradian``: the device's angle that looks ahead, counted clockwise; ``blind_m``: nearer
        echoes are the transducer's own. SettingError for beams that are no steps of the device."""
        super().__init__(channel)
        self._sonar, self._zero, self._blind, self._sound = sonar_cfg, zero_gradian, blind_m, sound_m_s
        self._frames, self._opened = Frames(), 0
        step = math.degrees(sonar_cfg.beam_step_rad) / 0.9
        self._step = round(step)
        if not sonar_cfg.mechanical or abs(step - self._step) > 1e-6 or not 1 <= self._step <= 10:
            raise SettingError(
                f"sensors.sonar: {sonar_cfg.n_ray} beams in {sonar_cfg.horizontal_aperture_deg:g} degrees "
                "are no steps of 1 to 10 gradians of one turned beam; take --sensors ping360"
            )
        self._whole, self._stride = sonar_cfg.is_ring, self._step
        """whether it turns all around; gradians that it turns by"""
        self._asked_s = self._heard_s = -math.inf
        self._by_itself, self._way = True, 1
        self._at = 0  # [gradian] from beam 0 to the one that is asked for next
        self._turns = self._astray = 0
        """changes of the way of asking since it answered last; beams beside those asked for since then"""
        seconds = 2.0 * sonar_cfg.max_range_m / sound_m_s
        self._period = max(80, math.ceil(seconds / (MOST_SAMPLES * TICK_S)))
        self._samples = min(MOST_SAMPLES, math.ceil(seconds / (self._period * TICK_S)))
        self._listens_s = TICK_S * self._period * self._samples

    def poll(self, now_s: float) -> list[SensorMessage]:
        pieces, found = self.channel.read(now_s), []
        if self.channel.opened != self._opened:
            self._opened = self.channel.opened
            self._frames.forget()
        for piece in pieces:
            for number, payload in self._frames.take(piece):
                if (ping := self._ping(number, payload, now_s)) is not None:
                    found.append(ping)
        for back, ping in enumerate(reversed(found)):  # of several the first were taken before the last
            found[-1 - back] = replace(ping, time_s=ping.time_s - back * self._listens_s)
        if self._frames.broken:
            self.refused["a wrong sum, or a length that no frame has"] = self._frames.broken
        self._ask(now_s)
        return found

    def look_around(self, whole: bool) -> bool:
        stride = 1 if whole else self._step
        if self._stride != stride:
            self._whole, self._stride, self._asked_s = whole or self._sonar.is_ring, stride, -math.inf
            self._at, self._way = 0, 1  # what was asked for last may lie beside the fan
        return True

    def close(self) -> None:
        """Stop the motor, give the place back."""
        self.channel.write(frame(MOTOR_OFF))
        self.channel.close()

    def _ask(self, now_s: float) -> None:
        """Begin, begin again where nothing comes, or ask for the next beam."""
        is_silent = now_s - max(self._heard_s, self._asked_s) > self._SILENT_S
        if is_silent and self._asked_s > -math.inf:
            self._by_itself, self._turns = not self._by_itself, self._turns + 1
        is_new = self._asked_s == -math.inf or self._astray >= self._MOST_ASTRAY
        if self._by_itself and (is_silent or is_new):
            first, last = (self._gradian(at) for at in ((self._sonar.n_ray - 1) * self._step, 0))
            if self._whole:
                first, last = first % self._stride, 399
            self._send(AUTO_TRANSMIT, struct.pack("<HH", first, last) + bytes([self._stride, 0]), now_s)
        elif not self._by_itself and (is_silent or self._heard_s >= self._asked_s):
            self._send(TRANSDUCER, struct.pack("<BB", 1, 0), now_s, self._gradian(self._at))

    def _send(self, number: int, rest: bytes, now_s: float, gradian: int | None = None) -> None:
        """A request, with how far and how long to listen."""
        mode_gain = struct.pack("<BB", 1, 1)
        angle = b"" if gradian is None else struct.pack("<H", gradian)
        pulse_us = min(max(round(8000.0 * self._sonar.max_range_m / self._sound), 5), 500)
        listening = struct.pack("<HHHH", pulse_us, self._period, 740, self._samples)
        if self.channel.write(frame(number, mode_gain + angle + listening + rest)):
            self._asked_s, self._astray = now_s, 0

    def _gradian(self, at: int) -> int:
        """The device's angle so far from beam 0."""
        return round(self._zero - math.degrees(self._sonar.first_beam_rad) / 0.9 - at) % 400

    def _ping(self, number: int, payload: bytes, now_s: float) -> SonarPing | None:
        head = {DEVICE_DATA: 14, AUTO_DEVICE_DATA: 20}.get(number)
        if head is None or len(payload) < head:
            return self.refuse(f"message {number}: not used")
        angle, _, period = struct.unpack_from("<HHH", payload, 2)
        profile = np.frombuffer(payload, np.uint8, offset=head)
        self.heard += 1
        self._heard_s = now_s
        if not self._by_itself and self._turns > 1:  # it was off, and may know the quicker way
            self._by_itself, self._asked_s, self._heard_s = True, -math.inf, -math.inf
        self._turns = 0
        bin_m = 0.5 * TICK_S * period * self._sound
        if len(profile) * bin_m < 0.98 * self._sonar.max_range_m or bin_m > _SMOOTH_M:
            return self.refuse("a profile shorter or coarser than was asked for: another program's request?")
        at = self._at_angle(angle)
        if at is None:
            self._astray += 1
            return self.refuse("an angle between the beams")
        if not self._by_itself:
            self._next(at)
        range_m = first_echo(profile, bin_m, self._blind)
        if math.isnan(range_m):
            return self.refuse("a profile neither with an echo nor quiet")
        hit = float(range_m <= self._sonar.max_range_m)
        listened_s = TICK_S * period * len(profile)
        nearest = np.array([min(range_m, self._sonar.max_range_m)])
        return SonarPing(now_s - listened_s, nearest, np.array([hit]), np.zeros(0), at / self._step)

    def _at_angle(self, gradian: int) -> int | None:
        """[gradian] from beam 0; None between, or beside, all that are asked for."""
        off = (self._zero - gradian - math.degrees(self._sonar.first_beam_rad) / 0.9) % 400
        at = round(off / self._stride) * self._stride
        if abs(off - at) > 0.5:
            return None
        at %= 400
        return at if self._whole or at <= (self._sonar.n_ray - 1) * self._step else None

    def _next(self, at: int) -> None:
        """Of a fan there and back, else round and round."""
        if self._whole:
            self._at = (at + self._stride) % 400
            return
        self._way = -1 if at >= (self._sonar.n_ray - 1) * self._step else 1 if at <= 0 else self._way
        self._at = at + self._way * self._step
