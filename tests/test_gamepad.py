"""A gamepad's sticks become commands. The controller is SDL's own virtual one, moved by SDL's own calls."""

import ctypes
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from uuvtai.live import gamepad as pad
from uuvtai.live.gamepad import gamepad, without_rest
from uuvtai.live.hand_driver import HandDriver
from uuvtai.live.hand_steering import HEAVE, SURGE, SWAY, YAW, HandSteering
from uuvtai.live.keyboard import keys_of
from uuvtai.live.viewer_server import LiveError

LEFT_X, LEFT_Y, RIGHT_X, RIGHT_Y = 0, 1, 2, 3
"""axes of SDL's virtual controller"""
_GAME_CONTROLLER, _AXES, _BUTTONS = 1, 6, 15


class VirtualController:
    """A controller that is plugged in by ``SDL_JoystickAttachVirtual``."""

    def __init__(self):
        pygame = pytest.importorskip("pygame", reason="needs pygame-ce (uuvtai[gamepad])")
        found = sorted(Path(pygame.__file__).parents[1].glob("pygame_ce.libs/libSDL2-2*"))
        if sys.platform != "linux" or not found:
            pytest.skip("SDL's library lies elsewhere on this system")
        self._sdl = ctypes.CDLL(str(found[0]))
        self._sdl.SDL_JoystickOpen.restype = ctypes.c_void_p
        self._sdl.SDL_JoystickSetVirtualAxis.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_int16]
        pygame.joystick.init()
        self.index = self._sdl.SDL_JoystickAttachVirtual(_GAME_CONTROLLER, _AXES, _BUTTONS, 0)
        assert self.index >= 0
        self._stick = self._sdl.SDL_JoystickOpen(self.index)

    def tilt(self, axis, share):
        self._sdl.SDL_JoystickSetVirtualAxis(self._stick, axis, int(32767 * share))

    def unplug(self):
        if self.index is not None:
            self._sdl.SDL_JoystickDetachVirtual(self.index)
            self.index = None


@pytest.fixture
def plugged():
    found = VirtualController()
    yield found
    found.unplug()


@pytest.mark.parametrize(
    ("stick", "share", "axis", "sign"),
    [
        (LEFT_Y, -1.0, SURGE, 1), (LEFT_Y, 1.0, SURGE, -1), (LEFT_X, -1.0, SWAY, 1),
        (RIGHT_Y, -1.0, HEAVE, 1), (RIGHT_X, 1.0, YAW, -1),
    ],
)  # fmt: skip
def test_each_stick_moves_its_axis(plugged, stick, share, axis, sign):
    with gamepad() as sticks:
        assert not sticks.tilted().any(), "at rest"
        plugged.tilt(stick, share)
        wanted = np.zeros(4)
        wanted[axis] = sign
        np.testing.assert_allclose(sticks.tilted(), wanted, atol=1e-3)
        plugged.tilt(stick, 0.0)
        assert not sticks.tilted().any()


def test_an_unplugged_gamepad_asks_for_nothing(plugged):
    with gamepad() as sticks:
        plugged.tilt(LEFT_Y, -1.0)
        assert sticks.tilted()[SURGE] == pytest.approx(1.0)
        plugged.unplug()
        assert not sticks.tilted().any()


def test_a_dead_zone_ends_where_the_command_begins():
    np.testing.assert_allclose(without_rest(np.array([0.0, 0.149, -0.15, 0.575, -1.2])), [0, 0, 0, 0.5, -1])


def test_without_a_gamepad_it_says_what_to_do():
    pytest.importorskip("pygame", reason="needs pygame-ce (uuvtai[gamepad])")
    with (
        pytest.raises(LiveError, match=r"no gamepad is connected.*plug one in, or leave --gamepad out"),
        gamepad(),
    ):
        pytest.fail("there is none")


def test_without_sdl_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(pad.importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(LiveError, match=r"pip install 'uuvtai\[gamepad\]'"), gamepad():
        pytest.fail("there is none")


def test_a_stick_outweighs_keys_where_it_is_not_at_rest():
    steering = HandSteering()
    steering.press(keys_of("9wq"), 0.0)
    tilt = np.array([-0.5, 0.25, 0.0, 0.0], np.float32)
    assert steering.action(0.1, tilt).tolist() == [-0.5, 0.25, 0.0, 1.0]
    assert steering.action(0.1).tolist() == [1.0, 0.0, 0.0, 1.0]


def test_the_driver_follows_the_sticks(small):
    small.begin([3], seed=77001)
    row = SimpleNamespace(num_envs=1, s=small.sim.s, config=small.sim.config, rows=small.sim.rows)
    clock = SimpleNamespace(begin=lambda *_: None, step=lambda _sim: None)
    sticks = SimpleNamespace(tilted=lambda: np.array([1.0, 0.0, 0.0, -0.5], np.float32))
    keys = SimpleNamespace(pressed=lambda: [])
    driver = HandDriver(row, keys, lambda _view: None, clock, sticks=sticks)
    driver.reset(None)
    driver.advance()
    assert driver.decide(None).action.tolist()[0] == pytest.approx([0.6, 0.0, 0.0, -0.3])
