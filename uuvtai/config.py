"""Configuration: one frozen section per stage noun. Unknown keys, wrong types, NaN and nonsense sizes are errors.

Units stand in the names: ``_m``, ``_s``, ``_m_s``, ``_rad`` and so on; angles that a person types end in ``_deg``. Numbers with neither a
source nor a design page behind them are engineering choices (EC). YAML in and out, and presets, live in ``loader.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Spread = Annotated[float, Field(ge=0, le=0.9)]
"""half width of a factor around 1 that must stay positive"""
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(ge=1)]
Interval = tuple[float, float]


def _ordered_interval(value: Interval) -> Interval:
    if value[0] > value[1]:
        raise ValueError(f"must be (low, high) with low <= high, got {value}")
    return value


OrderedInterval = Annotated[Interval, AfterValidator(_ordered_interval)]
PositiveInterval = Annotated[tuple[Positive, Positive], AfterValidator(_ordered_interval)]
Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
NonNegative6 = tuple[NonNegative, NonNegative, NonNegative, NonNegative, NonNegative, NonNegative]


class Section(BaseModel):
    """Base of every section: immutable, closed, finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    if not TYPE_CHECKING:

        def __getattr__(self, name):
            # Taichi asks every argument of every launch for an attribute that no section has: pydantic takes five times as long to say so
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")


# --------------------------------------------------------------------------------------------------------------------- world


class TankConfig(Section):
    """Known bounds of the water."""

    shape: Literal["rectangle", "circle"] = "rectangle"
    x_m: Interval = (0.0, 20.0)
    y_m: Interval = (0.0, 6.0)
    z_m: Interval = (-1.6, 0.0)
    """floor and surface"""

    @model_validator(mode="after")
    def _ordered(self) -> TankConfig:
        for name in ("x_m", "y_m", "z_m"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must be (low, high) with low < high, got {getattr(self, name)}")
        return self

    @property
    def radius_m(self) -> float:
        """Radius of the inscribed circle (the wall of a circular tank)."""
        return 0.5 * min(self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0])


class StaticObstacles(Section):
    """Random static obstacles: vertical cylinders and boxes through the full water column, anywhere within the side walls."""

    radius_m: PositiveInterval = (0.2, 0.4)
    half_extent_m: PositiveInterval = (0.2, 0.5)
    box_fraction: Fraction = 0.5
    """by index, so that half are exactly half of an even number"""
    gap_m: NonNegative = 0.9
    """between surfaces"""
    endpoint_gap_m: NonNegative = 0.8
    """from start and goal to the surface"""
    joined_clearance_m: NonNegative = 0.45
    """start and goal must be joined by free space with this clearance, else the layout is drawn again"""


class DynamicObstacles(Section):
    """Random moving obstacles."""

    radius_m: PositiveInterval = (0.15, 0.25)
    height_m: PositiveInterval = (0.3, 0.5)
    z_m: OrderedInterval = (-1.2, -0.4)
    cylinder_fraction: Fraction = 0.5
    """the others are spheres"""
    full_column_fraction: Fraction = 0.0
    """share of the moving bodies that are cylinders through the full water column (counted within cylinder_fraction)"""
    motion: Literal["line_circle", "waypoints"] = "line_circle"
    circle_fraction: Fraction = 0.5
    """the others go back and forth on a line"""
    line_length_m: PositiveInterval = (2.0, 6.0)
    circle_radius_m: PositiveInterval = (0.5, 2.0)
    corners: tuple[int, int] = (3, 5)
    corner_gap_m: NonNegative = 2.0
    """between any two corners of one path"""
    keep_clear_draws: Count = 16
    """draws of a path that keeps clear of static obstacles before the last one is taken as it is (0: the first); walls are always kept"""
    start_gap_m: NonNegative = 1.5
    """horizontal, centre to centre, at t = 0; always kept"""

    @model_validator(mode="after")
    def _consistent(self) -> DynamicObstacles:
        low, high = self.corners
        if not 2 <= low <= high <= 5:
            raise ValueError(f"corners must be (low, high) within 2 to 5, got {self.corners}")
        if self.full_column_fraction > self.cylinder_fraction:
            raise ValueError("full_column_fraction counts within cylinder_fraction and cannot exceed it")
        return self


class Waypoint(Section):
    """One corner of an explicit obstacle's closed path."""

    x_m: float
    y_m: float


class FixedObstacle(Section):
    """An obstacle that is always there, given explicitly; with ``path`` it moves along the closed polyline."""

    kind: Literal["sphere", "cylinder", "box"]
    x_m: float
    y_m: float
    z_m: float | None = None
    """centre; default: middle of the water column"""
    radius_m: Positive | None = None
    half_extents_m: tuple[Positive, Positive] | None = None
    height_m: Positive | None = None
    """default: the full water column"""
    yaw_deg: float = 0.0
    path: tuple[Waypoint, ...] = ()
    speed_m_s: NonNegative | None = None
    """default: the scenario's v"""

    @model_validator(mode="after")
    def _complete(self) -> FixedObstacle:
        if self.kind == "box" and self.half_extents_m is None:
            raise ValueError("a box needs half_extents_m: [x, y]")
        if self.kind != "box" and self.radius_m is None:
            raise ValueError(f"a {self.kind} needs radius_m")
        if len(self.path) not in (0, 2, 3, 4, 5):
            raise ValueError("path must have 2 to 5 waypoints (2 = back and forth)")
        if any((a.x_m, a.y_m) == (b.x_m, b.y_m) for a, b in zip(self.path, self.path[1:], strict=False)):
            raise ValueError("neighbouring waypoints of a path must differ")
        return self


class WorldConfig(Section):
    """Tank, spawn ranges and obstacles: with (seed, episode) it defines a scenario completely."""

    tank: TankConfig = TankConfig()
    spawn_x_m: OrderedInterval = (2.0, 18.0)
    spawn_y_m: OrderedInterval = (1.2, 4.8)
    spawn_z_m: OrderedInterval = (-1.2, -0.4)
    start_goal_gap_m: NonNegative = 3.0
    """horizontal, so the 3-D distance is never less"""
    n_static: Count = 8
    """S"""
    n_dynamic: Count = 6
    """D"""
    dynamic_speed_m_s: NonNegative = 0.6
    """v"""
    static_capacity: Count | None = None
    """slots kept for static obstacles, so that S can vary without recompilation; default n_static"""
    dynamic_capacity: Count | None = None
    static: StaticObstacles = StaticObstacles()
    dynamic: DynamicObstacles = DynamicObstacles()
    fixed: tuple[FixedObstacle, ...] = ()

    @model_validator(mode="after")
    def _fits(self) -> WorldConfig:
        for wanted, slots in (("n_static", "static_capacity"), ("n_dynamic", "dynamic_capacity")):
            capacity = getattr(self, slots)
            if capacity is not None and capacity < getattr(self, wanted):
                raise ValueError(f"{slots} {capacity} is less than {wanted} {getattr(self, wanted)}")
        for axis in ("x", "y", "z"):
            (low, high), (start, end) = getattr(self.tank, f"{axis}_m"), getattr(self, f"spawn_{axis}_m")
            if start < low or end > high:
                raise ValueError(f"spawn_{axis}_m ({start}, {end}) reaches out of tank.{axis}_m ({low}, {high})")
        return self

    @property
    def static_slots(self) -> int:
        """Slots kept for random static obstacles."""
        return self.n_static if self.static_capacity is None else self.static_capacity

    @property
    def dynamic_slots(self) -> int:
        """Slots kept for random moving obstacles."""
        return self.n_dynamic if self.dynamic_capacity is None else self.dynamic_capacity

    @property
    def n_fixed_static(self) -> int:
        """Explicit obstacles that stand still."""
        return sum(not obstacle.path for obstacle in self.fixed)

    @property
    def n_fixed_moving(self) -> int:
        """Explicit obstacles that move."""
        return sum(bool(obstacle.path) for obstacle in self.fixed)


# ------------------------------------------------------------------------------------------------------------------- vehicle

_S = 0.7071067811865476


class Thruster(Section):
    """One thruster: where it sits and which way positive thrust pushes."""

    position_m: Vector3
    direction: Vector3


_BLUEROV2_THRUSTERS = (
    Thruster(position_m=(0.1355, -0.1, -0.0725), direction=(_S, _S, 0.0)),
    Thruster(position_m=(0.1355, 0.1, -0.0725), direction=(_S, -_S, 0.0)),
    Thruster(position_m=(-0.1475, -0.1, -0.0725), direction=(-_S, _S, 0.0)),
    Thruster(position_m=(-0.1475, 0.1, -0.0725), direction=(-_S, -_S, 0.0)),
    Thruster(position_m=(0.0025, -0.1105, -0.005), direction=(0.0, 0.0, 1.0)),
    Thruster(position_m=(0.0025, 0.1105, -0.005), direction=(0.0, 0.0, 1.0)),
)


class VehicleConfig(Section):
    """Rigid body, hydrodynamics and thrusters (MarineGym BlueROV asset; Wu 2018 coefficients). Origin = centre of mass."""

    mass_kg: Positive = 11.26
    inertia_kg_m2: tuple[Positive, Positive, Positive] = (0.30375, 0.626, 0.5769)
    water_density_kg_m3: Positive = 997.0
    gravity_m_s2: Positive = 9.81
    volume_m3: Positive = 0.0113459
    buoyancy_height_m: float = 0.01
    added_mass: NonNegative6 = (5.5, 12.7, 14.57, 0.12, 0.12, 0.12)
    added_mass_follows: Literal["ground", "water"] = "ground"
    """whose acceleration the added mass resists: "ground" is M_A dnu/dt, the design's equation; "water" is M_A dnu_r/dt (Fossen 2011),
    which makes motion in a uniform current equal to motion in still water plus drift. They differ only where it turns in a current"""
    linear_damping: NonNegative6 = (4.03, 6.22, 5.18, 0.07, 0.07, 0.07)
    quadratic_damping: NonNegative6 = (18.18, 21.66, 36.99, 1.55, 1.55, 1.55)
    thrusters: Annotated[tuple[Thruster, ...], Field(min_length=1)] = _BLUEROV2_THRUSTERS
    rotor_tau_s: Positive = 0.01
    rotor_max_rpm: Positive = 3900.0
    thrust_forward: Vector3 = (4.7368e-7, -1.9275e-4, 8.4452e-2)
    """[kgf] quadratic in rpm for n > 0"""
    thrust_reverse: Vector3 = (-3.8442e-7, -1.6186e-4, -3.9139e-2)
    """[kgf] quadratic in rpm for n < 0"""
    dead_band_rpm: tuple[NonNegative, NonNegative] = (203.5, 210.5)
    """no thrust below this speed, forward and reverse: where the quadratic fit turns round. MarineGym's throttle dead band of 7.5 % is
    (620, 696): possible here too, slow motion then becomes a limit cycle of about 1 cm/s"""
    thrust_scale: Positive = 1.0
    """the paper's K_F / 4.4e-7"""
    attitude_hold: Literal["ideal", "thrusters", "none"] = "ideal"
    hull_radius_m: Positive = 0.17
    hull_half_length_m: NonNegative = 0.10
    max_surge_m_s: Positive = 0.6
    max_sway_m_s: Positive = 0.6
    max_heave_m_s: Positive = 0.4
    max_yaw_rate_rad_s: Positive = 1.0

    @model_validator(mode="after")
    def _thrust_grows(self) -> VehicleConfig:
        for name, curve, dead, sign in (
            ("thrust_forward", self.thrust_forward, self.dead_band_rpm[0], 1.0),
            ("thrust_reverse", self.thrust_reverse, self.dead_band_rpm[1], -1.0),
        ):
            edge = sign * max(dead, -sign * curve[1] / (2 * curve[0])) if sign * curve[0] > 0 else 0.0
            if sign * curve[0] <= 0 or sign * (curve[0] * edge**2 + curve[1] * edge + curve[2]) < 0:
                raise ValueError(f"{name} must push its own way and harder with speed outside the dead band, got {curve}")
            if abs(edge) >= self.rotor_max_rpm:
                raise ValueError(f"rotor_max_rpm must exceed the dead band of {name} ({abs(edge):.0f} rpm), got {self.rotor_max_rpm}")
        return self


class ActuationConfig(Section):
    """Inner loop: commanded body velocity and yaw rate to wrench, allocation, rotors (gains EC)."""

    velocity_gain: tuple[NonNegative, NonNegative, NonNegative] = (60.0, 60.0, 60.0)
    """[N s/m]"""
    velocity_integral: tuple[NonNegative, NonNegative, NonNegative] = (40.0, 40.0, 40.0)
    """[N/m]"""
    integral_band_m_s: Positive = 0.3
    """errors beyond this do not build up the integral: they are a step under way or a blocked vehicle, and both would overshoot later"""
    yaw_rate_gain: NonNegative = 4.0
    """[N m s]"""
    yaw_rate_integral: NonNegative = 4.0
    """[N m]"""
    integral_band_rad_s: Positive = 0.5
    max_integral_n: NonNegative = 40.0
    """what a current, lost gain or wrong parameters may take"""
    max_integral_n_m: NonNegative = 4.0
    max_force_n: tuple[Positive, Positive, Positive] = (90.0, 90.0, 80.0)
    """covers the drag at full speed of every published BlueROV2 parameter set (59, 78 and 44 N)"""
    max_moment_n_m: Positive = 8.0
    hold_gain_n_m: NonNegative = 60.0
    """[N m/rad] roll and pitch, ideal hold"""
    hold_damping: NonNegative = 8.0
    """[N m s] ideal hold"""
    hold_limit_n_m: NonNegative = 5.0
    """bound of the stabilising moment"""
    thruster_hold_gain_n_m: NonNegative = 20.0
    """[N m/rad] roll and pitch, hold by thrusters: lower, since it acts one control step and a rotor lag late"""
    thruster_hold_damping: NonNegative = 5.0
    """[N m s] hold by thrusters"""


class DisturbanceConfig(Section):
    """What the paper leaves out; all off by default. Each is a sweep axis."""

    current_m_s: Vector3 = (0.0, 0.0, 0.0)
    current_sigma_m_s: NonNegative = 0.0
    """standard deviation of the Gauss-Markov part, per horizontal axis"""
    current_tau_s: Positive = 20.0
    thruster_delay_s: NonNegative = 0.0
    thruster_gain_loss: Fraction = 0.0
    """each thruster's gain is drawn from [1 - loss, 1]"""
    dead_thruster: Count | None = None
    """index of a thruster that gives nothing"""
    mass_spread: Spread = 0.0
    """each parameter is scaled by a factor drawn from [1 - spread, 1 + spread] per episode; inertia and buoyancy follow the mass"""
    damping_spread: Spread = 0.0
    added_mass_spread: Spread = 0.0


# ------------------------------------------------------------------------------------------------------------------- sensors


class SonarConfig(Section):
    """Horizontal ring of beams, fixed to the yaw, always level."""

    n_ray: Annotated[int, Field(ge=16, multiple_of=16)] = 256
    max_range_m: Positive = 12.0
    vertical_half_aperture_deg: Annotated[float, Field(ge=0, lt=80)] = 10.0
    period_steps: PositiveCount = 1
    """control steps between pings"""
    latency_steps: Count = 0
    range_sigma_m: NonNegative = 0.0
    range_sigma_slope: NonNegative = 0.0
    """[m/m]"""
    range_quantum_m: NonNegative = 0.0
    range_jitter_m: NonNegative = 0.0
    """mean of a positive exponential error"""
    missed_return: Fraction = 0.0
    false_return: Fraction = 0.0
    bubble_clouds_per_s: NonNegative = 0.0
    """mean rate at which bubble clouds form; each hides a run of beams at one range and bearing"""
    bubble_beams: tuple[int, int] = (3, 8)
    bubble_s: Interval = (1.0, 3.0)
    ghost: Fraction = 0.0
    """probability per beam that a specular bounce replaces the direct return"""
    grazing_cosine: Fraction = 0.0
    """a return is lost below this cosine of incidence"""
    doppler_sigma_m_s: NonNegative = 0.0
    doppler_outlier: Fraction = 0.0
    """probability per beam that the Doppler is worthless"""
    doppler_outlier_m_s: NonNegative = 2.0
    """worthless = uniform within +- this (EC)"""


class DepthConfig(Section):
    """Forward camera."""

    rows: PositiveCount = 72
    cols: Annotated[int, Field(ge=16, multiple_of=16)] = 128
    fov_deg: Annotated[float, Field(gt=0, lt=170)] = 90.0
    """horizontal"""
    offset_b_m: Vector3 = (0.2, 0.0, 0.0)
    max_range_m: Positive = 10.0
    period_steps: PositiveCount = 5
    sigma_m: NonNegative = 0.0
    sigma_slope: NonNegative = 0.0


class DvlConfig(Section):
    sigma_m_s: NonNegative = 0.0
    scale_error: NonNegative = 0.0
    """standard deviation of the scale factor, drawn per episode"""
    period_steps: PositiveCount = 1
    dropout: Fraction = 0.0
    """probability per reading that the bottom is lost"""
    dropout_s: Interval = (0.0, 0.0)
    """how long it then stays lost"""


class ImuConfig(Section):
    gyro_noise_rad_s_rthz: NonNegative = 0.0
    heading_drift_rad_s: NonNegative = 0.0
    """standard deviation of the constant drift rate, drawn per episode"""
    accel_sigma_m_s2: NonNegative = 0.0
    attitude_sigma_rad: NonNegative = 0.0


class PressureConfig(Section):
    bias_m: NonNegative = 0.0
    """drawn uniformly from +- this, per episode"""
    sigma_m: NonNegative = 0.0


class SensorsConfig(Section):
    sonar: SonarConfig = SonarConfig()
    depth: DepthConfig = DepthConfig()
    dvl: DvlConfig = DvlConfig()
    imu: ImuConfig = ImuConfig()
    pressure: PressureConfig = PressureConfig()
    localization: Literal["truth", "dead_reckoning"] = "truth"


# ---------------------------------------------------------------------------------------------------- perception and planning


class TrackingConfig(Section):
    """Clusters of beams to tracks of moving bodies, and their forecast. Every constant is in seconds, not in scans (values EC, tuned)."""

    n_track: PositiveCount = 24
    n_cluster: PositiveCount = 48
    period_steps: PositiveCount = 3
    """control steps between tracked scans, at least; scans in between are left out"""
    split_m: NonNegative = 0.18
    split_slope: NonNegative = 0.03
    split_doppler_m_s: Positive = 0.3
    """neighbouring beams whose Doppler differs by more (plus 6 sigma) belong to different bodies"""
    wall_margin_m: NonNegative = 0.15
    """returns this close (plus 2 sigma of range) to a known wall are dropped"""
    max_width_m: Positive = 0.75
    min_radius_m: Positive = 0.1
    own_speed_sigma_m_s: Positive = 0.05
    """trust in the own measured velocity, which the Doppler of the known walls corrects"""
    birth_speed_sigma_m_s: Positive = 1.0
    """across the bearing, where the first Doppler says nothing"""
    accel_density: NonNegative = 0.03
    """[m^2/s^3] spectral density of a body's acceleration"""
    turn_rate_sigma_rad_s: NonNegative = 1.0
    """prior of a moving body's turn rate around 0; 0 = bodies are taken to go straight"""
    turn_density: NonNegative = 0.005
    """[rad^2/s^3] spectral density of the turn rate's changes"""
    gate_m: Positive = 0.3
    """a cluster this close to a prediction (plus one scan of its speed) may always match, however sure the filter is"""
    turn_gate: Positive = 20.0
    """squared normalised innovation (3 values) beyond which a body is taken to have turned"""
    moving_speed_m_s: NonNegative = 0.08
    moving_doppler_m_s: NonNegative = 0.03
    moving_shift_m: NonNegative = 0.12
    """displacement (forgotten over shift_memory_s) that shows motion across the beams"""
    shift_memory_s: Positive = 2.0
    shift_s: NonNegative = 0.5
    """displacement counts from this age on"""
    doppler_memory_s: Positive = 0.5
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
    max_growth_m: NonNegative = 0.5


class ForecastConfig(Section):
    """What forecasts of moving bodies know of how bodies move. Each switch is one row of an ablation."""

    use_turn_rate: bool = True
    """bodies keep their turn rate; off: straight ahead"""
    straight_odds: Positive = 4.0
    """prior odds that a body goes straight: a turn rate is used where its evidence against 0 outweighs them"""
    use_habits: bool = True
    """bodies turn where one was seen to turn"""
    n_turn: Annotated[int, Field(ge=16, multiple_of=16)] = 48
    """turns remembered"""
    across_m: Positive = 0.25
    """a course that passes a remembered turn within this leads to it,"""
    across_slope: NonNegative = 0.1
    """and within this more per metre ahead"""
    overdue_m: NonNegative = 0.15
    """a turn this far behind may still come: the filter lags"""
    passed_m: Positive = 0.5
    """a turn this far behind did not come"""
    use_reflection: bool = True
    """bodies turn back at the tank's walls"""
    use_coasting: bool = True
    """unseen bodies go on by their habits; off: straight on, or along their arc"""


class ElevationConfig(Section):
    """Memory in 3-D of bodies that left the sonar's fan (values EC, tuned)."""

    memory_s: NonNegative = 8.0
    """time constant with which an unseen body is forgotten; 0 = a body that beams see through is forgotten at once"""
    half_height_m: NonNegative = 0.2
    """half height assumed of a body that is no wider"""
    least_half_height_m: NonNegative = 0.1
    """half height assumed where a body is not seen: the flattest one that would hide so"""
    column_share: Fraction = 0.05
    """share of moving bodies expected to go through the full water column"""
    edge_m: Positive = 0.06
    """half width of the soft edge of the fan"""
    evidence_s: Positive = 0.15
    """scans closer together than this are not independent evidence"""
    hit_share: Fraction = 0.9
    """probability that a body in the fan is hit, where its place is known exactly"""
    use_camera: bool = True
    """let the camera's image tell heights too"""
    camera_hit_share: Annotated[float, Field(ge=0, lt=1)] = 0.5
    """probability that a body in the image and at a free distance shows in the column through its middle"""
    gone_share: Fraction = 0.25
    """below this probability of being where it is expected, a body is forgotten"""
    tail_share: Fraction = 0.02
    """heights that are less likely than this are taken to be free"""
    column_tail_share: Fraction = 0.15

    @model_validator(mode="after")
    def _is_somewhere(self) -> ElevationConfig:
        if 15 * self.tail_share + self.column_tail_share >= 1:
            raise ValueError(
                f"tail_share {self.tail_share} of 15 heights and column_tail_share {self.column_tail_share} must sum to less than 1: "
                "else a body could be taken to be nowhere"
            )
        return self


class MappingConfig(Section):
    """Two-layer occupancy map. Gains are per scan at 10 Hz; at another scan rate they are scaled so that gain per second is kept."""

    cell_m: Positive = 0.1
    period_steps: PositiveCount = 1
    """control steps between mapped scans, at least: 1 maps every scan, as in the paper; 5 (10 Hz, for which the gains were chosen) costs a
    fifth and drives as well"""
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
    stamp: Fraction = 0.0
    """eta_stamp: gain of the simulator-side debugging stamp; must stay 0 in every preset"""
    doppler_evidence_m_s: NonNegative = 0.15
    free_confident_s: NonNegative = 0.5
    """a hit in a cell seen free for this long is dynamic evidence"""
    promote_s: Positive = 2.0
    """dynamic evidence that stays this long in one cell becomes static"""
    depth_gate_m: Positive = 0.3
    """depth pixels count when their point lies within this of the vehicle's own depth"""
    free_range_m: Positive = 6.0
    """a beam without return clears no farther: a missed return looks the same, and far out no second beam sees the cell (EC)"""
    wall_margin_m: NonNegative = 0.15
    """returns this close to a known wall are not mapped: the wall is the boundary term already, and no hull fits in between (EC)"""
    occupied: Fraction = 0.5
    """tau_occ"""


class ClearanceConfig(Section):
    """Distance transform and risk."""

    max_m: Positive = 2.0
    """distances are exact up to here"""
    period_steps: PositiveCount = 5
    risk_static: NonNegative = 1.0
    """alpha_m"""
    risk_dynamic: NonNegative = 1.0
    """alpha_d"""
    risk_clearance: NonNegative = 0.1
    """alpha_delta [m]"""
    risk_epsilon_m: Positive = 0.1


class VoronoiConfig(Section):
    """Global planner on the medial axis."""

    site_gap_cells: Positive = 3.0
    min_clearance_m: NonNegative = 0.35
    """d_min"""
    cost_epsilon_m: Positive = 0.1
    """eps_r"""
    max_pops: PositiveCount = 20000
    """budget of each pass of the search"""
    use: Literal["static", "fused"] = "static"
    """which occupancy the route must avoid"""
    avoid_forecast: bool = False
    """plan around the forecast of moving bodies too (no gain found in trials)"""


class RouteConfig(Section):
    """Route, triggers, look-ahead and the RRT fallback."""

    n_way: PositiveCount = 512
    """waypoints kept; a longer route is spaced wider"""
    spacing_m: Positive = 0.2
    lookahead_m: Positive = 1.0
    risk_horizon_m: Positive = 3.0
    """length of the look-ahead segment for path risk and for the intersection trigger"""
    stuck_speed_m_s: NonNegative = 0.08
    stuck_s: Positive = 3.0
    safety_range_m: NonNegative = 0.5
    safety_ttc_s: NonNegative = 1.0
    forecast_clearance_m: NonNegative = 0.35
    """a forecast closer than this to the look-ahead path is an intersection"""
    reach_speed_m_s: NonNegative = 0.6
    """the vehicle can be anywhere up to this times t along the path when a forecast body is there"""
    progress_window_m: Positive = 1.5
    """how far ahead of the last foot the new one is looked for"""
    min_replan_s: NonNegative = 0.4
    """the same trigger does not fire again within this"""
    rrt_clearance_m: NonNegative = 0.1
    """overlay clearance floor of the paper: what the fallback may still cross"""
    rrt_iterations: PositiveCount = 4000
    """budget of the fallback; never wall time, so that results do not depend on the machine"""
    rrt_range_m: Positive = 1.0


class FeaturesConfig(Section):
    """Sectors of the sonar features."""

    n_sector: PositiveCount = 12
    ttc_cap_s: Positive = 10.0


class TeacherConfig(Section):
    """Behaviour tree's leaves: assessment of threats, evasion and driving. Ports of a tree override the numbers that are a leaf's own."""

    cruise_m_s: Positive = 0.6
    decide_period_steps: PositiveCount = 5
    """control steps between decisions of the evasion (10 Hz: more made no difference in a trial)"""
    lag_s: Positive = 0.35
    """time constant from commanded to driven velocity, for roll-outs"""
    horizon_s: Positive = 2.5
    """of roll-outs (1.5 s cost 7 points in a trial)"""

    n_heading: PositiveCount = 24
    n_speed: PositiveCount = 4
    evade_m_s: Positive = 0.85
    """fastest candidate; the limits of surge and sway are separate, so diagonals of the body are faster than its axes"""

    heave_m_s: NonNegative = 0.4
    """vertical speed of the candidates that dive or climb; 0 = evade level only"""
    n_heave_heading: PositiveCount = 13
    """headings of the candidates that dive or climb"""
    burst_s: NonNegative = 0.8
    """the candidates that are a short dash last so long, then they stop; 0 = none"""

    hull_reach_m: NonNegative = 0.22
    """hull centre to surface: between 0.17 abeam and 0.27 ahead"""
    contact_m: NonNegative = 0.1
    """clearance that the referee calls a collision"""
    margin_m: NonNegative = 0.25
    """wanted clearance beyond contact from a forecast body"""
    margin_growth_m_s: NonNegative = 0.1
    """the margin grows with prediction time"""
    closing_s: NonNegative = 0.25
    """effective clearance is reduced by this times the closing speed (the referee stops at 0.18 s)"""
    vertical_weight: Positive = 1.5
    """free water above or below a body counts this many times: the hull is slimmer upwards (0.17 m) and heights carry their own margin"""
    caution: Positive = 1.0
    """factor of both margins from moving bodies: more trades time and success for fewer collisions"""
    static_margin_m: NonNegative = 0.1
    """wanted clearance beyond contact from mapped obstacles and walls"""
    static_horizon_s: Positive = 1.5
    static_dt_s: Positive = 0.25

    weight_peak: NonNegative = 6.0
    """[1/m] largest depth of violation of the wanted clearance"""
    weight_mean: NonNegative = 6.0
    """[1/m] depth of violation averaged over the horizon, summed over bodies"""
    weight_contact: NonNegative = 12.0
    """[1/m] largest depth below contact"""
    weight_static: NonNegative = 12.0
    """[1/m] mean depth of violation of the static clearance"""
    weight_static_contact: NonNegative = 30.0
    """[1/m] largest depth below static contact"""
    weight_deviation: NonNegative = 1.0
    """per cruise speed of difference from the follow velocity"""
    weight_change: NonNegative = 0.3
    """per cruise speed of difference from the last command"""
    softness: Positive = 0.05
    """temperature of the cost-softmax mean over candidates"""

    calm_s: NonNegative = 0.5
    """evasion goes on for this long after the last predicted conflict"""
    conflict_within_s: NonNegative = 2.5
    emergency_ttc_s: NonNegative = 0.35
    emergency_range_m: NonNegative = 0.12
    emergency_closing_m_s: NonNegative = 0.15
    """slower approach is no emergency"""
    back_off_m_s: Positive = 0.85
    blocked_clearance_m: NonNegative = 0.25
    """the way to the look-ahead point is blocked below this static clearance"""
    goal_near_m: Positive = 1.5
    stuck_s: Positive = 4.0
    unstick_s: Positive = 1.5
    unstick_m_s: Positive = 0.3
    slow_clearance_m: Positive = 0.6
    """speed falls below cruise where the static clearance is smaller than this"""
    slow_fraction: Fraction = 0.5
    """share of cruise speed left at contact"""
    edge_gap_m: NonNegative = 0.26
    """hull centre to surface or floor, at least"""
    depth_gain: Positive = 1.0
    """[1/s] heave per metre of depth error"""
    yaw_gain: Positive = 1.5
    """[1/s]"""
    max_node: PositiveCount = 64

    @property
    def n_held(self) -> int:
        """Evasive velocities to be held: level headings times speeds; stop, last command, follow; diving and climbing ones."""
        return self.n_heading * self.n_speed + 3 + (2 * self.n_heave_heading + 2 if self.heave_m_s > 0 else 0)

    @property
    def first_burst(self) -> int:
        """Index of the first dash: ``n_held`` padded to whole packets of 16."""
        return 16 * -(-self.n_held // 16)

    @property
    def n_candidate(self) -> int:
        """Evasive velocities in all, padding included: the dashes go in two packets of 16 headings."""
        return self.first_burst + (32 if self.burst_s > 0 else 0)


class RewardConfig(Section):
    """Weights of the paper's r_t, one per term and named like it (the paper gives no values: EC), and the bounds of the soft terms.

    Scale: driving at 0.6 m/s along the route earns about 0.015 a step, 20 over a typical episode: as much as one success.
    """

    alive: float = 0.01
    """r_alive; less than path_distance takes at the usual look-ahead of 1 m, so that waiting does not pay"""
    progress: float = 1.0
    """w_p [1/m]"""
    path_distance: float = 0.02
    """w_d [1/m]"""
    cross_track: float = 0.02
    """w_ct [1/m]"""
    clearance: float = 0.1
    """w_c; touching costs five times what full speed earns"""
    ttc: float = 0.1
    """w_ttc"""
    overspeed: float = 0.1
    """w_v [s^2/m^2]"""
    upright: float = 0.005
    """w_u"""
    heading: float = 0.01
    """w_h; about as much as progress at full speed, so that the vehicle looks where it goes"""
    success: float = 20.0
    """w_s"""
    failure: float = 20.0
    """w_f"""
    tilt: float = 0.02
    """w_tilt [1/rad]"""
    effort: float = 0.005
    """w_eff"""
    soft_clearance_m: Positive = 0.4
    """C_t grows linearly from 0 here to 1 at contact"""
    soft_ttc_s: Positive = 2.0
    """T_t grows linearly from 0 here to 1 at impact"""
    safe_speed_m_s: Positive = 0.6
    """beyond this speed is overspeed (Table app_repro: 0.6 m/s)"""


class EpisodeConfig(Section):
    """Clock and the referee's rules."""

    control_dt_s: Positive = 0.02
    substeps: PositiveCount = 2
    horizon_steps: Annotated[int, Field(ge=1, le=30000)] = 3000
    goal_radius_m: Positive = 1.0
    collision_clearance_m: NonNegative = 0.1
    ttc_s: NonNegative = 0.18
    ttc_closing_m_s: NonNegative = 0.05


class Config(Section):
    """Everything a run needs; immutable."""

    world: WorldConfig = WorldConfig()
    vehicle: VehicleConfig = VehicleConfig()
    actuation: ActuationConfig = ActuationConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    sensors: SensorsConfig = SensorsConfig()
    tracking: TrackingConfig = TrackingConfig()
    forecast: ForecastConfig = ForecastConfig()
    elevation: ElevationConfig = ElevationConfig()
    mapping: MappingConfig = MappingConfig()
    clearance: ClearanceConfig = ClearanceConfig()
    voronoi: VoronoiConfig = VoronoiConfig()
    route: RouteConfig = RouteConfig()
    features: FeaturesConfig = FeaturesConfig()
    teacher: TeacherConfig = TeacherConfig()
    reward: RewardConfig = RewardConfig()
    episode: EpisodeConfig = EpisodeConfig()
