"""A person at the wheel: keys become commands, the map is shown as the vehicle knows it, and the episode is
played, logged and compared as any other."""

import os
import pty
import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.command import uuv
from uuvtai.live import hand_driver
from uuvtai.live.hand_driver import DriverView, HandDriver, HandPiece, view_of
from uuvtai.live.hand_steering import HEAVE, SURGE, SWAY, YAW, HandSteering
from uuvtai.live.keyboard import TerminalKeys, keyboard, keys_of
from uuvtai.live.viewer_server import LiveError
from uuvtai.measure.episodes.methods import Method
from uuvtai.show.steering_view import screenful

# ----------------------------------------------------------------------------------------------------- keys


def test_keys_and_arrows_of_a_terminal():
    assert keys_of("w\x1b[A\x1bOD \x1b[Zx") == ["w", "up", "left", " ", "\x1b", "[", "Z", "x"]


def test_a_terminal_is_read_without_waiting():
    master, slave = pty.openpty()
    try:
        keys = TerminalKeys(slave)
        assert keys.pressed() == []
        os.write(master, b"ws\n")
        assert keys.pressed()[:2] == ["w", "s"]
    finally:
        os.close(master)
        os.close(slave)


def test_the_terminal_is_put_back(monkeypatch):
    import termios

    master, slave = pty.openpty()
    with os.fdopen(slave) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        before = termios.tcgetattr(slave)
        with pytest.raises(RuntimeError), keyboard():
            assert termios.tcgetattr(slave) != before, "keys come one by one"
            raise RuntimeError
        assert termios.tcgetattr(slave) == before
    os.close(master)


@pytest.mark.parametrize(
    ("key", "axis", "sign"),
    [
        ("w", SURGE, 1), ("S", SURGE, -1), ("up", SURGE, 1), ("a", SWAY, 1), ("d", SWAY, -1),
        ("r", HEAVE, 1), ("f", HEAVE, -1), ("q", YAW, 1), ("right", YAW, -1),
    ],
)  # fmt: skip
def test_a_key_acts_on_its_axis_while_it_is_held(key, axis, sign):
    hands = HandSteering(share=0.5)
    hands.press([key], 10.0)
    expected = np.zeros(4)
    expected[axis] = 0.5 * sign
    assert np.array_equal(hands.action(10.5), expected)
    assert not hands.action(10.7).any(), "who lets go stops"


def test_two_axes_together_speed_and_stop():
    hands = HandSteering()
    hands.press(["w", "a", "9", "?", "\x1b", "é"], 0.0)
    assert hands.action(0.1).tolist() == [1.0, 1.0, 0.0, 0.0]
    hands.press(["s"], 0.2)
    assert hands.action(0.3).tolist() == [-1.0, 1.0, 0.0, 0.0], "the newest of an axis counts"
    hands.press([" "], 0.3)
    assert not hands.action(0.31).any()


# --------------------------------------------------------------------------------------------------- driving


class Script:
    """Keys pressed at chosen looks."""

    def __init__(self, *keys):
        self.left = list(keys)

    def pressed(self):
        return [self.left.pop(0)] if self.left else []


class OneRow:
    """The session's simulator as if its first row were all."""

    num_envs = 1

    def __init__(self, sim):
        self._sim = sim

    def __getattr__(self, name):
        return getattr(self._sim, name)


def test_the_hands_decide_at_the_clocks_pace(small):
    small.begin([3], seed=77001)
    shown, now, paced = [], SimpleNamespace(s=0.0), []
    clock = SimpleNamespace(begin=lambda *_: paced.clear(), step=paced.append)
    driver = HandDriver(OneRow(small.sim), Script("x", "w", "q"), shown.append, clock, lambda: now.s)
    driver.reset(None)
    assert not driver.decide(None).action.any() and len(shown) == 1, "x was pressed before the start"
    for _ in range(20):
        now.s += 0.02
        driver.advance()
    assert len(paced) == 20 and driver.decide(None).action.tolist()[0] == pytest.approx([0.6, 0, 0, 0.6])
    assert 4 <= len(shown) <= 6, "ten pictures a second"


def test_what_is_shown_is_what_the_vehicle_knows(small):
    small.begin([3], seed=77001)
    for _ in range(60):
        small.sim.step()
    view = view_of(small.sim, 0.6, np.zeros(4))
    sim = small.sim
    assert view.position == pytest.approx(sim.rows(sim.s.ego.pos_w)[0])
    assert view.time_s == pytest.approx(1.2) and view.static.any()
    before = view_of(sim, 0.6, np.zeros(4))  # then the truth is poisoned: nothing of it is shown
    for field in (sim.s.world.pos_w, sim.s.vehicle.pos_w, sim.s.vehicle.vel_b):
        field.from_numpy(np.full_like(field.to_numpy(), np.nan))
    after = view_of(sim, 0.6, np.zeros(4))
    assert all(np.array_equal(value, vars(after)[name]) for name, value in vars(before).items())


def test_one_person_drives_one_vehicle(small):
    with pytest.raises(LiveError, match="not 8"):
        HandDriver(small.sim, Script(), print, None)


def test_a_person_is_a_method(small):
    human = Method(hand_driver.NAME, small.trees["bt"], hand=HandPiece(Script(), lambda _view: None))
    note = human.driver_for(OneRow(small.sim))
    assert isinstance(note.pilot, HandDriver) and note.checkpoint_sha256 == ""
    assert note.outputs(0)["driver.action"].tolist() == [0.0] * 4


# --------------------------------------------------------------------------------------------------- picture


def seen(**changes):
    """What the person sees of a pool with a wall along the right end."""
    static, dynamic = np.zeros((2, 100, 200), bool)
    static[:, 195:] = True
    dynamic[50:54, 100:104] = True
    known = {
        "time_s": 3.0, "left_s": 57.0, "static": static, "dynamic": dynamic, "origin_m": (0.0, 0.0),
        "cell_m": 0.1, "position": (5.0, 5.0, -2.0), "yaw_rad": np.pi / 2, "velocity": (0.5, 0.0, -0.1),
        "goal": (15.0, 5.0, -1.0), "bodies": [(12.0, 8.0), (99.0, 8.0)], "near_m": 1.5, "share": 0.6,
        "action": (0.0, 0.0, 0.0, 0.0),
    }  # fmt: skip
    return DriverView(**(known | changes))


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 50), (40, 16), (20, 10)])
def test_a_screenful_fits_the_terminal(width, height):
    lines = screenful(seen(), width, height, "a\nb").plain.split("\n")
    chart = [line for line in lines if re.fullmatch(r"[|+].*[|+]", line)]
    assert all(len(line) <= width for line in chart) and (len(lines) <= height or height < 14)
    assert "G" in "".join(chart) and "↑" in "".join(chart) and "#" in "".join(chart)


def test_everything_lies_where_it_is():
    lines = screenful(seen(), 82, 40).plain.split("\n")
    chart = [line[1:-1] for line in lines if line.startswith("|")]
    assert len(chart) == 20 and len(chart[0]) == 80
    assert chart[9][20] == "↑" and chart[9][60] == "G" and chart[3][48] == "o"
    assert chart[9][40] == "%" and {row[79] for row in chart} == {"#"}
    assert "goal 10.0 m,  90 deg to the right, 1.0 m higher" in "\n".join(lines)


# --------------------------------------------------------------------------------------------------- command


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (("--rate", "0"), "--rate 0"),
        (("--episodes", "0"), "--episodes 0"),
        ((), "standard input is no terminal"),
    ],
)
def test_what_makes_no_sense_is_refused(typed, told, capfd, monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    code, out, err = uuv(capfd, "drive", *typed)
    assert (code, out) == (2, "") and told in err
