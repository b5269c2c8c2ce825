"""The termination check on hand-made states, the order of its rules, and the clock."""

import numpy as np
import pytest
import torch

from tests.bundles import Stage, clear, put
from tests.oracles import noise as noise_reference
from uuvtai.common import enums
from uuvtai.config import EpisodeConfig, TankConfig, VehicleConfig
from uuvtai.kernels.core.geometry import BOX, CYLINDER, FAR_M, SPHERE
from uuvtai.kernels.task import episode
from uuvtai.kernels.task.io import EpisodeIO

N, N_OBSTACLE = 8, 3
TOL = 1e-5
"""float32 at a few metres"""
VEHICLE, TANK, RULES = VehicleConfig(), TankConfig(), EpisodeConfig(horizon_steps=100)
FRONT_M = VEHICLE.hull_half_length_m + VEHICLE.hull_radius_m
SIZES = {"n_env": N, "n_obstacle": N_OBSTACLE, "n_thruster": 6}


class Court(Stage):
    """Structs of N envs: a vehicle at rest in mid-tank, heading along x, far from a goal, nothing around."""

    sizes = SIZES

    def begin(self):
        clear(self.termination, self.clock, self.vehicle, self.world, self.mission)
        put(self.clock, running=1, active=1)
        put(self.vehicle, pos_w=(10.0, 3.0, -0.8), quat_wb=(1.0, 0.0, 0.0, 0.0))
        put(self.mission, goal_w=(18.0, 3.0, -0.8))
        episode.reset_termination(self.io(EpisodeIO, VEHICLE, TANK, RULES))
        return self

    def put(self, env, slot, kind, pos, size, vel=(0, 0, 0), yaw=0.0):
        self.world.kind[env, slot] = kind
        self.world.pos_w[env, slot], self.world.size[env, slot] = pos, size
        self.world.vel_w[env, slot], self.world.yaw[env, slot] = vel, yaw

    def judge(self):
        io = self.io(EpisodeIO, VEHICLE, TANK, RULES)
        episode.check_termination(io)
        return {name: field.to_numpy() for name, field in vars(self.termination).items()}


court = Court.begun()


def outcome(book, env=0):
    return episode.OUTCOMES[book["outcome"][env]]


def test_names_belong_to_codes():
    assert episode.RUNNING == 0
    codes = ("RUNNING", "SUCCESS", "COLLISION", "TTC", "OUT_OF_TANK", "TIMEOUT")
    assert [episode.OUTCOMES[getattr(episode, code)] for code in codes] == [code.lower() for code in codes]


def test_nothing_happens_in_open_water(court):
    book = court.judge()
    assert outcome(book) == "running"
    assert book["clearance_m"] == pytest.approx(3.0 - 0.17, abs=TOL)
    assert np.all(book["ttc_s"] == np.float32(FAR_M))


@pytest.mark.parametrize(
    "pos",
    [
        (-0.01, 3, -0.8),
        (20.01, 3, -0.8),
        (10, -0.01, -0.8),
        (10, 6.01, -0.8),
        (10, 3, 0.01),
        (10, 3, -1.61),
        (float("nan"), 3, -0.8),
    ],
)
def test_out_of_tank(court, pos):
    court.vehicle.pos_w[0] = pos
    assert outcome(court.judge()) == "out_of_tank"


@pytest.mark.parametrize(("gap", "expected"), [(0.099, "collision"), (0.101, "running")])
@pytest.mark.parametrize("kind", [SPHERE, CYLINDER, BOX])
def test_collision_with_an_obstacle(court, kind, gap, expected):
    court.put(0, 1, kind, (10 + FRONT_M + gap + 0.3, 3, -0.8), (0.3, 0.3, 0.3))
    book = court.judge()
    assert book["clearance_m"][0] == pytest.approx(gap, abs=TOL)
    assert outcome(book) == expected


@pytest.mark.parametrize(("gap", "expected"), [(0.099, "collision"), (0.101, "running")])
def test_collision_with_a_side_wall(court, gap, expected):
    court.vehicle.pos_w[0] = (10, 0.17 + gap, -0.8)
    court.vehicle.pos_w[1] = (20 - FRONT_M - gap, 3, -0.8)
    book = court.judge()
    assert outcome(book, 0) == outcome(book, 1) == expected


@pytest.mark.parametrize(("gap", "expected"), [(-0.001, "collision"), (0.001, "running")])
def test_floor_and_surface_may_be_near_but_not_touched(court, gap, expected):
    court.vehicle.pos_w[0] = (10, 3, -1.6 + 0.17 + gap)
    court.vehicle.pos_w[1] = (10, 3, -0.17 - gap)
    pitched = np.radians(30)
    court.vehicle.quat_wb[2] = (np.cos(pitched / 2), 0, np.sin(pitched / 2), 0)
    court.vehicle.pos_w[2] = (10, 3, -0.17 - 0.1 * np.sin(pitched) - gap)
    book = court.judge()
    assert [outcome(book, env) for env in range(3)] == [expected] * 3
    assert book["clearance_m"][0] > 2.0, "floor and surface do not count as clearance"


@pytest.mark.parametrize(("speed", "expected"), [(1.7, "ttc"), (1.6, "running")])
def test_time_to_collision_by_hand(court, speed, expected):
    """0.3 m of clearance closing at 1.7 m/s: 0.176 s; at 1.6 m/s: 0.1875 s."""
    court.put(0, 2, SPHERE, (10 + FRONT_M + 0.3 + 0.2, 3, -0.8), (0.2, 0.2, 0.2), vel=(-speed, 0, 0))
    book = court.judge()
    assert book["ttc_s"][0] == pytest.approx(0.3 / speed, abs=1e-4)
    assert outcome(book) == expected


def test_time_to_collision_counts_own_motion_towards_a_static_obstacle(court):
    court.put(0, 0, BOX, (10 + FRONT_M + 0.102 + 0.3, 3, -0.8), (0.3, 1.0, 0.8))
    court.vehicle.vel_b[0] = (0.6, 0, 0)
    book = court.judge()
    assert book["ttc_s"][0] == pytest.approx(0.102 / 0.6, abs=1e-4)
    assert outcome(book) == "ttc"


def test_time_to_collision_counts_the_hull_s_turning(court):
    """Turning left at 1 rad/s moves the bow end towards an obstacle abeam of it at 0.1 m/s."""
    court.put(0, 0, SPHERE, (10.1, 3 + 0.17 + 0.2 + 0.15, -0.8), (0.2, 0.2, 0.2))
    court.vehicle.rate_b[0] = (0, 0, 1)
    assert court.judge()["ttc_s"][0] == pytest.approx(0.15 / 0.1, rel=1e-3)


@pytest.mark.parametrize(("speed", "counts"), [(0.049, False), (0.051, True)])
def test_slow_closing_is_no_threat(court, speed, counts):
    court.put(0, 0, SPHERE, (10 + FRONT_M + 0.15 + 0.2, 3, -0.8), (0.2, 0.2, 0.2), vel=(-speed, 0, 0))
    assert (court.judge()["ttc_s"][0] < FAR_M) == counts


def test_receding_and_passing_obstacles_are_no_threat(court):
    court.put(0, 0, SPHERE, (10 + FRONT_M + 0.35, 3, -0.8), (0.2, 0.2, 0.2), vel=(3, 0, 0))
    court.put(1, 0, SPHERE, (10 + FRONT_M + 0.35, 3, -0.8), (0.2, 0.2, 0.2), vel=(0, 3, 0))
    assert np.all(court.judge()["ttc_s"][:2] == np.float32(FAR_M))


def test_walls_give_no_time_to_collision(court):
    court.vehicle.pos_w[0] = (20 - FRONT_M - 0.11, 3, -0.8)
    court.vehicle.vel_b[0] = (3.0, 0, 0)
    assert outcome(court.judge()) == "running"


@pytest.mark.parametrize(
    ("offset", "expected"),
    [((0.999, 0, 0), "success"), ((1.001, 0, 0), "running"), ((0.8, 0, 0.7), "running")],
)
def test_success_is_a_distance_in_space(court, offset, expected):
    court.mission.goal_w[0] = tuple(np.add((10, 3, -0.8), offset))
    assert outcome(court.judge()) == expected


def test_timeout_at_the_horizon(court):
    court.clock.step[0], court.clock.step[1] = 99, 100
    book = court.judge()
    assert (outcome(book, 0), outcome(book, 1)) == ("running", "timeout")


def test_rules_hold_in_their_order(court):
    """Each row meets one rule less: all are out of time, the first four at the goal, and so on."""
    for env in range(5):
        court.clock.step[env] = 100
    for env in range(4):
        court.mission.goal_w[env] = (10.0, 3.0, -0.8)
    court.vehicle.pos_w[0] = (10.0, 3.0, 0.01)  # out, and through the surface
    for env in (0, 1):
        # touching and closing
        court.put(env, 0, SPHERE, (10 + FRONT_M + 0.05 + 0.2, 3, -0.8), (0.2, 0.2, 0.2), vel=(-3, 0, 0))
    court.put(2, 0, SPHERE, (10 + FRONT_M + 0.15 + 0.2, 3, -0.8), (0.2, 0.2, 0.2), vel=(-3, 0, 0))  # closing
    book = court.judge()
    assert [outcome(book, env) for env in range(5)] == [
        "out_of_tank", "collision", "ttc", "success", "timeout",
    ]  # fmt: skip


def test_book_of_the_episode(court):
    """Way sums straight steps; the smallest clearance stays; a reset begins with the clearance there."""
    court.put(0, 0, SPHERE, (10 + FRONT_M + 1.2, 3, -0.8), (0.2, 0.2, 0.2))
    episode.reset_termination(court.io(EpisodeIO, VEHICLE, TANK, RULES))
    assert court.termination.min_clearance_m[0] == pytest.approx(1.0, abs=TOL)
    for x in (10.3, 10.5, 10.1):
        court.vehicle.pos_w[0] = (x, 3.0, -0.8)
        book = court.judge()
    assert book["path_length_m"][0] == pytest.approx(0.3 + 0.2 + 0.4, abs=TOL)
    assert book["min_clearance_m"][0] == pytest.approx(0.5, abs=TOL)
    assert book["clearance_m"][0] == pytest.approx(0.9, abs=TOL)
    episode.reset_termination(court.io(EpisodeIO, VEHICLE, TANK, RULES))
    again = {name: field.to_numpy()[0] for name, field in vars(court.termination).items()}
    assert again["path_length_m"] == 0
    assert again["min_clearance_m"] == again["clearance_m"] == pytest.approx(0.9, abs=TOL)
    assert again["outcome"] == episode.RUNNING


def test_sleeping_rows_stay_as_they_are(court):
    court.clock.active[1] = 0
    court.vehicle.pos_w.fill(30.0)
    book = court.judge()
    assert outcome(book, 0) == "out_of_tank"
    assert outcome(book, 1) == "running"
    assert book["path_length_m"][1] == 0


# ------------------------------------------------------------------------------------------------------ clock


def begin(court, mask, seed=3, number=7):
    rows = (torch.tensor(values, dtype=torch.int32).expand(N).contiguous() for values in (mask, seed, number))
    episode.begin_episodes(court.io(EpisodeIO), *rows)


def test_episodes_begin_advance_end_and_sleep(court):
    even = [1, 0] * (N // 2)
    put(court.clock, running=0, step=50)
    begin(court, even)
    assert list(court.clock.active.to_numpy()) == list(court.clock.running.to_numpy()) == even
    assert list(court.clock.step.to_numpy()) == [0, 50] * (N // 2)
    assert court.episode.key[0] == noise_reference.episode_key(3, 7)
    # a reset pass of other rows: row 0 rests meanwhile, and goes on afterwards
    begin(court, [0] + [1] * (N - 1))
    assert court.clock.active[0] == 0
    episode.wake(court.io(EpisodeIO))
    assert court.clock.active.to_numpy().all()
    episode.advance_clock(court.io(EpisodeIO))
    assert np.all(court.clock.step.to_numpy() == 1)
    court.termination.outcome[2] = episode.TIMEOUT
    episode.deactivate_ended(court.io(EpisodeIO))
    episode.advance_clock(court.io(EpisodeIO))
    assert court.clock.step.to_numpy().tolist() == [2, 2, 1] + [2] * (N - 3)
    assert court.clock.running[2] == court.clock.active[2] == 0


def test_negative_seeds_have_keys_too(court):
    begin(court, [1] * N, seed=-1, number=0)
    assert court.episode.key[0] == noise_reference.episode_key(2**32 - 1, 0)


def test_codes_and_names_of_the_endings_agree():
    assert ("running", *enums.FINAL_OUTCOMES) == enums.OUTCOMES
    assert [
        enums.OUTCOMES[code]
        for code in (enums.SUCCESS, enums.COLLISION, enums.TTC, enums.OUT_OF_TANK, enums.TIMEOUT)
    ] == list(enums.FINAL_OUTCOMES)
    assert set(enums.COLLIDED) < set(enums.FINAL_OUTCOMES)
