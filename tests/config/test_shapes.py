"""Outlines and pictures as boxes: what they cover, how many they are, and what is refused."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image, ImageDraw

from uuvtai.common.files import FileError
from uuvtai.config import loader, shapes
from uuvtai.config.loader import ConfigError, load_config, to_yaml
from uuvtai.logs.drawing import obstacle_outline

TANK = "{x_m: [0, 30], y_m: [0, 20], z_m: [-3, 0]}"
TOLERANCE_M = 0.06
"""twice the thickness of a box along an edge"""


def world_of(folder, text, **picture):
    """Config of a world with these keys, and with a picture ``tank.png`` if one is given."""
    if picture:
        picture["image"].save(folder / "tank.png", **picture.get("options", {}))
    file = folder / "mine.yaml"
    file.write_text(f"extends: pool\nworld:\n  tank: {TANK}\n  {text}\n")
    return load_config(str(file))


def refusal(folder, text, **picture):
    with pytest.raises(ConfigError) as error:
        world_of(folder, text, **picture)
    return str(error.value).splitlines()[0]


def covered(boxes, points, grown=0.0):
    """(n,) bool: a box, made so much larger to all sides [m], holds the point."""
    found = np.zeros(len(points), bool)
    for x, y, a, b, degrees in boxes:
        yaw = np.radians(degrees)
        away = (points - (x, y)) @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        found |= (np.abs(away) <= np.array([a, b]) + grown).all(axis=1)
    return found


def boxes_in(config):
    rows = [(o.x_m, o.y_m, *o.half_extents_m, o.yaw_deg) for o in config.world.fixed]
    return np.array(rows).reshape(-1, 5)


@pytest.mark.parametrize("degrees", [0.0, 30.0, -77.0])
def test_a_rectangle_is_one_box(degrees):
    yaw = np.radians(degrees)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    corners = np.array([(2.0, 0.5), (-2.0, 0.5), (-2.0, -0.5), (2.0, -0.5)]) @ turn + (10, 8)
    (box,) = shapes.boxes_of("one", [corners], 0.025)
    drawn = {"kind": "box", "size": (*box[2:4], 1.0), "yaw": np.radians(box[4])}
    outline = obstacle_outline(drawn, np.array(box[:2]))
    for corner in corners:
        assert np.hypot(*(outline - corner).T).min() < 2e-3
    assert box[:2] == pytest.approx((10, 8), abs=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_any_outline_is_covered_and_nothing_beyond_it(seed):
    """Its edge has boxes all along, none sticks out, and what is empty inside is too small for a start."""
    draw = np.random.default_rng(seed)
    angles = np.sort(draw.uniform(0, 2 * np.pi, draw.integers(3, 9)))
    if np.diff([*angles, angles[0] + 2 * np.pi]).max() > 0.9 * np.pi:
        angles = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    corners = (15, 10) + draw.uniform(1, 4, len(angles))[:, None] * np.column_stack(
        [np.cos(angles), np.sin(angles)]
    )
    boxes = shapes.boxes_of("one", [corners], 0.025)
    assert len(boxes) <= 4 * len(corners)
    ends = np.roll(corners, -1, axis=0)
    edge = np.concatenate(
        [a + np.linspace(0, 1, 60)[:, None] * (b - a) for a, b in zip(corners, ends, strict=True)]
    )
    assert covered(boxes, edge, TOLERANCE_M).all()
    points = draw.uniform((10, 5), (20, 15), (1500, 2))
    inside = np.array([shapes._inside([corners], p[:1], p[1:])[0, 0] for p in points])
    near = np.array([np.hypot(*(edge - p).T).min() for p in points])
    assert not covered(boxes, points[~inside & (near > 2 * TOLERANCE_M)]).any()
    assert covered(boxes, points[inside], 2**0.5 * 0.45).all()


def test_what_is_made_of_rectangles_is_these_rectangles(tmp_path):
    ell = "[[15, 10], [20, 10], [20, 11], [16, 11], [16, 15], [15, 15]]"
    found = boxes_in(world_of(tmp_path, f"polygons: [{ell}]"))
    assert len(found) == 2
    points = np.random.default_rng(1).uniform((14, 9), (21, 16), (3000, 2))
    x, y = points.T
    wanted = (x > 15) & (y > 10) & ((x < 16) | (y < 11)) & (x < 20) & (y < 15)
    sure = np.minimum.reduce([abs(x - v) for v in (15, 16, 20)] + [abs(y - v) for v in (10, 11, 15)]) > 0.03
    np.testing.assert_array_equal(covered(found, points)[sure], wanted[sure])


def test_a_picture_is_where_map_server_of_ros_has_it(tmp_path):
    """The lower left corner is the origin, dark is occupied; a frame, a block, a turned wall and a pond."""
    image = Image.new("L", (600, 400), 255)
    draw = ImageDraw.Draw(image)
    draw.rectangle((100, 100, 139, 119), fill=0)
    draw.line((450, 50, 550, 250), fill=0, width=8)
    draw.rectangle((200, 250, 299, 349), fill=0)
    draw.rectangle((220, 270, 279, 329), fill=255)
    draw.rectangle((400, 300, 401, 300), fill=200)
    config = world_of(tmp_path, "occupancy: {image: tank.png, resolution: 0.05}", image=image)
    found = boxes_in(config)
    assert len(found) == 1 + 1 + 4
    block = min(found, key=lambda row: np.hypot(row[0] - 6, row[1] - 14.5))
    assert sorted(block[2:4]) == pytest.approx([0.5, 1.0], abs=2e-3)
    assert block[:2] == pytest.approx((6, 14.5), abs=2e-3)
    rows, columns = np.mgrid[0:400, 0:600]
    points = np.column_stack([columns.ravel() + 0.5, 400 - rows.ravel() - 0.5]) * 0.05
    dark = np.asarray(image).ravel() < 89
    assert covered(found, points[dark], 0.05).all()
    assert covered(found, points[~dark]).mean() < 2e-3
    assert config.world.occupancy is None and len(to_yaml(config)) < loader.MAX_BYTES
    (tmp_path / "whole.yaml").write_text(to_yaml(config))
    (tmp_path / "tank.png").unlink()
    assert loader.load_resolved(tmp_path / "whole.yaml") == config, "a run folder needs no picture"


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA"])
def test_every_usual_kind_of_picture_is_read(tmp_path, mode):
    image = Image.new("RGBA", (100, 100), (0, 0, 0, 0) if "A" in mode else "white")
    ImageDraw.Draw(image).rectangle((40, 40, 59, 49), fill="black")
    config = world_of(tmp_path, "occupancy: {image: tank.png, resolution: 0.1}", image=image.convert(mode))
    assert boxes_in(config) == pytest.approx(np.array([[5, 5.5, 0.5, 1, 90]]), abs=0.01)
    Image.eval(image.convert("RGB").convert("L"), lambda value: 255 - value).save(tmp_path / "tank.pgm")
    if "A" not in mode:
        text = "occupancy: {image: tank.pgm, resolution: 0.1, negate: 1, occupied_thresh: 0.9}"
        assert world_of(tmp_path, text).world.fixed == config.world.fixed


def test_a_picture_can_be_moved_turned_and_cut_by_the_tank(tmp_path):
    image = Image.new("L", (100, 100), 255)
    ImageDraw.Draw(image).rectangle((0, 0, 99, 9), fill=0)
    text = "occupancy: {image: tank.png, resolution: 0.1, origin: [%s]}"
    (moved,) = boxes_in(world_of(tmp_path, text % "5, -9.5, 0", image=image))
    assert moved[:2] == pytest.approx((10, 0.25), abs=0.06)
    (turned,) = boxes_in(world_of(tmp_path, text % "14, 5, 1.5708", image=image))
    assert turned[:2] == pytest.approx((4.5, 10), abs=0.02)
    assert refusal(tmp_path, text % "50, 0, 0", image=image).endswith(
        "world.occupancy: shows nothing in the tank; look at resolution, origin and negate"
    )


def _bomb(width, height):
    """A PNG of a few bytes that claims to be so large."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b"\0" * 99))
        + chunk(b"IEND", b"")
    )


def _sixteen_bits():
    held = io.BytesIO()
    Image.new("I;16", (9, 9)).save(held, "PNG")
    return held.getvalue()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (_bomb(60_000, 60_000), "decompression bomb"),
        (_bomb(5000, 5000), "has 5000 x 5000 pixels of mode L; a map has at most 4,000,000"),
        (_bomb(200, 200), "is no PNG or PGM that can be read (image file is truncated"),
        (_sixteen_bits(), "has 9 x 9 pixels of mode I;16"),
        (b"GIF89a" + b"\0" * 50, "is no PNG or PGM that can be read (cannot identify"),
        (b"\x89PNG\r\n\x1a\n" + b"\xff" * 40, "is no PNG or PGM that can be read"),
        (b"P5\n9999999999 1\n255\n", "is no PNG or PGM that can be read"),
        (b"", "is no PNG or PGM that can be read"),
    ],
)
def test_a_hostile_picture_is_refused_in_a_line(tmp_path, content, says):
    (tmp_path / "tank.png").write_bytes(content)
    told = refusal(tmp_path, "occupancy: {image: tank.png, resolution: 0.05}")
    assert "mine.yaml:4: world.occupancy.image: " in told and says in told and len(told) < 400


def test_what_is_no_file_or_too_large_is_refused(tmp_path, monkeypatch):
    assert "tank.png cannot be read (No such file" in refusal(
        tmp_path, "occupancy: {image: tank.png, resolution: 0.05}"
    )
    (tmp_path / "tank.png").mkdir()
    with pytest.raises(FileError, match="is a folder"):
        world_of(tmp_path, "occupancy: {image: tank.png, resolution: 0.05}")
    monkeypatch.setattr(shapes, "_MAX_IMAGE_BYTES", 10)
    with pytest.raises(FileError, match="more than the 10"):
        world_of(
            tmp_path,
            "occupancy: {image: tank2.png, resolution: 1}".replace("2", ""),
            image=_white_named(tmp_path),
        )


def _white_named(folder):
    (folder / "tank.png").rmdir()
    return Image.new("L", (50, 50), 255)


def test_noise_and_knots_are_refused_soon(tmp_path):
    noise = Image.fromarray((np.random.default_rng(0).random((200, 300)) * 255).astype(np.uint8))
    assert "obstacles, and 256 may be: remove specks" in refusal(
        tmp_path, "occupancy: {image: tank.png, resolution: 0.05, occupied_thresh: 0.8}", image=noise
    )
    knot = refusal(
        tmp_path, "occupancy: {image: tank.png, resolution: 0.05, occupied_thresh: 0.3}", image=noise
    )
    assert "world.occupancy: has more than 500 corners: straighten it" in knot
    rings = Image.new("L", (600, 400), 255)
    for i in range(0, 198, 3):
        ImageDraw.Draw(rings).rectangle((i, i, 599 - i, 399 - i), outline=0)
    told = refusal(tmp_path, "occupancy: {image: tank.png, resolution: 0.05}", image=rings)
    assert "world.occupancy: needs more than 256 boxes: straighten outlines" in told


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("polygons: [[[5, 5], [7, 5]]]", "mine.yaml:4: world.polygons.0: has no area"),
        ("polygons: [[[1, 1], [2, 2], [3, 3]]]", "world.polygons.0: has no area"),
        ("polygons: [[]]", "world.polygons.0: has no area"),
        ("polygons: [[[5, 5], [7, 5], [7, 21]]]", "world.polygons.0: [7.0, 21.0] is outside the tank"),
        ("polygons: [[[5, 5], [7, five], [7, 8]]]", "world.polygons.0.1.1: "),
        ("polygons: [[5, 5], [7, 5], [7, 8]]", "world.polygons.0.0: "),
        ("occupancy: {image: tank.png}", "world.occupancy.resolution: Field required"),
        ("occupancy: {image: tank.png, resolution: 0}", "world.occupancy.resolution: "),
        ("occupancy: {file: tank.png, resolution: 1}", "unknown key 'world.occupancy.file'"),
    ],
)
def test_what_is_no_outline_is_refused_in_a_line(tmp_path, text, says):
    with pytest.raises(ConfigError) as error:
        world_of(tmp_path, text)
    assert says in str(error.value)


def test_overlapping_outlines_of_a_base_are_kept_unless_said_anew(tmp_path):
    base = world_of(tmp_path, "polygons: [[[5, 5], [7, 5], [7, 6], [5, 6]]]")
    (tmp_path / "more.yaml").write_text(
        "extends: mine.yaml\nworld: {fixed: [{kind: sphere, x_m: 9, y_m: 9, radius_m: 1}]}\n"
    )
    more = load_config(str(tmp_path / "more.yaml")).world.fixed
    assert [one.kind for one in more] == ["sphere", "box"] and more[1] == base.world.fixed[0]
