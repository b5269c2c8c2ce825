"""uuv simulate's function: what it returns, at which times, and what it refuses."""

import functools
import json
import math

import numpy as np
import pytest

from tests.oracles import dynamics as oracle
from uuvtai.common.presets import preset_names
from uuvtai.compile.runtime import start_taichi
from uuvtai.config.loader import load_config
from uuvtai.evaluation.simulate import Trial, control_step, simulate
from uuvtai.logs.topics.motion import angles_of, quaternion_of

F32_POSITION_M = 2e-3
"""Single precision over some hundred substeps, far below the design's 1 cm."""


@functools.cache
def raw():
    """One object: kernels are compiled anew for another."""
    return load_config("open", overrides={"vehicle.attitude_hold": "none"})


def run(config, **kwargs):
    return simulate(config, Trial(**kwargs), start_taichi("cpu"))


@pytest.fixture(scope="module")
def mixed():
    """One run with every input but a command."""
    return run(
        raw(), seconds=2.0, wrench=(5, 2, 0, 0, 0, 0.3), current=(0.1, -0.2, 0.05),
        initial_rpy_deg=(10, -15, 100), initial_velocity=(0.3, 0, -0.1, 0.1, 0, 0.2), neutral=True,
    )  # fmt: skip


def test_document_has_the_documented_shape(mixed):
    assert list(mixed) == ["t", "position", "rpy_deg", "nu", "rpm"]
    assert [len(mixed[k]) for k in mixed] == [101] * 5
    assert np.allclose(mixed["t"], np.arange(101) * 0.02)
    assert [len(mixed[k][0]) for k in ("position", "rpy_deg", "nu", "rpm")] == [3, 3, 6, 6]
    assert json.loads(json.dumps(mixed, allow_nan=False)) == mixed


def test_first_sample_is_the_initial_state(mixed):
    assert mixed["position"][0] == [0, 0, 0]
    assert np.allclose(mixed["rpy_deg"][0], [10, -15, 100], atol=1e-4)
    assert np.allclose(mixed["nu"][0], [0.3, 0, -0.1, 0.1, 0, 0.2])


def test_all_inputs_act_as_in_the_oracle(mixed):
    want = oracle.simulate(
        oracle.Body().neutral(), 2.0, dt=5e-3, wrench=[5, 2, 0, 0, 0, 0.3], current=[0.1, -0.2, 0.05],
        rpy_deg=(10, -15, 100), nu=[0.3, 0, -0.1, 0.1, 0, 0.2], sample_s=0.02,
    )  # fmt: skip
    assert np.abs(np.array(mixed["position"]) - want["position"]).max() < F32_POSITION_M
    assert np.abs(np.array(mixed["nu"]) - want["nu"]).max() < F32_POSITION_M
    assert np.abs(np.array(mixed["rpy_deg"]) - want["rpy_deg"]).max() < 0.1
    assert not np.array(mixed["rpm"]).any()


def test_command_drives_the_inner_loop():
    out = run(load_config("open"), seconds=3.0, command=(0.5, 0, -0.2, 0.4), current=(0, 0, 0))
    assert np.allclose(np.array(out["nu"][-1])[[0, 1, 2, 5]], [0.5, 0, -0.2, 0.4], atol=0.025)
    assert np.abs(out["rpm"][-1]).max() > 500


@pytest.mark.parametrize(
    ("dt", "substeps", "control"),
    [
        (0.01, 2, 0.02),
        (0.02, 1, 0.02),
        (0.005, 4, 0.02),
        (0.001, 20, 0.02),
        (0.008, 3, 0.024),
        (0.05, 1, 0.05),
    ],
)
def test_control_step_follows_the_substep(dt, substeps, control):
    got = control_step(dt)
    assert got[0] == substeps and math.isclose(got[1], control)


def test_angles_there_and_back():
    rng = np.random.default_rng(0)
    for rpy in rng.uniform(-1.5, 1.5, (20, 3)) * [2, 1, 2]:
        assert np.allclose(angles_of(*quaternion_of(rpy)), rpy)
        assert np.allclose(oracle.quaternion_rotation(quaternion_of(rpy)), oracle.euler_rotation(*rpy))


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"seconds": 0.0}, "--seconds must be a positive number"),
        ({"seconds": -1.0}, "--seconds 10"),
        ({"seconds": math.nan}, "--seconds"),
        ({"seconds": 1e9}, "use fewer seconds"),
        ({"seconds": 1.0, "dt": 0.0}, "--dt 0.01"),
        ({"seconds": 1.0, "dt": -0.01}, "--dt"),
        ({"seconds": 1.0, "dt": math.inf}, "--dt"),
        ({"seconds": 1.0, "dt": 1e-9}, "larger --dt"),
        ({"seconds": 1.0, "wrench": (1, 2, 3)}, "--wrench must be 6 numbers"),
        ({"seconds": 1.0, "wrench": (0, 0, math.nan, 0, 0, 0)}, "--wrench must be finite"),
        ({"seconds": 1.0, "current": (0, 0, "x")}, "--current must be 3 numbers"),
        ({"seconds": 1.0, "initial_rpy_deg": (0, 0, 1e9)}, "--initial-rpy-deg must be finite numbers below"),
        ({"seconds": 1.0, "initial_velocity": ()}, "--initial-velocity must be 6 numbers"),
        ({"seconds": 1.0, "command": (0.9, 0, 0, 0)}, "--set vehicle.max_surge_m_s"),
    ],
)
def test_nonsense_is_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        run(raw(), **wrong)


def test_divergence_is_named():
    with pytest.raises(FloatingPointError, match="smaller substep"):
        run(raw(), seconds=20.0, dt=0.5, wrench=(0, 0, 0, 0, 0, 500))


PUBLISHED_DRAG_N = {
    "bluerov2": 8.96,
    "bluerov2_16v": 8.96,
    "bluerov2_heavy": 8.96,
    "bluerov2_li2020": 14.5,
    "bluerov2_vonbenzon2022": 59.0,
}
"""at 0.6 m/s surge"""


@pytest.mark.parametrize("name", preset_names("vehicle"))
def test_vehicle_presets_have_the_published_drag(name):
    v = load_config("open", vehicle=name).vehicle
    drag = v.linear_damping[0] * 0.6 + v.quadratic_damping[0] * 0.36
    assert abs(drag - PUBLISHED_DRAG_N[name]) < 0.05
    assert len(v.thrusters) == (8 if v.attitude_hold == "thrusters" else 6)
