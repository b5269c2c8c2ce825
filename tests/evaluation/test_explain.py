"""Causes of death: hand-made histories for every label, the geometry behind them, and a real replay."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.command import Quiet
from tests.oracles import hull as hull_reference
from tests.oracles import sonar as sonar_reference
from uuvtai.cli import main
from uuvtai.config import Config, TankConfig
from uuvtai.console.screen import Screen
from uuvtai.console.views import show_causes
from uuvtai.evaluation import failure_causes, failure_facts
from uuvtai.evaluation.episodes import EpisodeResult, jobs_of, run_episodes
from uuvtai.evaluation.evaluate import Request, compare
from uuvtai.kernels.core.geometry import BOX, CYLINDER, NONE, SPHERE

CONFIG = Config()
HERE = np.array([10.0, 3.0, -0.8])
"""Where the vehicle of a hand-made history stands, looking along x."""
NOSE_M = 0.27
"""Hull centre to the tip of the nose."""
END_S = 14.0
TOUCHED, SECOND, STATIC = 0, 1, 2


def at(x, y, z):
    """A place relative to the vehicle."""
    return HERE + np.array([x, y, z])


class Story:
    """A vehicle at rest for 4 s; a sphere seen from ahead comes at 1 m/s and touches the nose at the end."""

    def __init__(self, speed=1.0, radius=0.2, rise=0.0, end_s=END_S, gap=0.05):
        self.t = np.round(np.arange(end_s - min(4.0, end_s - 0.1), end_s + 0.05, 0.1), 3)
        self.n = len(self.t)
        self.ago = self.t[-1] - self.t
        self.kind = np.array([SPHERE, NONE, NONE])
        self.size = np.array([[radius] * 3, [0.2] * 3, [0.3, 0.3, 0.8]])
        self.speed = np.array([speed, 0.0, 0.0])
        self.circle = np.zeros(3)
        self.obstacle = np.tile(np.array([2.0, 1.0, -0.8]), (self.n, 3, 1))
        touching = at(NOSE_M + gap + radius, 0.0, rise)
        self.obstacle[:, TOUCHED] = touching + self.ago[:, None] * [speed, 0.0, 0.0]
        self.vel = np.zeros((self.n, 3, 3))
        self.vel[:, TOUCHED, 0] = -speed
        self.hull_vel = np.zeros((self.n, 3))
        self.pos = np.tile(HERE, (self.n, 1))
        self.sees = np.ones(self.n, bool)
        self.believes = np.ones(self.n, bool)
        self.foreseen_vel = np.tile([-speed, 0.0], (self.n, 1))
        self.leaf = ["Evade"] * self.n
        self.conflict = np.ones(self.n, bool)
        self.believed_gap = 0.0
        self.place_error = np.zeros(3)
        self.vel_valid = np.ones(self.n, int)
        self.coarse = None
        self.look, self.config = 0.0, CONFIG

    def turn(self, ago_s, before=(0.0, -1.0)):
        """The touched moved along ``before`` until ``ago_s`` before the end; forecasts went on straight."""
        early = self.ago > ago_s + 1e-6
        corner = self.obstacle[~early, TOUCHED][0]
        self.vel[early, TOUCHED] = [before[0], before[1], 0.0]
        self.obstacle[early, TOUCHED] = corner - (self.ago[early, None] - ago_s) * self.vel[early, TOUCHED]
        self.foreseen_vel[early] = before
        return self

    def put(self, slot, kind, pos, size, speed=0.0):
        self.kind[slot], self.size[slot], self.speed[slot] = kind, size, speed
        self.obstacle[:, slot] = pos
        return self

    def obstacles(self):
        return failure_facts.Obstacles(
            self.kind, self.size, np.zeros(3), self.speed, self.circle, np.where(self.speed > 0, 8.0, np.inf)
        )

    def scan(self):
        """Beam 0 looks at the touched, wherever it is: the tests turn the vehicle's yaw with the bearing."""
        away = np.linalg.norm((self.obstacle[:, TOUCHED] - self.pos)[:, :2], axis=1) - self.size[TOUCHED, 0]
        scan = np.full((self.n, CONFIG.sensors.sonar.n_ray), 12.0)
        scan[self.sees, 0] = away[self.sees]
        return scan

    def history(self):
        toward = self.obstacle[:, TOUCHED] - self.pos
        yaw = np.arctan2(toward[:, 1], toward[:, 0]) + self.look
        lead = 0.1 * np.arange(26)
        forecast = self.obstacle[:, TOUCHED, None, :2] + lead[:, None] * self.foreseen_vel[:, None]
        return failure_facts.History(
            t_s=self.t, pos_w=self.pos, believed_pos_w=self.pos + self.place_error, vel_valid=self.vel_valid,
            quat_wb=np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], -1), vel_b=self.hull_vel,
            rate_b=np.zeros((self.n, 3)), obstacle_w=self.obstacle, obstacle_vel_w=self.vel,
            ping_age_s=np.zeros(self.n), range_m=self.scan(),
            track_moving=np.where(self.believes, 1, 0)[:, None], track_w=self.obstacle[:, TOUCHED, None, :2],
            forecast_w=forecast[:, None], forecast_m=np.where(self.believes, 0.2, -1.0)[:, None],
            forecast_above_w=self.pos[:, 2:] + self.believed_gap,
            forecast_below_w=self.pos[:, 2:] - self.believed_gap, conflict=self.conflict, leaf=self.leaf,
            action=np.zeros((self.n, 4)), map_clearance_m=np.ones(self.n),
            coarse=self.coarse or failure_facts.CoarseHistory(
                np.array([0.0, END_S]), np.stack([HERE, HERE]), np.ones(2), np.ones(2, bool), ["", ""]
            ),
        )  # fmt: skip

    def explained(self, outcome="collision"):
        return failure_causes.explain(outcome, self.history(), self.obstacles(), self.config)


def corridor(story, half_gap=0.32):
    """Boxes on both sides and behind, through the full water column: no way out but up or down."""
    story.put(SECOND, BOX, at(0.0, half_gap + 0.5 + 0.17, 0.0), [3.0, 0.5, 0.8])
    return story.put(STATIC, BOX, at(0.0, -half_gap - 0.5 - 0.17, 0.0), [3.0, 0.5, 0.8])


def below(rise):
    return Story(rise=rise, radius=0.2, gap=-0.3)


def with_second(story, y=0.7):
    return story.put(SECOND, SPHERE, at(0.3, y, 0.0), [0.2] * 3, speed=1.0)


def hit_static(evading=False, moving_m=None):
    story = Story(speed=1.0).put(STATIC, CYLINDER, at(NOSE_M + 0.3 + 0.05, 0.0, 0.0), [0.3, 0.3, 0.8])
    story.obstacle[:, TOUCHED] = at(0.0, 2.5 if moving_m is None else NOSE_M + 0.2 + moving_m, 0.0)
    story.leaf = ["Evade" if evading else "FollowRoute"] * story.n
    return story


def change(story, **fields):
    for name, value in fields.items():
        setattr(story, name, value)
    return story


def at_wall(story):
    story.kind[TOUCHED] = NONE
    story.pos = np.tile([0.2, 3.0, -0.8], (story.n, 1))
    story.leaf = ["FollowRoute"] * story.n
    return story


def at_depth(z):
    story = Story()
    story.kind[TOUCHED] = NONE
    story.pos = np.tile([10.0, 3.0, z], (story.n, 1))
    return story


def lately(story, seconds, name, before):
    """Field ``name`` was ``before`` until ``seconds`` before the end."""
    values = getattr(story, name)
    for i in np.flatnonzero(story.ago > seconds + 1e-6):
        values[i] = before
    return story


def late_into_the_fan():
    """The vehicle rises to the touched's depth only in the last 0.7 s."""
    story = lately(Story(), 0.6, "believes", False)
    story.pos[story.ago > 0.7, 2] -= 0.6
    return story


def diving_into_it():
    """The vehicle dives for its last second; the touched stays below the fan."""
    story = below(-0.35)
    story.pos[:, 2] += 0.3 * np.minimum(story.ago, 1.0)
    return story


def from_behind():
    """A sonar that looks ahead only, and the touched comes from behind."""
    sonar = CONFIG.sensors.sonar.model_copy(update={"horizontal_aperture_deg": 130.0})
    sensors = CONFIG.sensors.model_copy(update={"sonar": sonar})
    config = CONFIG.model_copy(update={"sensors": sensors})
    return change(Story(), look=np.pi, config=config)


def above_the_floor():
    """In a corridor, too near to the floor to dive below what comes over the whole width at its height."""
    story = corridor(Story(speed=2.0, rise=0.25, gap=-0.05))
    for places in (story.pos, *np.moveaxis(story.obstacle, 1, 0)):
        places[:, 2] -= 0.5
    return story


STORIES = {
    "out_of_tank": (lambda: change(at_wall(Story()), pos=np.tile([-0.1, 3.0, -0.8], (41, 1))), "out_of_tank"),
    "depth_error": (lambda: change(at_depth(-1.5), place_error=np.array([0, 0, 0.06])), "collision"),
    "localization_error": (lambda: change(hit_static(), place_error=np.array([0.08, 0.08, 0])), "collision"),
    "velocity_lost": (lambda: change(hit_static(), vel_valid=np.full(41, 2)), "collision"),
    "undetected_depth_change": (diving_into_it, "collision"),
    "obstacle_reversed": (lambda: Story().turn(1.1, before=(1.0, 0.1)), "collision"),
    "no_depth_left": (above_the_floor, "collision"),
    "hit_floor": (lambda: at_depth(-1.5), "collision"),
    "hit_surface": (lambda: at_depth(-0.1), "collision"),
    "hit_static": (hit_static, "collision"),
    "hit_wall": (lambda: at_wall(Story()), "collision"),
    "evaded_into_static": (lambda: hit_static(evading=True), "collision"),
    "no_escape_at_start": (lambda: Story(end_s=1.5), "collision"),
    "undetected_beside": (from_behind, "collision"),
    "undetected_above": (lambda: below(0.35), "collision"),
    "undetected_below": (lambda: below(-0.35), "collision"),
    "obstacle_turned": (lambda: Story().turn(1.1), "collision"),
    "late_detection": (late_into_the_fan, "collision"),
    "occluded": (lambda: lately(lately(Story(), 0.3, "sees", False), 0.4, "believes", False), "collision"),
    "untracked": (lambda: lately(Story(), 0.9, "believes", False), "collision"),
    "obstacle_on_curve": (
        lambda: change(Story(), circle=np.array([2.0, 0, 0]), foreseen_vel=np.tile([-1.0, 0.5], (41, 1))),
        "collision",
    ),
    "prediction_error": (lambda: change(Story(), foreseen_vel=np.tile([-1.0, 0.5], (41, 1))), "collision"),
    "late_reaction": (lambda: lately(Story(), 0.4, "leaf", "FollowRoute"), "collision"),
    "failed_evasion": (Story, "collision"),
    "depth_change_needed": (lambda: corridor(Story(speed=2.0, rise=0.25, gap=-0.05)), "collision"),
    "blocked_by_static": (lambda: corridor(Story(speed=5.0)), "collision"),
    "second_obstacle_near": (lambda: with_second(Story(speed=5.0)), "collision"),
    "obstacle_too_fast": (lambda: Story(speed=5.0), "collision"),
}


TIMEOUTS = {
    "no_route": {"no_route_share": 0.6},
    "too_slow": {"progress_m": 1.5},
    "waiting": {"waiting_share": 0.6},
    "blocked_by_traffic": {"evading_share": 0.6},
    "stuck": {"driven_m": 0.3},
    "no_progress": {},
}
QUIET = {
    "no_route_share": 0.0, "progress_m": 0.2, "waiting_share": 0.1, "evading_share": 0.1, "driven_m": 4.0,
}  # fmt: skip


def test_every_label_has_a_story():
    assert set(STORIES) | set(TIMEOUTS) == set(failure_causes.CAUSES)


@pytest.mark.parametrize("label", STORIES)
def test_a_story_gets_its_label(label):
    make, outcome = STORIES[label]
    found = make().explained(outcome)
    assert found.label == label, (found.touched, found.facts)
    json.dumps(vars(found.touched) | found.facts, allow_nan=False)


@pytest.mark.parametrize("label", TIMEOUTS)
def test_a_timeout_gets_its_label(label):
    assert failure_causes.timeout_label(QUIET | TIMEOUTS[label]) == label


@pytest.mark.parametrize(
    ("make", "label"),
    [
        (lambda: below(0.25), "failed_evasion"),  # the fan still holds its edge at the end
        (lambda: Story().turn(1.3), "failed_evasion"),  # long ago, and the forecasts since were right
        # the forecast knew of the turn
        (lambda: change(Story().turn(1.1), foreseen_vel=_learnt_turn(1.1)), "failed_evasion"),
        (lambda: Story(end_s=2.1), "failed_evasion"),  # old enough not to have started in danger
        (lambda: change(at_depth(-1.5), vel_valid=np.zeros(41)), "velocity_lost"),
        (lambda: change(at_depth(-1.5), vel_valid=np.full(41, 2)), "hit_floor"),  # heave is known
        (lambda: change(hit_static(), vel_valid=np.where(np.arange(41) < 35, 0, 1)), "hit_static"),  # again
        (lambda: hit_static(moving_m=0.9), "evaded_into_static"),
        (lambda: hit_static(moving_m=1.1), "hit_static"),
        # the last chance was 0.5 s before the end
        (lambda: lately(Story(), 0.6, "leaf", "FollowRoute"), "failed_evasion"),
        (lambda: with_second(Story(speed=5.0), y=1.5), "obstacle_too_fast"),
        (lambda: change(at_depth(-1.5), place_error=np.array([0, 0, 0.04])), "hit_floor"),
        (lambda: change(at_depth(-1.5), place_error=np.array([0, 0, -0.06])), "hit_floor"),  # the safe way
        (lambda: change(at_depth(-0.1), place_error=np.array([0, 0, -0.06])), "depth_error"),
        (lambda: change(hit_static(), place_error=np.array([0.06, 0.07, 0])), "hit_static"),
        (lambda: Story().turn(1.1, before=(0.5, -0.9)), "obstacle_turned"),  # by less than 120 degrees
    ],
)
def test_just_past_a_threshold_the_label_changes(make, label):
    found = make().explained()
    assert found.label == label, found.facts


def _learnt_turn(ago_s):
    """Constant velocities that lead from every place before the turn to where the touched ends."""
    story = Story().turn(ago_s)
    left = np.maximum(story.ago, 0.1)[:, None]
    return (story.obstacle[-1, TOUCHED, :2] - story.obstacle[:, TOUCHED, :2]) / left


def test_facts_of_a_plain_story():
    found = lately(Story(), 0.8, "leaf", "FollowRoute").explained()
    assert (found.touched.name, found.touched.slot, found.touched.moving) == ("sphere", TOUCHED, True)
    assert found.touched.gap_m == pytest.approx(0.05, abs=1e-3)
    assert found.touched.closing_m_s == pytest.approx(1.0, abs=1e-3)
    facts = found.facts
    assert (facts["age_s"], facts["evading_s"], facts["leaf"]) == (14.0, 0.8, "Evade")
    assert (facts["fan_ago_s"], facts["seen_ago_s"], facts["believed_ago_s"]) == (0.0, 0.0, 0.0)
    assert facts["forecast_error_m"] == pytest.approx(0.0, abs=1e-3)
    assert facts["turned_ago_s"] is None
    assert facts["static_near_m"] == pytest.approx(3.0 - 0.17, abs=1e-3)
    assert facts["second_body_m"] is None


REMARKABLE = {
    "second obstacle near": lambda: with_second(Story()),
    "static near": lambda: corridor(Story()),
    "turned lately": lambda: Story().turn(2.4),
    "corner passed in reach before": lambda: Story().turn(1.1),
    "changed its depth": lambda: change(Story(), pos=diving_into_it().pos),
    "remembered to the end": lambda: below(0.35),
    "remembered clear of the own depth": lambda: change(below(0.35), believed_gap=0.2),
    "taken as static": lambda: lately(Story(), 2.0, "believes", False),
    "backed off before the last chance": lambda: change(Story(), leaf=["BackOff"] * 41),
    "only heave escaped": lambda: change(
        STORIES["depth_change_needed"][0](), foreseen_vel=np.tile([-2.0, 0.5], (41, 1))
    ),
}


def test_every_remark_has_its_story_and_a_plain_one_has_none():
    assert set(REMARKABLE) == set(failure_causes.REMARKS)
    assert Story().explained().remarks == []
    for remark, make in REMARKABLE.items():
        assert remark in make().explained().remarks, remark
    assert "turned lately" not in Story().turn(1.1).explained().remarks  # the label says so already


def test_a_start_in_danger_says_what_it_would_be_otherwise():
    assert Story(end_s=1.5).explained().remarks[0] == "else failed_evasion"
    # too short for every interval that is looked at
    assert Story(end_s=0.2).explained().label == "no_escape_at_start"


def test_a_forgotten_obstacle_and_a_seen_corner_are_told():
    story = Story().turn(1.1)
    story.believes[story.ago < 0.45] = False
    story.sees[story.ago < 0.25] = False
    facts = story.explained().facts
    assert (facts["believed_ago_s"], facts["seen_ago_s"], facts["turned_ago_s"]) == (0.5, 0.3, 1.1)
    assert facts["taken_as_static_ago_s"] == 0.0
    # the turn was at 12.9 s, a lap lasts 8 s: it passed the same corner once before, and the vehicle stood
    # within reach
    assert facts["turns_in_reach_before"] == 1
    far = failure_facts.CoarseHistory(
        np.array([0.0, END_S]), np.stack([at(-13.0, 0, 0), HERE]), np.ones(2), np.ones(2, bool), ["", ""]
    )
    assert change(story, coarse=far).explained().facts["turns_in_reach_before"] == 1
    above = failure_facts.CoarseHistory(
        np.array([0.0, END_S]), np.stack([at(0, 0, 0.7), at(0, 0, 0.7)]), np.ones(2), np.ones(2, bool),
        ["", ""],
    )  # fmt: skip
    assert change(story, coarse=above).explained().facts["turns_in_reach_before"] == 0


@pytest.mark.parametrize("rise", [0.35, -0.35])
def test_the_gap_that_was_believed_is_told(rise):
    assert change(below(rise), believed_gap=0.3).explained().facts["believed_gap_m"] == pytest.approx(0.3)
    assert change(below(rise), believes=np.zeros(41, bool)).explained().facts["believed_gap_m"] is None


def test_a_ttc_stop_names_the_obstacle_that_closes_in_and_not_the_nearest():
    story = Story(speed=3.0, gap=0.4).put(STATIC, CYLINDER, at(0.0, 0.17 + 0.3 + 0.15, 0.0), [0.3, 0.3, 0.8])
    assert story.explained("ttc").touched.slot == TOUCHED
    assert story.explained("collision").touched.slot == STATIC


def test_a_ttc_stop_never_names_a_obstacle_that_moves_away():
    story = with_second(Story(speed=3.0, gap=0.4), y=0.5)
    story.vel[:, SECOND] = [0.0, 2.0, 0.0]
    found = story.explained("ttc")
    assert found.facts["second_body_m"] < found.touched.gap_m
    assert found.touched.slot == TOUCHED


def test_a_second_obstacle_that_passed_earlier_is_not_near():
    story = with_second(Story())
    story.obstacle[story.ago < 1.0, SECOND] += [0.0, 2.0, 0.0]
    assert story.explained().facts["second_body_m"] > 2.0


def test_a_scan_is_compared_with_the_moment_of_its_ping():
    """Delivered 0.2 s late: the touched is 0.2 m nearer by then, twice the tolerance."""
    story = Story()
    late = replace(
        story.history(), ping_age_s=np.full(story.n, 0.2), range_m=story.scan() + 0.2 * (np.arange(256) == 0)
    )
    assert failure_causes.explain("collision", late, story.obstacles(), CONFIG).facts["seen_ago_s"] == 0.0
    unchanged = replace(late, ping_age_s=np.zeros(story.n))
    assert (
        failure_causes.explain("collision", unchanged, story.obstacles(), CONFIG).facts["seen_ago_s"] is None
    )


def test_timeout_facts_from_the_coarse_history():
    t = np.arange(0.0, 60.1, 0.5)
    pos = np.stack([0.05 * t, 0 * t, 0 * t - 1], -1)
    coarse = failure_facts.CoarseHistory(
        t, pos, 8.0 - 0.05 * t, t < 52, ["Hold" if s > 56 else "FollowRoute" for s in t]
    )
    facts = change(Story(), coarse=coarse).explained("timeout").facts
    assert facts["progress_m"] == pytest.approx(0.5)
    assert facts["driven_m"] == pytest.approx(0.5)
    assert facts["goal_m"] == pytest.approx(5.0)
    assert facts["no_route_share"] == pytest.approx(17 / 21, abs=1e-3)
    assert facts["waiting_share"] == pytest.approx(8 / 21, abs=1e-3)


# --------------------------------------------------------------------------------------------------- geometry

HULL_TOLERANCE_M = 1e-3
"""The axis is sampled every 25 mm (hindsight._AXIS_SAMPLES)."""


def random_obstacles(rng, n):
    kind = rng.integers(1, 4, n)
    size = rng.uniform(0.15, 0.5, (n, 3))
    size[kind != BOX, 1] = size[kind != BOX, 0]
    size[kind == SPHERE, 2] = size[kind == SPHERE, 0]
    return kind, size, rng.uniform(-3, 3, n)


def test_hull_gaps_equal_the_reference():
    rng = np.random.default_rng(5)
    kind, size, yaw = random_obstacles(rng, 12)
    pos = rng.uniform(-0.3, 0.3, (20, 3))
    axis = rng.normal(size=(20, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    obstacle = rng.uniform(-1, 1, (20, 12, 3)) + 1.2 * np.sign(rng.normal(size=(20, 12, 3)))
    gap, normal, along = failure_facts.hull_gaps(pos, axis, kind, obstacle, size, yaw, 0.17, 0.10)
    expected = [
        [
            hull_reference.clearance(pos[i], axis[i], kind[j], obstacle[i, j], size[j], yaw[j])
            for j in range(12)
        ]
        for i in range(len(pos))
    ]
    np.testing.assert_allclose(gap, expected, atol=HULL_TOLERANCE_M)
    step = 1e-4
    pushed, _, _ = failure_facts.hull_gaps(pos, axis, kind, obstacle + step * normal, size, yaw, 0.17, 0.10)
    # moving an obstacle along the normal opens the gap
    np.testing.assert_allclose((pushed - gap) / step, 1.0, atol=0.02)
    assert np.abs(along).max() <= 0.10 + 1e-9


@pytest.mark.parametrize("shape", ["rectangle", "circle"])
def test_wall_gaps_equal_the_reference(shape):
    rng = np.random.default_rng(6)
    tank = TankConfig(shape=shape, x_m=(0.0, 8.0), y_m=(0.0, 6.0))
    pos, axis = rng.uniform([2, 1, -1], [6, 5, -0.5], (30, 3)), rng.normal(size=(30, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    expected = [
        hull_reference.wall_clearance(p, a, shape, tank.x_m, tank.y_m) for p, a in zip(pos, axis, strict=True)
    ]
    np.testing.assert_allclose(failure_facts.wall_gaps(pos, axis, tank, 0.17, 0.10), expected, atol=1e-9)


def test_floor_and_surface_gaps_of_a_tilted_hull():
    axis = np.array([[1.0, 0, 0], [np.sqrt(0.5), 0, np.sqrt(0.5)]])
    floor, surface = failure_facts.floor_and_surface_gaps(
        np.tile([1.0, 1, -0.5], (2, 1)), axis, CONFIG.world.tank, 0.17, 0.10
    )
    np.testing.assert_allclose(floor, [1.1 - 0.17, 1.1 - 0.17 - 0.1 * np.sqrt(0.5)])
    np.testing.assert_allclose(surface, [0.5 - 0.17, 0.5 - 0.17 - 0.1 * np.sqrt(0.5)])


def test_beam_entries_equal_the_reference():
    rng = np.random.default_rng(7)
    kind, size, yaw = random_obstacles(rng, 30)
    sonar = CONFIG.sensors.sonar
    met = 0
    for j in range(30):
        pos, heading = rng.uniform(-1, 1, 3), rng.uniform(-3, 3)
        obstacle = pos + rng.uniform([1.0, 1.0, -1.5], [4.0, 4.0, 1.5])
        quat = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
        scene = {
            "kind": kind[j : j + 1][None],
            "size": size[j][None, None],
            "yaw": yaw[j : j + 1][None],
            "obstacle_pos": obstacle[None, None],
        }
        bearing = sonar_reference.beam_headings(np.array(quat), sonar.n_ray)
        u = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        expected, _ = sonar_reference.obstacle_hits(
            scene, 0, 0, pos, u, np.tan(np.radians(sonar.vertical_half_aperture_deg))
        )
        found = failure_facts.beam_entries(
            pos[None], np.array([heading]), kind[j], obstacle[None], size[j], yaw[j], sonar
        )[0]
        np.testing.assert_allclose(found, expected, atol=1e-9)
        met += np.isfinite(found).any()
    assert 5 < met < 30  # some are within the fan, some are not


def test_a_held_velocity_is_approached_with_the_lag():
    t = np.linspace(0, 2.0, 2001)
    path, vel = (
        found[0]
        for found in failure_facts.rolled_out(
            np.zeros(3), np.array([0.5, 0, 0]), np.array([[0.0, 0.8, -0.2]]), t, 0.35
        )
    )
    left = np.exp(-t / 0.35)[:, None]
    expected = (1 - left) * [0.0, 0.8, -0.2] + left * [0.5, 0.0, 0.0]
    np.testing.assert_allclose(np.gradient(path, t, axis=0)[1:-1], expected[1:-1], atol=1e-3)
    np.testing.assert_allclose(vel, expected)
    np.testing.assert_allclose(path[0], 0.0)


def test_everything_escapes_in_free_water_and_nothing_from_a_box():
    free = Story()
    free.kind[TOUCHED] = NONE
    level, heaving = failure_facts.escapes(free.history(), free.obstacles(), CONFIG, 1.0)
    assert level == int((failure_facts.candidates(CONFIG, 0.0)[:, 2] == 0).sum()) == 33
    assert heaving == 66  # 0.4 m/s for 1.5 s reaches neither floor nor surface from mid-water
    story = corridor(Story(speed=2.0))
    assert failure_facts.escapes(story.history(), story.obstacles(), CONFIG, 1.0)[0] == 0


def test_candidates_respect_the_limits_of_the_body_axes():
    command = failure_facts.candidates(CONFIG, 0.7)
    along = command[:, 0] * np.cos(0.7) + command[:, 1] * np.sin(0.7)
    across = command[:, 1] * np.cos(0.7) - command[:, 0] * np.sin(0.7)
    assert np.abs(along).max() == pytest.approx(CONFIG.vehicle.max_surge_m_s)
    assert np.abs(across).max() == pytest.approx(CONFIG.vehicle.max_sway_m_s)
    # diagonals are the fastest
    assert np.hypot(along, across).max() == pytest.approx(np.hypot(0.6, 0.6), abs=1e-6)
    assert set(np.round(command[:, 2], 6)) == {0.0, 0.4, -0.4}


def test_obstacles_go_straight_on_after_the_end():
    story = Story(speed=1.0)
    then, vel = failure_facts.motion(story.history(), np.array([END_S - 0.25, END_S + 0.4]))
    np.testing.assert_allclose(then[:, TOUCHED, 0] - story.obstacle[-1, TOUCHED, 0], [0.25, -0.4], atol=1e-6)
    np.testing.assert_allclose(vel[:, TOUCHED], [[-1.0, 0.0, 0.0]] * 2)


# ---------------------------------------------------------------------------------- tables, replay, recording


def row(label, episode, closing=None, **facts):
    result = EpisodeResult(1, episode, "collision", 3.0, 0.0, 0.05, 1.0, {}, {}, {}, np.zeros(1), np.zeros(1))
    return failure_causes.Row(
        result,
        failure_causes.Explanation(label, failure_causes.Touched("sphere", closing_m_s=closing), facts),
    )


def test_the_table_counts_sorts_and_names_the_worst():
    rows = [
        row("late_reaction", 0, 0.2), row("late_reaction", 1, 0.9), row("undetected_above", 2),
        row("late_reaction", 3, 0.5), row("hit_wall", 4), row("late_reaction", 5, 0.1),
    ]  # fmt: skip
    table = failure_causes.table_of(rows)
    assert [(entry["label"], entry["count"]) for entry in table] == [
        ("late_reaction", 4),
        ("hit_wall", 1),
        ("undetected_above", 1),
    ]
    assert table[0]["examples"] == [[1, 1], [1, 3], [1, 0]]
    assert sum(entry["share"] for entry in table) == pytest.approx(1.0)
    assert table[0]["meaning"] == failure_causes.CAUSES["late_reaction"]
    assert failure_causes.table_of([]) == []


def test_what_is_typical_of_a_label():
    unknown = {"seen_ago_s": None, "evading_s": 1.0, "last_chance_s": 0.5, "forecast_error_m": None}
    known = {"seen_ago_s": 0.1, "evading_s": 3.0, "last_chance_s": None, "forecast_error_m": 0.1}
    rows = [row("late_reaction", 0, **unknown), row("late_reaction", 1, **known), row("stuck", 2, goal_m=2.0)]
    rows[0].explanation.remarks.extend(["static near", "turned lately"])
    rows[1].explanation.remarks.append("turned lately")
    late, stuck = failure_causes.table_of(rows)
    assert (late["knew_share"], late["evading_median_s"], late["last_chance_median_s"]) == (0.5, 2.0, 1.25)
    assert late["undetected_median_s"] == pytest.approx((failure_facts.WINDOW_S + 0.1) / 2)
    assert late["remarks"] == {"turned lately": 2, "static near": 1}
    assert {
        stuck[name]
        for name in ("knew_share", "undetected_median_s", "evading_median_s", "last_chance_median_s")
    } == {None}
    assert stuck["remarks"] == {}


def test_recordings_go_round_the_labels():
    rows = [
        row("late_reaction", 0, 0.2),
        row("late_reaction", 1, 0.9),
        row("undetected_above", 2),
        row("late_reaction", 3, 0.5),
    ]
    assert [r.result.episode for r in failure_causes.chosen_for_recording(rows, 3)] == [1, 2, 3]
    assert [r.result.episode for r in failure_causes.chosen_for_recording(rows, 99)] == [1, 2, 3, 0]
    assert failure_causes.chosen_for_recording(rows, 0) == [] == failure_causes.chosen_for_recording([], 3)


@pytest.fixture(scope="module")
def played(small):
    """Blind driving among fast obstacles: most episodes fail within seconds."""
    small.sim.use_tree(small.trees["straight"])
    small.sim.set_scenes([(8, 9, 1.5)])
    results, _ = run_episodes(small.sim, jobs_of([7], 12))
    yield small, results, failure_causes.explain_failures(small.sim, results)
    small.sim.set_scenes()
    small.sim.use_tree(small.trees["bt"])


def test_a_replay_ends_as_the_episode_did_and_explains_every_failure(played):
    _, results, rows = played
    failed = failure_causes.failures(results)
    assert len(failed) >= 6
    assert [row.result for row in rows] == failed
    for row in rows:
        assert row.explanation.label in failure_causes.CAUSES
        assert row.document()["outcome"] == row.result.outcome
        json.dumps(row.document(), allow_nan=False)


def test_the_killer_is_what_the_referee_saw(played):
    _, _, rows = played
    stops = [
        row
        for row in rows
        if row.result.outcome == "collision" and row.explanation.touched.name not in ("floor", "surface")
    ]
    assert stops
    for row in stops:
        assert row.explanation.touched.gap_m == pytest.approx(
            row.result.min_clearance_m, abs=2 * HULL_TOLERANCE_M
        )


def test_a_replay_that_ends_differently_is_an_error(played):
    small, results, _ = played
    wrong = replace(
        failure_causes.failures(results)[0], time_s=failure_causes.failures(results)[0].time_s + 0.04
    )
    small.sim.use_tree(small.trees["straight"])
    with pytest.raises(RuntimeError, match="instead of"):
        failure_causes.explain_failures(small.sim, [wrong])


def test_nothing_failed_means_nothing_is_replayed(small):
    assert failure_causes.explain_failures(small.sim, []) == []


def test_the_worst_are_recorded_with_a_picture(played, tmp_path):
    small, _, rows = played
    shortest = min(rows, key=lambda row: row.result.time_s)
    notes = []
    small.sim.use_tree(small.trees["straight"])
    paths = failure_causes.record_worst(small.sim, [shortest], tmp_path, "pool", "straight", notes.append)
    stem = (
        f"{shortest.explanation.label}_straight_seed{shortest.result.seed}_episode{shortest.result.episode}"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{stem}.mcap", f"{stem}.png"]
    assert paths == [tmp_path / f"{stem}.mcap"]
    assert notes


@pytest.fixture
def request_of(small, tmp_path, monkeypatch):
    """A request for a short comparison that runs on the session's simulator."""
    monkeypatch.setattr("uuvtai.sim.sim.Sim", lambda *_: small.sim)

    def build(**options):
        asked = {
            "agents": ["straight"], "seeds": [3], "episodes": 6, "num_envs": small.N, "explain": True,
            "explain_record": 0,
        }  # fmt: skip
        return Request(
            config=small.config, world="pool", sensors="paper", run_dir=tmp_path / "run", **(asked | options)
        )

    yield build
    small.sim.use_tree(small.trees["bt"])


def test_a_comparison_carries_its_causes(request_of):
    result, folder = compare(request_of(explain_record=1), Quiet())
    agent = result["agents"][0]
    failed = [d for d in agent["episodes_detail"] if d["outcome"] != "success"]
    assert failed
    assert [(e["seed"], e["episode"], e["outcome"]) for e in agent["explain"]] == [
        (d["seed"], d["episode"], d["outcome"]) for d in failed
    ]
    assert sum(cause["count"] for cause in agent["causes"]) == len(failed)
    assert [(folder / e["log"]).is_file() for e in agent["explain"] if e["log"]] == [True]
    assert json.loads((folder / "eval/result.json").read_text()) == result
    written = json.loads((folder / "eval/explain.json").read_text())
    assert written["agents"] == [{"name": "straight", "causes": agent["causes"], "explain": agent["explain"]}]


def test_without_explain_the_document_has_no_causes(request_of):
    result, folder = compare(request_of(explain=False), Quiet())
    assert not {"causes", "explain"} & set(result["agents"][0])
    assert not (folder / "eval/explain.json").exists()


def test_an_interrupted_explanation_leaves_the_results(request_of, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("uuvtai.evaluation.failure_causes.explain_failures", interrupted)
    request = request_of()
    with pytest.raises(KeyboardInterrupt):
        compare(request, Quiet())
    assert json.loads((request.run_dir / "eval/result.json").read_text())["agents"][0]["episodes"] == 6
    assert json.loads((request.run_dir / "run.json").read_text())["status"] == "interrupted"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--explain-record", "2"], "give --explain too"),
        (["--explain", "--explain-record", "-1"], "must be at least 0"),
    ],
)
def test_bad_combinations_are_one_message(capfd, arguments, says):
    with pytest.raises(SystemExit) as left:
        main(["eval", *arguments])
    assert left.value.code == 2
    assert says in capfd.readouterr().err


def test_the_table_is_printed_and_no_failure_is_said(capfd):
    causes_found = failure_causes.table_of(
        [row("late_reaction", 0, 0.2, forecast_error_m=0.1, seen_ago_s=0.0, evading_s=0.4, last_chance_s=0.5)]
    )
    agent = {"name": "bt", "episodes": 9, "explain": [{}], "causes": causes_found}
    show_causes(Screen(), {"agents": [agent, {"name": "calm", "episodes": 9, "explain": [], "causes": []}]})
    out = capfd.readouterr().out
    assert "bt: why 1 of 9 episodes failed" in out
    assert "late_reaction" in out and "1:0" in out and "100 %" in out
    assert "calm: no episode failed, nothing to explain" in out


def test_help_names_the_default_that_markup_would_swallow(capfd):
    with pytest.raises(SystemExit):
        main(["eval", "--help"])
    out = capfd.readouterr().out
    assert "[default: 3]" in out
    assert "\\" not in out
