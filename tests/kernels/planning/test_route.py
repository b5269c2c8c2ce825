"""Triggers one by one, the queue, progress, path-relative terms, and loading a path from the host."""

import numpy as np
import pytest

from tests import planning_maps as maps
from tests.bundles import io_for, put
from tests.map_bits import kept, room
from tests.oracles import route as oracle
from tests.planning_stage import CONFIG, N_ENV, clean, plan, put_ends, put_maps, room_m, stage, way_of
from uuvtai.common import enums as codes
from uuvtai.kernels.planning import route, triggers
from uuvtai.kernels.planning.io import RouteIO

POSITION_M = 2e-5
"""float32 at 20 m resolves 1e-6 m; lengths are sums of a hundred such steps."""
R, DT = CONFIG.route, CONFIG.episode.control_dt_s
REST_STEPS = round(R.min_replan_s / DT)


def fire():
    triggers.fire_triggers(io_for(RouteIO, stage(), CONFIG))


def follow():
    route.follow_route(io_for(RouteIO, stage(), CONFIG))


def load(env, corners):
    s, c = stage(), CONFIG
    io = io_for(RouteIO, s.route, s.clearance, s.clock, c.clearance, c.route, c.voronoi, c.mapping, maps.TANK)
    route.load_route(io, np.array(corners, np.float32), env, codes.PLANNER_RRT)
    s.route.want_plan[env] = 1  # nobody loads a route that was not asked for


def set_step(step):
    # fill() would compile a kernel for every value
    stage().clock.step.from_numpy(np.full(N_ENV, step, np.int32))


def with_routes():
    """Every env moves at 0.5 m/s along a route that was planned long ago."""
    s = clean()
    fire()
    plan()
    put(s.route, replans=0, stuck_steps=0)
    s.ego.vel_b.from_numpy(np.tile(np.float32([0.5, 0, 0]), (N_ENV, 1)))
    set_step(1000)
    return s


def held(env):
    """Names of the triggers in ``fired``."""
    bits = stage().route.fired[env]
    return [name for i, name in enumerate(codes.TRIGGERS) if bits >> i & 1]


def counts(env):
    return dict(zip(codes.TRIGGERS, stage().route.replans.to_numpy()[env].tolist(), strict=True))


def test_initial_fires_once_and_again_only_while_there_is_no_route():
    s = clean()
    fire()
    assert [s.route.want_plan[env] for env in range(N_ENV)] == [1] * N_ENV
    assert held(0) == ["initial"] and s.route.trigger[0] == codes.TRIGGER_INITIAL
    plan([0])
    s.ego.vel_b.fill(0.5)
    for step in range(1, REST_STEPS):
        set_step(step)
        fire()
        assert s.route.n_queue[None] == 0
    set_step(REST_STEPS)
    fire()
    assert held(0) == [] and held(1) == ["initial"]
    assert counts(0)["initial"] == 1 and counts(1)["initial"] == 2


def test_nothing_fires_on_a_clear_way():
    s = with_routes()
    fire()
    assert s.route.n_queue[None] == 0
    assert all(held(env) == [] and s.route.trigger[env] == codes.TRIGGER_NONE for env in range(N_ENV))


def test_stuck_needs_its_time_and_starts_anew():
    s = with_routes()
    speed = np.full((N_ENV, 3), [0.5, 0, 0], np.float32)
    speed[2] = [0.03, 0.02, 0.0]
    s.ego.vel_b.from_numpy(speed)
    needed = round(R.stuck_s / DT)
    for k in range(2 * needed):
        set_step(1000 + k)
        fire()
        assert held(2) == (["stuck"] if (k + 1) % needed == 0 else []), f"step {k}"
        assert held(3) == []
    assert counts(2) == {"initial": 0, "stuck": 2, "safety": 0, "intersection": 0}


def test_nobody_is_stuck_at_the_goal():
    s = with_routes()
    s.ego.vel_b.fill(0)
    put_ends([(17.2, 3.0)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    fire()
    assert s.route.stuck_steps[0] == 0
    put_ends([(16.8, 3.0)] * N_ENV, [(18.0, 3.0)] * N_ENV)
    fire()
    assert s.route.stuck_steps[0] == 1


@pytest.mark.parametrize(
    ("range_m", "doppler", "hit", "fires"),
    [
        (0.49, 0.0, 1, True),
        (0.51, 0.0, 1, False),
        (0.49, 0.0, 0, False),
        (2.0, -2.05, 1, True),
        (2.0, -1.95, 1, False),
        (2.0, 2.05, 1, False),
    ],
)
def test_safety_by_range_and_by_time(range_m, doppler, hit, fires):
    s = with_routes()
    s.scan.range_m[1, 5], s.scan.doppler_m_s[1, 5], s.scan.hit[1, 5] = range_m, doppler, hit
    fire()
    assert held(1) == (["safety"] if fires else [])
    assert held(0) == []


def test_each_trigger_rests_by_itself_and_one_is_counted():
    s = with_routes()
    s.scan.range_m[1, 5], s.scan.hit[1, 5] = 0.3, 1
    fire()
    assert held(1) == ["safety"]
    put_maps(
        [np.zeros(maps.SHAPE, bool), np.hypot(maps.X - 4.0, maps.Y - 3.0) < 0.3]
        + [np.zeros(maps.SHAPE, bool)] * (N_ENV - 2)
    )
    set_step(1001)
    fire()
    assert held(1) == ["intersection"]
    set_step(1000 + REST_STEPS - 1)
    fire()
    assert held(1) == []
    set_step(1001 + REST_STEPS)
    fire()
    assert held(1) == ["safety", "intersection"] and s.route.trigger[1] == codes.TRIGGER_SAFETY
    assert counts(1) == {"initial": 0, "stuck": 0, "safety": 2, "intersection": 1}
    assert s.route.served_step[1, codes.TRIGGER_INTERSECTION - 1] == 1001 + REST_STEPS


@pytest.mark.parametrize(("x", "fires"), [(4.9, True), (5.6, False), (1.4, False)])
def test_intersection_with_the_map_looks_as_far_as_its_horizon_and_not_back(x, fires):
    with_routes()
    occ = np.zeros(maps.SHAPE, bool)
    occ[maps.cell_of((x, 3.0))] = True
    put_maps([occ] + [np.zeros(maps.SHAPE, bool)] * (N_ENV - 1))
    fire()
    assert held(0) == (["intersection"] if fires else [])
    assert held(1) == []


def test_intersection_with_the_map_before_the_clearance_is_renewed():
    s = with_routes()
    occ = np.zeros((N_ENV, *maps.SHAPE), np.uint16)
    occ[0][maps.cell_of((4.0, 3.0))] = codes.FULL
    s.grid_map.static_occ.from_numpy(occ)
    fire()
    assert held(0) == ["intersection"] and held(1) == []


def put_obstacle(env, when, at, radius=0.2):
    s = stage()
    radii, pos = s.forecast.radius_m.to_numpy(), s.forecast.pos_w.to_numpy()
    radii[env, 1], pos[env, 1] = radius, (-50.0, 3.0)  # forecast at all steps, far away at the others
    for k in range(radii.shape[2]):
        if when[0] <= k * CONFIG.tracking.forecast_dt_s <= when[1]:
            pos[env, 1, k] = at
    put(s.forecast, radius_m=radii, pos_w=pos)


@pytest.mark.parametrize(
    ("when", "at", "fires"),
    [
        ((1.9, 2.1), (3.1, 3.0), True),  # the vehicle can be at 3.2 after 2 s
        ((0.1, 0.3), (3.1, 3.0), False),  # gone before the vehicle can be there
        ((2.4, 2.5), (4.2, 3.0), False),  # beyond reach: 3.5 m at most, and 0.55 m to keep
        ((1.9, 2.1), (3.1, 3.54), True),  # 0.2 m radius + 0.35 m to keep
        ((1.9, 2.1), (3.1, 3.60), False),
    ],
)
def test_intersection_with_the_forecast(when, at, fires):
    s = with_routes()
    put_obstacle(4, when, at)
    fire()
    assert held(4) == (["intersection"] if fires else [])
    assert held(0) == []
    assert [s.route.queue[i] for i in range(s.route.n_queue[None])] == ([4] if fires else [])


@pytest.mark.parametrize(("now", "then", "fires"), [(0.2, 0.4, True), (0.4, 0.2, False)])
def test_intersection_with_the_forecast_keeps_the_radius_of_that_moment(now, then, fires):
    """Passing 0.65 m away after 2 s: within 0.35 m of a radius of 0.4 m, not of one of 0.2 m."""
    s = with_routes()
    put_obstacle(4, (1.9, 2.1), (3.1, 3.65))
    times = np.arange(s.forecast.radius_m.shape[2]) * CONFIG.tracking.forecast_dt_s
    radii = s.forecast.radius_m.to_numpy()
    radii[4, 1] = np.where(times < 1.0, now, then)
    s.forecast.radius_m.from_numpy(radii)
    fire()
    assert held(4) == (["intersection"] if fires else [])


def test_the_queue_holds_awake_envs_in_order():
    s = clean()
    s.clock.active.from_numpy(np.array([0, 1, 0, 1, 1, 0, 0, 1], np.int32))
    fire()
    assert s.route.n_queue[None] == 4
    assert sorted(s.route.queue[i] for i in range(4)) == [1, 3, 4, 7]


def random_way(rng, n):
    turns = np.cumsum(rng.normal(0, 0.5, n))
    return np.array([5.0, 3.0]) + np.cumsum(
        np.stack([np.cos(turns), np.sin(turns)], 1) * rng.uniform(0.1, 0.6, (n, 1)), 0
    )


def test_loading_keeps_the_line_and_spaces_it():
    s = clean()
    rng = np.random.default_rng(3)
    for env in range(N_ENV):
        corners = random_way(rng, 12)
        load(env, corners)
        way = way_of(env)
        steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
        assert steps.max() <= R.spacing_m * (1 + 2e-4)
        for corner in corners:
            assert np.linalg.norm(way - corner, axis=1).min() < POSITION_M
        assert steps.sum() == pytest.approx(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum(), abs=1e-3)
        left = s.route.way_left_m.to_numpy()[env, : len(way)]
        assert np.allclose(left, [*steps[::-1].cumsum()[::-1].tolist(), 0.0], atol=1e-4)
        assert s.route.planner[env] == codes.PLANNER_RRT
        assert s.route.planned_by.to_numpy()[env].tolist() == [0, 1, 0]


def test_loading_counts_the_cost_of_the_line():
    s = clean()
    load(0, [(5.0, 1.05), (9.0, 1.05)])
    load(1, [(5.0, 3.0), (9.0, 3.0)])
    row, col = maps.cell_of((7.0, 1.05))
    assert s.route.cost[0] == pytest.approx(4.0 / room_m(s)[0, row, col], rel=1e-3)
    assert s.route.cost[1] == pytest.approx(4.0 / CONFIG.clearance.max_m, rel=1e-3)


def test_terms_along_random_routes_agree_with_the_oracle():
    rng = np.random.default_rng(11)
    s = clean()
    ways = [random_way(rng, 12) for _ in range(N_ENV)]
    for env in range(N_ENV):
        load(env, ways[env])
    length = [oracle.corners_and_lengths(w)[1][-1] for w in ways]
    for travelled in np.linspace(0.0, 0.95, 14):
        pos = np.array(
            [oracle.point_at(w, travelled * total) for w, total in zip(ways, length, strict=True)]
        ) + rng.normal(0, 0.02, (N_ENV, 2))
        yaw = rng.uniform(-np.pi, np.pi, N_ENV).astype(np.float32)
        s.ego.pos_w.from_numpy(np.column_stack([pos, np.full(N_ENV, -0.5)]).astype(np.float32))
        s.mission.goal_w.from_numpy(
            np.column_stack([[w[-1] for w in ways], np.full(N_ENV, -1.1)]).astype(np.float32)
        )
        s.ego.rpy.from_numpy(np.column_stack([np.zeros((N_ENV, 2)), yaw]).astype(np.float32))
        before = s.route.arc.to_numpy()
        fire()
        follow()
        assert (s.route.arc.to_numpy() >= before).all()
        for env, way in enumerate(ways):
            at, cross = oracle.nearest_on(way, pos[env])
            left = length[env] - at
            aim = oracle.point_at(way, at + R.lookahead_m)
            depth = -0.5 - 0.6 * min(1.0, R.lookahead_m / left)
            bearing = np.arctan2(*(aim - pos[env])[::-1]) - yaw[env]
            assert s.route.remaining_m[env] == pytest.approx(left, abs=2e-3)
            assert s.route.cross_track_m[env] == pytest.approx(cross, abs=2e-4)
            assert s.route.lookahead_w[env].to_numpy() == pytest.approx([*aim, depth], abs=2e-3)
            assert abs(np.angle(np.exp(1j * (s.route.heading_error[env] - bearing)))) < 5e-3


def test_cross_track_is_positive_on_the_left():
    s = clean()
    load(0, [(2.0, 3.0), (18.0, 3.0)])
    load(1, [(2.0, 3.0), (18.0, 3.0)])
    put_ends([(5.0, 3.4), (5.0, 2.6)] + [(5.0, 3.0)] * 6, [(18.0, 3.0)] * N_ENV)
    s.route.arc.fill(14.0)
    fire()
    follow()
    assert s.route.cross_track_m[0] == pytest.approx(0.4, abs=1e-5)
    assert s.route.cross_track_m[1] == pytest.approx(-0.4, abs=1e-5)
    assert s.route.remaining_m[0] == pytest.approx(13.0, abs=1e-4)
    assert s.route.lookahead_w[0].to_numpy()[:2] == pytest.approx([6.0, 3.0], abs=1e-4)
    assert s.route.heading_error[0] == pytest.approx(np.arctan2(-0.4, 1.0), abs=1e-4)


def test_progress_never_goes_back_nor_jumps_to_a_far_leg():
    s = clean()
    load(0, [(5.0, 2.6), (10.0, 2.6), (10.0, 3.4), (5.0, 3.4)])
    put_ends([(6.0, 3.3)] * N_ENV, [(5.0, 3.4)] * N_ENV)  # nearer to the far leg, ten metres of route ahead
    fire()
    follow()
    assert s.route.remaining_m[0] == pytest.approx(10.8 - 1.0, abs=1e-3)
    put_ends([(5.2, 2.6)] * N_ENV, [(5.0, 3.4)] * N_ENV)
    fire()
    follow()
    assert s.route.remaining_m[0] == pytest.approx(10.8 - 1.0, abs=1e-3)


def test_depth_arrives_with_the_goal():
    s = clean()
    load(0, [(2.0, 3.0), (6.0, 3.0)])
    depths = []
    for x, z in ((2.0, -0.4), (4.0, -0.4), (5.5, -0.4)):
        s.ego.pos_w[0], s.mission.goal_w[0] = [x, 3.0, z], [6.0, 3.0, -1.2]
        s.route.arc[0] = (x - 2.0) / 0.2
        follow()
        depths.append(s.route.lookahead_w[0][2])
    assert depths == pytest.approx([-0.6, -0.8, -1.2], abs=1e-4)


def test_without_a_route_the_vehicle_hovers():
    s = clean()
    put_ends([(4.0, 3.0)] * N_ENV, [(7.0, 3.0)] * N_ENV)
    fire()
    follow()
    assert np.array_equal(s.route.lookahead_w[0].to_numpy(), s.ego.pos_w[0].to_numpy())
    assert (s.route.heading_error[0], s.route.cross_track_m[0]) == (0.0, 0.0)
    assert s.route.remaining_m[0] == pytest.approx(3.0)
    assert s.route.n_ahead[0] == 1 and np.isfinite(s.route.path_risk[0])


def test_path_risk_is_the_mean_over_the_look_ahead_segment():
    s = clean()
    rng = np.random.default_rng(5)
    static, dynamic = rng.random((2, *maps.SHAPE)).astype(np.float32)
    site = room(rng.uniform(0.1, 2.0, maps.SHAPE))
    put(s.grid_map, static_occ=kept(static), dynamic_occ=kept(dynamic))
    put(s.clearance, site=site)
    load(2, [(3.03, 1.04), (4.03, 2.04), (12.0, 2.04)])
    put_ends([(3.03, 1.04)] * N_ENV, [(12.0, 2.04)] * N_ENV)
    follow()
    c, clearance, points = CONFIG.clearance, room_m(s)[2], s.route.ahead_w.to_numpy()[2][: s.route.n_ahead[2]]
    assert len(points) == round(R.risk_horizon_m / maps.CELL_M) + 1
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.max() < maps.CELL_M + 1e-4
    assert np.allclose(points[-1], [4.03 + 3.0 - np.sqrt(2.0), 2.04], atol=1e-3)
    cells = [maps.cell_of(p) for p in points]
    risk = [
        c.risk_static * static[k]
        + c.risk_dynamic * dynamic[k]
        + c.risk_clearance / (clearance[k] + c.risk_epsilon_m)
        for k in cells
    ]
    assert s.route.path_risk[2] == pytest.approx(np.mean(risk), rel=1e-4)


def test_triggers_and_route_see_the_same_ahead():
    """Where no route is planned, what the triggers saw along it stays; looked at again it is the same."""
    s = with_routes()
    fire()
    assert not s.route.want_plan.to_numpy().any()
    follow()
    names = ("ahead_w", "n_ahead", "path_risk")
    seen = [getattr(s.route, name).to_numpy() for name in names]
    put(s.route, want_plan=1, n_ahead=0, path_risk=0)
    follow()
    for name, values in zip(names, seen, strict=True):
        assert np.array_equal(getattr(s.route, name).to_numpy(), values), name
    assert seen[2].all() and s.route.n_ahead[0] > 1


def test_reset_clears_only_the_rows_that_are_awake():
    s = with_routes()
    fire()
    follow()
    before = {
        name: getattr(s.route, name).to_numpy()
        for name in vars(s.route)
        if getattr(s.route, name).shape[:1] == (N_ENV,)
    }
    s.clock.active.from_numpy(np.array([1, 0, 1, 0, 0, 0, 0, 0], np.int32))
    route.reset_route(io_for(RouteIO, s.route, s.clock))
    for name, values in before.items():
        after = getattr(s.route, name).to_numpy()
        assert np.array_equal(after[[1, 3, 4, 5, 6, 7]], values[[1, 3, 4, 5, 6, 7]]), name
        if name not in ("queue", "failed", "served_step"):
            assert not after[[0, 2]].any(), name
    assert (s.route.served_step.to_numpy()[[0, 2]] < -REST_STEPS).all()


def test_asleep_rows_are_left_alone():
    s = with_routes()
    fire()
    follow()
    s.clock.active.fill(0)
    before = {
        name: getattr(s.route, name).to_numpy()
        for name in ("arc", "lookahead_w", "stuck_steps", "ahead_w", "path_risk", "fired")
    }
    put_ends([(9.0, 2.0)] * N_ENV, [(3.0, 3.0)] * N_ENV)
    s.ego.vel_b.fill(0)
    fire()
    follow()
    for name, values in before.items():
        assert np.array_equal(getattr(s.route, name).to_numpy(), values), name
    assert s.route.n_queue[None] == 0
