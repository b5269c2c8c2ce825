"""NumPy float64 oracle of one map update: sectors between beams, returns beam by beam, and the paper's
equations.

Where float32 may rightly land in the other cell (a point within ``DOUBT`` of a cell's edge, a comparison
within ``DOUBT`` of its threshold), the cells concerned are reported as doubtful, so that a test can leave out
exactly those.
"""

import math

import numpy as np

from uuvtai.kernels.core.grid import grid_origin, outside_cells

DOUBT = 3e-4
"""[cells, or the threshold's own unit] float32 positions of tens of metres are good to 1e-5 m = 1e-4 cells;
with a margin."""

STATIC, DYNAMIC, DEPTH = 1, 2, 4


class MapOracle:
    """Constants of one configuration."""

    def __init__(self, mapping, sonar, depth, tank, episode):
        self.m, self.sonar, self.depth, self.tank = mapping, sonar, depth, tank
        self.cell = mapping.cell_m
        self.origin = np.array(grid_origin(tank, self.cell))
        self.outside = np.array(outside_cells(tank, self.cell))
        steps = sonar.period_steps * math.ceil(mapping.period_steps / sonar.period_steps)
        self.rate = 10.0 * steps * episode.control_dt_s
        self.depth_rate = max(self.rate, 10.0 * depth.period_steps * episode.control_dt_s)
        self.confident = math.ceil(mapping.free_confident_s * 10 / self.rate - 1e-6)
        self.promote = math.ceil(mapping.promote_s * 10 / self.rate - 1e-6)
        self.threshold = max(mapping.doppler_evidence_m_s, 3 * sonar.doppler_sigma_m_s)

    # -- geometry

    def gap(self, p):
        """Distance of a point from the nearest wall, negative outside."""
        t = self.tank
        if t.shape == "circle":
            return t.radius_m - math.hypot(p[0] - sum(t.x_m) / 2, p[1] - sum(t.y_m) / 2)
        return min(p[0] - t.x_m[0], t.x_m[1] - p[0], p[1] - t.y_m[0], t.y_m[1] - p[1])

    def wall_range(self, pos, unit):
        """Range of the wall along a beam from inside, by bisection of ``gap``: no formula of the kernel's."""
        low, high = 0.0, 100.0
        for _ in range(80):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.gap(pos + middle * unit) > 0 else (low, middle)
        return low

    def cells(self, p):
        """(cell of a point, every cell that float32 might take for it)."""
        exact = (np.asarray(p)[:2] - self.origin) / self.cell
        options = {
            (math.floor(exact[1] + dy), math.floor(exact[0] + dx))
            for dy in (-DOUBT, DOUBT)
            for dx in (-DOUBT, DOUBT)
        }
        return (math.floor(exact[1]), math.floor(exact[0])), options

    def error(self, r):
        s = self.sonar
        return 3 * (s.range_sigma_m + s.range_sigma_slope * r + s.range_jitter_m) + s.range_quantum_m

    # -- evidence

    def reach(self, r, hit):
        """[cells] up to which a beam proves free water."""
        s = self.sonar
        proved = (
            r - self.cell - (s.range_sigma_m + s.range_sigma_slope * r)
            if hit
            else min(self.m.free_range_m, s.max_range_m)
        )
        return max(proved, 0.0) / self.cell

    def free_water(self, pos, yaw, scan, doubtful):
        """Cells in the triangle between two neighbouring beams, both as long as the smaller reach."""
        reach = np.array(
            [self.reach(float(r), hit) for r, hit in zip(scan["range"], scan["hit"], strict=True)]
        )
        legs, between = np.minimum(reach, np.roll(reach, -1)), 2 * math.pi / self.sonar.n_ray
        row, col = np.indices(self.outside.shape)
        x, y = (
            index + 0.5 - (pos[axis] - self.origin[axis]) / self.cell for axis, index in ((0, col), (1, row))
        )
        sector = (np.arctan2(y, x) - yaw) / between
        slack = DOUBT / np.maximum(np.hypot(x, y), 1e-9) / between

        def depth(of):
            """How far inside its triangle's far side each centre lies."""
            number = np.floor(of).astype(int)
            middle = yaw + (number + 0.5) * between
            return legs[number % len(legs)] * math.cos(between / 2) - (
                x * np.cos(middle) + y * np.sin(middle)
            )

        free = depth(sector) > 0
        for shifted in (sector - slack, sector, sector + slack):
            unsure = (np.abs(depth(shifted)) < DOUBT) | ((depth(shifted) > 0) != free)
            doubtful.update((int(r), int(c)) for r, c in np.argwhere(unsure))
        return free & ~self.outside

    def near_static(self, static, cell, r):
        """(a statically occupied cell is within reach of this return, the reach is doubtful)."""
        extent = (2 * math.pi / self.sonar.n_ray * r + self.error(r)) / self.cell
        reach = min(4, 1 + int(extent))
        near = static[
            max(0, cell[0] - reach) : cell[0] + reach + 1, max(0, cell[1] - reach) : cell[1] + reach + 1
        ]
        return bool((near >= self.m.occupied).any()), abs(extent - round(extent)) < DOUBT and reach < 4

    def own_motion(self, scan, yaw):
        """(own velocity ahead and left, Doppler that counts as motion): the reading, mended by what the walls
        told the tracking.

        ``walls``: None = this scan was not tracked and the one before told nothing; else (error in the world,
        sigma left, same scan?).
        """
        own, threshold = np.array(scan["vel"][:2], float), self.threshold
        if scan.get("walls") is None:
            return own, threshold
        error, sigma, same = scan["walls"]
        held = not scan.get("valid", True)
        if held or same:
            c, s = math.cos(yaw), math.sin(yaw)
            own = own - np.array([[c, s], [-s, c]]) @ np.asarray(error, float)
        if held:
            threshold = max(threshold, 3 * math.hypot(self.sonar.doppler_sigma_m_s, sigma))
        return own, threshold

    def hit_of(self, pos, yaw, ray, scan, tracked, state, doubtful):
        """(cell, bit) of a return, or None."""
        n_ray, r = self.sonar.n_ray, float(scan["range"][ray])
        angle = 2 * math.pi * ray / n_ray
        unit = np.array([math.cos(yaw + angle), math.sin(yaw + angle)])
        point = pos[:2] + r * unit
        gap, wall = self.gap(point) - self.m.wall_margin_m, self.wall_range(pos[:2], unit) - self.error(r) - r
        cell, options = self.cells(point)
        own, threshold = self.own_motion(scan, float(yaw))
        through_water = scan["doppler"][ray] + own[0] * math.cos(angle) + own[1] * math.sin(angle)
        moves = abs(through_water) > threshold or tracked
        unsure = (
            len(options) > 1
            or min(abs(gap), abs(wall)) < DOUBT
            or (not tracked and abs(abs(through_water) - threshold) < DOUBT)
        )
        if gap < -DOUBT or wall < -DOUBT or self.outside[cell]:
            return None
        held = 0 < state["dynamic_scans"][cell] < self.promote
        if not moves and (held or state["free_scans"][cell] >= self.confident):
            near, doubt = self.near_static(state["static"], cell, r)
            moves, unsure = not near, unsure or doubt
        if unsure:
            doubtful.update(options)
            return None
        return cell, DYNAMIC if moves else STATIC

    def depth_cells(self, image, pos, rpy, doubtful):
        """Cells of the nearest point at the vehicle's own depth, per image column."""
        d = self.depth
        focal = 0.5 * d.cols / math.tan(math.radians(d.fov_deg / 2))
        R = rotation(*rpy)
        cells = set()
        for col in range(d.cols):
            best, unsure = None, set()
            for row in range(d.rows):
                z = float(image[row, col])
                offset_b = np.array(d.offset_b_m) + z * np.array(
                    [1, (d.cols / 2 - col - 0.5) / focal, (d.rows / 2 - row - 0.5) / focal]
                )
                point = R @ offset_b
                cell, options = self.cells(pos + point)
                if 0 < z < 0.999 * d.max_range_m and abs(point[2]) <= self.m.depth_gate_m + DOUBT:
                    if abs(point[2]) >= self.m.depth_gate_m - DOUBT or len(options) > 1:
                        unsure |= options
                    if best is None or z < best[0]:
                        best = (z, cell, options)
            if best and not unsure:
                cells.add(best[1])
            elif best:
                doubtful.update(unsure | best[2])
        return {
            c
            for c in cells
            if 0 <= c[0] < self.outside.shape[0] and 0 <= c[1] < self.outside.shape[1] and not self.outside[c]
        }

    # -- update

    def update(self, state, scan, image=None):
        """(new state, doubtful mask) after one fresh scan, and an image that arrived with it."""
        shape, doubtful = state["static"].shape, set()
        bits = state["depth_hit"] * DEPTH
        pos, yaw = scan["pos"].astype(float), float(scan["yaw"])
        free = self.free_water(pos[:2], yaw, scan, doubtful)
        for ray in range(self.sonar.n_ray):
            if scan["hit"][ray]:
                found = self.hit_of(pos, yaw, ray, scan, scan["tracked"][ray], state, doubtful)
                if found:
                    bits[found[0]] |= found[1]
        if image is not None:
            for cell in self.depth_cells(
                image["depth"], image["pos"].astype(float), image["rpy"].astype(float), doubtful
            ):
                bits[cell] |= DEPTH
        mask = np.zeros(shape, bool)
        for cell in doubtful:
            if 0 <= cell[0] < shape[0] and 0 <= cell[1] < shape[1]:
                mask[cell] = True
        return self.merged(state, free, bits), mask

    def merged(self, state, free, bits):
        """The paper's two equations, and the counters."""
        m = self.m
        s_hit, d_hit = (bits & STATIC) > 0, (bits & DYNAMIC) > 0
        free = free & ~s_hit & ~d_hit
        consistent = ((state["static"] > 0) | s_hit) & ~free & ~d_hit & (state["dynamic"] < m.occupied)
        static = (
            (1 - m.static_decay) ** self.rate * state["static"]
            + min(1, m.static_hit * self.rate) * s_hit
            - min(1, m.static_free * self.rate) * free
            + min(1, m.depth_hit * self.depth_rate) * (((bits & DEPTH) > 0) & consistent)
        )
        dynamic = (
            (1 - m.dynamic_decay) ** self.rate * state["dynamic"]
            + min(1, m.dynamic_hit * self.rate) * d_hit
            - min(1, m.dynamic_free * self.rate) * free
        )
        hit = s_hit | d_hit
        return {
            "static": np.floor(np.clip(static, 0, 1) * 65535) / 65535,
            "dynamic": np.floor(np.clip(dynamic, 0, 1) * 65535) / 65535,
            "depth_hit": np.zeros(free.shape, bool),
            "seen": state["seen"] | free | (bits > 0),
            "free_scans": np.where(
                hit, 0, np.minimum(self.confident, state["free_scans"].astype(int) + free)
            ),
            "dynamic_scans": np.where(free, 0, np.minimum(255, state["dynamic_scans"].astype(int) + d_hit)),
        }


def rotation(roll, pitch, yaw):
    """R_wb of yaw-pitch-roll angles."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return Rz @ Ry @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
