"""What a scan and a depth image say about the cells of the map: free water, a return that stays or moves, a point seen by the camera.

Free water is written as the scan's step into ``seen_step`` (any thread, any order: all write the same number); returns are bits of
``evidence``, or-ed by the one thread that has all of an env's returns. ``mapping.py`` merges both into the two layers.
"""

import math

import taichi as ti

from uuvtai.config import DepthConfig, MappingConfig, SonarConfig, TankConfig
from uuvtai.kernels.geometry import FAR_M, TWO_PI, quaternion_wb, rotation_wb, turned_z
from uuvtai.kernels.grid import cell_of, grid_origin
from uuvtai.kernels.lanes import LANES, f16x, i16x, ramp_lanes
from uuvtai.kernels.signature import Const, In, Out
from uuvtai.state import DepthImage, GridMask, MapState, SonarScan, TrackState

STATIC_HIT = 1
DYNAMIC_HIT = 2
DEPTH_HIT = 4

_MAX_REACH = 4
"""[cells] farthest neighbour that may explain a surprising return as the edge of a static body."""

_NO_RETURN_SHARE = 0.999
"""A depth pixel beyond this share of the camera's range saw nothing."""


def doppler_threshold(mapping, sonar):
    """[m/s] compensated Doppler that counts as motion: the configured value, or 3 sigma of the sensor's noise."""
    return max(mapping.doppler_evidence_m_s, 3.0 * sonar.doppler_sigma_m_s)


def pinhole(depth):
    """(focal length, middle row, middle column) [pixels]: pixel [row, col] looks along (1, (middle_col - col)/f, (middle_row - row)/f)."""
    return 0.5 * depth.cols / math.tan(math.radians(0.5 * depth.fov_deg)), 0.5 * depth.rows - 0.5, 0.5 * depth.cols - 0.5


# ------------------------------------------------------------------------------------------------------------------------ beams


@ti.func
def range_error(range_m, sonar: Const[SonarConfig]):
    """[m] error that a return at this range may have: 3 sigma of its noise, jitter and quantum (data sheet)."""
    return 3.0 * (sonar.range_sigma_m + sonar.range_sigma_slope * range_m + sonar.range_jitter_m) + sonar.range_quantum_m


@ti.func
def beam_dir(yaw, ray, n_ray):
    """Horizontal unit vector of a beam (``yaw`` 0: in the body's frame)."""
    bearing = yaw + TWO_PI / n_ray * ray
    return ti.Vector([ti.cos(bearing), ti.sin(bearing)])


@ti.func
def wall_span(pos, unit, tank: Const[TankConfig]):
    """(enter, leave) [m] along a horizontal beam between the known side walls; leave < enter where it misses the tank."""
    span = ti.Vector([0.0, FAR_M])
    if ti.static(tank.shape == "circle"):
        off = pos - ti.Vector([0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1])])
        along = off.dot(unit)
        # distance of the line from the centre by a cross product: along^2 - off^2 would cancel badly
        inside = ti.static(tank.radius_m**2) - (off[0] * unit[1] - off[1] * unit[0]) ** 2
        half = ti.sqrt(ti.max(inside, 0.0))
        span = ti.Vector([ti.max(-along - half, 0.0), -along + half])
        if inside < 0.0:
            span = ti.Vector([0.0, -1.0])
    else:
        for axis in ti.static(range(2)):
            low, high = ti.static((tank.x_m, tank.y_m)[axis])
            inverse = 1.0 / (unit[axis] if ti.abs(unit[axis]) > 1e-9 else 1e-9)
            a, b = (low - pos[axis]) * inverse, (high - pos[axis]) * inverse
            span = ti.Vector([ti.max(span[0], ti.min(a, b)), ti.min(span[1], ti.max(a, b))])
    return span


@ti.func
def wall_gap(pos, tank: Const[TankConfig]):
    """[m] from a point to the nearest side wall, negative outside."""
    gap = 0.0
    if ti.static(tank.shape == "circle"):
        off = pos - ti.Vector([0.5 * (tank.x_m[0] + tank.x_m[1]), 0.5 * (tank.y_m[0] + tank.y_m[1])])
        gap = ti.static(tank.radius_m) - off.norm()
    else:
        gap = ti.min(pos[0] - tank.x_m[0], tank.x_m[1] - pos[0], pos[1] - tank.y_m[0], tank.y_m[1] - pos[1])
    return gap


# ------------------------------------------------------------------------------------------------------------------- free space


@ti.func
def free_reach(range_m, hit, sonar: Const[SonarConfig], mapping: Const[MappingConfig]):
    """[m] up to which a beam proves free water: one cell and one sigma before its return, ``free_range_m`` without one."""
    before = range_m - mapping.cell_m - (sonar.range_sigma_m + sonar.range_sigma_slope * range_m)
    return ti.select(hit == 1, before, ti.min(mapping.free_range_m, sonar.max_range_m))


@ti.func
def mark_free(env, pos, unit, enter, end, step, grid_map: Out[MapState], tank: Const[TankConfig], cell_m: Const[float]):
    """Free water along a beam: the cells under its samples enter + (k + 0.5) cell <= end, k = 0, 1, .., sixteen at a time."""
    x0, y0 = ti.static(grid_origin(tank, cell_m))
    col0 = (pos[0] - x0) / cell_m + unit[0] * (enter / cell_m)
    row0 = (pos[1] - y0) / cell_m + unit[1] * (enter / cell_m)
    last = ti.floor((end - enter) / cell_m - 0.5) + 0.5
    first = 0.5
    step16 = ti.cast(step, ti.i16)
    while first <= last:
        sample = f16x(0.0)
        for i in ti.static(range(LANES)):
            # lanes past the end repeat the last sample
            sample[i] = ti.min(first + i, last)
        rows, cols = i16x(0), i16x(0)
        for i in ti.static(range(LANES)):
            rows[i] = ti.cast(row0 + unit[1] * sample[i], ti.i32)
            cols[i] = ti.cast(col0 + unit[0] * sample[i], ti.i32)
        for i in ti.static(range(LANES)):
            grid_map.seen_step[env, rows[i], cols[i]] = step16
        first += float(LANES)


@ti.func
def mark_free_beams(
    env,
    group,
    step,
    grid_map: Out[MapState],
    scan: In[SonarScan],
    mapping: Const[MappingConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
):
    """Free space of sixteen neighbouring beams."""
    n_ray = ti.static(scan.range_m.shape[1])
    pos = ti.Vector([scan.ping_pos_w[env][0], scan.ping_pos_w[env][1]])
    for ray in range(group * LANES, (group + 1) * LANES):
        unit = beam_dir(scan.ping_yaw[env], ray, n_ray)
        span = wall_span(pos, unit, tank)
        reach = free_reach(scan.range_m[env, ray], scan.hit[env, ray], sonar, mapping)
        # a millimetre short of the wall, so that rounding cannot leave the tank's own cells
        mark_free(env, pos, unit, span[0], ti.min(reach, span[1] - 1e-3), step, grid_map, tank, mapping.cell_m)


# ------------------------------------------------------------------------------------------------------------------------- hits


@ti.func
def moves_by_doppler(env, ray, unit_b, scan: In[SonarScan], threshold: Const[float]):
    """1 where the return moves through the water along the beam: measured rate of range plus own velocity along the beam."""
    vel = scan.ping_vel_b[env]
    through_water = scan.doppler_m_s[env, ray] + vel[0] * unit_b[0] + vel[1] * unit_b[1]
    return ti.cast(ti.abs(through_water) > threshold, ti.i32)


@ti.func
def moves_by_track(env, ray, tracks: In[TrackState]):
    """1 where the beam belongs to a track that is confirmed as moving."""
    track = tracks.beam_track[env, ray]
    moving = 0
    if track >= 0:
        moving = tracks.moving[env, track]
    return moving


@ti.func
def edge_of_static(env, row, col, reach, grid_map: In[MapState], occupied: Const[float]):
    """1 where a cell within ``reach`` cells (square) is statically occupied."""
    n_row, n_col = ti.static(grid_map.static_occ.shape[1:])
    found = 0
    for r in range(ti.max(row - reach, 0), ti.min(row + reach + 1, n_row)):
        for c in range(ti.max(col - reach, 0), ti.min(col + reach + 1, n_col)):
            if grid_map.static_occ[env, r, c] >= occupied:
                found = 1
    return found


@ti.func
def is_inconsistent(
    env,
    row,
    col,
    range_m,
    grid_map: In[MapState],
    mapping: Const[MappingConfig],
    sonar: Const[SonarConfig],
    confident_scans: Const[int],
    promote_scans: Const[int],
):
    """1 where a return contradicts a cell that was confidently free, or one that such evidence holds and has not yet promoted.

    The edge of a static body does this too: range noise and the gap between beams move its returns into cells that other beams
    cleared. So nothing counts near a statically occupied cell: within one cell plus beam spacing plus range error.
    """
    confident = ti.cast(grid_map.free_scans[env, row, col], ti.i32) >= confident_scans
    held = ti.cast(grid_map.dynamic_scans[env, row, col], ti.i32)
    inconsistent = 0
    if confident or (held > 0 and held < promote_scans):
        spacing = ti.static(TWO_PI / sonar.n_ray) * range_m
        reach = 1 + ti.cast((spacing + range_error(range_m, sonar)) / mapping.cell_m, ti.i32)
        inconsistent = 1 - edge_of_static(env, row, col, ti.min(reach, _MAX_REACH), grid_map, mapping.occupied)
    return inconsistent


@ti.func
def mark_hits(
    env,
    grid_map: Out[MapState],
    scan: In[SonarScan],
    tracks: In[TrackState],
    mask: In[GridMask],
    mapping: Const[MappingConfig],
    sonar: Const[SonarConfig],
    tank: Const[TankConfig],
    confident_scans: Const[int],
    promote_scans: Const[int],
):
    """Bit of every return's cell: what moves is DYNAMIC_HIT only, the rest STATIC_HIT; returns from known walls are left out."""
    n_ray = ti.static(scan.range_m.shape[1])
    threshold = ti.static(doppler_threshold(mapping, sonar))
    pos = ti.Vector([scan.ping_pos_w[env][0], scan.ping_pos_w[env][1]])
    for ray in range(n_ray):
        if scan.hit[env, ray] == 1:
            range_m = scan.range_m[env, ray]
            unit_b = beam_dir(0.0, ray, n_ray)
            unit = turned_z(unit_b, scan.ping_yaw[env])
            point = pos + unit * range_m
            if wall_gap(point, tank) >= mapping.wall_margin_m:
                # noise along a slanting beam reaches deeper into the tank than the margin
                if range_m <= wall_span(pos, unit, tank)[1] - range_error(range_m, sonar):
                    cell = cell_of(point, tank, mapping.cell_m)
                    moves = moves_by_doppler(env, ray, unit_b, scan, threshold) | moves_by_track(env, ray, tracks)
                    if moves == 0:
                        moves = is_inconsistent(env, cell[0], cell[1], range_m, grid_map, mapping, sonar, confident_scans, promote_scans)
                    mark_bit(env, cell, ti.select(moves == 1, DYNAMIC_HIT, STATIC_HIT), grid_map, mask)


@ti.func
def mark_bit(env, cell, bit, grid_map: Out[MapState], mask: In[GridMask]):
    """Set a bit of a cell's evidence, unless the cell is outside the tank or off the grid."""
    n_row, n_col = ti.static(grid_map.evidence.shape[1:])
    if cell[0] >= 0 and cell[0] < n_row and cell[1] >= 0 and cell[1] < n_col:
        if mask.outside[cell[0], cell[1]] == 0:
            old = ti.cast(grid_map.evidence[env, cell[0], cell[1]], ti.i32)
            grid_map.evidence[env, cell[0], cell[1]] = ti.cast(old | bit, ti.u8)


# ------------------------------------------------------------------------------------------------------------------------ depth


@ti.func
def nearest_in_gate(env, first_col, image: In[DepthImage], R_wb, depth: Const[DepthConfig], gate_m: Const[float]):
    """Per image column, sixteen of them: smallest depth [m] whose point lies within ``gate_m`` of the vehicle's own depth, and its row."""
    focal, middle_row, middle_col = ti.static(pinhole(depth))
    left = (middle_col - ramp_lanes(float(first_col))) / focal
    mount = R_wb[2, 0] * depth.offset_b_m[0] + R_wb[2, 1] * depth.offset_b_m[1] + R_wb[2, 2] * depth.offset_b_m[2]
    nearest, nearest_row = f16x(FAR_M), i16x(0)
    for row in range(ti.static(image.depth_m.shape[1])):
        z = f16x(0.0)
        for i in ti.static(range(LANES)):
            z[i] = image.depth_m[env, row, first_col + i]
        climb = R_wb[2, 0] + R_wb[2, 2] * (middle_row - row) / focal + R_wb[2, 1] * left
        rise = mount + z * climb
        for i in ti.static(range(LANES)):
            seen = (ti.abs(rise[i]) <= gate_m) & (z[i] < ti.static(depth.max_range_m * _NO_RETURN_SHARE)) & (z[i] > 0.0)
            nearer = seen & (z[i] < nearest[i])
            nearest[i] = ti.select(nearer, z[i], nearest[i])
            nearest_row[i] = ti.select(nearer, row, nearest_row[i])
    return nearest, nearest_row


@ti.func
def mark_depth(
    env,
    grid_map: Out[MapState],
    image: In[DepthImage],
    mask: In[GridMask],
    mapping: Const[MappingConfig],
    depth: Const[DepthConfig],
    tank: Const[TankConfig],
):
    """DEPTH_HIT in the cell of the nearest point at the vehicle's own depth, per image column; it waits there for the next merge."""
    focal, middle_row, middle_col = ti.static(pinhole(depth))
    rpy = image.shot_rpy[env]
    R_wb = rotation_wb(quaternion_wb(rpy[0], rpy[1], rpy[2]))
    offset = ti.Vector([depth.offset_b_m[0], depth.offset_b_m[1], depth.offset_b_m[2]])
    for packet in range(ti.static(image.depth_m.shape[2] // LANES)):
        nearest, nearest_row = nearest_in_gate(env, packet * LANES, image, R_wb, depth, mapping.depth_gate_m)
        for i in range(LANES):
            if nearest[i] < FAR_M:
                ray_b = ti.Vector([1.0, (middle_col - packet * LANES - i) / focal, (middle_row - nearest_row[i]) / focal])
                point = image.shot_pos_w[env] + R_wb @ (offset + nearest[i] * ray_b)
                mark_bit(env, cell_of(point, tank, mapping.cell_m), DEPTH_HIT, grid_map, mask)
