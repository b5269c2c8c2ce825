"""Every array of the simulator, one struct per stage: shape, dtype, unit and frame are written here and nowhere else.

Frames: ``_w`` world (z up, origin at the tank's corner, z = 0 at the surface), ``_b`` body (x forward, y left, z up). SI units, radians.
Structs hold arrays only: a Python number in a struct would go stale silently. ``n_env`` is always the first index.
Truth (what the simulator knows) and sensed or remembered data (what the vehicle knows) never share a struct.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, TypeVar

import taichi as ti

REAL = "real"
"""dtype of continuous quantities: float32, or float64 where a run asks for double precision."""

_T = TypeVar("_T")


PACKET = 16
"""Lanes of a packed array (lanes.LANES)."""
WORD = 64
"""Bits of a word of a bit array (bits.WORD)."""


def array(
    *shape: str, vec: int = 0, dtype: Any = REAL, packed: bool = False, lanes: bool = False, bits: bool = False, beside: str = ""
) -> Any:
    """Declare one array of a struct: named sizes, optional vector length, dtype (default: the run's real type).

    ``packed`` groups the last axis into vectors of sixteen neighbours: one packet is one index, which Taichi loads as a whole.
    ``lanes`` keeps single elements as indices, but lays the last axis (padded to whole packets) out in groups of sixteen, so that the
    compiler sees that a loop over ``packet * 16 + i`` with static i meets neighbours: it then loads, computes and stores whole vectors.
    ``bits`` keeps sixty-four neighbours on the last axis as the bits of one word (uint64), the first in the lowest.
    Arrays of one shape with the same word in ``beside`` lie side by side, element by element: what is touched together is fetched together.
    """
    metadata = {"shape": shape, "vec": vec, "dtype": ti.u64 if bits else dtype, "packed": packed, "lanes": lanes, "bits": bits}
    return dataclasses.field(metadata=metadata | {"beside": beside})


def allocate(struct: type[_T], sizes: dict[str, int], real: Any = ti.f32) -> _T:
    """Build every array of ``struct``; ``sizes`` maps each name of a shape to its length. Taichi must be running."""
    built: dict[str, Any] = {}
    for declared in dataclasses.fields(struct):  # type: ignore[arg-type]
        if declared.metadata["beside"]:
            built |= {} if declared.name in built else _side_by_side(struct, declared.metadata["beside"], sizes, real)
        else:
            built[declared.name] = _field(declared, sizes, real)
    return struct(**built)


def _side_by_side(struct: type, group: str, sizes: dict[str, int], real: Any) -> dict[str, Any]:
    together = [f for f in dataclasses.fields(struct) if f.metadata["beside"] == group]  # type: ignore[arg-type]
    shape = _shape(together[0], sizes)
    built = {f.name: ti.field(_dtype(f, real)) for f in together}
    ti.root.dense((ti.i, ti.ij, ti.ijk, ti.ijkl)[len(shape) - 1], shape).place(*built.values())
    return built


def _dtype(declared: dataclasses.Field, real: Any) -> Any:
    return real if declared.metadata["dtype"] is REAL else declared.metadata["dtype"]


def _shape(declared: dataclasses.Field, sizes: dict[str, int]) -> tuple[int, ...]:
    shape = tuple(sizes[name] for name in declared.metadata["shape"])
    return (*shape[:-1], -(-shape[-1] // WORD)) if declared.metadata["bits"] else shape


def _field(declared: dataclasses.Field, sizes: dict[str, int], real: Any) -> Any:
    shape, dtype = _shape(declared, sizes), _dtype(declared, real)
    if declared.metadata["packed"]:
        return ti.Vector.field(PACKET, dtype, shape=(*shape[:-1], shape[-1] // PACKET), layout=ti.Layout.AOS)
    if declared.metadata["lanes"]:
        return _field_in_lanes(shape, dtype)
    if declared.metadata["vec"]:
        # a vector's components stay together: apart, they would lie a whole array from each other, which for a power of two of envs is the
        # same cache set for every component of every array
        return ti.Vector.field(declared.metadata["vec"], dtype, shape=shape, layout=ti.Layout.AOS)
    return ti.field(dtype, shape=shape)


def _field_in_lanes(shape: tuple[int, ...], dtype: Any) -> Any:
    """A scalar field whose last axis is split in two levels, the inner one of sixteen; in memory and in use it is like any other."""
    field, axes, node = ti.field(dtype), (ti.i, ti.j, ti.k, ti.l)[: len(shape)], ti.root
    for axis, length in zip(axes[:-1], shape[:-1], strict=True):
        node = node.dense(axis, length)
    node.dense(axes[-1], _packets(shape[-1])).dense(axes[-1], PACKET).place(field)
    return field


def _packets(length: int) -> int:
    return -(-length // PACKET)


def bytes_of(struct: type, sizes: dict[str, int], real_bytes: int = 4) -> int:
    """Memory that ``allocate`` would take [bytes], known before anything is allocated."""
    total = 0
    for declared in dataclasses.fields(struct):
        count = max(1, declared.metadata["vec"])
        shape = _shape(declared, sizes)
        if declared.metadata["lanes"]:
            shape = (*shape[:-1], PACKET * _packets(shape[-1]))
        count *= math.prod(shape)
        total += count * (real_bytes if declared.metadata["dtype"] is REAL else _DTYPE_BYTES[declared.metadata["dtype"]])
    return total


_DTYPE_BYTES = {ti.f32: 4, ti.f64: 8, ti.i32: 4, ti.u32: 4, ti.i16: 2, ti.u16: 2, ti.i8: 1, ti.u8: 1, ti.u64: 8}


# --------------------------------------------------------------------------------------------------------------------- clock


@dataclass(frozen=True, eq=False)
class ClockState:
    """Which envs run, and their time. Every kernel sees it; it holds no truth about the world."""

    active: ti.Field = array("n_env", dtype=ti.i32)
    """1 = running; 0 = ended, waiting for a reset"""
    awake: ti.Field = array("n_env", dtype=ti.i32)
    """1 = processed by the kernels of this pass: the running rows in a step, the rows being reset in a reset"""
    step: ti.Field = array("n_env", dtype=ti.i32)
    """control steps done since the episode's start; time = step * control_dt_s"""


@dataclass(frozen=True, eq=False)
class EpisodeState:
    """Which episode each env plays. Its key opens every random stream, so only the simulator's side (world, vehicle, sensors) gets it."""

    seed: ti.Field = array("n_env", dtype=ti.i32)
    """seed of the scenario"""
    number: ti.Field = array("n_env", dtype=ti.i32)
    """episode index under that seed"""
    key: ti.Field = array("n_env", dtype=ti.u32)
    """random key of (seed, number)"""


# --------------------------------------------------------------------------------------------------------------------- truth


@dataclass(frozen=True, eq=False)
class VehicleState:
    """Truth: rigid body and rotors. Origin = centre of mass."""

    pos_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    quat_wb: ti.Field = array("n_env", vec=4)
    """unit quaternion (w, x, y, z), body to world"""
    vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] over ground"""
    rate_b: ti.Field = array("n_env", vec=3)
    """[rad/s]"""
    acc_b: ti.Field = array("n_env", vec=3)
    """[m/s^2] inertial acceleration in body axes over the last substep (what an IMU feels, without gravity)"""
    rpm: ti.Field = array("n_env", "n_thruster")
    """[rpm] rotor speed after the lag"""


@dataclass(frozen=True, eq=False)
class VehicleParams:
    """Truth: physical parameters of each vehicle (equal unless randomised). Diagonals in the order of Fossen's nu."""

    mass_kg: ti.Field = array("n_env")
    """[kg]"""
    inertia: ti.Field = array("n_env", vec=3)
    """[kg m^2] diagonal"""
    added_mass: ti.Field = array("n_env", vec=6)
    """[kg, kg m^2] diagonal"""
    linear_damping: ti.Field = array("n_env", vec=6)
    """[N s/m, N m s] diagonal"""
    quadratic_damping: ti.Field = array("n_env", vec=6)
    """[N s^2/m^2, N m s^2] diagonal"""
    buoyancy_n: ti.Field = array("n_env")
    """[N] rho g V"""
    buoyancy_height_m: ti.Field = array("n_env")
    """[m] centre of buoyancy above the centre of mass"""
    thruster_gain: ti.Field = array("n_env", "n_thruster")
    """1 = healthy, 0 = dead"""
    delay_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps between an rpm command and its effect"""


@dataclass(frozen=True, eq=False)
class ActuationState:
    """Inner loop and rotors' commands."""

    command: ti.Field = array("n_env", vec=4)
    """[m/s, m/s, m/s, rad/s] commanded surge, sway, heave, yaw rate"""
    integral: ti.Field = array("n_env", vec=4)
    """[N, N, N, N m] integral part of the wrench"""
    rpm_command: ti.Field = array("n_env", "n_thruster")
    """[rpm] what the rotors are told now (after the delay)"""
    rpm_queue: ti.Field = array("n_env", "n_delay", "n_thruster")
    """[rpm] commands under way, a ring indexed by episode step"""
    thrust_n: ti.Field = array("n_env", "n_thruster")
    """[N] thrust of each rotor in the last substep"""
    hold_moment_b: ti.Field = array("n_env", vec=3)
    """[N m] moment of the ideal attitude hold"""
    external_wrench_b: ti.Field = array("n_env", vec=6)
    """[N, N m] applied from outside (experiments); zero in navigation"""


@dataclass(frozen=True, eq=False)
class Allocation:
    """Thruster geometry, the same for all envs."""

    wrench_of_thrust: ti.Field = array("n_wrench", "n_thruster")
    """body wrench (6) of unit thrust of each thruster"""
    thrust_of_wrench: ti.Field = array("n_thruster", "n_wrench")
    """least-squares inverse over the controllable axes"""


@dataclass(frozen=True, eq=False)
class CurrentState:
    """Truth: water velocity."""

    mean_w: ti.Field = array("n_env", vec=3)
    """[m/s] constant part"""
    vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] constant plus Gauss-Markov part"""


@dataclass(frozen=True, eq=False)
class SceneState:
    """What is asked of the scenario of each env: data, so that cells of a sweep need no recompilation."""

    n_static: ti.Field = array("n_env", dtype=ti.i32)
    """S: random static obstacles wanted"""
    n_dynamic: ti.Field = array("n_env", dtype=ti.i32)
    """D: moving obstacles wanted"""
    speed_m_s: ti.Field = array("n_env")
    """v: nominal speed of the moving obstacles [m/s]"""


@dataclass(frozen=True, eq=False)
class WorldState:
    """Truth: obstacles as a list per env, fixed and static ones first, moving ones from ``first_dynamic`` on. kind NONE = empty slot."""

    kind: ti.Field = array("n_env", "n_body", dtype=ti.i32)
    """geometry.SPHERE, CYLINDER, BOX or NONE"""
    pos_w: ti.Field = array("n_env", "n_body", vec=3)
    """[m] centre"""
    vel_w: ti.Field = array("n_env", "n_body", vec=3)
    """[m/s]"""
    size: ti.Field = array("n_env", "n_body", vec=3)
    """[m] sphere (r, r, r), cylinder (r, r, half height), box half extents"""
    yaw: ti.Field = array("n_env", "n_body")
    """[rad]"""
    draws: ti.Field = array("n_env", dtype=ti.i32)
    """how many layouts were drawn until start and goal were joined by free space"""
    unclear_paths: ti.Field = array("n_env", dtype=ti.i32)
    """paths of moving obstacles taken as they were: no draw kept clear of static obstacles"""
    faults: ti.Field = array("n_env", dtype=ti.i32)
    """0 = the scenario is as asked; else a bit set of scenario.FAULTS: draws ran out, the world cannot be placed"""


@dataclass(frozen=True, eq=False)
class PathState:
    """Truth: how the moving obstacles move. A closed polyline of 2 to 5 waypoints (2 = back and forth), or a circle (n_way = 0)."""

    n_way: ti.Field = array("n_env", "n_dynamic", dtype=ti.i32)
    """waypoints of the closed polyline; 0 = circle"""
    way_w: ti.Field = array("n_env", "n_dynamic", "n_corner", vec=2)
    """[m] waypoints; of a circle, way 0 is the centre"""
    radius_m: ti.Field = array("n_env", "n_dynamic")
    """[m] of a circle; positive = counter-clockwise, negative = clockwise"""
    length_m: ti.Field = array("n_env", "n_dynamic")
    """[m] once around the closed path"""
    phase_m: ti.Field = array("n_env", "n_dynamic")
    """[m] arc length along the closed path at t = 0"""
    speed_m_s: ti.Field = array("n_env", "n_dynamic")
    """[m/s]"""


@dataclass(frozen=True, eq=False)
class FixedTable:
    """Obstacles given explicitly by the world's YAML, the same for all envs; moving ones fill the first slots of the moving list."""

    kind: ti.Field = array("n_fixed", dtype=ti.i32)
    """geometry kind"""
    pos_w: ti.Field = array("n_fixed", vec=3)
    """[m]"""
    size: ti.Field = array("n_fixed", vec=3)
    """[m] as in WorldState"""
    yaw: ti.Field = array("n_fixed")
    """[rad]"""
    n_way: ti.Field = array("n_fixed", dtype=ti.i32)
    """waypoints of its path, 0 = does not move"""
    way_w: ti.Field = array("n_fixed", "n_corner", vec=2)
    """[m]"""
    speed_m_s: ti.Field = array("n_fixed")
    """[m/s], negative = the scenario's v"""


@dataclass(frozen=True, eq=False)
class ScenarioScratch:
    """Scratch of scenario drawing: free space on a coarse grid, to see whether start and goal are joined."""

    reach: ti.Field = array("n_env", "n_coarse_row", "n_coarse_col", dtype=ti.u8)
    """0 = free, 1 = blocked, 2 = reached from the start"""
    footprint: ti.Field = array("n_env", "n_body", vec=7)
    """plan view of the bodies at rest (footprint.py)"""


# ------------------------------------------------------------------------------------------------------------------- mission


@dataclass(frozen=True, eq=False)
class MissionState:
    """What the vehicle is told: its goal. (The tank's bounds are known from the config.)"""

    goal_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    start_w: ti.Field = array("n_env", vec=3)
    """[m]"""
    start_yaw: ti.Field = array("n_env")
    """[rad]"""


# ------------------------------------------------------------------------------------------------------------------- sensing


@dataclass(frozen=True, eq=False)
class Proprioception:
    """Sensed: DVL, IMU, pressure and the pose estimate. Values hold their last reading where the flag says invalid."""

    vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] DVL"""
    vel_valid: ti.Field = array("n_env", dtype=ti.i32)
    """1 = the DVL has a reading no older than its own period"""
    rpy: ti.Field = array("n_env", vec=3)
    """[rad] roll, pitch, yaw of the IMU"""
    rate_b: ti.Field = array("n_env", vec=3)
    """[rad/s] gyro"""
    specific_force_b: ti.Field = array("n_env", vec=3)
    """[m/s^2] accelerometer: acceleration minus gravity, in body axes"""
    depth_m: ti.Field = array("n_env")
    """[m] pressure depth, positive down"""
    pos_w: ti.Field = array("n_env", vec=3)
    """[m] position estimate (truth or dead reckoning; z from pressure in dead reckoning)"""


@dataclass(frozen=True, eq=False)
class ProprioceptionMemory:
    """Hidden state of the proprioceptive sensors (simulator side)."""

    pressure_bias_m: ti.Field = array("n_env")
    """[m] constant over an episode"""
    dvl_scale: ti.Field = array("n_env")
    """1 + scale error, constant over an episode"""
    heading_error: ti.Field = array("n_env")
    """[rad] integrated heading drift"""
    heading_rate: ti.Field = array("n_env")
    """[rad/s] drift rate of the episode"""
    dropout_until: ti.Field = array("n_env", dtype=ti.i32)
    """step until which the DVL has lost the bottom"""


@dataclass(frozen=True, eq=False)
class SonarScan:
    """Sensed: the newest delivered sonar scan. Beam 0 ahead, counter-clockwise, horizontal."""

    range_m: ti.Field = array("n_env", "n_ray", lanes=True)
    """[m] no return = maximum range"""
    doppler_m_s: ti.Field = array("n_env", "n_ray", lanes=True)
    """[m/s] rate of change of the distance to what the beam hit, positive = receding, ego motion included"""
    intensity: ti.Field = array("n_env", "n_ray", lanes=True)
    """[0, 1]"""
    hit: ti.Field = array("n_env", "n_ray", lanes=True, dtype=ti.i32)
    """1 = return"""
    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = delivered in this very step"""
    ping_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step at which it was taken"""
    ping_pos_w: ti.Field = array("n_env", vec=3)
    """[m] own position estimate when it was taken"""
    ping_yaw: ti.Field = array("n_env")
    """[rad] own yaw estimate when it was taken"""
    ping_vel_b: ti.Field = array("n_env", vec=3)
    """[m/s] own measured velocity when it was taken"""


@dataclass(frozen=True, eq=False)
class SonarMemory:
    """Hidden state of the sonar (simulator side): scans under way and bubble clouds."""

    range_m: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[m] ring of scans taken and not yet delivered"""
    doppler_m_s: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[m/s]"""
    intensity: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True)
    """[0, 1]"""
    hit: ti.Field = array("n_env", "n_latency", "n_ray", lanes=True, dtype=ti.i32)
    """1 = return"""
    step: ti.Field = array("n_env", "n_latency", dtype=ti.i32)
    """step at which it was taken, -1 = empty"""
    pos_w: ti.Field = array("n_env", "n_latency", vec=3)
    """[m] own position estimate then"""
    yaw: ti.Field = array("n_env", "n_latency")
    """[rad]"""
    vel_b: ti.Field = array("n_env", "n_latency", vec=3)
    """[m/s]"""
    mount_w: ti.Field = array("n_env", vec=3)
    """[m] scratch of one ping: true position of the sonar"""
    mount_vel_w: ti.Field = array("n_env", vec=2)
    """[m/s] its true horizontal velocity"""
    heading_w: ti.Field = array("n_env", vec=2)
    """unit vector along beam 0"""
    body_x_m: ti.Field = array("n_env", "n_body", lanes=True)
    """[m] scratch of one ping: centre of a body's outline from the sensor, along x of the world"""
    body_y_m: ti.Field = array("n_env", "n_body", lanes=True)
    """[m] along y"""
    body_reach_m: ti.Field = array("n_env", "n_body", lanes=True)
    """[m] radius around it that holds the outline, far below 0 = empty slot"""
    cloud_beam: ti.Field = array("n_env", "n_cloud", dtype=ti.i32)
    """first beam of a bubble cloud, counted from the world's x axis"""
    cloud_width: ti.Field = array("n_env", "n_cloud", dtype=ti.i32)
    """beams it covers"""
    cloud_range_m: ti.Field = array("n_env", "n_cloud")
    """[m]"""
    cloud_until: ti.Field = array("n_env", "n_cloud", dtype=ti.i32)
    """step at which it is gone"""


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Sensed: forward depth camera, row 0 at the top, column 0 at the left."""

    depth_m: ti.Field = array("n_env", "n_pixel_row", "n_pixel_col", lanes=True, dtype=ti.f32)
    """[m] z-depth along the optical axis; no return = maximum range"""
    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = taken in this very step"""
    shot_pos_w: ti.Field = array("n_env", vec=3)
    """[m] own position estimate when it was taken"""
    shot_rpy: ti.Field = array("n_env", vec=3)
    """[rad] own attitude estimate when it was taken"""


# ------------------------------------------------------------------------------------------------------ perception and memory


@dataclass(frozen=True, eq=False)
class TrackState:
    """Remembered: moving (and candidate) bodies seen by the sonar, one Kalman filter each."""

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
    """share of each height hypothesis (elevation.heights), summing to 1"""
    present: ti.Field = array("n_env", "n_track")
    """probability that the body is where it is expected"""
    scan_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the ping that the states refer to, -1 = no scan yet"""
    beam_track: ti.Field = array("n_env", "n_ray", dtype=ti.i32)
    """track that explains this beam of the newest scan, -1 = none (carried over by bearing where that scan was not tracked)"""
    pick: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """scratch of one scan: cluster matched to this track, -1 = none"""
    pick_cost: ti.Field = array("n_env", "n_track")
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
    count: ti.Field = array("n_env", dtype=ti.i32)
    """clusters found"""
    pos_w: ti.Field = array("n_env", "n_cluster", vec=2)
    """[m] centre of the body"""
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
class HabitState:
    """Remembered: places where moving bodies turned in this episode, of whichever track; and each track's last straight leg."""

    turn_x: ti.Field = array("n_env", "n_turn", packed=True)
    """[m] place of the turn, world"""
    turn_y: ti.Field = array("n_env", "n_turn", packed=True)
    """[m]"""
    in_x: ti.Field = array("n_env", "n_turn", packed=True)
    """unit course before the turn"""
    in_y: ti.Field = array("n_env", "n_turn", packed=True)
    """unit course before the turn"""
    out_x: ti.Field = array("n_env", "n_turn", packed=True)
    """unit course after it"""
    out_y: ti.Field = array("n_env", "n_turn", packed=True)
    """unit course after it"""
    weight: ti.Field = array("n_env", "n_turn", packed=True)
    """times seen, less times that it did not come; not above 0 = empty"""
    next_slot: ti.Field = array("n_env", dtype=ti.i32)
    """slot that the next new turn takes"""
    leg: ti.Field = array("n_env", "n_track", vec=4)
    """[m, m, m/s, m/s] state of the track when it was last on a straight leg"""
    leg_step: ti.Field = array("n_env", "n_track", dtype=ti.i32)
    """episode step of that, -1 = never"""


@dataclass(frozen=True, eq=False)
class ForecastState:
    """Where each moving track is expected, at equal steps from now to the horizon."""

    pos_w: ti.Field = array("n_env", "n_track", "n_forecast", vec=2)
    """[m]"""
    radius_m: ti.Field = array("n_env", "n_track", "n_forecast")
    """[m] body radius plus what the uncertainty adds"""
    above_w: ti.Field = array("n_env", "n_track")
    """[m] world z of the lowest edge of what may be above the own height; the own height where the body may be level with the vehicle"""
    below_w: ti.Field = array("n_env", "n_track")
    """[m] world z of the highest edge of what may be below"""


@dataclass(frozen=True, eq=False)
class GridMask:
    """The known bounds on the grid, the same for all envs. Cell [row, col] has its centre at origin + (col + 0.5, row + 0.5) * cell."""

    outside: ti.Field = array("n_row", "n_col", dtype=ti.i32)
    """1 = outside the tank (the grid has a border of such cells)"""
    outside_bits: ti.Field = array("n_row", "n_col", bits=True)
    """the same, one bit a cell"""


@dataclass(frozen=True, eq=False)
class MapState:
    """Remembered: the two-layer occupancy map. Row = y, column = x. What is asked of many cells at once is kept in bits."""

    static_occ: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.f32, beside="layers")
    """[0, 1] persistent layer M^s"""
    dynamic_occ: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.f32, beside="layers")
    """[0, 1] layer M^d of what moves"""
    dynamic_scans: ti.Field = array("n_env", "n_row", "n_col", dtype=ti.u8)
    """scans with dynamic evidence since the cell was last seen free (saturating): promotion to static"""
    free_scans: ti.Field = array("n_env", "n_row", "n_col", vec=8, bits=True)
    """scans that saw the cell free since its last return, up to what makes it confident: a number of eight bits, one word for each"""
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
    """Scratch: what one env's scan says about the cells. Slots are shared by all envs: few serve many and stay in the cache."""

    static_hit: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """static returns"""
    dynamic_hit: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """returns of what moves"""
    fan_edge: ti.Field = array("n_slot", "n_row", "n_col", bits=True, beside="marks")
    """cells at which a column enters or leaves the fan of free water (fan.py)"""
    fetched: ti.Field = array("n_slot", dtype=ti.f32)
    """see mapping.fetch_cells"""


@dataclass(frozen=True, eq=False)
class ClearanceState:
    """Distance to the nearest occupied or outside cell, centre to centre, with that cell."""

    clearance_m: ti.Field = array("n_env", "n_row", "n_col", lanes=True, dtype=ti.f32)
    """[m] exact up to clearance.max_m, which stands for "at least" """
    site_row: ti.Field = array("n_env", "n_row", "n_col", lanes=True, dtype=ti.i16)
    """row of the nearest site, -1 = none within clearance.max_m"""
    site_col: ti.Field = array("n_env", "n_row", "n_col", lanes=True, dtype=ti.i16)
    """column of the nearest site"""
    fresh: ti.Field = array("n_env", dtype=ti.i32)
    """1 = computed in this very step"""


@dataclass(frozen=True, eq=False)
class ClearanceMemory:
    """What the newest clearance was computed from: the next one redoes only what changed. And scratch, its slots shared by all envs."""

    sites: ti.Field = array("n_env", "n_row", "n_col", bits=True)
    """occupied cells and cells outside"""
    farthest: ti.Field = array("n_env", "n_row", "n_packet", dtype=ti.i32)
    """[cells^2] largest squared distance among sixteen neighbours in a row"""
    limit: ti.Field = array("n_env", dtype=ti.i32)
    """[cells^2] limit of the distances, 0 = nothing computed yet"""
    row_key: ti.Field = array("n_slot", "n_row", "n_col", dtype=ti.i32, packed=True)
    """scratch: key of the nearest site in the same row (clearance.py)"""
    near_up: ti.Field = array("n_slot", "n_packet", "n_row", bits=True)
    """scratch: rows of a packet's columns that have a site in reach, lowest row first"""
    near_down: ti.Field = array("n_slot", "n_packet", "n_row", bits=True)
    """scratch: the same, highest row first"""
    stale: ti.Field = array("n_slot", "n_packet", "n_row", bits=True)
    """scratch: rows of a packet's columns that must be redone"""


# ------------------------------------------------------------------------------------------------------------------ planning


@dataclass(frozen=True, eq=False)
class VoronoiState:
    """Scratch of the global planner. Slots are shared by the queue (slot s plans its items s, s + n_plan, ...): few serve many envs."""

    weight: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.f32)
    """[1/m] 1 / max(clearance, eps_r) of a traversable cell, 0 = not traversable"""
    cost: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.f32)
    """cost-to-go of the cells reached by the search"""
    cell: ti.Field = array("n_plan", "n_row", "n_col", dtype=ti.u8)
    """bits of voronoi.py: on the skeleton or not (filled on demand), reached, direction of the next cell towards the goal"""
    heap: ti.Field = array("n_plan", "n_heap", dtype=ti.u64)
    """binary heap of open cells: bits of the estimated total cost, then the cell (row * n_col + col)"""
    path_cell: ti.Field = array("n_plan", "n_path", dtype=ti.i32)
    """cells of the path found, from start to goal"""
    node_cost: ti.Field = array("n_plan", "n_path", dtype=ti.f32)
    """shortcutting: cost-to-go of every few path cells"""
    node_next: ti.Field = array("n_plan", "n_path", dtype=ti.i32)
    """shortcutting: how many nodes the best chord from here spans, 0 = along the cells to the next node"""
    pops: ti.Field = array("n_env", dtype=ti.i32)
    """cells expanded by the newest plan of this env"""


@dataclass(frozen=True, eq=False)
class RouteState:
    """Remembered: the route, how it came about, and where the vehicle is along it."""

    n_way: ti.Field = array("n_env", dtype=ti.i32)
    """waypoints in use; 0 = no route yet"""
    way_w: ti.Field = array("n_env", "n_way", vec=2)
    """[m] waypoints at most route.spacing_m apart, first = where it was planned, last = goal"""
    way_left_m: ti.Field = array("n_env", "n_way")
    """[m] route length from this waypoint to the last"""
    cost: ti.Field = array("n_env")
    """sum |dp| / max(clearance, eps) of the route when it was planned"""
    planner: ti.Field = array("n_env", dtype=ti.i32)
    """who planned it: route.PLANNER_NONE, PLANNER_VORONOI, PLANNER_RRT"""
    trigger: ti.Field = array("n_env", dtype=ti.i32)
    """trigger of this step's replan, route.TRIGGER_NONE if none (a bit set of the triggers that fired in `fired`)"""
    fired: ti.Field = array("n_env", dtype=ti.i32)
    """bit set of every trigger that holds in this step"""
    want_plan: ti.Field = array("n_env", dtype=ti.i32)
    """1 = plan in this step"""
    fallback_reason: ti.Field = array("n_env", dtype=ti.i32)
    """why Voronoi failed in this step (voronoi.* code), 0 = it did not"""
    queue: ti.Field = array("n_env", dtype=ti.i32)
    """env ids that plan in this step"""
    n_queue: ti.Field = array(dtype=ti.i32)
    """length of the queue"""
    failed: ti.Field = array("n_env", dtype=ti.i32)
    """env ids whose Voronoi plan failed in this step: the host's RRT takes them"""
    n_failed: ti.Field = array(dtype=ti.i32)
    """length of that list"""
    plan_step: ti.Field = array("n_env", dtype=ti.i32)
    """episode step of the newest route"""
    replans: ti.Field = array("n_env", "n_trigger", dtype=ti.i32)
    """replans of the episode by trigger: initial, stuck, safety, intersection"""
    planned_by: ti.Field = array("n_env", "n_planner", dtype=ti.i32)
    """routes of the episode by planner: voronoi, rrt"""
    fallbacks: ti.Field = array("n_env", "n_reason", dtype=ti.i32)
    """fallbacks of the episode by reason: voronoi.* code - 1"""
    kept: ti.Field = array("n_env", dtype=ti.i32)
    """replans of the episode in which both planners failed and the old route (if any) stayed"""
    second_passes: ti.Field = array("n_env", dtype=ti.i32)
    """plans of the episode that left the skeleton and searched all traversable cells"""
    served_step: ti.Field = array("n_env", "n_trigger", dtype=ti.i32)
    """episode step at which this trigger was last answered by a replan"""
    ahead_w: ti.Field = array("n_env", "n_ahead", vec=2)
    """[m] points of the look-ahead segment, one cell apart, from the foot on"""
    n_ahead: ti.Field = array("n_env", dtype=ti.i32)
    """points in use"""
    arc: ti.Field = array("n_env")
    """[waypoint index, fractional] foot of the vehicle on the route"""
    lookahead_w: ti.Field = array("n_env", vec=3)
    """[m] point to steer at"""
    heading_error: ti.Field = array("n_env")
    """[rad] bearing of the look-ahead point minus own yaw"""
    cross_track_m: ti.Field = array("n_env")
    """[m] signed distance from the route, positive = left of it"""
    remaining_m: ti.Field = array("n_env")
    """[m] route length still ahead"""
    path_risk: ti.Field = array("n_env")
    """mean of the risk map over the look-ahead segment"""
    stuck_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps in a row at low speed away from the goal"""


# --------------------------------------------------------------------------------------------- features, teacher, reward, end


@dataclass(frozen=True, eq=False)
class FeatureState:
    """What the policy and the tree see of the surroundings, by sector (sector 0 centred ahead, counter-clockwise)."""

    sector_range_m: ti.Field = array("n_env", "n_sector")
    """[m] smallest range in the sector"""
    sector_ttc_s: ti.Field = array("n_env", "n_sector")
    """[s] smallest range / closing speed of a beam in the sector, capped"""
    sector_closing_m_s: ti.Field = array("n_env", "n_sector")
    """[m/s] largest closing speed in the sector, ego motion included; 0 where nothing returned"""
    sector_valid: ti.Field = array("n_env", "n_sector", dtype=ti.i32)
    """1 = at least one beam of the sector returned"""


@dataclass(frozen=True, eq=False)
class TeacherState:
    """The behaviour tree: blackboard, statuses and action."""

    status: ti.Field = array("n_env", "n_node", dtype=ti.i8)
    """status of every node after the newest tick (tree_tick codes)"""
    running_child: ti.Field = array("n_env", "n_node", dtype=ti.i16)
    """child (preorder index) that a node with memory goes on with"""
    result: ti.Field = array("n_env", "n_node", dtype=ti.i8)
    """scratch of one tick: what each leaf answers when it is ticked"""
    since_step: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """episode step at which a leaf that is running began"""
    ticks: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """ticks of every node in the episode"""
    acted: ti.Field = array("n_env", "n_node", dtype=ti.i32)
    """control steps of the episode in which this leaf set the action"""
    action: ti.Field = array("n_env", vec=4)
    """[-1, 1] surge, sway, heave, yaw rate of the tree"""
    leaf: ti.Field = array("n_env", dtype=ti.i32)
    """node that set the action, -1 = none (then the vehicle is told to stop)"""
    follow_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity that following the route asks for (level)"""
    evade_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] best evasive velocity found"""
    evade_cost: ti.Field = array("n_env")
    """cost of that velocity"""
    candidate_cost: ti.Field = array("n_env", "n_candidate")
    """cost of every candidate of the newest decision"""
    want_evade: ti.Field = array("n_env", dtype=ti.i32)
    """1 = plan an evasion in this step"""
    ttc_s: ti.Field = array("n_env")
    """[s] smallest sensed time to contact, geometry.FAR_M = none"""
    threat_bearing: ti.Field = array("n_env")
    """[rad] its bearing in the body frame"""
    nearest_m: ti.Field = array("n_env")
    """[m] smallest sensed distance from the hull"""
    nearest_bearing: ti.Field = array("n_env")
    """[rad] its bearing in the body frame"""
    clearance_m: ti.Field = array("n_env")
    """[m] mapped static clearance of the own position"""
    away_w: ti.Field = array("n_env", vec=2)
    """unit vector away from the nearest mapped obstacle, zero = none near"""
    path_clearance_m: ti.Field = array("n_env")
    """[m] smallest mapped clearance on the straight way to the look-ahead point"""
    conflict_s: ti.Field = array("n_env")
    """[s] time of the first predicted conflict of following the route, geometry.FAR_M = none"""
    hold_conflict_s: ti.Field = array("n_env")
    """[s] time of the first predicted conflict of stopping here, geometry.FAR_M = none"""
    body_near_m: ti.Field = array("n_env")
    """[m] distance to the nearest forecast body now, hull to surface"""
    calm_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps since a conflict was last predicted"""
    evading_steps: ti.Field = array("n_env", dtype=ti.i32)
    """control steps since the tree began to evade, 0 = not evading"""
    last_vel_w: ti.Field = array("n_env", vec=3)
    """[m/s] velocity asked for in the last step"""


@dataclass(frozen=True, eq=False)
class TreeTable:
    """A behaviour tree flattened to preorder arrays, the same for all envs: trees are data, no tree needs a recompilation."""

    n_node: ti.Field = array(dtype=ti.i32)
    """nodes in use"""
    kind: ti.Field = array("n_node", dtype=ti.i32)
    """kind of node (tree_tick codes)"""
    end: ti.Field = array("n_node", dtype=ti.i32)
    """one past the last descendant in preorder"""
    parent: ti.Field = array("n_node", dtype=ti.i32)
    """preorder index of the parent, -1 = root"""
    leaf: ti.Field = array("n_node", dtype=ti.i32)
    """which condition or action a leaf is"""
    param: ti.Field = array("n_node", vec=4)
    """numbers from the leaf's ports"""


@dataclass(frozen=True, eq=False)
class RewardState:
    """Reward of the step, term by term."""

    term: ti.Field = array("n_env", "n_term")
    """weighted terms, in the order of reward.TERMS"""
    episode_sum: ti.Field = array("n_env", "n_term")
    """their sums over the episode"""
    total: ti.Field = array("n_env")
    """reward of the step"""
    episode_return: ti.Field = array("n_env")
    """sum of rewards over the episode"""
    last_remaining_m: ti.Field = array("n_env")
    """[m] route length that was still ahead in the last step, negative = unknown"""


@dataclass(frozen=True, eq=False)
class RefereeState:
    """How each episode stands, judged from the truth. Never an input of mapping, planning, teacher or policy."""

    outcome: ti.Field = array("n_env", dtype=ti.i32)
    """episode.RUNNING, SUCCESS, COLLISION, TTC, OUT_OF_TANK or TIMEOUT"""
    clearance_m: ti.Field = array("n_env")
    """[m] hull to nearest obstacle or side wall, now"""
    ttc_s: ti.Field = array("n_env")
    """[s] smallest clearance / closing speed over the obstacles, geometry.FAR_M = none"""
    min_clearance_m: ti.Field = array("n_env")
    """[m] smallest of the episode"""
    path_length_m: ti.Field = array("n_env")
    """[m] driven"""
    last_pos_w: ti.Field = array("n_env", vec=3)
    """[m] position at the last step"""
