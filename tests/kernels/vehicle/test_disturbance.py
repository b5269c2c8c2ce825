"""Every disturbance changes what it should, and is off by default."""

import numpy as np
import pytest

from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config
from uuvtai.sim.plant import Plant

N_ENV = 4096
"""Rows of one plant: the standard error of a standard deviation is 1.1 %."""

SIGMA, TAU_S, MEAN = 0.12, 5.0, (0.2, -0.1, 0.05)
DELAY_STEPS = 3
STATISTICS = 0.05
"""Allowed relative error of a standard deviation: four standard errors."""


def config(**disturbance):
    return Config.model_validate({"disturbance": disturbance})


@pytest.fixture(scope="module")
def disturbed():
    """All switches on."""
    settings = {
        "current_m_s": MEAN, "current_sigma_m_s": SIGMA, "current_tau_s": TAU_S,
        "thruster_delay_s": DELAY_STEPS * 0.02, "thruster_gain_loss": 0.3, "dead_thruster": 4,
        "mass_spread": 0.1, "damping_spread": 0.5, "added_mass_spread": 0.2,
    }  # fmt: skip
    plant = Plant(config(**settings), start_taichi("cpu"), n_env=N_ENV)
    plant.reset()
    return plant


@pytest.fixture(scope="module")
def calm():
    plant = Plant(config(), start_taichi("cpu"), n_env=8)
    plant.reset()
    return plant


def test_off_by_default(calm):
    p, v = calm.params, calm.config.vehicle
    assert (p.mass_kg.to_numpy() == np.float32(v.mass_kg)).all()
    assert np.allclose(p.buoyancy_n.to_numpy(), v.water_density_kg_m3 * v.gravity_m_s2 * v.volume_m3)
    assert (p.added_mass.to_numpy() == np.float32(v.added_mass)).all()
    assert (p.linear_damping.to_numpy() == np.float32(v.linear_damping)).all()
    assert (p.quadratic_damping.to_numpy() == np.float32(v.quadratic_damping)).all()
    assert (p.thruster_gain.to_numpy() == 1).all() and not p.delay_steps.to_numpy().any()
    assert not calm.current.vel_w.to_numpy().any()


@pytest.mark.parametrize(
    ("name", "nominal", "spread"),
    [
        ("mass_kg", "mass_kg", 0.1),
        ("added_mass", "added_mass", 0.2),
        ("linear_damping",) * 2 + (0.5,),
        ("quadratic_damping",) * 2 + (0.5,),
    ],
)
def test_parameters_spread_uniformly(disturbed, name, nominal, spread):
    factor = getattr(disturbed.params, name).to_numpy() / np.array(getattr(disturbed.config.vehicle, nominal))
    factor = factor.reshape(N_ENV, -1)
    assert factor.min() >= 1 - spread - 1e-5 and factor.max() <= 1 + spread + 1e-5
    assert np.abs(factor.mean(axis=0) - 1).max() < 4 * spread / np.sqrt(3 * N_ENV)
    assert np.abs(factor.std(axis=0) / (spread / np.sqrt(3)) - 1).max() < STATISTICS
    if factor.shape[1] > 1:
        independent = np.corrcoef(factor.T) - np.eye(factor.shape[1])
        assert np.abs(independent).max() < 5 / np.sqrt(N_ENV)


def test_buoyancy_and_inertia_follow_the_mass(disturbed):
    p, v = disturbed.params, disturbed.config.vehicle
    factor = p.mass_kg.to_numpy() / v.mass_kg
    assert np.allclose(
        p.buoyancy_n.to_numpy(), factor * v.water_density_kg_m3 * v.gravity_m_s2 * v.volume_m3, rtol=1e-6
    )
    assert np.allclose(p.inertia.to_numpy(), factor[:, None] * np.array(v.inertia_kg_m2), rtol=1e-6)


def test_gain_loss_and_dead_thruster(disturbed):
    gain = disturbed.params.thruster_gain.to_numpy()
    assert not gain[:, 4].any()
    healthy = np.delete(gain, 4, axis=1)
    assert healthy.min() > 0.7 - 1e-6 and healthy.max() <= 1
    assert np.abs(healthy.mean(axis=0) - 0.85).max() < 4 * 0.3 / np.sqrt(12 * N_ENV)


def test_thrust_follows_the_gain(disturbed):
    disturbed.reset()
    disturbed.write(disturbed.actuation.rpm_command, 2000.0)
    for _ in range(10):
        disturbed.step()
    thrust, gain = disturbed.actuation.thrust_n.to_numpy(), disturbed.params.thruster_gain.to_numpy()
    healthy = thrust[0, 0] / gain[0, 0]
    assert healthy > 10
    assert np.allclose(thrust, healthy * gain, rtol=1e-4)


def test_commands_arrive_late(disturbed):
    disturbed.reset()
    assert (disturbed.params.delay_steps.to_numpy() == DELAY_STEPS).all()
    action = np.tile(np.array([1, 0, 0, 0], np.float32), (N_ENV, 1))
    fired = []
    for _ in range(DELAY_STEPS + 2):
        disturbed.step(action)
        fired.append(bool(np.abs(disturbed.actuation.rpm_command.to_numpy()).max() > 0))
    assert fired == [False] * DELAY_STEPS + [True, True]


def test_a_queue_from_another_episode_is_gone_after_reset(disturbed):
    action = np.ones((N_ENV, 4), np.float32)
    for _ in range(5):
        disturbed.step(action)
    disturbed.reset()
    for _ in range(DELAY_STEPS):
        disturbed.step(action)
        assert not disturbed.actuation.rpm_command.to_numpy().any()


def test_current_is_a_gauss_markov_process(disturbed):
    disturbed.reset()
    first = disturbed.current.vel_w.to_numpy() - MEAN
    steps = round(TAU_S / 0.02)
    for k in range(steps):
        disturbed.step()
        if k == 0:
            second = disturbed.current.vel_w.to_numpy() - MEAN
    last = disturbed.current.vel_w.to_numpy() - MEAN
    for sample in (first, last):  # stationary from the start
        assert np.abs(sample[:, :2].std(axis=0) / SIGMA - 1).max() < STATISTICS
        assert np.abs(sample[:, :2].mean(axis=0)).max() < 4 * SIGMA / np.sqrt(N_ENV)
        assert np.abs(sample[:, 2]).max() < 1e-6  # horizontal only
    for axis in (0, 1):
        assert abs(np.corrcoef(first[:, axis], last[:, axis])[0, 1] - np.exp(-1)) < 4 / np.sqrt(N_ENV)
    kick = (second - np.exp(-0.02 / TAU_S) * first)[:, :2]
    assert np.abs(kick.std(axis=0) / (SIGMA * np.sqrt(1 - np.exp(-0.04 / TAU_S))) - 1).max() < STATISTICS
    # the first kick owes nothing to the initial draw
    assert np.abs(np.corrcoef(kick.T, first[:, :2].T)[:2, 2:]).max() < 5 / np.sqrt(N_ENV)
    assert abs(np.corrcoef(kick.T)[0, 1]) < 5 / np.sqrt(N_ENV)


def test_an_episode_is_a_function_of_its_key(disturbed):
    rng = np.random.default_rng(0)
    keys = rng.integers(0, 2**32, N_ENV, dtype=np.uint64).astype(np.uint32)

    def drawn(k):
        disturbed.reset(k)
        disturbed.step()
        p = disturbed.params
        return np.c_[
            p.mass_kg.to_numpy(),
            p.quadratic_damping.to_numpy(),
            p.thruster_gain.to_numpy(),
            disturbed.current.vel_w.to_numpy(),
        ]

    once = drawn(keys)
    order = rng.permutation(N_ENV)
    assert np.array_equal(drawn(keys[order]), once[order])


def test_a_thruster_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="thrusters 0 to 5"):
        Plant(config(dead_thruster=6), start_taichi("cpu"))
