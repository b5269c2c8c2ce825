"""Thruster watch: weighing against a NumPy oracle, who is given up, and that nobody else notices."""

import numpy as np
import pytest
import torch

from tests.oracles.actuation import thrust_of_rpm
from uuvtai.config import Thruster, VehicleConfig
from uuvtai.config.loader import ConfigError, load_config
from uuvtai.kernels.vehicle import thruster_fault

SEED = 77002
LEFT, RIGHT = 4, 5
"""the vertical thrusters of the six-thruster frame"""
HEALTHY, DEAD_LEFT, DEAD_RIGHT, BOTH_WEAK, ONE_WEAK, DEAD_LEVEL = range(6)
GAINS = {
    DEAD_LEFT: {LEFT: 0.0}, DEAD_RIGHT: {RIGHT: 0.0}, BOTH_WEAK: {LEFT: 0.5, RIGHT: 0.5},
    ONE_WEAK: {LEFT: 0.6}, DEAD_LEVEL: {0: 0.0},
}  # fmt: skip
STEPS = 60
SMOOTH_S = 0.1


def weave(step):
    """Sway to and fro, which asks the vertical thrusters to hold the roll, with some heave."""
    action = torch.zeros(8, 4)
    action[:, 1] = 1.0 if step // 15 % 2 == 0 else -1.0
    action[:, 2] = 0.3 if step // 20 % 2 == 0 else -0.3
    return action


def driven(small, gains):
    """(thruster given up (rows,), speeds asked for (steps, rows, thrusters)) of all rows, from rest."""
    small.begin(range(8), seed=SEED)
    s = small.sim.s
    for row, lost in gains.items():
        for thruster, gain in lost.items():
            s.params.thruster_gain[row, thruster] = gain
    asked = []
    for step in range(STEPS):
        small.sim.step(weave(step))
        asked.append(s.actuation.rpm_command.to_numpy()[:8].copy())
    return s.ego.given_up.to_numpy()[:8].copy(), np.array(asked)


@pytest.fixture(scope="module")
def lossy(small):
    return driven(small, GAINS)


@pytest.fixture(scope="module")
def whole(small):
    return driven(small, {})


def test_a_dead_vertical_thruster_is_given_up_and_no_other(lossy, whole):
    assert not whole[0].any()
    expected = {DEAD_LEFT: 1 + LEFT, DEAD_RIGHT: 1 + RIGHT}
    assert lossy[0].tolist() == [expected.get(row, 0) for row in range(8)]


def test_its_mate_carries_on_alone(lossy):
    cfg = VehicleConfig()
    for row, dead, mate in ((DEAD_LEFT, LEFT, RIGHT), (DEAD_RIGHT, RIGHT, LEFT)):
        asked = lossy[1][:, row]
        given_up = np.flatnonzero(asked[:, dead])[-1] + 1
        assert 2 < given_up < STEPS - 10 and not asked[given_up:, dead].any()
        assert np.abs(thrust_of_rpm(asked[given_up:, mate], cfg)).max() > 1.0


def test_whole_vehicles_get_the_same_to_the_last_bit(lossy, whole):
    for row in (HEALTHY, 6, 7):
        assert np.array_equal(lossy[1][:, row], whole[1][:, row])


def test_both_share_what_the_pair_was_asked_for(small):
    """The step after the verdict: one thruster gets the thrust of two."""
    asked = {}
    for given_up in (0, 1 + LEFT, 1 + RIGHT):
        small.begin([0], seed=SEED)
        small.sim.s.ego.given_up[0] = given_up
        small.sim.step(weave(0))
        rpm = small.sim.s.actuation.rpm_command.to_numpy()[0]
        asked[given_up] = rpm, thrust_of_rpm(rpm, small.config.vehicle)
    both = asked[0][1][LEFT] + asked[0][1][RIGHT]
    for given_up, alone in ((1 + LEFT, RIGHT), (1 + RIGHT, LEFT)):
        rpm, thrust = asked[given_up]
        assert rpm[given_up - 1] == 0 and thrust[alone] == pytest.approx(both, abs=0.01)
        assert np.array_equal(rpm[:4], asked[0][0][:4])


def test_it_is_forgotten_with_the_episode(small):
    small.begin([0], seed=SEED)
    small.sim.s.ego.given_up[0] = 1 + LEFT
    small.sim.step(weave(0))
    small.sim.step(weave(1))
    assert small.sim.s.actuation.response.to_numpy()[0, 7] == 0, "nothing is weighed after the verdict"
    small.begin([0], seed=SEED)
    assert small.sim.s.ego.given_up[0] == 0 and not small.sim.s.actuation.response.to_numpy()[0].any()


# ---------------------------------------------------------------------------------------------- the equations


def felt(cfg, vel, rate, rpy, force):
    """[N] vertical thrust that explains these readings: Fossen's equation of heave, in float64."""
    mass = cfg.mass_kg + np.array(cfg.added_mass[:3])
    up = np.cos(rpy[0]) * np.cos(rpy[1])
    gained = force[2] - cfg.gravity_m_s2 * up - np.cross(rate, vel)[2]
    drag = (cfg.linear_damping[2] + cfg.quadratic_damping[2] * abs(vel[2])) * vel[2]
    net = cfg.gravity_m_s2 * (cfg.water_density_kg_m3 * cfg.volume_m3 - cfg.mass_kg)
    return mass[2] * gained + np.cross(rate, mass * vel)[2] + drag - net * up


def test_the_sums_are_those_of_the_oracle(small):
    small.begin(range(8), seed=SEED)
    s, cfg = small.sim.s, small.config
    random = np.random.default_rng(3)
    vel, rate, rpy = (random.normal(0, size, (8, 3)).astype(np.float32) for size in (0.3, 0.3, 0.2))
    force = random.normal([0, 0, 9.81], 0.5, (8, 3)).astype(np.float32)
    rpm = random.uniform(-3000, 3000, (8, 6)).astype(np.float32)
    before = random.uniform(0, 1, (8, 12)).astype(np.float32)
    for row in range(8):
        s.clock.step[row], s.ego.vel_valid[row] = 1, int(row != 7)
        for name, value in (("vel_b", vel), ("rate_b", rate), ("rpy", rpy), ("specific_force_b", force)):
            getattr(s.ego, name)[row] = value[row].tolist()
        for i in range(6):
            s.actuation.rpm_queue[row, 0, i] = rpm[row, i]
        for i in range(12):
            s.actuation.response[row, i] = before[row, i]
    thruster_fault.watch_thrusters(small.sim.io.thrusters)
    after = s.actuation.response.to_numpy()[:8]
    kept, stays = np.exp(-0.02 / cfg.actuation.watch_s), np.exp(-0.02 / SMOOTH_S)
    for row in range(7):
        asked = [thrust_of_rpm(rpm[row, thruster], cfg.vehicle) for thruster in (LEFT, RIGHT)]
        force_n = felt(cfg.vehicle, *(x[row].astype(float) for x in (vel, rate, rpy, force)))
        smooth = stays * before[row, :3] + (1 - stays) * np.array([force_n, *asked])
        a, b, total = smooth[1], smooth[2], smooth[1] + smooth[2]
        r = smooth[0] - total
        new = np.array([r * r, r * total, total * total, r, 1.0, (r + a) ** 2, a, (r + b) ** 2, b])
        np.testing.assert_allclose(after[row, :3], smooth, rtol=2e-4, atol=2e-3)
        np.testing.assert_allclose(after[row, 3:], kept * before[row, 3:] + 0.02 * new, rtol=2e-4, atol=2e-3)
    assert np.array_equal(after[7], before[7]), "without a DVL nothing is weighed"


def test_the_first_step_has_nothing_to_weigh(small):
    small.begin([0], seed=SEED)
    small.sim.step(weave(0))
    assert not small.sim.s.actuation.response.to_numpy()[0].any()
    small.sim.step(weave(1))
    assert small.sim.s.actuation.response.to_numpy()[0, 7] == pytest.approx(0.02)


# --------------------------------------------------------------------------------------------- who is watched


def test_frames_with_two_or_more_vertical_thrusters_are_watched():
    six, eight = (load_config("open", vehicle=name) for name in ("bluerov2", "bluerov2_heavy"))
    assert thruster_fault.vertical_pair(six.vehicle) == (LEFT, RIGHT)
    assert thruster_fault.vertical_pair(eight.vehicle) == ()
    assert thruster_fault.vertical_group(eight.vehicle) == (4, 5, 6, 7)
    assert all(thruster_fault.is_watched(one.vehicle, one.actuation) for one in (six, eight))
    off = load_config("open", overrides={"actuation.watch_s": 0})
    assert not thruster_fault.is_watched(off.vehicle, off.actuation)
    *level, left, right = six.vehicle.thrusters
    turned = Thruster(position_m=right.position_m, direction=(0.0, 0.0, -1.0))
    leaning = Thruster(position_m=right.position_m, direction=(0.0, 0.5, 1.0))
    for other in (turned, leaning):
        assert thruster_fault.vertical_pair(VehicleConfig(thrusters=(*level, left, other))) == ()


def test_an_impossible_memory_is_refused():
    with pytest.raises(ConfigError, match=r"actuation\.watch_s"):
        load_config("open", overrides={"actuation.watch_s": -1})
