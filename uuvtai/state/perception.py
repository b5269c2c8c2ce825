"""The own pose, moving obstacles, where they will be, and the map: what is remembered of what was sensed."""

from __future__ import annotations

from dataclasses import dataclass

import taichi as ti

from uuvtai.state.arrays import array


@dataclass(frozen=True, eq=False)
class LocalizationState:
    """Remembered: two Kalman filters, of the horizontal pose and of the depth."""

    mean: ti.Field = array("n_env", vec=9)
    """[m, m, rad, m/s, m/s, rad/s, 1, m/s^2, m/s^2] x, y, heading less the IMU's, velocity ahead and to the
    left in the level body frame, rate of the heading's correction, scale error of the DVL, error of the
    accelerometer ahead and to the left"""
    cov: ti.Field = array("n_env", vec=45)
    """upper triangle of the 9 x 9 covariance, row by row"""
    depth: ti.Field = array("n_env", vec=4)
    """[m, m/s, m, m/s^2] z, heave, how much too deep the zeroed pressure sensor reads, and the
    accelerometer's error upwards"""
    depth_cov: ti.Field = array("n_env", vec=10)
    """upper triangle of their covariance"""
    motion: ti.Field = array("n_env", vec=4)
    """[m/s^2, rad/s] what the IMU said in the last step: acceleration ahead, to the left and upwards in the
    level body frame, and rate of the yaw"""


@dataclass(frozen=True, eq=False)
class EchoState:
    """Remembered: what a mechanical beam heard last along each of its bearings, and from where. Of a sonar
    whose beams come at once: nothing."""

    step: ti.Field = array("n_env", "n_echo", dtype=ti.i32, beside="echo")
    """when it was taken, -1 = never"""
    pos_x_m: ti.Field = array("n_env", "n_echo", beside="echo")
    """[m] own position estimate then, world"""
    pos_y_m: ti.Field = array("n_env", "n_echo", beside="echo")
    """[m]"""
    bearing_w: ti.Field = array("n_env", "n_echo", beside="echo")
    """[rad] where the beam looked, in the world"""
    range_m: ti.Field = array("n_env", "n_echo", beside="echo")
    """[m] no return = maximum range"""
    intensity: ti.Field = array("n_env", "n_echo", beside="echo")
    """[0, 1]"""
    hit: ti.Field = array("n_env", "n_echo", dtype=ti.i32, beside="echo")
    """1 = return, and no later beam went through it"""
    told: ti.Field = array("n_env", "n_echo", dtype=ti.i32, beside="echo")
    """1 = the tracking has had it"""
    shown: ti.Field = array("n_env", "n_echo", dtype=ti.i32, beside="echo")
    """the bearing whose return stands in each beam of the scan, -1 = none"""


@dataclass(frozen=True, eq=False)
class TrackState:
    """Remembered: moving (and candidate) obstacles seen by the sonar, one Kalman filter each."""

    alive: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """1 = slot in use"""
    moving: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """1 = confirmed as moving"""
    state: ti.Field = array("n_env", "n_track", vec=4)
    """[m, m, m/s, m/s] x, y, vx, vy in the world frame"""
    cov: ti.Field = array("n_env", "n_track", vec=10)
    """upper triangle of the 4 x 4 covariance, row by row"""
    z_m: ti.Field = array("n_env", "n_track")
    """[m] depth plane in which it was last seen (the vehicle's own z then)"""
    radius_m: ti.Field = array("n_env", "n_track")
    """[m] horizontal radius"""
    radius_var: ti.Field = array("n_env", "n_track")
    """[m^2] variance of the radius"""
    turn_rate: ti.Field = array("n_env", "n_track")
    """[rad/s] rate at which the velocity turns; 0 = unknown"""
    turn_cov: ti.Field = array("n_env", "n_track", vec=5)
    """covariance of the turn rate with x, y, vx, vy, and its own variance [rad^2/s^2]; 0 = not estimated"""
    doppler_m_s: ti.Field = array("n_env", "n_track")
    """[m/s] fading mean of the compensated Doppler"""
    doppler_var: ti.Field = array("n_env", "n_track")
    """[m^2/s^2] variance of that mean"""
    shift_w: ti.Field = array("n_env", "n_track", vec=2)
    """[m] fading displacement since birth"""
    sight_w: ti.Field = array("n_env", "n_track")
    """[rad] bearing under which it was last seen"""
    sweep: ti.Field = array("n_env", "n_track")
    """[rad] fading change of that bearing since birth: how far the view of its faces has turned"""
    age: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """scans since birth"""
    misses: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """scans in a row without a matching cluster"""
    seen_step: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """episode step of the last match"""
    height: ti.Field = array("n_env", "n_track", "n_height", packed=True)
    """share of each height hypothesis (height.heights), summing to 1"""
    present: ti.Field = array("n_env", "n_track")
    """probability that the obstacle is where it is expected"""
    spot_step: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """episode step of the image that showed it last, -1 = none"""
    scan_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the ping that the states refer to, -1 = no scan yet"""
    beam_track: ti.Field = array("n_env", "n_ray", dtype=ti.i32)
    """track that explains this beam of the newest scan, -1 = none (carried over by bearing where that scan
    was not tracked)"""
    pick: ti.Field = array("n_env", "n_track", dtype=ti.i32, scratch=True)
    """scratch of one scan: cluster matched to this track, -1 = none"""
    pick_cost: ti.Field = array("n_env", "n_track", scratch=True)
    """scratch of one scan: cost of that match (-2 log likelihood)"""


@dataclass(frozen=True, eq=False)
class ClusterState:
    """Scratch of one scan: runs of neighbouring beams that belong together."""

    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = clustered in this very step"""
    scan_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the ping that was clustered last, -1 = none yet"""
    scan_yaw: ti.Field = array("n_env")
    """[rad] own yaw at that ping"""
    slip_w: ti.Field = array("n_env", vec=2)
    """[m/s] error of the own measured velocity, as the known walls show it"""
    own_sigma_m_s: ti.Field = array("n_env")
    """[m/s] what is left of that error along its worst direction, where the velocity was no valid reading; 0
    where it was one"""
    count: ti.Field = array("n_env", dtype=ti.i32)
    """clusters found"""
    pos_w: ti.Field = array("n_env", "n_cluster", vec=2)
    """[m] centre of the obstacle"""
    radius_m: ti.Field = array("n_env", "n_cluster")
    """[m] from the half-angle"""
    range_m: ti.Field = array("n_env", "n_cluster")
    """[m] mean range of its beams"""
    range_var: ti.Field = array("n_env", "n_cluster")
    """[m^2] variance of that mean"""
    doppler_m_s: ti.Field = array("n_env", "n_cluster")
    """[m/s] mean, compensated for own motion"""
    doppler_var: ti.Field = array("n_env", "n_cluster")
    """[m^2/s^2] variance of that mean"""
    bearing_w: ti.Field = array("n_env", "n_cluster")
    """[rad] of the middle of what is seen"""
    first_beam: ti.Field = array("n_env", "n_cluster", dtype=ti.i32)
    """first beam"""
    span: ti.Field = array("n_env", "n_cluster", dtype=ti.i32)
    """beams from the first to the last, missed ones included"""
    n_beam: ti.Field = array("n_env", "n_cluster", dtype=ti.i32)
    """number of beams that hit it"""
    hidden: ti.Field = array("n_env", "n_cluster", dtype=ti.i32)
    """edges beyond which it may go on unseen: 1 = first, 2 = last, 3 = both"""
    match: ti.Field = array("n_env", "n_cluster", dtype=ti.i32)
    """track it was matched to, -1 = none"""
    beam_cluster: ti.Field = array("n_env", "n_ray", dtype=ti.i32)
    """cluster of this beam, -1 = none"""
    beam_doppler: ti.Field = array("n_env", "n_ray")
    """[m/s] Doppler of this beam, compensated with the own measured velocity"""


@dataclass(frozen=True, eq=False)
class SpotState:
    """What the camera shows that the sonar does not."""

    column_m: ti.Field = array("n_env", "n_pixel_col", lanes=True)
    """[m] horizontal distance of the nearest thing in every column of the newest image, geometry.FAR_M =
    none"""
    edge_m: ti.Field = array("n_env", "n_pixel_col", lanes=True)
    """[m] the same in the column's first and last pixel: what reaches there goes on beyond the image"""


@dataclass(frozen=True, eq=False)
class TurnHistory:
    """Remembered: places where moving obstacles turned in this episode, of whichever track; and each track's
    last straight leg."""

    turn: ti.Field = array("n_env", "n_turn_row", "n_turn", packed=True)
    """rows (``turn_history.TURN_X`` and so on): place of the turn [m, m], world; unit course before it and
    after it; times seen, less times that it did not come: not above 0 = empty. One array, for there may be
    1,024 nodes in all"""
    next_slot: ti.Field = array("n_env", dtype=ti.i32)
    """slot that the next new turn takes"""
    leg: ti.Field = array("n_env", "n_track", vec=4)
    """[m, m, m/s, m/s] state of the track when it was last on a straight leg"""
    leg_step: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """episode step of that, -1 = never"""
    run_from_w: ti.Field = array("n_env", "n_track", vec=2)
    """[m] where the present straight way began, or was first seen"""
    run_kind: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """0 = on none yet, 1 = its begin was not seen, 2 = it began with a turn back that was seen, 3 = with a
    corner"""


@dataclass(frozen=True, eq=False)
class ForecastState:
    """Where each moving track is expected, at equal steps from now to the horizon."""

    pos_w: ti.Field = array("n_env", "n_track", "n_forecast", vec=2)
    """[m]"""
    radius_m: ti.Field = array("n_env", "n_track", "n_forecast")
    """[m] body radius plus what the uncertainty adds"""
    turn_m: ti.Field = array("n_env", "n_track")
    """[m] from the track's state to its next expected turn, for obstacles that go straight"""
    turn_out_w: ti.Field = array("n_env", "n_track", vec=2)
    """course after it, unit vector"""
    above_w: ti.Field = array("n_env", "n_track")
    """[m] world z of the lowest edge of what may be above the own height; the own height where the obstacle
    may be level with the vehicle"""
    below_w: ti.Field = array("n_env", "n_track")
    """[m] world z of the highest edge of what may be below"""


@dataclass(frozen=True, eq=False)
class FutureState:
    """What each moving track may do instead of what is forecast, and how probable that is.

    Whoever fills it (a learned forecast, say) gives probabilities that sum to 1 at most; what is left is the
    forecast's own. An obstacle begins all its futures where the forecast does, and is never faster than
    there.
    """

    share: ti.Field = array("n_env", "n_track", "n_future")
    """probability of this future, 0 = none"""
    pos_w: ti.Field = array("n_env", "n_track", "n_future", "n_forecast", vec=2)
    """[m] where the obstacle then is, at the forecast's times"""


@dataclass(frozen=True, eq=False)
class PastState:
    """Remembered for a learned forecast: where each track was, and where it turned. Newest first."""

    past_w: ti.Field = array("n_env", "n_track", "n_past", vec=2)
    """[m] places in the last seconds, ``forecast_codes.PAST_S`` apart"""
    past_step: ti.Field = array("n_env", "n_track", dtype=ti.i32, beside="counts")
    """episode step of the newest one"""
    past_count: ti.Field = array("n_env", "n_track", dtype=ti.i32, beside="counts")
    """places remembered"""
    bend_w: ti.Field = array("n_env", "n_track", "n_bend", vec=2)
    """[m] the last turns between straight ways"""
    bend_count: ti.Field = array("n_env", "n_track", dtype=ti.i32, beside="counts")
    """turns remembered"""


@dataclass(frozen=True, eq=False)
class MixtureState:
    """A learned forecast: a network of two hidden layers, what it is told of each track, and what it says."""

    frame: ti.Field = array("n_env", "n_track", "n_frame")
    """[m, m, -, -, m/s] place now, unit course and speed, in which columns and futures are counted"""
    column: ti.Field = array("n_env", "n_track", "n_column")
    """what the network is told (``forecast_codes.COLUMNS``)"""
    hidden: ti.Field = array("n_env", "n_track", "n_hidden", scratch=True)
    """scratch: first layer, then the second one"""
    said: ti.Field = array("n_env", "n_track", "n_said")
    """logits of the futures, then their places: see ``mixture``"""
    weight: ti.Field = array("n_weight", packed=True)
    """constant: the layers one after the other, each a row of biases, then a row for each input"""


@dataclass(frozen=True, eq=False)
class GridMask:
    """The known bounds on the grid, the same for all envs. Cell [row, col] has its centre at origin + (col +
    0.5, row + 0.5) * cell."""

    outside: ti.Field = array("n_row", "n_col", dtype=ti.i32)
    """1 = outside the tank (the grid has a border of such cells)"""
    outside_bits: ti.Field = array("n_row", "n_col", bits=True)
    """the same, one bit a cell"""


@dataclass(frozen=True, eq=False)
class MapState:
    """Remembered: the two-layer occupancy map. Row = y, column = x. What is asked of many cells at once is
    kept in bits."""

    static_occ: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.u16, beside="layers")
    """persistent layer M^s; ``enums.FULL`` is an occupancy of 1"""
    dynamic_occ: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.u16, beside="layers")
    """layer M^d of what moves; likewise"""
    dynamic_scans: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.u8)
    """scans with dynamic evidence since the cell was last seen free (saturating): promotion to static"""
    free_scans: ti.Field = array("n_env", "n_row", "n_col", vec=8, bits=True)
    """scans that saw the cell free since its last return, up to what makes it confident: a number of eight
    bits, one word for each"""
    confident: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """seen free long enough that a return is a surprise"""
    held: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """dynamic_scans is not 0"""
    alive: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """a layer is not 0"""
    seen: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """observed at least once: everything else is unknown"""
    static_occupied: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """M^s reaches tau_occ"""
    dynamic_occupied: ti.Field = array("n_env", "n_row", "n_col", bits=True, beside="words")
    """M^d reaches tau_occ"""
    depth_hit: ti.Field = array("n_env", "n_row", "n_col", bits=True)
    """points seen by the camera since the newest scan"""
    depth_waits: ti.Field = array("n_env", dtype=ti.i32)
    """1 = there may be such points"""
    map_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the newest scan in the map; far below 0 = none yet"""


@dataclass(frozen=True, eq=False)
class MapScratch:
    """Scratch: what one env's scan says about the cells. Slots are shared by all envs: few serve many and
    stay in the cache.

    Marks are taken back as they are read: between two scans there are none.
    """

    static_hit: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """static returns"""
    dynamic_hit: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """returns of what moves"""
    fan_edge: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """cells at which a column enters or leaves the fan of free water (sensor_model.py)"""
    due: ti.Field = array("n_slot", dtype=ti.i32, scratch=True)
    """where several loop items share an env: 1 = the scan marked here is to be merged, 2 = with points of the
    camera"""


@dataclass(frozen=True, eq=False)
class PerceptionStructs:
    """Structs of this room, by the noun of their stage."""

    echoes: EchoState
    localization: LocalizationState
    tracks: TrackState
    clusters: ClusterState
    spots: SpotState
    turn_history: TurnHistory
    forecast: ForecastState
    futures: FutureState
    past: PastState
    mixture: MixtureState
    mask: GridMask
    grid_map: MapState
    map_scratch: MapScratch
