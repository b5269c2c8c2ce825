"""Pictures and videos of logs: sizes, and the right colours in the right places."""

import cv2
import numpy as np
import pytest

from tests.oracles import logs as episode
from uuvtai.common.obstacle_motion import obstacle_positions
from uuvtai.logs import drawing as ink
from uuvtai.logs.encode import LogError
from uuvtai.logs.picture import paint_picture, picture
from uuvtai.logs.video import FrameArtist, video
from uuvtai.logs.writer import McapEpisodeLog

INKS = ink.agent_inks(["bt", "straight", "planner"])
N_STEP = 110


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="module")
def bt(folder):
    return episode.record(folder / "bt.mcap", N_STEP)


@pytest.fixture(scope="module")
def straight(folder):
    described = episode.header("straight")
    return episode.record(folder / "straight.mcap", N_STEP, described, "collision", sway=-0.9)


def place(world, width=1600, side=0):
    """Pixel of a world point in a picture of the pool."""
    scale = (width - 62 - 44 - side) / 20
    return round(62 + world[0] * scale), round(96 + (6 - world[1]) * scale)


def around(image, pixel, reach=3):
    x, y = pixel
    return image[y - reach : y + reach + 1, x - reach : x + reach + 1].reshape(-1, 3).astype(int)


def has(pixels, color, tolerance=12):
    return bool((np.abs(pixels - np.array(color)).max(axis=1) <= tolerance).any())


def test_picture_has_what_it_should_where_it_should(folder, bt, straight):
    image = cv2.imread(str(picture([bt, straight], folder / "p.png")))
    assert image.shape[1] == 1600 and image.shape[0] % 2 == 0
    last = ink.load_recording(bt, ink.PICTURE_TOPICS)["/map/dynamic"].values[-1]
    row, col = np.unravel_index(last.values.argmax(), last.values.shape)
    assert last.values[row, col] > 0.9
    spot = (last.origin_m[0] + (col + 0.5) * last.cell_m, last.origin_m[1] + (row + 0.5) * last.cell_m)
    assert has(around(image, place(spot)), ink.DYNAMIC, 30)
    assert has(around(image, place(episode.GOAL), 5), ink.GOAL)
    for name, log in (("bt", bt), ("straight", straight)):
        path = ink.load_recording(log, ink.PICTURE_TOPICS).positions
        assert has(around(image, place(path[len(path) // 4]), 2), INKS[name])
    assert has(around(image, place((1.0, 5.0)), 1), ink.WATER, 1)
    assert has(around(image, place((0.0, 3.0)), 2), ink.INK)
    assert (image[5, 5] == 255).all()


def test_static_occupancy_is_dark_where_the_map_says_so(folder, bt):
    image = cv2.imread(str(picture(bt, folder / "s.png", obstacles=False)))
    layer = ink.load_recording(bt, ink.PICTURE_TOPICS)["/map/static"].values[-1]
    inside = layer.values.copy()
    inside[:4], inside[-4:], inside[:, :6], inside[:, -10:] = 0, 0, 0, 0  # not the walls
    row, col = np.unravel_index(inside.argmax(), inside.shape)
    spot = (layer.origin_m[0] + (col + 0.5) * layer.cell_m, layer.origin_m[1] + (row + 0.5) * layer.cell_m)
    assert around(image, place(spot), 1).mean() < 80


def test_clearance_is_coloured_from_dark_at_the_wall_to_bright_in_the_open(folder, bt):
    image = cv2.imread(str(picture(bt, folder / "c.png", clearance=True, obstacles=False)))
    wall, open_water = (around(image, place(spot, side=92), 2).mean() for spot in ((4.0, 5.75), (4.0, 4.6)))
    assert open_water > wall + 30
    assert has(around(image, place((4.0, 4.6), side=92), 2), (37, 231, 253), 45)  # the bright end of viridis


def test_the_end_shows_the_outcome(bt, straight):
    loaded = [ink.load_recording(path, ink.PICTURE_TOPICS) for path in (bt, straight)]
    crash, arrival = (
        paint_picture([recording], obstacles=False).image for recording in (loaded[1], loaded[0])
    )
    at = place(loaded[1].positions[-1])
    difference = np.abs(crash.astype(int) - arrival.astype(int)).max(axis=2)
    assert difference[at[1] - 9 : at[1] + 10, at[0] - 9 : at[0] + 10].max() > 100


def test_where_methods_go_the_same_way_both_are_seen(folder, bt):
    surrogate = episode.record(folder / "surrogate.mcap", N_STEP, episode.header("surrogate"))
    loaded = [ink.load_recording(path, ink.PICTURE_TOPICS) for path in (bt, surrogate)]
    image = paint_picture(loaded, obstacles=False).image
    path = loaded[0].positions
    assert has(around(image, place(path[len(path) // 4]), 2), INKS["bt"])
    assert has(
        around(image, place(path[len(path) // 4]), 5), ink.agent_inks(["bt", "surrogate"])["surrogate"], 60
    )  # its edge, a pixel and a half wide


def test_true_obstacles_are_as_old_as_the_map(folder, bt):
    """The first agent's map is drawn; another agent that took longer does not move the obstacles on."""
    longer = folder / "longer.mcap"
    episode.record(longer, 2 * N_STEP, episode.header("straight"), sway=-0.9)
    first, second = (ink.load_recording(path, ink.PICTURE_TOPICS) for path in (bt, longer))
    body = episode.OBSTACLES[4]
    then, later = (
        obstacle_positions(body, np.array([recording.duration_s]))[0] for recording in (first, second)
    )
    assert np.linalg.norm(then - later) > 1.0
    alone, both = paint_picture([first]).image, paint_picture([first, second]).image
    for center, there in ((then, True), (later, False)):
        rim = place((center[0], center[1] + body["size"][0]))
        assert has(around(alone, rim, 2), ink.MOVER, 60) is has(around(both, rim, 2), ink.MOVER, 60) is there


def test_remarks_stand_in_red_beside_the_title(bt):
    recording = ink.load_recording(bt)
    plain = paint_picture([recording]).image
    marked = paint_picture([recording], remark="unseen above").image
    rows, cols = np.nonzero((plain != marked).any(axis=2))
    assert rows.max() < 60 and cols.min() > 250
    assert has(marked[: rows.max() + 1, cols.min() :].reshape(-1, 3).astype(int), ink.FAILED, 60)


def test_obstacles_above_and_below_the_vehicle_are_dashed():
    def ink_used(own_z_m):
        canvas = ink.map_canvas(episode.scenario()["tank"], 1280, (52, 28, 84, 212))
        ink.paint_truth(
            canvas, {"obstacles": [episode.OBSTACLES[0] | {"size": [0.35, 0.35, 0.2]}]}, 0.0, own_z_m
        )
        return int((255 - canvas.image.astype(int)).sum())

    level, reaching_up, below, above = (ink_used(z) for z in (-0.8, -1.1, -1.3, -0.3))
    assert level == reaching_up == ink_used(None)
    assert 0.4 * level < below == above < 0.8 * level


def test_trajectories_of_other_episodes_are_not_overlaid(folder, bt):
    other = episode.record(folder / "other.mcap", N_STEP, episode.header(episode=4))
    with pytest.raises(LogError, match="another episode"):
        picture([bt, other], folder / "never.png")
    assert not (folder / "never.png").exists()


def test_a_round_tank_is_round():
    tank = {"shape": "circle", "x_m": [0, 16], "y_m": [0, 16], "radius_m": 8.0}
    canvas = ink.map_canvas(tank, 1000, (50, 50, 60, 40))
    ink.paint_water(canvas, tank)
    canvas.cells(np.array(ink.STATIC), np.ones((160, 160)), (0.0, 0.0), 0.1)
    ink.paint_walls(canvas, tank)
    corner, middle = canvas.pixels([(0.5, 0.5), (8, 8)]).astype(int)
    assert (canvas.image[corner[1], corner[0]] == 255).all()
    assert tuple(canvas.image[middle[1], middle[0]]) == ink.STATIC
    assert canvas.image.shape[0] % 2 == canvas.image.shape[1] % 2 == 0


def test_cells_lie_where_the_world_says():
    canvas = ink.Canvas((400, 300), (20.0, 30.0), 35.0, (0.0, 10.0), (0.0, 6.0))
    opacity = np.zeros((64, 104))
    opacity[2 + 35, 2 + 71] = 1.0  # centre (7.15, 3.55) with two cells of border
    canvas.cells(np.array(ink.DYNAMIC), opacity, (-0.2, -0.2), 0.1)
    hit = np.argwhere((canvas.image == np.array(ink.DYNAMIC)).all(axis=2))
    np.testing.assert_allclose(hit.mean(axis=0)[::-1], canvas.pixels([(7.15, 3.55)])[0], atol=1.0)
    assert 2 <= np.ptp(hit[:, 0]) <= 4


@pytest.mark.parametrize("font", ["own", "strokes"])
def test_text_is_drawn_with_any_opencv(monkeypatch, font):
    if font == "strokes":
        monkeypatch.delattr(cv2, "FontFace", raising=False)
        monkeypatch.setattr(cv2, "getTextSize", lambda *_: ((40, 20), 5))
        monkeypatch.setattr(cv2, "putText", lambda image, *_: image[10:20, 10:20].fill(0))
    canvas = ink.Canvas((300, 60), (0, 0), 1.0, (0, 1), (0, 1))
    assert canvas.text((10, 40), "pool · 3.2 m", 22, ink.INK, True) > 20
    assert canvas.image.min() < 100


def test_a_frame_shows_the_moment(bt):
    recording = ink.load_recording(bt)
    artist = FrameArtist(recording)
    canvas = ink.map_canvas(recording.scenario["tank"], 1280, (52, 28, 84, 212))
    for time_s in (0.3, 1.7):
        frame = artist.frame(time_s)
        hull = canvas.pixels([recording["/pose"].at(time_s)])[0].round().astype(int)
        assert has(around(frame, hull, 1), INKS["bt"])
        x, y, radius = recording["/tracks"].at(time_s)[0, :3]
        rim = canvas.pixels([(x, y + radius + 0.06)])[0].round().astype(int)
        assert has(around(frame, rim, 2), ink.DYNAMIC, 30)
    early, late = artist.frame(0.0).astype(int), artist.frame(2.2).astype(int)
    assert np.abs(early - late).max() > 100
    assert (
        artist.frame(0.3) == FrameArtist(recording).frame(0.3)
    ).all()  # independent of what was drawn before


@pytest.mark.parametrize(("draw", "name"), [(picture, "out.png"), (video, "out.mp4"), (video, "out.gif")])
def test_missing_files_and_bad_places(folder, bt, tmp_path, draw, name):
    with pytest.raises(LogError, match="cannot open"):
        draw(tmp_path / "nowhere.mcap", tmp_path / name)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LogError, match="cannot write"):
        draw(bt, tmp_path / "file" / name)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_a_log_without_poses_cannot_be_drawn(tmp_path):
    with McapEpisodeLog(tmp_path / "a.mcap", episode.header()) as log:
        log.close(episode.result(0))
    with pytest.raises(LogError, match="nothing to draw"):
        picture(tmp_path / "a.mcap", tmp_path / "a.png")


def test_a_log_without_maps_is_drawn_all_the_same(tmp_path):
    episode.record(tmp_path / "a.mcap", 20, maps=False)
    assert cv2.imread(str(picture(tmp_path / "a.mcap", tmp_path / "a.png", clearance=True))) is not None
    assert FrameArtist(ink.load_recording(tmp_path / "a.mcap")).frame(0.2).shape[1] == 1280
