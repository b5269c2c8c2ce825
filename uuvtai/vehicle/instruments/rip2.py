"""Water Linked's Sonar 3D-15: range images in datagrams (RIP2: protobuf within snappy).

Source: docs.waterlinked.com, Range Image Protocol. A packet: ``RIP2``, its length u32, content, crc32 of all
before, little endian. Columns go from port to starboard, rows from below to above; 0 = nothing returned.
"""

from __future__ import annotations

import functools
import math
import zlib
from typing import Any, NamedTuple

import numpy as np

from uuvtai.common.errors import SettingError
from uuvtai.config import Config
from uuvtai.vehicle.instruments.channel import Channel, Instrument
from uuvtai.vehicle.mavlink import LinkError
from uuvtai.vehicle.messages import DepthShot, SensorMessage, SonarPing

PORT = 4747
LONGEST = 65507  # [bytes] of a datagram
_MOST_CONTENT = 1 << 20  # [bytes] of what unfolds from one
_MOST_PIXELS = 1 << 16
_RANGE_IMAGE = "RangeImage"
_FIELDS = {
    "Stamp": (("seconds", 1, "int64"), ("nanos", 2, "int32")),
    "Header": (("timestamp", 1, "Stamp"), ("sequence_id", 2, "uint32")),
    "Any": (("type_url", 1, "string"), ("value", 2, "bytes")),
    "Packet": (("msg", 1, "Any"),),
    _RANGE_IMAGE: (
        ("header", 1, "Header"), ("range", 3, "float"), ("width", 5, "uint32"), ("height", 6, "uint32"),
        ("fov_horizontal", 7, "float"), ("fov_vertical", 8, "float"),
        ("image_pixel_scale", 9, "float"), ("image_pixel_data", 10, "uint32"),
    ),
}  # fmt: skip


class RangeImage(NamedTuple):
    """One image."""

    sent_s: float
    """by the device's clock"""
    range_m: np.ndarray
    """(rows, columns) [m], row 0 below, column 0 to port; 0 = nothing returned"""
    fov_rad: tuple[float, float]
    """horizontal, vertical, between the middles of the outer pixels"""
    max_range_m: float


@functools.cache
def _messages() -> dict[str, Any]:
    """protobuf's classes of ``_FIELDS``; LinkError where a package is missing."""
    try:
        import cramjam  # noqa: F401
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise LinkError(
            "a 3D-15 speaks protobuf within snappy, which are not here: pip install 'uuvtai[instruments]'"
        ) from None
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name="uuvtai_rip2.proto", package="uuvtai.rip2", syntax="proto3"
    )
    for name, fields in _FIELDS.items():
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            added = message.field.add(name=field, number=number, label=kinds.LABEL_OPTIONAL)
            if kind in _FIELDS:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".uuvtai.rip2.{kind}"
            else:
                added.type = getattr(kinds, f"TYPE_{kind.upper()}")
            if field == "image_pixel_data":
                added.label = kinds.LABEL_REPEATED
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = (pool.FindMessageTypeByName(f"uuvtai.rip2.{name}") for name in _FIELDS)
    return {found.name: message_factory.GetMessageClass(found) for found in made}


def image_of(packet: bytes) -> RangeImage | str:
    """The range image of a packet, or why there is none."""
    import cramjam

    length = int.from_bytes(packet[4:8], "little")
    if packet[:4] != b"RIP2" or length != len(packet) or length < 13:
        return "no packet of RIP2, or a piece of one"
    if zlib.crc32(packet[:-4]) != int.from_bytes(packet[-4:], "little"):
        return "a wrong sum"
    kinds, content = _messages(), packet[8:-4]
    if _unfolded(content) > _MOST_CONTENT:
        return "more than any image unfolds to"
    try:
        told = kinds["Packet"].FromString(bytes(cramjam.snappy.decompress_raw(content))).msg
        if told.type_url.rpartition(".")[2] != _RANGE_IMAGE:
            return f"{told.type_url.rpartition('.')[2][:32]}: not used"
        image = kinds[_RANGE_IMAGE].FromString(told.value)
    except Exception as error:  # protobuf's and cramjam's own
        return f"no RIP2 inside ({type(error).__name__})"
    size, count = image.width * image.height, len(image.image_pixel_data)
    numbers = image.image_pixel_scale, image.range, image.fov_horizontal, image.fov_vertical
    sound = all(math.isfinite(n) and n > 0 for n in numbers) and max(numbers[2:]) < 180.0
    if not (sound and min(image.width, image.height) > 1 and size == count <= _MOST_PIXELS):
        return "an image of an impossible size"
    pixels = np.array(image.image_pixel_data, np.float64).reshape(image.height, image.width)
    if pixels.max() * image.image_pixel_scale > 1.1 * image.range:
        return "pixels beyond the range that it tells"
    stamp = image.header.timestamp
    return RangeImage(
        stamp.seconds + 1e-9 * stamp.nanos,
        pixels * image.image_pixel_scale,
        (math.radians(image.fov_horizontal), math.radians(image.fov_vertical)),
        image.range,
    )


def packet_of(image: RangeImage) -> bytes:
    """The packet of an image, as the device sends it; distances in steps of 5 mm."""
    import cramjam

    kinds, scale = _messages(), 0.005
    nanos = round(1e9 * image.sent_s)
    stamp = kinds["Stamp"](seconds=nanos // 10**9, nanos=nanos % 10**9)
    rows, columns = image.range_m.shape
    value = kinds[_RANGE_IMAGE](
        header=kinds["Header"](timestamp=stamp), range=image.max_range_m, width=columns, height=rows,
        fov_horizontal=math.degrees(image.fov_rad[0]), fov_vertical=math.degrees(image.fov_rad[1]),
        image_pixel_scale=scale, image_pixel_data=np.rint(image.range_m.ravel() / scale).astype(int).tolist(),
    )  # fmt: skip
    told = kinds["Any"](type_url=f"type.googleapis.com/waterlinked.sonar.protocol.{_RANGE_IMAGE}")
    told.value = value.SerializeToString()
    content = bytes(cramjam.snappy.compress_raw(kinds["Packet"](msg=told).SerializeToString()))
    head = b"RIP2" + (len(content) + 12).to_bytes(4, "little") + content
    return head + zlib.crc32(head).to_bytes(4, "little")


def _unfolded(content: bytes) -> int:
    """Length that a raw snappy block says it unfolds to (its first varint)."""
    size = 0
    for at, byte in enumerate(content[:5]):
        size |= (byte & 0x7F) << (7 * at)
        if byte < 0x80:
            return size
    return 1 << 62


class Sonar3D(Instrument):
    """What lies level becomes a scan of the config's fan, all of it an image of the config's camera."""

    def __init__(self, channel: Channel, config: Config) -> None:
        """SettingError for a ring, and at the first image for a fan or a camera that sees more than the
        device, which looks ahead."""
        super().__init__(channel)
        _messages()
        self._sonar, self._depth = config.sensors.sonar, config.sensors.depth
        if self._sonar.is_ring or self._sonar.mechanical:
            raise SettingError("sensors.sonar: a 3D-15 looks ahead; take a fan: --sensors multibeam")
        self._maps: tuple[Any, ...] | None = None
        self._of: tuple[Any, ...] = ()

    def poll(self, now_s: float) -> list[SensorMessage]:
        found: list[SensorMessage] = []
        for packet in self.channel.read(now_s):
            image = "the same again" if packet == self._last else image_of(packet)
            self._last = packet
            if isinstance(image, str):
                self.refuse(image)
                continue
            self.heard += 1
            found += self._told(image, self.clock.measured_s(image.sent_s, now_s))
        return found

    def _told(self, image: RangeImage, time_s: float) -> list[SensorMessage]:
        if image.max_range_m < 0.98 * self._sonar.max_range_m:
            self.refuse("an image shorter than the sonar's range")
            return []
        if self._maps is None:
            self._of, self._maps = (image.range_m.shape, image.fov_rad), self._mapped(image)
        if self._of != (image.range_m.shape, image.fov_rad):
            self.refuse("an image of another size or view than the first")
            return []
        columns, level, pixels, scale = self._maps
        far = np.where(image.range_m > 0, image.range_m, np.inf)
        nearest = far[level].min(axis=0)[columns]
        hit = nearest <= self._sonar.max_range_m
        ping = SonarPing(
            time_s, np.where(hit, nearest, self._sonar.max_range_m), hit.astype(float), np.zeros(0)
        )
        depth = np.minimum(far.ravel()[pixels] * scale, self._depth.max_range_m)
        return [ping, DepthShot(time_s, depth)]

    def _mapped(self, image: RangeImage) -> tuple[Any, ...]:
        """(column of each beam, level rows, pixel of each of the camera's, its z-depth per metre)."""
        rows, columns = image.range_m.shape
        wide, high = image.fov_rad

        def column(left: np.ndarray) -> np.ndarray:
            return np.rint((0.5 - left / wide) * (columns - 1)).astype(int)

        beams = self._sonar.first_beam_rad + self._sonar.beam_step_rad * np.arange(self._sonar.n_ray)
        up = np.linspace(-0.5 * high, 0.5 * high, rows)
        aperture = math.radians(self._sonar.vertical_half_aperture_deg)
        level = np.abs(up) <= max(aperture, np.abs(up).min())  # of a coarse image the rows beside the middle
        reach = math.tan(0.5 * math.radians(self._depth.fov_deg))
        across = reach * (1.0 - 2.0 * (np.arange(self._depth.cols) + 0.5) / self._depth.cols)
        above = reach * (self._depth.rows - 2.0 * (np.arange(self._depth.rows) + 0.5)) / self._depth.cols
        y, z = np.meshgrid(across, above)
        row = np.rint((np.arctan2(z, np.hypot(1.0, y)) / high + 0.5) * (rows - 1)).astype(int)
        of_beam, of_pixel = column(beams), column(np.arctan(y))
        seen = [of_beam.min() >= 0, of_beam.max() < columns, of_pixel.min() >= 0, of_pixel.max() < columns]
        if not all([*seen, row.min() >= 0, row.max() < rows]):
            raise SettingError(
                f"the 3D-15 sees {math.degrees(wide):.0f} x {math.degrees(high):.0f} degrees, sensors.sonar "
                "or sensors.depth more; what nobody sees would count as free: --set "
                "sensors.sonar.horizontal_aperture_deg=90 --set sensors.depth.rows=44"
            )
        return of_beam, level, row * columns + of_pixel, 1.0 / np.sqrt(1.0 + y * y + z * z)
