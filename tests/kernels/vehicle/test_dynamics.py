"""Rigid body in water: the reference table, an RK4 oracle, order of convergence, invariants, rows."""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.oracles import dynamics as oracle
from uuvtai.compile.runtime import start_taichi
from uuvtai.config import Config, VehicleConfig
from uuvtai.sim.plant import Plant

POSITION_M, SPEED_M_S, ANGLE_DEG = 0.01, 0.01, 0.3
"""What is asked for at the 0.01 s substep."""

PRINTED = 0.5e-3
"""The table prints three decimals."""

F32_ACCELERATION = 2e-4
"""[m/s^2, rad/s^2] single precision: forces of 100 N cancel to some 1e-5 N, divided by inertias of 0.4 kg
m^2."""

F32_DRIFT_M = 2e-3
"""500 substeps of single precision over metres, and the second-order error of turning the current."""

ORDER_TWO = 3.5
"""A second-order method divides the error by 4 when dt is halved; 2 is what the design demands."""

SAMPLE_S, DT_S = 0.2, 5e-3
"""Every tenth control step; the oracle's, whose error is of the fourth order."""
TABLE = {
    "net buoyancy": {},
    "heave force": {"wrench": [0, 0, 10, 0, 0, 0]},
    "heave force, neutral": {"wrench": [0, 0, 10, 0, 0, 0], "neutral": True},
    "roll release": {"rpy_deg": [30, 0, 0]},
    "current": {"current": [0.3, 0, 0], "neutral": True},
    "yaw moment": {"wrench": [0, 0, 0, 0, 0, 1]},
    "strong yaw moment": {"wrench": [0, 0, 0, 0, 0, 39.5]},
}
EXPECTED = [  # case, time, quantity, component, value, digits printed
    ("net buoyancy", 10, "position", 2, 0.475, PRINTED),
    ("net buoyancy", 10, "nu", 2, 0.065, PRINTED),
    ("heave force", 5, "position", 2, 1.940, PRINTED),
    ("heave force", 5, "nu", 2, 0.467, PRINTED),
    ("heave force, neutral", 5, "position", 2, 1.877, PRINTED),
    ("roll release", 1, "rpy_deg", 0, 10.1, 0.05),
    ("roll release", 2, "rpy_deg", 0, -5.3, 0.05),
    ("roll release", 5, "rpy_deg", 0, 2.0, 0.05),
    ("roll release", 10, "rpy_deg", 0, -1.2, 0.05),
    ("current", 20, "nu", 0, 0.299, PRINTED),
    ("current", 20, "position", 0, 5.215, PRINTED),
    ("yaw moment", 5, "nu", 5, 0.781, PRINTED),
    ("strong yaw moment", 5, "nu", 5, 5.026, PRINTED),
]
ALLOWED = {"position": POSITION_M, "nu": SPEED_M_S, "rpy_deg": ANGLE_DEG}


def random_cases(n, seed=3):
    """Wrenches, currents, attitudes and velocities of the size that a BlueROV2 meets."""
    rng = np.random.default_rng(seed)
    return [
        {
            "wrench": [*rng.uniform(-8, 8, 3), *rng.uniform(-0.5, 0.5, 3)],
            "current": [*rng.uniform(-0.3, 0.3, 3)],
            "rpy_deg": [*rng.uniform(-40, 40, 2), rng.uniform(-180, 180)],
            "nu": [*rng.uniform(-0.5, 0.5, 3), *rng.uniform(-0.8, 0.8, 3)],
            "neutral": bool(i % 2),
        }
        for i in range(n)
    ]


def run_f64(cases, substeps, n_sample):
    """Trajectories from a process in double precision: {substeps: {quantity: (sample, case, component)}}."""
    job = {"cases": cases, "substeps": substeps, "n_sample": n_sample}
    command = [sys.executable, str(Path(__file__).parents[2] / "physics_f64.py")]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    done = subprocess.run(
        command, input=json.dumps(job), capture_output=True, text=True, env=env, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    runs = json.loads(done.stdout[done.stdout.index('{"') :])
    return {int(n): {name: np.array(x) for name, x in run.items()} for n, run in runs.items()}


def reference(case, seconds):
    """The oracle's trajectory of one case, sampled like the plant's."""
    body = oracle.Body().neutral() if case.get("neutral") else oracle.Body()
    settings_ = {k: v for k, v in case.items() if k != "neutral"}
    return oracle.simulate(body, seconds, dt=DT_S, sample_s=SAMPLE_S, **settings_)


@cache
def random_reference(index):
    """That of a random case."""
    return reference(random_cases(3)[index], 5.0)


# ------------------------------------------------------------------------------------------- double precision


@pytest.fixture(scope="module")
def exact_runs():
    """Table first, then random cases, at one, two and four substeps of a control step of 0.02 s."""
    return run_f64([*TABLE.values(), *random_cases(3)], [1, 2, 4], 101)


@pytest.mark.parametrize(("case", "time_s", "quantity", "component", "value", "digits"), EXPECTED)
def test_reference_table(exact_runs, case, time_s, quantity, component, value, digits):
    got = exact_runs[2][quantity][round(time_s / SAMPLE_S), list(TABLE).index(case), component]
    assert abs(got - value) < ALLOWED[quantity]
    fine = exact_runs[4][quantity][round(time_s / SAMPLE_S), list(TABLE).index(case), component]
    assert abs(fine - value) < 1.5 * digits


@pytest.mark.parametrize("index", range(3))
def test_random_experiments_agree_with_rk4(exact_runs, index):
    want = random_reference(index)
    column = len(TABLE) + index
    n = len(want["nu"])
    for quantity, allowed in ALLOWED.items():
        difference = exact_runs[2][quantity][:n, column] - want[quantity]
        if quantity == "rpy_deg":
            difference = (difference + 180) % 360 - 180
        assert np.abs(difference).max() < allowed, quantity


def test_halving_dt_divides_the_error_by_four(exact_runs):
    for index, case in enumerate([TABLE["roll release"], *random_cases(3)]):
        column = list(TABLE).index("roll release") if index == 0 else len(TABLE) + index - 1
        want = random_reference(index - 1) if index else reference(case, 3.0)
        error = [np.abs(exact_runs[n]["nu"][15, column] - want["nu"][15]).max() for n in (1, 2, 4)]
        assert error[0] > ORDER_TWO * error[1] > ORDER_TWO**2 * error[2], case


def test_level_drag_of_the_oracle_matches_the_table():
    body = oracle.Body().neutral()
    for axis, speed, drag in ((0, 0.6, 8.96), (1, 0.4, 5.95), (2, 0.2, 2.52)):
        nu = np.zeros(6)
        nu[axis] = speed
        force = -body.mass_matrix @ oracle.nu_dot(body, np.eye(3), nu, np.zeros(6), np.zeros(3))
        assert abs(force[axis] - drag) < 0.005


# ------------------------------------------------------------------------------------------- single precision

N_ENV = 6


@pytest.fixture(scope="module")
def plant():
    """Raw plant, no attitude hold."""
    return Plant(Config(vehicle=VehicleConfig(attitude_hold="none")), start_taichi("cpu"), n_env=N_ENV)


def random_state(plant, seed):
    """Put every env into a random motion; returns (quaternions, nu, wrench, current)."""
    rng = np.random.default_rng(seed)
    plant.reset()
    q = rng.normal(size=(N_ENV, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    nu, wrench = rng.uniform(-1, 1, (N_ENV, 6)), rng.uniform(-20, 20, (N_ENV, 6)) * 0.5
    current = rng.uniform(-0.5, 0.5, (N_ENV, 3))
    plant.write(plant.vehicle.quat_wb, q)
    plant.write(plant.vehicle.vel_b, nu[:, :3])
    plant.write(plant.vehicle.rate_b, nu[:, 3:])
    plant.write(plant.actuation.external_wrench_b, wrench)
    plant.write(plant.current.vel_w, current)
    return q, nu, wrench, current


def motion(plant):
    """All that moves, as one array (n_env, ..)."""
    v = plant.vehicle
    fields = (v.pos_w, v.quat_wb, v.vel_b, v.rate_b, v.acc_b, v.rpm)
    return np.concatenate([f.to_numpy().reshape(N_ENV, -1) for f in fields], axis=1)


def test_acceleration_equals_the_oracle(plant):
    dt = 2.0**-10  # small enough that the change over it is dt times the derivative at its middle
    for seed in range(3):
        q, nu, wrench, current = random_state(plant, seed)
        plant.step(substeps=1, dt_s=dt)
        after = np.c_[plant.vehicle.vel_b.to_numpy(), plant.vehicle.rate_b.to_numpy()].astype(float)
        got = (after - nu.astype(np.float32)) / dt
        for env in range(N_ENV):
            rotation = oracle.quaternion_rotation(q[env])
            want = oracle.nu_dot(oracle.Body(), rotation, nu[env], wrench[env], current[env])
            middle = oracle.nu_dot(
                oracle.Body(), rotation, nu[env] + 0.5 * dt * want, wrench[env], current[env]
            )
            rounding = 2 * np.finfo(np.float32).eps / dt  # nu is stored with 24 bits
            # the attitude turns by up to 1 mrad meanwhile: some 60 times that in a restoring acceleration
            turn = 60 * dt
            assert np.abs(got[env] - middle).max() < F32_ACCELERATION + rounding + turn


def test_imu_acceleration_is_the_derivative_of_the_world_velocity(plant):
    dt = 0.01
    q, nu, _, _ = random_state(plant, 7)
    plant.step(substeps=1, dt_s=dt)
    v = plant.vehicle
    for env in range(N_ENV):
        before = oracle.quaternion_rotation(q[env])
        after = oracle.quaternion_rotation(v.quat_wb.to_numpy()[env].astype(float))
        change = (after @ v.vel_b.to_numpy()[env] - before @ nu[env, :3]) / dt
        turned = oracle.quaternion_rotation(
            (q[env] + v.quat_wb.to_numpy()[env]) / np.linalg.norm(q[env] + v.quat_wb.to_numpy()[env])
        )
        # second differences of a motion of about 10 m/s^2
        assert np.allclose(turned.T @ change, v.acc_b.to_numpy()[env], atol=5e-3)


@settings(max_examples=8, derandomize=True, deadline=None)
@given(st.integers(0, 10**6))
def test_energy_never_grows_without_thrust_and_current(plant, seed):
    random_state(plant, seed)
    plant.write(plant.actuation.external_wrench_b, 0.0)
    plant.write(plant.current.vel_w, 0.0)
    last = np.full(N_ENV, np.inf)
    for _ in range(40):
        q = plant.vehicle.quat_wb.to_numpy().astype(float)
        nu = np.c_[plant.vehicle.vel_b.to_numpy(), plant.vehicle.rate_b.to_numpy()]
        z = plant.vehicle.pos_w.to_numpy()[:, 2]
        now = np.array(
            [
                oracle.energy(oracle.Body(), z[i], oracle.quaternion_rotation(q[i]), nu[i].astype(float))
                for i in range(N_ENV)
            ]
        )
        assert (now <= last + 2e-5).all()  # single precision of some 10 J
        last = now
        plant.step()


def test_frictionless_body_keeps_its_energy(plant):
    """nu^T C(nu) nu = 0: Coriolis and Munk terms do no work."""
    random_state(plant, 11)
    plant.write(plant.actuation.external_wrench_b, 0.0)
    plant.write(plant.current.vel_w, 0.0)
    plant.write(plant.params.linear_damping, 0.0)
    plant.write(plant.params.quadratic_damping, 0.0)
    plant.write(plant.params.buoyancy_n, 0.0)
    plant.write(plant.params.mass_kg, 0.0)  # no weight either; the added mass stays
    body = oracle.Body(mass=0.0, buoyancy=0.0)

    def kinetic():
        nu = np.c_[plant.vehicle.vel_b.to_numpy(), plant.vehicle.rate_b.to_numpy()].astype(float)
        return np.array([0.5 * x @ body.mass_matrix @ x for x in nu])

    before = kinetic()
    for _ in range(50):
        plant.step(substeps=8)
    # second-order error of 400 substeps of 2.5 ms at rates of 1 rad/s
    assert np.abs(kinetic() / before - 1).max() < 1e-3


TETHER = {"tether_m": 30.0, "tether_at_b_m": (-0.2, 0.0, 0.1)}


@pytest.fixture(scope="module")
def tethered_plant():
    """A tether, and added mass that follows the water."""
    vehicle = VehicleConfig(attitude_hold="none", added_mass_follows="water", **TETHER)
    return Plant(Config(vehicle=vehicle), start_taichi("cpu"), n_env=2)


def test_added_mass_that_follows_the_water_knows_no_uniform_current(tethered_plant):
    """Galilei: in a uniform current everything is as in still water, plus the drift."""
    current = np.array([0.3, -0.2, 0.0], np.float32)
    plant = tethered_plant
    plant.reset()
    plant.write(plant.actuation.external_wrench_b, [4, 1, 0, 0, 0, 0.4])
    plant.write(plant.current.vel_w, [current, 0 * current])
    # heading 0: body axes are world axes at the start
    plant.write(plant.vehicle.vel_b, [current, 0 * current])
    for _ in range(250):
        plant.step()
    assert np.abs(plant.vehicle.rate_b.to_numpy()[1, 2]) > 0.3  # it does turn
    place = plant.vehicle.pos_w.to_numpy()
    assert np.abs(place[0] - place[1] - 5.0 * current).max() < F32_DRIFT_M
    assert np.abs(plant.vehicle.rate_b.to_numpy()[0] - plant.vehicle.rate_b.to_numpy()[1]).max() < F32_DRIFT_M


def test_a_tether_drags_across_as_a_third_of_its_length(tethered_plant):
    """Beside the oracle, whose wrench it is: towed level, and turned on the spot."""
    plant, wide_m, (length_m, at) = tethered_plant, 0.0076, TETHER.values()
    pushes = np.array([[20.0, 10.0, 3.0, 0, 0, 0], [0, 0, 0, 0, 0, 2.0]])

    def tethered(push):
        def wrench(rotation, nu):
            there = rotation @ (nu[:3] + np.cross(nu[3:], at))
            there[2] = 0.0
            pull = -0.5 * 997.0 * 1.2 * wide_m * (length_m / 3) * np.linalg.norm(there) * there
            return push + np.r_[rotation.T @ pull, np.cross(at, rotation.T @ pull)]

        return wrench

    plant.reset()
    plant.write(plant.actuation.external_wrench_b, pushes)
    for _ in range(50):
        plant.step()
    nu = np.c_[plant.vehicle.vel_b.to_numpy(), plant.vehicle.rate_b.to_numpy()]
    for env, push in enumerate(pushes):
        found = oracle.simulate(oracle.Body(), 1.0, DT_S, tethered(push))["nu"][-1]
        free = oracle.simulate(oracle.Body(), 1.0, DT_S, push)["nu"][-1]
        assert np.abs(nu[env] - found).max() < SPEED_M_S < np.abs(found - free).max()


WRONG = [
    {"mass_kg": 0}, {"inertia_kg_m2": (0.3, 0, 0.5)}, {"added_mass": (5, -1, 1, 0, 0, 0)},
    {"linear_damping": (-1,) * 6}, {"thrust_forward": (-4.7e-7, 0, 0)}, {"rotor_max_rpm": 150},
]  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_unphysical_parameters_are_refused(wrong):
    with pytest.raises(ValidationError):
        VehicleConfig(**wrong)


def test_neutral_body_rests(plant):
    plant.reset()
    plant.write(plant.params.buoyancy_n, plant.params.mass_kg.to_numpy() * np.float32(9.81))
    plant.write(plant.vehicle.quat_wb, [1, 0, 0, 0])
    for _ in range(50):
        plant.step()
    assert np.array_equal(plant.vehicle.pos_w.to_numpy(), np.zeros((N_ENV, 3), np.float32))


def test_quaternion_stays_a_unit(plant):
    random_state(plant, 5)
    for _ in range(200):
        plant.step()
    assert np.abs(np.linalg.norm(plant.vehicle.quat_wb.to_numpy(), axis=1) - 1).max() < 1e-6


def test_rows_are_independent_and_permute(plant):
    random_state(plant, 9)
    order = np.array([3, 0, 5, 1, 4, 2])
    v = plant.vehicle
    start = {name: f.to_numpy() for name, f in (("q", v.quat_wb), ("v", v.vel_b), ("w", v.rate_b))}
    wrench, current = plant.actuation.external_wrench_b.to_numpy(), plant.current.vel_w.to_numpy()

    def run(rows):
        plant.reset()
        plant.write(plant.vehicle.quat_wb, start["q"][rows])
        plant.write(plant.vehicle.vel_b, start["v"][rows])
        plant.write(plant.vehicle.rate_b, start["w"][rows])
        plant.write(plant.actuation.external_wrench_b, wrench[rows])
        plant.write(plant.current.vel_w, current[rows])
        for _ in range(20):
            plant.step()
        return motion(plant)

    straight = run(np.arange(N_ENV))
    assert np.array_equal(run(order), straight[order])
    changed = run(np.array([2, 1, 2, 3, 4, 5]))  # env 0 is somebody else now
    assert np.array_equal(changed[1:], straight[1:])
    assert not np.array_equal(changed[0], straight[0])


def test_sleeping_rows_do_not_move(plant):
    random_state(plant, 4)
    before = motion(plant)
    plant.clock.active.from_numpy(np.array([1, 0, 1, 0, 0, 1], np.int32))
    plant.step()
    moved = (motion(plant) != before).any(axis=1)
    plant.clock.active.fill(1)
    assert moved.tolist() == [True, False, True, False, False, True]


def test_reset_leaves_nothing_behind(plant):
    plant.reset()
    fresh = motion(plant)
    random_state(plant, 2)
    plant.write(plant.actuation.rpm_command, 2000.0)
    for _ in range(10):
        plant.step()
    plant.reset()
    assert np.array_equal(motion(plant), fresh)
    assert not plant.actuation.rpm_command.to_numpy().any()
    assert not plant.actuation.external_wrench_b.to_numpy().any()


def test_reset_starts_at_the_mission(plant):
    plant.write(plant.mission.start_w, [1.0, 2.0, -0.5])
    plant.write(plant.mission.start_yaw, 0.7)
    plant.reset()
    assert np.allclose(plant.vehicle.pos_w.to_numpy(), [1.0, 2.0, -0.5])
    angles = [
        oracle.euler_angles(oracle.quaternion_rotation(q.astype(float)))
        for q in plant.vehicle.quat_wb.to_numpy()
    ]
    assert np.allclose(angles, [0, 0, 0.7], atol=1e-6)
    plant.write(plant.mission.start_w, 0.0)
    plant.write(plant.mission.start_yaw, 0.0)
