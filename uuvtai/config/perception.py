"""The own pose, moving obstacles, their forecast and height, and the map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from uuvtai.config.base import Fraction, NonNegative, Packets, Positive, PositiveCount, Section


class LocalizationConfig(Section):
    """Filter of the own pose, where ``sensors.localization`` is ``estimated`` (values EC, tuned). What the
    sensors do wrong it takes from their own sections."""

    sure_speed_m_s: Positive = 0.1
    """the own velocity counts as known (``vel_valid``) while its standard deviation is smaller: the velocity
    loop is closed by it"""
    use_walls: bool = True
    """correct the pose by the beams that end on a known wall, and the velocity by their Doppler; off: dead
    reckoning that knows how uncertain it is"""
    gate_sigmas: Annotated[float, Field(ge=1, le=10)] = 3.0
    """a beam counts if it ends within so many standard deviations of where the wall is expected, and so does
    the mean of it and its neighbours; likewise its Doppler"""
    wall_sigma_m: Positive = 0.003
    """error of the known place of a wall"""
    bearing_sigma_rad: NonNegative = 0.001
    """error of a beam's direction"""
    obstacle_returns_per_m: NonNegative = 240.0
    """[1/m] returns of neighbouring beams and scans in a row that err together where an obstacle stands so
    close before a wall that it is not told from it, per metre of that. How often one does follows from how
    many returns of the scan fall short of the walls"""


class TrackingConfig(Section):
    """Clusters of beams to tracks of moving obstacles, and their forecast. Every constant is in seconds, not
    in scans (values EC, tuned)."""

    n_track: PositiveCount = 24
    n_cluster: PositiveCount = 48
    period_steps: PositiveCount = 3
    """control steps between tracked scans, at least; scans in between are left out"""
    wall_margin_m: NonNegative = 0.15
    """returns this close (plus 2 sigma of range) to a known wall are dropped"""
    max_width_m: Positive = 0.75
    min_radius_m: Positive = 0.1
    own_speed_sigma_m_s: Positive = 0.05
    """trust in the own measured velocity, which the Doppler of the known walls corrects"""
    birth_speed_sigma_m_s: Positive = 1.0
    """across the bearing, where the first Doppler says nothing"""
    accel_density: NonNegative = 0.03
    """[m^2/s^3] spectral density of an obstacle's acceleration"""
    turn_rate_sigma_rad_s: NonNegative = 1.0
    """prior of a moving obstacle's turn rate around 0; 0 = obstacles are taken to go straight"""
    turn_density: NonNegative = 0.005
    """[rad^2/s^3] spectral density of the turn rate's changes"""
    gate_m: Positive = 0.3
    """a cluster this close to a prediction (plus one scan of its speed) may always match, however sure the
    filter is"""
    turn_gate: Positive = 20.0
    """squared normalised innovation (3 values) beyond which an obstacle is taken to have turned"""
    partial_sigmas: NonNegative = 0.0
    """a cluster with free edges that is narrower than its track by more standard deviations than this is a
    part of the body, which leaves the sonar's fan by its nearest side first; 0 = it is all of it
    (``research/LOG.md``)"""
    max_misses: PositiveCount = 8
    """in units of nominal 10 Hz scans"""
    see_through_s: NonNegative = 0.15
    """an older track that beams see through dies when it has been unseen this long"""
    hidden_s: NonNegative = 2.0
    """a track behind a nearer return is kept this long"""
    horizon_s: Positive = 2.5
    forecast_dt_s: Positive = 0.1
    growth_sigmas: NonNegative = 1.0
    """a forecast's radius grows by this many standard deviations of the predicted position"""


class ForecastConfig(Section):
    """What forecasts of moving obstacles know of how obstacles move. Each switch is one row of an
    ablation."""

    use_turn_rate: bool = True
    """obstacles keep their turn rate; off: straight ahead"""
    use_turn_history: bool = True
    """obstacles turn where one was seen to turn"""
    n_turn: Packets = 48
    """turns remembered"""
    use_reflection: bool = True
    """obstacles turn back at the tank's walls"""
    use_coasting: bool = True
    """unseen obstacles go on by their turn history; off: straight on, or along their arc"""
    use_turning_back: bool = True
    """obstacles above or below the fan whose next turn is not known may have turned back: the expected
    velocity fades, and the uncertainty grows both ways along their course (``traffic.leg_m``); off: they go
    on for sure"""
    learned: Annotated[str, Field(max_length=1000)] = ""
    """network that says what obstacles may do: ``built-in``, or the run folder of ``uuv train forecast``;
    empty = none (``docs/learning.md``)"""
    keep_columns: bool = False
    """keep what such a network is told of each track, to train one"""


class HeightConfig(Section):
    """Memory in 3-D of obstacles that left the sonar's fan (values EC, tuned)."""

    memory_s: NonNegative = 8.0
    """time constant with which an unseen obstacle is forgotten; 0 = an obstacle that beams see through is
    forgotten at once"""
    half_height_m: NonNegative = 0.2
    """half height assumed of an obstacle that is no wider"""
    least_half_height_m: NonNegative = 0.1
    """half height assumed where an obstacle is not seen: the flattest one that would hide so"""
    column_share: Fraction = 0.05
    """share of moving obstacles expected to go through the full water column"""
    use_camera: bool = True
    """let the camera's image tell heights too"""


class CameraTrackingConfig(Section):
    """Tracked obstacles followed by the camera where the sonar's fan misses them (values EC, tuned)."""

    use_camera: bool = True
    """off: the image tells heights only"""
    range_m: Positive = 4.0
    """nothing farther is looked at: the sonar's fan is high enough there"""
    sigma_m: Positive = 0.035
    """error of a spot's place"""


class MappingConfig(Section):
    """Two-layer occupancy map. Gains are per scan at 10 Hz; at another scan rate they are scaled so that gain
    per second is kept."""

    cell_m: Positive = 0.1
    period_steps: PositiveCount = 1
    """control steps between mapped scans, at least: 1 maps every scan, as in the paper; 5 (10 Hz, for which
    the gains were chosen) costs a fifth and drives as well"""
    static_hit: Fraction = 0.15
    """eta_occ"""
    static_free: Fraction = 0.08
    """eta_free"""
    static_decay: Fraction = 0.002
    """lambda_s"""
    depth_hit: Fraction = 0.10
    """eta_depth"""
    dynamic_hit: Fraction = 0.6
    """eta_dyn"""
    dynamic_free: Fraction = 0.3
    """eta_dyn,free"""
    dynamic_decay: Fraction = 0.1
    """lambda_d"""
    doppler_evidence_m_s: NonNegative = 0.15
    free_confident_s: NonNegative = 0.5
    """a hit in a cell seen free for this long is dynamic evidence"""
    promote_s: Positive = 2.0
    """dynamic evidence that stays this long in one cell becomes static"""
    depth_gate_m: Positive = 0.3
    """depth pixels count when their point lies within this of the vehicle's own depth"""
    free_range_m: Positive = 6.0
    """a beam without return clears no farther: a missed return looks the same, and far out no second beam
    sees the cell (EC)"""
    wall_margin_m: NonNegative = 0.15
    """returns this close to a known wall are not mapped: the wall is the boundary term already, and no hull
    fits in between (EC)"""
    occupied: Fraction = 0.5
    """tau_occ"""
