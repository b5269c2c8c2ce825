"""Beams of different ages: each is kept with where the vehicle was, shown from where it is, and used once."""

import numpy as np
import pytest

from tests.bundles import STRUCTS, Stage, clear, put
from tests.kernels.perception.test_tracking import CONFIG, ELEVATION, FORECAST
from tests.map_bits import get_map
from uuvtai.config import (
    DepthConfig,
    EpisodeConfig,
    LocalizationConfig,
    MappingConfig,
    TankConfig,
    VehicleConfig,
)
from uuvtai.config.loader import load_config
from uuvtai.kernels.core.grid import grid_origin, grid_shape, outside_cells
from uuvtai.kernels.perception import localization, mapping, sensor_model, tracking
from uuvtai.kernels.perception.io import EchoesIO, LocalizationIO, MappingIO, TrackingIO
from uuvtai.sim.setup import load_bounds

SENSORS = load_config("pool", "ping360", overrides={"sensors.sonar.n_ray": 64}).sensors
SONAR = SENSORS.sonar
POND, RULES = TankConfig(x_m=(0.0, 12.0), y_m=(0.0, 8.0)), EpisodeConfig()
MAP, CAMERA = MappingConfig(), DepthConfig(rows=6, cols=16)
SHAPE = grid_shape(POND, MAP.cell_m)
SIZES = {
    "n_env": 1, "n_ray": 64, "n_echo": 64, "n_row": SHAPE[0], "n_col": SHAPE[1], "n_slot": 1,
    "n_turn_row": 7, "n_turn": 16,
    "n_track": 16, "n_cluster": 16, "n_height": 16, "n_pixel_row": 6, "n_pixel_col": 16,
}  # fmt: skip


class Head(Stage):
    """A beam that is turned over discs in an endless pond, by a NumPy model; and the kernels that use it."""

    sizes = SIZES

    def begin(self):
        clear(*(struct for noun, struct in vars(self).items() if noun in STRUCTS))
        load_bounds(self.mask, np.array(outside_cells(POND, MAP.cell_m)))
        self.clock.active.fill(1)
        self.recall = self.io(EchoesIO, SONAR)
        self.tracking = self.io(TrackingIO, CONFIG, FORECAST, ELEVATION, SONAR, POND, RULES)
        self.mapping = self.io(MappingIO, MAP, SONAR, CAMERA, POND, RULES)
        sensor_model.reset_echoes(self.recall)
        tracking.reset_tracks(self.tracking)
        mapping.reset_map(self.mapping)
        self.taken, self.step = 0, 0
        return self

    def due(self):
        """The beam that is taken in this control step, None = none."""
        if self.taken * SONAR.step_us > self.step * 20_000:
            return None
        there = self.taken % (2 * SONAR.n_ray - 2)
        self.taken += 1
        return min(there, 2 * SONAR.n_ray - 2 - there)

    def hear(self, beam, pos, yaw, range_m):
        """Deliver one beam (range None = no return), and recall."""
        put(self.scan, ping_yaw=yaw, ping_pos_w=[*pos, -0.8], ping_vel_b=0.0, ping_vel_valid=1)
        put(self.scan, doppler_m_s=np.nan)
        put(self.scan, new_from=beam, new_count=1, fresh=1, ping_step=self.step)
        self.scan.range_m[0, beam] = SONAR.max_range_m if range_m is None else range_m
        self.scan.hit[0, beam] = int(range_m is not None)
        self.clock.step.fill(self.step)
        sensor_model.recall_echoes(self.recall)

    def bearing(self, beam):
        return SONAR.first_beam_rad + SONAR.beam_step_rad * beam

    def seen(self):
        """{beam: range} of the scan's returns."""
        hit, range_m = self.scan.hit.to_numpy()[0], self.scan.range_m.to_numpy()[0]
        return {int(b): float(range_m[b]) for b in np.flatnonzero(hit)}


beam_head = Head.begun()


def disc_range(pos, bearing, discs):
    """[m] to the nearest of discs (x, y, radius), None beyond the sonar's reach."""
    u, best = np.array([np.cos(bearing), np.sin(bearing)]), np.inf
    for x, y, radius in discs:
        off = np.array([x, y]) - pos
        room = radius**2 - (off[0] * u[1] - off[1] * u[0]) ** 2
        if room >= 0 and (r := off @ u - np.sqrt(room)) > 0:
            best = min(best, r)
    return float(best) if best <= SONAR.max_range_m else None


# ----------------------------------------------------------------------------------------------------- memory


def test_a_remembered_return_is_where_it_was_seen_from_here(beam_head):
    """Seen from (4, 4), nose along x, 3 m off; then the vehicle drives, turns, and hears nothing else."""
    beam_head.hear(40, (4.0, 4.0), 0.0, 3.0)
    there = np.array([4.0, 4.0]) + 3.0 * np.array(
        [np.cos(beam_head.bearing(40)), np.sin(beam_head.bearing(40))]
    )
    for step, (x, y, yaw) in enumerate(((4.5, 4.0, 0.0), (5.0, 3.6, 0.3), (4.0, 4.4, -0.2)), 1):
        beam_head.step = step
        beam_head.hear(2 + step, (x, y), yaw, None)
        away = there - [x, y]
        ((beam, range_m),) = beam_head.seen().items()
        assert range_m == pytest.approx(np.hypot(*away), abs=1e-5)
        off = np.arctan2(away[1], away[0]) - yaw - beam_head.bearing(beam)
        assert abs(off) <= 0.5 * SONAR.beam_step_rad + 1e-6
    beam_head.step = 9
    beam_head.hear(1, (4.0, 4.0), np.pi, None)
    assert beam_head.seen() == {}, "behind the sector now"


def test_a_new_beam_takes_away_what_it_goes_through_and_keeps_what_is_behind(beam_head):
    beam_head.hear(40, (4.0, 4.0), 0.0, 3.0)
    turn = SONAR.beam_step_rad
    beam_head.step = 2  # one beam to the right of it now looks there: it ends before it, then goes through
    beam_head.hear(39, (4.0, 4.0), turn, 1.0)
    assert beam_head.seen() == {39: 1.0}
    beam_head.step = 4
    beam_head.hear(30, (4.0, 4.0), 2 * turn, None)
    assert set(beam_head.seen()) == {38}, "two returns there, the nearer is shown"
    beam_head.step = 6
    beam_head.hear(39, (4.0, 4.0), turn, None)
    assert beam_head.seen() == {}


# -------------------------------------------------------------------------------------------------------- map


def test_hits_are_marked_once_and_where_the_vehicle_was_when_the_beam_was_taken(beam_head):
    """The vehicle drives at 0.5 m/s past two discs; its estimated place jumps by a metre at the end. The map
    keeps what was marked from where it was marked."""
    discs = ((7.0, 4.6, 0.3), (7.5, 2.9, 0.25))
    while beam_head.step < 300:
        pos = np.array([3.0 + 0.5 * 0.02 * beam_head.step, 4.0])
        if (beam := beam_head.due()) is not None:
            beam_head.hear(beam, pos, 0.0, disc_range(pos, beam_head.bearing(beam), discs))
            mapping.update_map(beam_head.mapping)
            beam_head.scan.fresh.fill(0)
        beam_head.step += 1
    found = get_map(beam_head.grid_map)
    x0, y0 = grid_origin(POND, MAP.cell_m)
    row, col = np.nonzero(found["static"][0] > MAP.occupied)
    x, y = x0 + (col + 0.5) * MAP.cell_m, y0 + (row + 0.5) * MAP.cell_m
    off = np.array([np.hypot(x - dx, y - dy) - radius for dx, dy, radius in discs])
    assert np.abs(off).min(0).max() < 0.15, "within a cell and a half of a disc's outline"
    assert (np.abs(off).argmin(0) == 0).sum() >= 4 and (np.abs(off).argmin(0) == 1).sum() >= 4
    assert not found["dynamic"][0].any(), "no speed is read from a beam without Doppler"
    seen = found["seen"][0].any(0)
    assert seen.any() and not seen[: int((2.8 - x0) / MAP.cell_m)].any(), "nothing behind the fan"
    before = found["static"][0].copy()
    beam_head.hear(0, (4.0, 4.0), 0.0, None)  # elsewhere: the old returns are not marked from here again
    mapping.update_map(beam_head.mapping)
    after = get_map(beam_head.grid_map)["static"][0]
    assert not ((after > MAP.occupied) & (before <= MAP.occupied)).any()


# ------------------------------------------------------------------------------------------------------- pose


POSE_COV = np.zeros(45)
POSE_COV[[0, 9, 17, 24, 30, 35, 39, 42, 44]] = [0.01, 0.01, 1e-4, 0.04, 0.04, 1e-6, 1e-6, 1e-6, 1e-6]


def corrected(stage, place, **scan):
    """What one scan makes of the pose of a vehicle that rests at a place, of covariance ``POSE_COV``."""
    pos = [*place, -0.8]
    io = stage.io(LocalizationIO, LocalizationConfig(), SENSORS, POND, RULES, VehicleConfig())
    put(stage.clock, active=1)
    put(stage.ego, pos_w=pos, specific_force_b=[0.0, 0.0, 9.81])
    localization.reset_pose(io)
    put(stage.localization, cov=POSE_COV)
    put(stage.scan, ping_pos_w=pos, fresh=1, **scan)
    localization.correct_pose(io)
    return stage.localization


def test_the_pose_filter_uses_a_beam_once():
    """A wall is heard by one beam; the other beams of the scan hold what was heard before."""
    away = SONAR.first_beam_rad + SONAR.beam_step_rad * np.arange(64)
    left, stage = {}, Stage(n_env=1, n_ray=64)
    for count in (1, 3):
        scan = {"range_m": 3.0 / np.cos(away), "hit": np.abs(away) < 0.6, "new_from": 32, "new_count": count}
        state = corrected(stage, (9.0, 4.0), doppler_m_s=np.nan, **scan)
        after = state.cov.to_numpy()[0]
        assert np.isfinite(after).all() and np.isfinite(state.mean.to_numpy()).all()
        np.testing.assert_allclose(after[[24, 30]], 0.04, rtol=1e-3, err_msg="walls tell no speed")
        left[count] = after[0]
    one = 1 / (1 / 0.01 + 1 / (0.02**2 + 0.005**2 / 12 + LocalizationConfig().wall_sigma_m ** 2))
    assert left[1] == pytest.approx(one, rel=0.4), "what one range tells, and no more"
    assert left[3] < 0.7 * left[1] < 0.007


# ----------------------------------------------------------------------------------------------------- tracks


def sweep(beam_head, steps, discs_at, drive=(0.0, 0.0)):
    """Turn the head for so many control steps; ``discs_at``: time [s] -> discs."""
    found = []
    for _ in range(steps):
        pos = np.array([3.0, 4.0]) + np.array(drive) * 0.02 * beam_head.step
        if (beam := beam_head.due()) is not None:
            discs = discs_at(0.02 * beam_head.step)
            beam_head.hear(beam, pos, 0.0, disc_range(pos, beam_head.bearing(beam), discs))
            tracking.track_obstacles(beam_head.tracking)
            found.append(
                [getattr(beam_head.tracks, name).to_numpy()[0] for name in ("alive", "moving", "state")]
            )
            beam_head.scan.fresh.fill(0)
        beam_head.step += 1
    return found


def test_what_rests_is_tracked_from_sweep_to_sweep_and_not_called_moving(beam_head):
    discs = ((5.5, 4.7, 0.25), (6.0, 3.2, 0.2), (7.5, 4.4, 0.3))
    found = sweep(beam_head, 600, lambda t: discs, drive=(0.15, 0.0))
    moving = sum(int(row[1].sum()) for row in found)
    assert moving <= 0.01 * 3 * len(found)
    alive, _, state = found[-1]
    for x, y, _ in discs[2:]:  # the others are beside the sector by now
        assert (np.hypot(state[alive == 1, 0] - x, state[alive == 1, 1] - y) < 0.15).any()


def test_a_lone_mover_is_told_once_it_was_met_a_second_time(beam_head):
    """0.3 m/s across, 3 m ahead: after two sweeps it is called moving, and which way it goes is right."""
    found = sweep(beam_head, 400, lambda t: ((6.0, 3.0 + 0.3 * t, 0.25),))
    first = next(i for i, row in enumerate(found) if row[1].any())
    since = first * SONAR.step_us / 1e6
    assert since > 0.9 * SONAR.sweep_s, "one look tells no speed"
    alive, moving, state = found[-1]
    assert moving.sum() == 1
    assert state[(moving == 1) & (alive == 1), 3] == pytest.approx(0.3, abs=0.15)
