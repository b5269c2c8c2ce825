"""Scenarios: ranges, counts, gaps, free space, paths; pure functions of (world, seed, episode)."""

import functools
from operator import attrgetter

import numpy as np
import pytest

from tests.bundles import Stage
from tests.conftest import set_step
from tests.oracles import world as reference
from uuvtai.common.obstacle_motion import KIND_NAMES, describe_scenario, path_positions
from uuvtai.common.presets import preset_names
from uuvtai.config import EpisodeConfig, TrafficConfig, WorldConfig
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.geometry import BOX, CYLINDER, NONE, SPHERE
from uuvtai.kernels.task import episode
from uuvtai.kernels.task.io import EpisodeIO
from uuvtai.kernels.world import scenario as scenarios
from uuvtai.kernels.world.io import WorldIO
from uuvtai.sim import setup

RULES = EpisodeConfig()
"""one object: a kernel is compiled anew for another"""
N = 64
"""Episodes drawn per world."""
N_FLOOD = 8
"""of which the flood fill is repeated independently"""
FLOAT_TOL_M = 1e-4
"""float32 at coordinates up to 20 m, and outlines sampled every 5 mm"""
OUTLINE_TOL_M = 1.5e-3
"""a path sampled every 2 cm against a disc or corner"""
SPEED_TOL_M_S = 0.02
"""a corner passed within the last 2 % of a step; float32 positions alone give 2e-4"""
SHARE_SIGMAS = 5.0
WORLDS = ("pool", "gauntlet", "inertial", "maze", "netpen")


def world_config(name, **changes):
    return WorldConfig.model_validate({**load_config(name).world.model_dump(), **changes})


class Drawn(Stage):
    """Structs of one world, and its scenarios as arrays."""

    def __init__(self, cfg, n_env=N):
        super().__init__(n_env=n_env, **setup.scenario_sizes(cfg))
        self.cfg, self.n_env = cfg, n_env
        self.slots = setup.obstacle_slots(cfg)
        setup.load_fixed(self.fixed, cfg)

    def draw(self, seed=0, numbers=None, mask=None, scene=None):
        """Arrays by name of the episodes ``numbers`` (default 0 .. n_env - 1)."""
        cfg, n = self.cfg, self.n_env
        setup.set_scenes(self.scene, cfg, [scene or (cfg.n_static, cfg.n_dynamic, cfg.dynamic_speed_m_s)])
        numbers = np.arange(n) if numbers is None else np.asarray(numbers)
        mask = np.ones(n) if mask is None else np.asarray(mask)
        rows = (np.broadcast_to(a, n).astype(np.int32) for a in (mask, seed, numbers))
        episode.begin_episodes(self.io(EpisodeIO), *rows)
        scenarios.generate_scenarios(self.io(WorldIO, cfg))
        return self.at(0, keep_active=True)

    def at(self, step, keep_active=False):
        """Arrays by name with the obstacles where they are at a step."""
        self.move(step, keep_active)
        out = {f"path_{name}": field.to_numpy() for name, field in vars(self.path).items()}
        for struct in (self.world, self.mission):
            out |= {name: field.to_numpy() for name, field in vars(struct).items()}
        return out

    def move(self, step, keep_active=False):
        """The obstacles' places at a step."""
        if not keep_active:
            episode.wake(self.io(EpisodeIO))
        set_step(self.clock, step)
        scenarios.move_obstacles(self.io(WorldIO, self.cfg, RULES))
        return self.world.pos_w.to_numpy()

    def obstacles(self, drawn, env, first=0, last=None):
        """(kind, pos, size, yaw) in float64 of the obstacles in a range of slots."""
        rows = [drawn[name][env].astype(float) for name in ("kind", "pos_w", "size", "yaw")]
        slots = range(self.slots.n_obstacle)[first:last]
        return [
            (int(rows[0][i]), rows[1][i], rows[2][i], float(rows[3][i])) for i in slots if rows[0][i] != NONE
        ]

    def still(self, drawn, env):
        return self.obstacles(drawn, env, 0, self.slots.first_dynamic)


def inertial(**dynamic):
    """Small obstacles within wide turns, where both legs are clear."""
    world = load_config("gauntlet_inertial").world.model_dump()
    small = {"radius_m": (0.1, 0.12), "half_extent_m": (0.1, 0.12)}
    changes = {"dynamic_speed_m_s": 1.5, "obstacle_acceleration_m_s2": 0.5, "n_static": 4}
    changes |= {"static": world["static"] | small}
    changes |= {"dynamic": world["dynamic"] | {"keep_clear_draws": 16} | dynamic}
    return world_config("gauntlet_inertial", **changes)


@functools.cache
def drawn_world(name):
    # one set of slots serves the preset's S and D and every other (S, D)
    room = {"static_capacity": 12, "dynamic_capacity": 15} if name == "pool" else {}
    world_of = Drawn(inertial() if name == "inertial" else world_config(name, **room))
    return world_of, world_of.draw()


@pytest.fixture(params=WORLDS)
def any_world(request):
    return drawn_world(request.param)


def within(values, interval, margin=FLOAT_TOL_M):
    return np.all(values >= interval[0] - margin) and np.all(values <= interval[1] + margin)


# ------------------------------------------------------------------------------------------------ every world


def test_every_scenario_is_placed_as_asked(any_world):
    of, drawn = any_world
    setup.check_scenarios(drawn["faults"])
    assert np.all(drawn["draws"] >= 1)
    first, cfg = of.slots.first_dynamic, of.cfg
    still, moving = drawn["kind"][:, :first] != NONE, drawn["kind"][:, first:] != NONE
    assert np.all(still.sum(axis=1) == cfg.n_fixed_static + cfg.n_static)
    assert np.all(moving.sum(axis=1) == cfg.n_fixed_moving + cfg.n_dynamic)


def test_start_and_goal_keep_ranges_and_gap(any_world):
    of, drawn = any_world
    for point in (drawn["start_w"], drawn["goal_w"]):
        for axis, name in enumerate(("spawn_x_m", "spawn_y_m", "spawn_z_m")):
            assert within(point[:, axis], getattr(of.cfg, name))
    across = np.linalg.norm((drawn["goal_w"] - drawn["start_w"])[:, :2], axis=1)
    assert across.min() >= of.cfg.start_goal_gap_m - FLOAT_TOL_M
    assert within(drawn["start_yaw"], (-np.pi, np.pi))
    assert np.ptp(drawn["start_yaw"]) > 5.5


def test_static_obstacles_keep_sizes_and_gaps(any_world):
    of, drawn = any_world
    cfg, n_fixed = of.cfg, of.cfg.n_fixed_static
    for env in range(N):
        obstacles = of.still(drawn, env)
        for i, obstacle in enumerate(obstacles):
            kind, pos, size, _ = obstacle
            ends = [
                reference.plan_distances(drawn[end][env, :2].astype(float), *obstacle)
                for end in ("start_w", "goal_w")
            ]
            assert min(ends) >= cfg.static.endpoint_gap_m - FLOAT_TOL_M
            if i < n_fixed:
                continue
            assert pos[2] - size[2] == pytest.approx(cfg.tank.z_m[0], abs=FLOAT_TOL_M)
            assert pos[2] + size[2] == pytest.approx(cfg.tank.z_m[1], abs=FLOAT_TOL_M)
            sizes = size[:2] if kind == BOX else size[:1]
            assert within(sizes, cfg.static.half_extent_m if kind == BOX else cfg.static.radius_m)
            assert reference.wall_distances(reference.outline(*obstacle), cfg.tank).min() >= -FLOAT_TOL_M
            for other in obstacles[:i]:
                assert reference.keeps_gap(obstacle, other, cfg.static.gap_m - FLOAT_TOL_M)


def test_half_of_the_static_obstacles_are_boxes(any_world):
    of, drawn = any_world
    random = drawn["kind"][:, of.cfg.n_fixed_static : of.cfg.n_fixed_static + of.cfg.n_static]
    assert np.all((random == BOX).sum(axis=1) == int(of.cfg.n_static * of.cfg.static.box_fraction))


def test_free_space_joins_start_and_goal(any_world):
    of, drawn = any_world
    for env in range(N_FLOOD):
        ends = (drawn[end][env].astype(float) for end in ("start_w", "goal_w"))
        assert reference.is_joined(*ends, of.still(drawn, env), of.cfg.tank, of.cfg.static.joined_clearance_m)


def test_moving_obstacles_keep_sizes_depths_and_the_gap_to_the_start(any_world):
    of, drawn = any_world
    cfg, first = of.cfg.dynamic, of.slots.first_dynamic
    for env in range(N):
        for kind, pos, size, _ in of.obstacles(drawn, env, first):
            assert within(size[0], cfg.radius_m)
            assert np.hypot(*(pos - drawn["start_w"][env])[:2]) >= cfg.start_gap_m - FLOAT_TOL_M
            full = size[2] > cfg.height_m[1]
            if kind == CYLINDER and cfg.full_column_fraction > 0 and full:
                assert (pos[2] - size[2], pos[2] + size[2]) == pytest.approx(of.cfg.tank.z_m, abs=FLOAT_TOL_M)
                continue
            assert within(pos[2], cfg.z_m)
            if kind == CYLINDER:
                assert within(2 * size[2], cfg.height_m)


def test_half_are_cylinders_and_half_of_each_go_in_circles(any_world):
    of, drawn = any_world
    cfg, n, first = of.cfg.dynamic, of.cfg.n_dynamic, of.slots.first_dynamic
    cylinder = drawn["kind"][:, first : first + n] == CYLINDER
    assert np.all(cylinder.sum(axis=1) == int(n * cfg.cylinder_fraction))
    full = cylinder & (drawn["size"][:, first : first + n, 2] > cfg.height_m[1])
    assert np.all(full.sum(axis=1) == int(n * cfg.full_column_fraction))
    if cfg.motion == "line_circle":
        circle = drawn["path_n_way"][:, :n] == 0
        assert np.all(np.abs(circle.sum(axis=1) - n * cfg.circle_fraction) < 1)


def test_paths_keep_their_shapes_within_the_walls(any_world):
    of, drawn = any_world
    cfg, n, first = of.cfg.dynamic, of.cfg.n_dynamic, of.slots.first_dynamic
    for env in range(N):
        for lane in range(n):
            n_way, way = drawn["path_n_way"][env, lane], drawn["path_way_w"][env, lane].astype(float)
            radius, length = drawn["path_radius_m"][env, lane], drawn["path_length_m"][env, lane]
            points = reference.path_points(n_way, way, radius, length)
            assert (
                reference.wall_distances(points, of.cfg.tank).min()
                >= drawn["size"][env, first + lane, 0] - FLOAT_TOL_M
            )
            legs = np.linalg.norm(np.diff([*way[:n_way], way[0]], axis=0), axis=1)
            if n_way == 0:
                assert within(abs(radius), cfg.circle_radius_m)
                assert length == pytest.approx(2 * np.pi * abs(radius), rel=1e-6)
                continue
            assert length == pytest.approx(legs.sum(), rel=1e-6)
            if cfg.motion == "waypoints":
                assert cfg.corners[0] <= n_way <= cfg.corners[1]
                assert (
                    min(np.hypot(*(a - b)) for i, a in enumerate(way[:n_way]) for b in way[:i])
                    >= cfg.corner_gap_m - FLOAT_TOL_M
                )
            else:
                assert n_way == 2
                assert within(legs, cfg.line_length_m)


def test_paths_keep_clear_of_static_obstacles_or_are_counted(any_world):
    of, drawn = any_world
    n, first = of.cfg.n_dynamic, of.slots.first_dynamic
    if of.cfg.dynamic.keep_clear_draws == 0:
        assert not drawn["unclear_paths"].any()
        return
    for env in range(N):
        touching = 0
        for lane in range(n):
            points = reference.path_points(*_row(drawn, env, lane))
            room = drawn["size"][env, first + lane, 0]
            gaps = [
                reference.plan_distances(points, *obstacle).min() - room for obstacle in of.still(drawn, env)
            ]
            touching += min(gaps, default=1.0) < -OUTLINE_TOL_M
        assert touching <= drawn["unclear_paths"][env] <= n


def _row(drawn, env, lane):
    n_way = int(drawn["path_n_way"][env, lane])
    return (
        n_way,
        drawn["path_way_w"][env, lane].astype(float),
        *(float(drawn[f"path_{k}"][env, lane]) for k in ("radius_m", "length_m")),
    )


def test_moving_obstacles_keep_constant_speed_on_their_paths(any_world):
    """Central differences over one control step equal the stated velocity; off corners its length is v."""
    of, _ = any_world
    n, first = of.cfg.n_dynamic, of.slots.first_dynamic
    dt, v, turns_at_once = RULES.control_dt_s, of.cfg.dynamic_speed_m_s, not of.cfg.obstacle_acceleration_m_s2
    for step in (1, 500, 2999):
        before, now, after = (of.at(step + shift) for shift in (-1, 0, 1))
        pos = [snap["pos_w"][:, first : first + n].astype(float) for snap in (before, now, after)]
        vel = now["vel_w"][:, first : first + n].astype(float)
        speed = np.linalg.norm(vel, axis=-1)
        assert np.allclose(speed, v, atol=1e-5) if turns_at_once else speed.max() <= v + 1e-5
        ahead, behind = (pos[2] - pos[1]) / dt, (pos[1] - pos[0]) / dt
        # the tightest circle changes the velocity by 0.014 m/s
        off_corners = np.abs(ahead - behind).max(axis=-1) < SPEED_TOL_M_S
        assert off_corners.mean() > 0.95 or not turns_at_once
        assert np.abs(0.5 * (ahead + behind) - vel)[off_corners].max() < SPEED_TOL_M_S
        assert np.all(pos[0][..., 2] == pos[2][..., 2])


@pytest.mark.parametrize("motion", ["waypoints", "line_circle"])
def test_obstacles_with_inertia_move_as_an_integrator_says(motion):
    """Turns, reversals and their moments by constant acceleration, integrated in float64; speeds that a path
    cannot have are lowered."""
    of = drawn_world("inertial")[0]
    if motion != of.cfg.dynamic.motion:
        of = Drawn(inertial(motion=motion), n_env=8)
    most = of.cfg.obstacle_acceleration_m_s2
    drawn = of.draw(seed=5, mask=np.arange(of.n_env) < 8, scene=(of.cfg.n_static, of.cfg.n_dynamic, 0.8))
    drawn, steps = {name: rows[:8] for name, rows in drawn.items()}, np.arange(0, 1000, 50)
    shown = [of.at(step) for step in steps]
    of.draw()
    speed, easing, n_way = (drawn[f"path_{name}"] for name in ("speed_m_s", "easing_m", "n_way"))
    assert easing[speed > 0] == pytest.approx(speed[speed > 0] ** 2 / most, rel=1e-5)
    for env, lane in np.argwhere(speed > 0):
        slot = of.slots.first_dynamic + lane
        found = np.array([[*at["pos_w"][env, slot, :2], *at["vel_w"][env, slot, :2]] for at in shown])
        if n_way[env, lane] == 0:
            assert speed[env, lane] ** 2 <= most * abs(drawn["path_radius_m"][env, lane]) * (1 + 1e-5)
            continue
        corners = drawn["path_way_w"][env, lane, : n_way[env, lane]].astype(float)
        numbers = (drawn[f"path_{name}"][env, lane].astype(float) for name in ("phase_m", "speed_m_s"))
        wanted = reference.driven(corners, *numbers, most, steps * RULES.control_dt_s)
        assert found == pytest.approx(wanted, abs=0.01)
    assert 0.0 < np.mean(speed[speed > 0] < 0.79) < 0.9 and np.max(speed) == np.float32(0.8)


def test_turns_with_inertia_keep_clear_of_static_obstacles_too():
    """Five of these scenarios would have one in a way that nobody counted."""
    of, drawn = drawn_world("inertial")
    moving = slice(of.slots.first_dynamic, None)
    place = np.stack([of.move(step)[:, moving, :2].astype(float) for step in range(0, 3000, 15)])
    touching, used = np.zeros(N), drawn["kind"][:, moving] != NONE
    for env, lane in np.argwhere(used):
        still = [reference.plan_distances(place[:, env, lane], *one).min() for one in of.still(drawn, env)]
        touching[env] += min(still) < drawn["size"][env, moving][lane, 0] - OUTLINE_TOL_M
    assert (touching <= drawn["unclear_paths"]).all() and drawn["unclear_paths"].sum() < 0.5 * used.sum()


def test_the_log_s_closed_form_gives_the_same_positions(any_world):
    of, _ = any_world
    drawn = of.at(777)
    for env in range(0, N, 16):
        document = describe_scenario(lambda name, env=env: attrgetter(name)(of).to_numpy()[env])
        assert len(document["obstacles"]) == np.sum(drawn["kind"][env] != NONE)
        for obstacle in document["obstacles"]:
            assert KIND_NAMES[drawn["kind"][env, obstacle["slot"]]] == obstacle["kind"]
            if obstacle["path"] is not None:
                (at,) = path_positions(obstacle["path"], np.array([777 * RULES.control_dt_s]))
                # float32 arcs of up to 10 m
                assert at == pytest.approx(drawn["pos_w"][env, obstacle["slot"], :2], abs=1e-3)


# ---------------------------------------------------------------------------------- distributions of the pool


def test_pool_draws_are_uniform():
    of, drawn = drawn_world("pool")
    first, n = of.slots.first_dynamic, of.cfg.n_dynamic
    kind, size = drawn["kind"], drawn["size"]
    cylinders, boxes = kind[:, :first] == CYLINDER, kind[:, :first] == BOX
    line = drawn["path_n_way"][:, :n] == 2
    columns = {
        "radius": (size[:, :first, 0][cylinders], (0.2, 0.4)),
        "half extent x": (size[:, :first, 0][boxes], (0.2, 0.5)),
        "half extent y": (size[:, :first, 1][boxes], (0.2, 0.5)),
        "yaw": (drawn["yaw"][:, :first][boxes], (0.0, 2 * np.pi)),
        "heading": (drawn["start_yaw"], (-np.pi, np.pi)),
        "start z": (drawn["start_w"][:, 2], (-1.2, -0.4)),
        "start y": (drawn["start_w"][:, 1], (1.2, 4.8)),
        "goal y": (drawn["goal_w"][:, 1], (1.2, 4.8)),
        "moving radius": (size[:, first : first + n, 0], (0.15, 0.25)),
        "moving z": (drawn["pos_w"][:, first : first + n, 2], (-1.2, -0.4)),
        "line": (0.5 * drawn["path_length_m"][:, :n][line], (2.0, 6.0)),
        "circle": (np.abs(drawn["path_radius_m"][:, :n][~line]), (0.5, 2.0)),
        "direction": (drawn["path_radius_m"][:, :n][~line], (-1.0, 1.0)),
        "phase": ((drawn["path_phase_m"] / np.maximum(drawn["path_length_m"], 1e-9))[:, :n], (0.0, 1.0)),
    }
    for name, (values, (low, high)) in columns.items():
        lower_half = np.ravel(values) < 0.5 * (low + high)
        assert abs(lower_half.mean() - 0.5) * 2 * np.sqrt(lower_half.size) < SHARE_SIGMAS, name
    assert np.ptp(drawn["pos_w"][:, :first, 0][cylinders | boxes]) > 18.0


def test_most_pool_paths_keep_clear():
    """16 draws find a clear path nearly always; this is what makes the world fair."""
    of, drawn = drawn_world("pool")
    assert drawn["unclear_paths"].sum() < 0.02 * N * of.cfg.n_dynamic


# ---------------------------------------------------------------------------------------------- pure function


PURE = ("kind", "pos_w", "vel_w", "size", "yaw", "start_w", "goal_w", "start_yaw", "draws", "unclear_paths")


def test_order_of_episodes_changes_nothing():
    of, drawn = drawn_world("pool")
    order = np.random.default_rng(0).permutation(N)
    again = of.draw(numbers=order)
    for name in PURE:
        assert np.array_equal(again[name], drawn[name][order]), name
    of.draw()


def test_a_reset_touches_only_its_rows_and_forgets_what_was_there():
    of, drawn = drawn_world("pool")
    of.draw(seed=5, scene=(12, 15, 3.0))
    mixed = of.draw(mask=np.arange(N) % 2 == 0)
    other = of.draw(seed=5, scene=(12, 15, 3.0))
    for name in PURE:
        assert np.array_equal(mixed[name][::2], drawn[name][::2]), name
        if name not in ("pos_w", "vel_w"):  # moved to step 0 of the new clock only where active
            assert np.array_equal(mixed[name][1::2], other[name][1::2]), name
    of.draw()


def test_seed_and_episode_both_matter():
    of, drawn = drawn_world("pool")
    assert not np.any(np.all(of.draw(seed=1)["start_w"] == drawn["start_w"], axis=1))
    assert len(np.unique(drawn["start_w"], axis=0)) == N
    of.draw()


def test_number_and_speed_of_moving_obstacles_change_nothing_else():
    of, drawn = drawn_world("pool")
    first, n = of.slots.first_dynamic, of.cfg.n_dynamic
    more = of.draw(scene=(of.cfg.n_static, 15, 3.0))
    none = of.draw(scene=(of.cfg.n_static, 0, 0.0))
    for changed in (more, none):
        for name in ("start_w", "goal_w", "start_yaw", "draws"):
            assert np.array_equal(changed[name], drawn[name])
        for name in ("kind", "pos_w", "size", "yaw"):
            assert np.array_equal(changed[name][:, :first], drawn[name][:, :first])
    assert np.all((more["kind"][:, first:] != NONE).sum(axis=1) == 15)
    assert not (none["kind"][:, first:] != NONE).any()
    for name in ("kind", "pos_w", "size"):
        assert np.array_equal(more[name][:, first : first + n], drawn[name][:, first : first + n])
    assert np.allclose(np.linalg.norm(more["vel_w"][:, first:], axis=-1), 3.0, atol=1e-5)
    of.draw()


def test_number_of_static_obstacles_keeps_start_goal_and_the_first_obstacles():
    of, drawn = drawn_world("pool")
    fewer = of.draw(scene=(4, of.cfg.n_dynamic, of.cfg.dynamic_speed_m_s))
    assert np.array_equal(fewer["start_w"], drawn["start_w"])
    assert np.array_equal(fewer["goal_w"], drawn["goal_w"])
    same_layout = fewer["draws"] == drawn["draws"]
    assert same_layout.mean() > 0.9
    for name in ("kind", "pos_w", "size", "yaw"):
        assert np.array_equal(fewer[name][same_layout, :4], drawn[name][same_layout, :4])
    of.draw()


# ----------------------------------------------------------------------------------------- a user's own world


def test_explicit_obstacles_stand_and_move_as_written():
    """A wall, a shuttling box, a sphere on a triangle; start and goal share a side of the wall."""
    cfg = WorldConfig.model_validate(
        {
            "n_static": 0,
            "n_dynamic": 0,
            "static_capacity": 0,
            "dynamic_capacity": 0,
            "fixed": [
                {"kind": "box", "x_m": 10, "y_m": 3, "half_extents_m": [0.1, 3.0]},
                {
                    "kind": "box", "x_m": 0, "y_m": 0, "half_extents_m": [0.2, 0.1], "yaw_deg": 30,
                    "height_m": 0.4, "z_m": -1.0,
                }
                | {"path": [{"x_m": 2, "y_m": 2}, {"x_m": 5, "y_m": 2}], "speed_m_s": 1.5},
                {"kind": "cylinder", "x_m": 19, "y_m": 0.5, "radius_m": 0.3},
                {"kind": "sphere", "x_m": 0, "y_m": 0, "radius_m": 0.2, "z_m": -0.5}
                | {"path": [{"x_m": 12, "y_m": 1}, {"x_m": 16, "y_m": 1}, {"x_m": 16, "y_m": 4}]},
            ],
        }
    )  # fmt: skip
    of = Drawn(cfg, n_env=64)
    drawn = of.draw()
    assert not drawn["faults"].any()
    assert drawn["draws"].max() > 16, "some pairs of start and goal must have been given up"
    side = (drawn["start_w"][:, 0] - 10) * (drawn["goal_w"][:, 0] - 10)
    assert np.all(side > 0)
    assert [kind for kind, *_ in of.obstacles(drawn, 0)] == [BOX, CYLINDER, BOX, SPHERE]
    dt = RULES.control_dt_s
    later = of.at(150)  # 3 s: the box is 1.5 m back on its way, the sphere 1.8 m along
    assert later["pos_w"][:, 2] == pytest.approx(np.tile([3.5, 2, -1.0], (64, 1)), abs=FLOAT_TOL_M)
    assert later["vel_w"][:, 2] == pytest.approx(np.tile([-1.5, 0, 0], (64, 1)), abs=1e-5)
    assert later["yaw"][:, 2] == pytest.approx(np.radians(30))
    assert later["size"][0, 2] == pytest.approx([0.2, 0.1, 0.2])
    assert later["pos_w"][:, 3] == pytest.approx(
        np.tile([12 + 0.6 * 150 * dt, 1, -0.5], (64, 1)), abs=FLOAT_TOL_M
    )
    assert later["size"][0, 0] == pytest.approx([0.1, 3.0, 0.8])


def test_a_world_that_cannot_be_placed_is_told():
    """By number of obstacles, and by what stands there: one compiled world."""
    small = {"kind": "box", "x_m": 10, "y_m": 3, "half_extents_m": [0.1, 0.1]}
    told = {
        "n_static": 12, "n_dynamic": 1, "static": {"gap_m": 4.0}, "start_goal_gap_m": 9, "fixed": [small],
        "dynamic": {"line_length_m": [30, 40], "circle_fraction": 0},
    }  # fmt: skip
    of = Drawn(WorldConfig.model_validate(told), n_env=4)

    def faults(*scene):
        return of.draw(scene=(*scene, 0.6))["faults"]

    with pytest.raises(RuntimeError, match=r"4 of 4 scenarios.*static obstacles find no place"):
        setup.check_scenarios(faults(12, 0))
    assert not faults(1, 0).any()
    with pytest.raises(RuntimeError, match="moving obstacle finds no path"):
        setup.check_scenarios(faults(0, 1))
    walled = told | {"fixed": [small | {"half_extents_m": [4.1, 3.0]}]}
    setup.load_fixed(of.fixed, WorldConfig.model_validate(walled))
    with pytest.raises(RuntimeError, match="no layout joins start and goal"):
        setup.check_scenarios(faults(0, 0))


@pytest.mark.parametrize(
    "scene", [(17, 0, 0.6), (0, 17, 0.6), (-1, 0, 0.6), (0, 0, float("nan")), (0, 0, -1.0)]
)
def test_scenes_that_do_not_fit_are_refused(scene):
    of = drawn_world("gauntlet")[0]
    with pytest.raises(ValueError, match=r"slots|speed"):
        setup.set_scenes(of.scene, of.cfg, [scene])


SPHERE_ON = {"kind": "sphere", "x_m": 1, "y_m": 1, "radius_m": 0.1}


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_static": 9, "static_capacity": 8},
        {"spawn_x_m": [-1, 5]},
        {"spawn_z_m": [-1.2, 0.4]},
        {"static": {"radius_m": [0.4, 0.2]}},
        {"static": {"radius_m": [0.0, 0.2]}},
        {"dynamic": {"corners": [3, 6]}},
        {"dynamic": {"cylinder_fraction": 0.2, "full_column_fraction": 0.3}},
        {"fixed": [{"kind": "sphere", "x_m": 1, "y_m": 1}]},
        {"fixed": [SPHERE_ON | {"path": [{"x_m": 1, "y_m": 1}, {"x_m": 1, "y_m": 1}]}]},
        {
            "fixed": [SPHERE_ON | {"path": [{"x_m": x, "y_m": 1} for x in (1, 3, 1)]}],
            "obstacle_acceleration_m_s2": 1.0,
        },
    ],
)
def test_worlds_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError):
        WorldConfig.model_validate(wrong)


@pytest.mark.parametrize("world", sorted(preset_names("world")))
def test_what_is_known_beforehand_is_true_of_the_world(world):
    """The prior that a world's preset gives the vehicle says of its moving obstacles what the world draws."""
    config = load_config(world)
    obstacles, known = config.world.dynamic, config.traffic
    if config.world.n_dynamic == 0:
        assert known == TrafficConfig()  # nothing is said of what is not there
        return
    assert known.z_m == obstacles.z_m
    assert config.height.column_share <= max(0.05, obstacles.full_column_fraction)
    drawn = [*(2 * radius for radius in obstacles.radius_m), *obstacles.height_m]
    assert min(drawn) <= known.height_m[0] <= known.height_m[1] <= max(drawn)
    if obstacles.motion == "line_circle" and obstacles.circle_fraction < 1:
        assert known.leg_m == obstacles.line_length_m
