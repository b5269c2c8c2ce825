"""Recompute what a log claims, from the log alone: ``python log_alone.py episode.mcap`` prints how far its
figures are from ours.

Written from scenario.json's ``formulas`` and config.yaml as an outsider would, in float64; it knows the file
and nothing of uuvtai.
"""

import base64
import json
import math
import sys
from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import yaml
from mcap.reader import make_reader
from scipy.ndimage import distance_transform_edt


class Log:
    """Metadata, attachments, and the messages of every topic as (log time [ns], content)."""

    def __init__(self, path):
        self.messages = defaultdict(list)
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True)
            self.metadata = {record.name: record.metadata for record in reader.iter_metadata()}
            attachments = {record.name: record.data for record in reader.iter_attachments()}
            for _, channel, message in reader.iter_messages():
                self.messages[channel.topic].append(
                    (message.log_time, json.loads(message.data, parse_constant=refuse))
                )
        self.config_text = attachments["config.yaml"]
        self.config = yaml.safe_load(self.config_text)
        self.scenario = json.loads(attachments["scenario.json"])
        self.dt = self.scenario["control_dt_s"]

    def step(self, time_ns):
        return round(time_ns * 1e-9 / self.dt)

    def stamp_step(self, data):
        """Control step of a message's own timestamp."""
        return self.step(data["timestamp"]["sec"] * 1_000_000_000 + data["timestamp"]["nsec"])

    def column(self, topic, key):
        """One field of every message as an array."""
        return np.array([data[key] for _, data in self.messages[topic]], float)

    def steps(self, topic):
        """Control steps at which a topic was logged."""
        return [self.step(time) for time, _ in self.messages[topic]]


def refuse(name):
    """For numbers that JSON does not have."""
    raise ValueError(f"{name} is not a finite number")


# ------------------------------------------------------------------------------------------------------ truth


def rotations(quat):
    """Body to world (n, 3, 3) of unit quaternions (n, 4) w, x, y, z."""
    w, x, y, z = np.moveaxis(np.asarray(quat, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def vehicle(log):
    """Truth at every control step: position, R (body to world), velocity and rates in world axes."""
    R = rotations(log.column("/state", "orientation"))
    vel, rates = (np.einsum("tij,tj->ti", R, log.column("/state", key)) for key in ("velocity", "rates"))
    return SimpleNamespace(pos=log.column("/state", "position"), R=R, vel=vel, rates=rates)


def obstacle_motion(body, times):
    """(positions, velocities), each (n, 3), of an obstacle at these times."""
    pos, vel = np.tile(np.array(body["position"], float), (len(times), 1)), np.zeros((len(times), 3))
    path = body["path"]
    if path is None:
        return pos, vel
    arc = (path["phase_m"] + path["speed_m_s"] * times) % path["length_m"]
    if path["shape"] == "circle":
        radius, angle = path["radius_m"], arc / path["radius_m"]
        pos[:, 0] = path["center"][0] + abs(radius) * np.cos(angle)
        pos[:, 1] = path["center"][1] + abs(radius) * np.sin(angle)
        turn = math.copysign(path["speed_m_s"], radius)
        vel[:, 0], vel[:, 1] = -turn * np.sin(angle), turn * np.cos(angle)
        return pos, vel
    corners = np.array(path["corners"] + path["corners"][:1], float)
    legs = np.diff(corners, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    ends = np.cumsum(lengths)
    leg = np.minimum(np.searchsorted(ends, arc, side="right"), len(legs) - 1)
    along = arc - (ends - lengths)[leg]
    unit = legs / lengths[:, None]
    pos[:, :2] = corners[leg] + along[:, None] * unit[leg]
    vel[:, :2] = path["speed_m_s"] * unit[leg]
    turns, easing = unit - np.roll(unit, 1, axis=0), path.get("easing_m", 1e-9)
    for corner, away, sign in ((leg, along, -1), ((leg + 1) % len(legs), lengths[leg] - along, 1)):
        size = np.hypot(*turns[corner].T)[:, None]
        inside = np.maximum(easing * size / 2 - away[:, None], 0)
        pos[:, :2] += turns[corner] / size * inside**2 / (2 * easing)
        vel[:, :2] += sign * path["speed_m_s"] * turns[corner] / size * inside / easing
    return pos, vel


# ------------------------------------------------------------------------------------------------------ sonar


def wall_ranges(tank, x, y, ux, uy):
    """[m] from inside the tank to its side wall along horizontal unit vectors."""
    if tank["shape"] == "circle":
        x, y = x - sum(tank["x_m"]) / 2, y - sum(tank["y_m"]) / 2
        b = x * ux + y * uy
        return -b + np.sqrt(np.maximum(b * b - x * x - y * y + tank["radius_m"] ** 2, 0))
    with np.errstate(divide="ignore"):
        to_x = np.where(ux > 0, tank["x_m"][1] - x, tank["x_m"][0] - x) / ux
        to_y = np.where(uy > 0, tank["y_m"][1] - y, tank["y_m"][0] - y) / uy
    return np.minimum(to_x, to_y)


def outline_ranges(body, yaw, rel, slope, ux, uy):
    """[m] to the horizontal outline of an obstacle at ``rel`` (n, 3) from the sonar; inf = missed."""
    size, far = body["size"], np.hypot(rel[:, 0], rel[:, 1])
    if body["kind"] == "box":
        c, s = math.cos(yaw), math.sin(yaw)
        enter, leave = -np.inf, np.inf
        for axis_x, axis_y, half in ((c, s, size[0]), (-s, c, size[1])):
            middle = (rel[:, 0] * axis_x + rel[:, 1] * axis_y)[:, None]
            with np.errstate(divide="ignore"):
                one, other = (np.add(middle, side * half) / (ux * axis_x + uy * axis_y) for side in (-1, 1))
            enter = np.maximum(enter, np.minimum(one, other))
            leave = np.minimum(leave, np.maximum(one, other))
    else:
        squared = np.full(len(rel), size[0] ** 2)
        if body["kind"] == "sphere":
            squared = squared - np.maximum(np.abs(rel[:, 2]) - far * slope, 0) ** 2
        middle = rel[:, :1] * ux + rel[:, 1:2] * uy
        with np.errstate(invalid="ignore"):
            root = np.sqrt(middle**2 - (far**2 - squared)[:, None])
        enter, leave = middle - root, middle + root
    gap = 0 if body["kind"] == "sphere" else np.maximum(np.abs(rel[:, 2:]) - size[2], 0)
    with np.errstate(invalid="ignore"):
        return np.where((enter <= leave) & (enter > 0) & (gap <= enter * slope), enter, np.inf)


def recast(log):
    """Error-free (range, Doppler, whether what is met moves), each (n_scan, n_beam), of every logged scan."""
    scenario, sonar, truth = log.scenario, log.config["sensors"]["sonar"], vehicle(log)
    steps = np.array([log.stamp_step(data) for _, data in log.messages["/sonar/scan"]])
    pos, vel, R = truth.pos[steps], truth.vel[steps], truth.R[steps]
    bearing = (
        np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None] + 2 * np.pi * np.arange(sonar["n_ray"]) / sonar["n_ray"]
    )
    ux, uy = np.cos(bearing), np.sin(bearing)
    slope = math.tan(math.radians(sonar["vertical_half_aperture_deg"]))
    best, away = wall_ranges(scenario["tank"], pos[:, :1], pos[:, 1:2], ux, uy), np.zeros_like(ux)
    moves = np.zeros(ux.shape, bool)
    for body in scenario["obstacles"]:
        obstacle_pos, obstacle_vel = obstacle_motion(body, steps * log.dt)
        found = outline_ranges(body, body["yaw"], obstacle_pos - pos, slope, ux, uy)
        nearer = found < best
        best = np.where(nearer, found, best)
        moves = np.where(nearer, body["path"] is not None, moves)
        away = np.where(nearer, obstacle_vel[:, :1] * ux + obstacle_vel[:, 1:2] * uy, away)
    return best, away - vel[:, :1] * ux - vel[:, 1:2] * uy, moves


def sonar_figures(log, gate_m):
    """Residuals of returns within ``gate_m`` of the recast; others, wrong hits and misses are edges."""
    true_range, true_doppler, moves = recast(log)
    answer, hit = log.column("/sonar/scan", "ranges"), log.column("/sonar/scan", "intensities") > 0
    reach = log.config["sensors"]["sonar"]["max_range_m"]
    clear = np.abs(true_range - reach) > gate_m
    expected = true_range < reach
    error = answer - true_range
    fits = np.where(expected, hit & (np.abs(error) <= gate_m), ~hit)
    used = fits & expected & clear
    slip = (log.column("/sonar/doppler", "velocity") - true_doppler)[used]
    return {
        "beams": int(clear.sum()),
        "returns": int(used.sum()),
        "fitting_share": float(fits[clear].mean()),
        "no_return_is_max_range": bool(np.all(answer[~hit] == reach)),
        "range_mean_m": float(error[used].mean()),
        "range_sigma_m": float(error[used].std()),
        "range_within_2_mm": float(np.mean(np.abs(error[used]) <= 2e-3)),
        "range_max_m": float(np.abs(error[used]).max()),
        "doppler_mean_m_s": float(slip.mean()),
        "doppler_sigma_m_s": float(slip.std()),
        "doppler_within_1e_3": float(np.mean(np.abs(slip) <= 1e-3)),
        "returns_of_moving_obstacles": int(moves[used].sum()),
    }


# -------------------------------------------------------------------------------------------------------- map


def grid_values(data):
    """``value`` of every cell (n_row, n_col)."""
    offset = next(field["offset"] for field in data["fields"] if field["name"] == "value")
    raw = np.frombuffer(base64.b64decode(data["data"]), np.uint8).reshape(
        -1, data["column_count"], data["cell_stride"]
    )
    return np.ascontiguousarray(raw[:, :, offset : offset + 4]).view("<f4")[:, :, 0].astype(float)


def wall_gap(tank, x, y):
    """[m] to the nearest side wall, negative beyond it."""
    if tank["shape"] == "circle":
        return tank["radius_m"] - np.hypot(x - sum(tank["x_m"]) / 2, y - sum(tank["y_m"]) / 2)
    (x0, x1), (y0, y1) = tank["x_m"], tank["y_m"]
    return np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))


class Mapper:
    """The two-layer map, folded scan by scan from what the vehicle sensed."""

    def __init__(self, log):
        self.log, self.tank = log, log.scenario["tank"]
        self.m, self.sonar = log.config["mapping"], log.config["sensors"]["sonar"]
        self.depth = log.config["sensors"]["depth"]
        self.tracking = log.config["tracking"]
        first = log.messages["/map/static"][0][1]
        self.cell = first["cell_size"]["x"]
        self.origin = np.array([first["pose"]["position"][axis] for axis in "xy"])
        shape = grid_values(first).shape
        centre_y, centre_x = (
            (np.arange(n) + 0.5) * self.cell + low for n, low in zip(shape, self.origin[::-1], strict=True)
        )
        self.outside = wall_gap(self.tank, centre_x[None, :], centre_y[:, None]) < 0
        self.static, self.dynamic = np.zeros(shape), np.zeros(shape)
        self.free_scans, self.dynamic_scans = np.zeros(shape, int), np.zeros(shape, int)
        self.depth_mark = np.zeros(shape, bool)
        self.last_mapped = self.last_tracked = None
        scan_steps = self.sonar["period_steps"] * math.ceil(
            self.m["period_steps"] / self.sonar["period_steps"]
        )
        self.period = scan_steps * log.dt
        self.depth_period = max(self.period, self.depth["period_steps"] * log.dt)
        poses = log.messages["/pose_estimate"]
        self.pos = np.array([[data["pose"]["position"][axis] for axis in "xyz"] for _, data in poses])
        self.R = rotations([[data["pose"]["orientation"][axis] for axis in "wxyz"] for _, data in poses])

    def layers(self):
        """{step: (static, dynamic)} after every control step."""
        log, found = self.log, {}
        scans = {log.step(time): data for time, data in log.messages["/sonar/scan"]}
        dopplers = {log.step(time): data for time, data in log.messages["/sonar/doppler"]}
        tracked = {log.step(time): data["beams"] for time, data in log.messages["/tracks"]}
        lines = {log.step(time): data for time, data in log.messages["/camera/line"]}
        for step in range(len(self.pos)):
            if step in lines:
                self.mark_depth(lines[step])
            if step in scans and (
                self.last_tracked is None or step - self.last_tracked >= self.tracking["period_steps"]
            ):
                self.last_tracked = step
            if step in scans and (
                self.last_mapped is None or step - self.last_mapped >= self.m["period_steps"]
            ):
                self.fold(scans[step], dopplers[step], tracked.get(step, []))
                self.last_mapped = step
            found[step] = self.static, self.dynamic
        return found

    def cells(self, x, y):
        """(row, column) of points, and which of them lie in the tank's cells."""
        row, col = (
            np.floor((v - low) / self.cell).astype(int)
            for v, low in ((y, self.origin[1]), (x, self.origin[0]))
        )
        on = (row >= 0) & (row < self.outside.shape[0]) & (col >= 0) & (col < self.outside.shape[1])
        row, col = np.where(on, row, 0), np.where(on, col, 0)
        return row, col, on & ~self.outside[row, col]

    def mark_depth(self, line):
        step, d = self.log.stamp_step(line), self.depth
        column, row, z = (np.array(line[key], float) for key in ("column", "row", "depth"))
        focal = d["cols"] / 2 / math.tan(math.radians(d["fov_deg"] / 2))
        ray = np.stack(
            [np.ones_like(z), (d["cols"] / 2 - 0.5 - column) / focal, (d["rows"] / 2 - 0.5 - row) / focal],
            axis=-1,
        )
        point = self.pos[step] + (np.array(d["offset_b_m"]) + z[:, None] * ray) @ self.R[step].T
        row, col, counts = self.cells(point[:, 0], point[:, 1])
        self.depth_mark[row[counts], col[counts]] = True

    def fold(self, scan, doppler, tracked):
        """One mapped scan."""
        m, n = self.m, self.sonar["n_ray"]
        step = self.log.stamp_step(scan)
        angle = 2 * np.pi * np.arange(n) / n
        bearing = np.arctan2(self.R[step][1, 0], self.R[step][0, 0]) + angle
        beams = SimpleNamespace(
            range=np.array(scan["ranges"]),
            hit=np.array(scan["intensities"]) > 0,
            through=np.array(doppler["velocity"])
            + np.cos(angle) * doppler["own_velocity"][0]
            + np.sin(angle) * doppler["own_velocity"][1],
            tracked=np.isin(np.arange(n), tracked),
            ux=np.cos(bearing),
            uy=np.sin(bearing),
            x=self.pos[step][0],
            y=self.pos[step][1],
        )
        beams.wall = wall_ranges(self.tank, beams.x, beams.y, beams.ux, beams.uy)
        beams.sigma = self.sonar["range_sigma_m"] + self.sonar["range_sigma_slope"] * beams.range
        beams.spread = np.sqrt(
            beams.sigma**2 + self.sonar["range_jitter_m"] ** 2 + self.sonar["range_quantum_m"] ** 2 / 12
        )
        if self.last_tracked == step:  # a valid reading between tracked scans is taken as it is
            beams.through = beams.through - self.slip(beams)
        static_hit, moving_hit = self.returns(beams)
        hit = static_hit | moving_hit
        free = self.free_water(beams) & ~hit
        consistent = (static_hit | (self.static > 0)) & ~free & ~moving_hit & (self.dynamic < m["occupied"])
        rate, depth_rate = 10 * self.period, 10 * self.depth_period
        self.static = clipped(
            (1 - m["static_decay"]) ** rate * self.static
            + min(1, m["static_hit"] * rate) * static_hit
            - min(1, m["static_free"] * rate) * free
            + min(1, m["depth_hit"] * depth_rate) * (self.depth_mark & consistent)
        )
        self.dynamic = clipped(
            (1 - m["dynamic_decay"]) ** rate * self.dynamic
            + min(1, m["dynamic_hit"] * rate) * moving_hit
            - min(1, m["dynamic_free"] * rate) * free
        )
        self.free_scans = np.where(hit, 0, np.minimum(self.free_scans + free, 255))
        self.dynamic_scans = np.where(free, 0, np.minimum(self.dynamic_scans + moving_hit, 255))
        self.depth_mark = np.zeros_like(self.depth_mark)

    def slip(self, b):
        """[m/s] along every beam: the own velocity's error by which known walls move, under a prior."""
        near = (
            wall_gap(self.tank, b.x + b.range * b.ux, b.y + b.range * b.uy)
            < self.tracking["wall_margin_m"] + 2 * b.spread
        )
        wall, sigma = b.hit & near, max(self.sonar["doppler_sigma_m_s"], 0.01)
        u = np.stack([b.ux, b.uy], 1)
        prior = (sigma / self.tracking["own_speed_sigma_m_s"]) ** 2 * np.eye(2)
        return u @ np.linalg.solve(u[wall].T @ u[wall] + prior, u[wall].T @ b.through[wall])

    def free_water(self, b):
        silent = min(self.m["free_range_m"], self.sonar["max_range_m"])
        reach = np.maximum(np.where(b.hit, b.range - self.cell - b.sigma, silent), 0)
        legs, between = np.minimum(reach, np.roll(reach, -1)), 2 * np.pi / len(reach)
        y, x = (
            (np.arange(n) + 0.5) * self.cell + low
            for n, low in zip(self.outside.shape, self.origin[::-1], strict=True)
        )
        dx, dy = np.broadcast_arrays(x[None, :] - b.x, y[:, None] - b.y)
        beam = np.floor((np.arctan2(dy, dx) - math.atan2(b.uy[0], b.ux[0])) / between).astype(int) % len(
            reach
        )
        after = (beam + 1) % len(reach)
        # the far side of the triangle is at right angles to the line halfway between its beams
        ahead = (dx * (b.ux[beam] + b.ux[after]) + dy * (b.uy[beam] + b.uy[after])) / 2
        return (ahead < legs[beam] * math.cos(between / 2) ** 2) & ~self.outside

    def returns(self, b):
        """(cells with a return of what rests, cells with a return of what moves)."""
        m, s = self.m, self.sonar
        error = 3 * (b.sigma + s["range_jitter_m"]) + s["range_quantum_m"]
        x, y = b.x + b.range * b.ux, b.y + b.range * b.uy
        row, col, inside = self.cells(x, y)
        counts = (
            b.hit & inside & (wall_gap(self.tank, x, y) >= m["wall_margin_m"]) & (b.range <= b.wall - error)
        )
        moves = (np.abs(b.through) > max(m["doppler_evidence_m_s"], 3 * s["doppler_sigma_m_s"])) | b.tracked
        confident, promote = (
            math.ceil(m[key] / self.period - 1e-6) for key in ("free_confident_s", "promote_s")
        )
        against = (self.free_scans >= confident) | ((self.dynamic_scans > 0) & (self.dynamic_scans < promote))
        for i in np.flatnonzero(counts & ~moves & against[row, col]):
            reach = min(4, 1 + int((2 * math.pi / s["n_ray"] * b.range[i] + error[i]) / self.cell))
            near = self.static[
                max(row[i] - reach, 0) : row[i] + reach + 1, max(col[i] - reach, 0) : col[i] + reach + 1
            ]
            moves[i] = not np.any(near >= m["occupied"])
        static_hit, moving_hit = np.zeros_like(self.outside), np.zeros_like(self.outside)
        static_hit[row[counts & ~moves], col[counts & ~moves]] = True
        moving_hit[row[counts & moves], col[counts & moves]] = True
        return static_hit, moving_hit

    def clearance(self, static, dynamic):
        """[m] of every cell."""
        layer = np.maximum(static, dynamic) if self.log.config["voronoi"]["use"] == "fused" else static
        distance = distance_transform_edt(~((layer >= self.m["occupied"]) | self.outside)) * self.cell
        return np.minimum(distance, self.log.config["clearance"]["max_m"])


def clipped(values):
    return np.floor(np.clip(values, 0.0, 1.0) * 65535) / 65535  # a layer keeps two bytes


def map_figures(log, same):
    """Both layers redone from the scans, at every logged grid; cells within ``same`` agree."""
    mapper = Mapper(log)
    redone = mapper.layers()
    found = {}
    for name, i in (("static", 0), ("dynamic", 1)):
        grids = [(log.step(time), grid_values(data)) for time, data in log.messages[f"/map/{name}"]]
        wrong = [np.abs(values - redone[step][i]) > same for step, values in grids]
        touched = [(values > 0) | (redone[step][i] > 0) for step, values in grids]
        sides = [
            (values >= mapper.m["occupied"]) != (redone[step][i] >= mapper.m["occupied"])
            for step, values in grids
        ]
        found[name] = {
            "grids": len(grids),
            "touched_cells": int(np.sum(touched)),
            "occupied_cells": int(np.sum([values >= mapper.m["occupied"] for _, values in grids])),
            "agreeing_share_of_touched": float(1 - np.sum(wrong) / max(np.sum(touched), 1)),
            "cells_on_the_other_side_of_occupied": int(np.sum(sides)),
        }
    found["clearance"] = clearance_figures(log, mapper, redone)
    found["depth_points"] = sum(len(data["column"]) for _, data in log.messages["/camera/line"])
    found["tracked_beams"] = sum(len(data["beams"]) for _, data in log.messages["/tracks"])
    return found


def clearance_figures(log, mapper, redone):
    """/map/clearance against the distance transform of the logged map of its time and of the redone one."""
    layers = zip(log.messages["/map/static"], log.messages["/map/dynamic"], strict=True)
    maps = {log.step(time): (grid_values(data), grid_values(other)) for (time, data), (_, other) in layers}
    worst, from_logged, other_sites, cells = 0.0, 0, 0, 0
    for _, data in log.messages["/map/clearance"]:
        step, answer = log.stamp_step(data), grid_values(data)
        if step in maps:
            from_logged += 1
            worst = max(worst, float(np.abs(answer - mapper.clearance(*maps[step])).max()))
        cells += answer.size
        other_sites += int(np.sum(np.abs(answer - mapper.clearance(*redone[step])) > 1e-5))
    c = log.config["clearance"]
    risk = [
        grid_values(risk)
        - (
            c["risk_static"] * static
            + c["risk_dynamic"] * dynamic
            + c["risk_clearance"] / (answer + c["risk_epsilon_m"])
        )
        for (_, risk), (_, near), (static, dynamic) in zip(
            log.messages["/map/risk"], log.messages["/map/clearance"], maps.values(), strict=True
        )
        for answer in [grid_values(near)]
    ]
    return {
        "grids": len(log.messages["/map/clearance"]),
        "grids_with_their_map": from_logged,
        "max_error_m": worst,
        "agreeing_share_from_scans": 1 - other_sites / cells,
        "risk_max_error": float(np.abs(risk).max()),
    }


# ----------------------------------------------------------------------------------------------------- camera


def camera_figures(log, same_m):
    """Pixels of every third image against the depth at which a ray marched through the true world hits."""
    truth, depth = vehicle(log), log.config["sensors"]["depth"]
    focal = depth["cols"] / 2 / math.tan(math.radians(depth["fov_deg"] / 2))
    error, rise = [], []
    for _, line in log.messages["/camera/line"][::3]:
        step = log.stamp_step(line)
        column, row, z = (np.array(line[key], float) for key in ("column", "row", "depth"))
        ray = np.stack(
            [
                np.ones_like(z),
                (depth["cols"] / 2 - 0.5 - column) / focal,
                (depth["rows"] / 2 - 0.5 - row) / focal,
            ],
            axis=-1,
        )
        length = np.linalg.norm(ray, axis=1)
        eye = truth.R[step] @ np.array(depth["offset_b_m"])
        ray = ray @ truth.R[step].T
        error.append(z - marched(log, truth.pos[step] + eye, ray / length[:, None], step * log.dt) / length)
        rise.append(eye[2] + z * ray[:, 2])
    error = np.concatenate(error)
    return {
        "pixels": len(error),
        "share_within": float(np.mean(np.abs(error) <= same_m)),
        "mean_m": float(error.mean()),
        "gate_overrun_m": float(np.max(np.abs(np.concatenate(rise))) - log.config["mapping"]["depth_gate_m"]),
    }


def marched(log, start, unit, time):
    """[m] along unit vectors to the nearest obstacle or side wall: as far as nothing can be, repeatedly."""
    along = np.zeros(len(unit))
    obstacles = [(body, obstacle_motion(body, np.array([time]))[0][0]) for body in log.scenario["obstacles"]]
    for _ in range(100):
        point = start + along[:, None] * unit
        room = wall_gap(log.scenario["tank"], point[:, 0], point[:, 1])
        for body, pos in obstacles:
            room = np.minimum(room, core_distance(body, (point - pos) @ own_axes(body).T))
        along = along + room
    return along


# ----------------------------------------------------------------------------------------------------- safety


def own_axes(body):
    """World to the body's own axes (3, 3)."""
    c, s = math.cos(body["yaw"]), math.sin(body["yaw"])
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) if body["kind"] == "box" else np.eye(3)


def core_distance(body, q):
    """[m] from points (n, 3), in the body's own axes, to the solid."""
    size = np.array(body["size"])
    if body["kind"] == "sphere":
        return np.linalg.norm(q, axis=1) - size[0]
    if body["kind"] == "box":
        return np.linalg.norm(np.maximum(np.abs(q) - size, 0), axis=1)
    return np.hypot(
        np.maximum(np.hypot(q[:, 0], q[:, 1]) - size[0], 0), np.maximum(np.abs(q[:, 2]) - size[2], 0)
    )


def hull_distance(hull, body, rel, axis):
    """[m] from hull to obstacle; rel (n, 3) = hull's centre from the body's. Ternary search on its axis."""
    rel, axis = rel @ own_axes(body).T, axis @ own_axes(body).T
    low, high = np.full(len(rel), -hull["hull_half_length_m"]), np.full(len(rel), hull["hull_half_length_m"])
    for _ in range(40):
        a, b = low + (high - low) / 3, high - (high - low) / 3
        falls = core_distance(body, rel + a[:, None] * axis) > core_distance(body, rel + b[:, None] * axis)
        low, high = np.where(falls, a, low), np.where(falls, high, b)
    return core_distance(body, rel + (0.5 * (low + high))[:, None] * axis) - hull["hull_radius_m"]


def threats(log):
    """(clearance [m], time to collision [s] with inf = none, whether a closing speed is at its threshold)."""
    truth, hull, rules = vehicle(log), log.config["vehicle"], log.config["episode"]
    times = np.arange(len(truth.pos)) * log.dt
    axis, spin = truth.R[:, :, 0], np.cross(truth.rates, truth.R[:, :, 0])
    half = hull["hull_half_length_m"] * axis
    ends = np.stack([wall_gap(log.scenario["tank"], *(truth.pos + side * half).T[:2]) for side in (-1, 1)])
    clearance = ends.min(axis=0) - hull["hull_radius_m"]
    ttc, doubtful = np.full(len(times), np.inf), np.zeros(len(times), bool)
    for body in log.scenario["obstacles"]:
        pos, vel = obstacle_motion(body, times)
        rel, drift = truth.pos - pos, truth.vel - vel
        gap = hull_distance(hull, body, rel, axis)
        # a little later and a little earlier along the present motion: no formula for nearest points or
        # normals
        blink = 1e-5
        later, earlier = (
            hull_distance(hull, body, rel + t * drift, axis + t * spin) for t in (blink, -blink)
        )
        closing = (earlier - later) / (2 * blink)
        clearance = np.minimum(clearance, gap)
        closes = closing > rules["ttc_closing_m_s"]
        ttc = np.where(closes, np.minimum(ttc, np.maximum(gap, 0) / np.where(closes, closing, 1)), ttc)
        doubtful |= np.abs(closing - rules["ttc_closing_m_s"]) < 1e-4
    return clearance, ttc, doubtful


def outcome(log, clearance, ttc):
    """(name, step) of the first rule that holds."""
    truth, tank, hull, rules = (
        vehicle(log), log.scenario["tank"], log.config["vehicle"], log.config["episode"],
    )  # fmt: skip
    z_low, z_high = tank["z_m"]
    for step in range(1, len(truth.pos)):
        x, y, z = truth.pos[step]
        lift = hull["hull_half_length_m"] * abs(truth.R[step, 2, 0]) + hull["hull_radius_m"]
        if wall_gap(tank, x, y) < 0 or not z_low <= z <= z_high:
            return "out_of_tank", step
        if clearance[step] < rules["collision_clearance_m"] or min(z - z_low, z_high - z) < lift:
            return "collision", step
        if ttc[step] < rules["ttc_s"]:
            return "ttc", step
        if np.linalg.norm(truth.pos[step] - log.scenario["goal"]) <= rules["goal_radius_m"]:
            return "success", step
        if step >= rules["horizon_steps"]:
            return "timeout", step
    return "running", len(truth.pos) - 1


def safety_figures(log):
    clearance, ttc, doubtful = threats(log)
    answer = [data for _, data in log.messages["/safety"]]
    told_ttc = np.array([np.inf if data["ttc_s"] is None else data["ttc_s"] for data in answer])
    both = np.isfinite(told_ttc) & np.isfinite(ttc) & ~doubtful
    name, step = outcome(log, clearance, ttc)
    result = log.metadata["uuv.result"]
    return {
        "steps": len(answer),
        "clearance_max_error_m": float(np.abs(clearance - [data["clearance_m"] for data in answer]).max()),
        "min_clearance_error_m": abs(float(clearance.min()) - float(result["min_clearance_m"])),
        "ttc_compared": int(both.sum()),
        "ttc_max_relative_error": float(np.max(np.abs(ttc / told_ttc - 1)[both], initial=0.0)),
        "ttc_null_disagrees": int(np.sum((np.isfinite(told_ttc) != np.isfinite(ttc)) & ~doubtful)),
        "ttc_doubtful": int(doubtful.sum()),
        "outcome": name,
        "outcome_told": result["outcome"],
        "ends_at_the_last_step": step == len(answer) - 1,
        "time_error_s": abs(step * log.dt - float(result["time_s"])),
    }


def obstacle_error(log):
    """[m] and [m/s]: largest difference between /obstacles/truth and the closed form."""
    place, speed = 0.0, 0.0
    times = np.array(log.steps("/obstacles/truth")) * log.dt
    for i, body in enumerate(log.scenario["obstacles"]):
        pos, vel = obstacle_motion(body, times)
        answer = np.array(
            [
                [data["obstacles"][i][key] for key in ("x", "y", "z", "vx", "vy", "vz")]
                for _, data in log.messages["/obstacles/truth"]
            ]
        )
        place = max(place, float(np.abs(answer[:, :3] - pos).max()))
        # at a corner of a path either direction is right
        speed = max(speed, float(np.sort(np.abs(answer[:, 3:] - vel).max(axis=1))[-2]))
    return {"position_m": place, "velocity_m_s": speed}


def figures(log, gate_m=0.15, same=1e-3):
    """Every comparison with what the log says."""
    return {
        "sonar": sonar_figures(log, gate_m), "camera": camera_figures(log, 2e-3),
        "map": map_figures(log, same), "safety": safety_figures(log), "obstacles": obstacle_error(log),
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(figures(Log(sys.argv[1])), indent=1))
