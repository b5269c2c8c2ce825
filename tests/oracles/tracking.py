"""NumPy float64 oracle of the tracking stage, one env at a time: full 5 x 5 covariances (x, y, vx, vy, turn
rate) in Joseph's form, Jacobians by differences, greedy pairs by sorting.

Written from the description of the method, with the product's constants passed in or restated here.
"""

from dataclasses import dataclass, field

import numpy as np

ARC = np.pi / 4
CONFIRMED = 3
SPLIT_M, SPLIT_SLOPE, SPLIT_DOPPLER_M_S = 0.18, 0.03, 0.3
MOVING_M_S, MOVING_DOPPLER_M_S, SIGHT_DOPPLER_M_S = 0.08, 0.03, 0.2
MOVING_SHIFT_M, SHIFT_S, SHIFT_MEMORY_S, DOPPLER_MEMORY_S = 0.12, 0.5, 2.0, 0.5


@dataclass
class Scan:
    range_m: np.ndarray
    doppler: np.ndarray
    hit: np.ndarray
    pos: np.ndarray
    yaw: float
    vel_b: np.ndarray
    step: int
    vel_valid: bool = True


@dataclass
class Cluster:
    beams: list
    first: int
    span: int
    range_m: float
    range_var: float
    bearing: float
    radius: float
    pos: np.ndarray
    doppler: float
    doppler_var: float
    hidden: int
    match: int = -1


@dataclass
class Track:
    x: np.ndarray
    P: np.ndarray
    radius: float
    radius_var: float
    z: float
    doppler: float
    doppler_var: float
    sight: float
    seen: int
    moving: int = 0
    shift: np.ndarray = field(default_factory=lambda: np.zeros(2))
    sweep: float = 0.0
    age: int = 0
    misses: int = 0


def unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


def range_variance(r, sonar):
    return (
        (sonar.range_sigma_m + sonar.range_sigma_slope * r) ** 2
        + sonar.range_jitter_m**2
        + sonar.range_quantum_m**2 / 12
    )


def split_distance(r, sonar):
    return max(SPLIT_M + SPLIT_SLOPE * r, 4 * np.sqrt(range_variance(r, sonar)))


# --------------------------------------------------------------------------------------------------- clusters


def labelled(scan, cfg, sonar, tank):
    """Mask of candidate beams, compensated Doppler and the own velocity's error."""
    bearing = scan.yaw + np.arange(sonar.n_ray) * 2 * np.pi / sonar.n_ray
    u = np.stack([np.cos(bearing), np.sin(bearing)], 1)
    rot = np.array([[np.cos(scan.yaw), -np.sin(scan.yaw)], [np.sin(scan.yaw), np.cos(scan.yaw)]])
    still = scan.doppler + u @ (rot @ scan.vel_b[:2])
    p = scan.pos[:2] + scan.range_m[:, None] * u
    if tank.shape == "circle":
        centre = np.array([sum(tank.x_m) / 2, sum(tank.y_m) / 2])
        gap = tank.radius_m - np.hypot(*(p - centre).T)
    else:
        gap = np.minimum(
            np.minimum(p[:, 0] - tank.x_m[0], tank.x_m[1] - p[:, 0]),
            np.minimum(p[:, 1] - tank.y_m[0], tank.y_m[1] - p[:, 1]),
        )
    near_wall = gap < cfg.wall_margin_m + 2 * np.sqrt([range_variance(r, sonar) for r in scan.range_m])
    wall = (scan.hit == 1) & near_wall
    slip, _left = velocity_error(u[wall], still[wall], cfg, sonar, scan.vel_valid)
    return (scan.hit == 1) & ~near_wall, still, slip


def velocity_error(u, still, cfg, sonar, valid):
    """(own velocity's error that explains the walls' Doppler, its largest standard deviation after)."""
    sigma = max(sonar.doppler_sigma_m_s, 0.01)
    # m/s: a held reading may be off by the vehicle's whole speed
    trust = cfg.own_speed_sigma_m_s if valid else 1.0
    information = u.T @ u / sigma**2 + np.eye(2) / trust**2
    left = np.linalg.inv(information)
    return left @ (u.T @ still) / sigma**2, 0.0 if valid else np.sqrt(np.linalg.eigvalsh(left).max())


def clusters_of(scan, cfg, sonar, tank):
    candidate, still, slip = labelled(scan, cfg, sonar, tank)
    n, r = sonar.n_ray, scan.range_m

    def joined(a, b):
        close = abs(r[b] - r[a]) <= split_distance(r[a], sonar)
        return (
            candidate[a]
            and candidate[b]
            and close
            and abs(still[b] - still[a]) <= SPLIT_DOPPLER_M_S + 6 * sonar.doppler_sigma_m_s
        )

    def follower(a):
        for ahead in (1, 2):
            if joined(a, (a + ahead) % n):
                return ahead
        if scan.hit[(a + 1) % n] == 0 and scan.hit[(a + 2) % n] == 0 and joined(a, (a + 3) % n):
            return 3
        return 0

    crossing = [any(follower((s - back) % n) >= back for back in (1, 2, 3)) for s in range(n)]
    start = crossing.index(False) if False in crossing else 0
    out, k = [], 0
    while k < n:
        if not candidate[(start + k) % n]:
            k += 1
            continue
        run = [k]
        while (ahead := follower((start + run[-1]) % n)) and run[-1] + ahead < n:
            run.append(run[-1] + ahead)
        cluster = cluster_from(
            [(start + i) % n for i in run], run[-1] - run[0], scan, still, slip, cfg, sonar
        )
        if cluster and len(out) < cfg.n_cluster:
            out.append(cluster)
        k = run[-1] + 1
    return out


def edge_open(scan, edge, way, sonar):
    r = scan.range_m[edge]
    for step in (1, 2):
        beam = (edge + way * step) % sonar.n_ray
        if scan.hit[beam]:
            return scan.range_m[beam] - r < 0.1 + 3 * np.sqrt(range_variance(r, sonar))
    return False


def cluster_from(beams, steps, scan, still, slip, cfg, sonar):
    """A run as a cluster, or None where it cannot be a obstacle."""
    n, spacing = len(beams), 2 * np.pi / sonar.n_ray
    ra, rb = scan.range_m[beams[0]], scan.range_m[beams[-1]]
    mean = scan.range_m[beams].mean() - sonar.range_jitter_m
    hidden = int(edge_open(scan, beams[0], -1, sonar)) + 2 * int(edge_open(scan, beams[-1], 1, sonar))
    chord = 2 * np.sqrt(ra * rb) * np.sin(min(steps, sonar.n_ray // 2) * spacing / 2)
    depth = max(cfg.max_width_m, 4 * np.sqrt(range_variance(ra, sonar)))
    if steps >= sonar.n_ray // 2 or chord >= cfg.max_width_m or abs(ra - rb) >= depth:
        return None
    if not hidden and n < cfg.min_radius_m / (max(mean, 0.1) * spacing):
        return None
    half = 0.5 * spacing * (steps + 1)
    bearing = scan.yaw + spacing * (beams[0] + steps / 2)
    radius = np.clip(mean * np.sin(half) / (1 - ARC * np.sin(half)), cfg.min_radius_m, cfg.max_width_m / 2)
    sigma = max(sonar.doppler_sigma_m_s, 0.01)
    rates = still[beams]
    if sonar.doppler_outlier > 0:
        rates = np.clip(rates, rates.mean() - 3 * sigma, rates.mean() + 3 * sigma)
    return Cluster(
        beams, beams[0], steps + 1, mean, range_variance(mean, sonar) / n + 0.01**2, bearing, radius,
        scan.pos[:2] + (mean + ARC * radius) * unit(bearing), rates.mean() - slip @ unit(bearing),
        (sigma**2 + sonar.doppler_outlier * 9 * sigma**2) / n + 0.01**2, hidden,
    )  # fmt: skip


# ----------------------------------------------------------------------------------------------------- filter


def arc(x, dt):
    """State (x, y, vx, vy, turn rate) after dt: along the chord of the middle course, velocity turned."""
    mid, late = turned(x[2:4], 0.5 * dt * x[4]), turned(x[2:4], dt * x[4])
    return np.array([x[0] + dt * mid[0], x[1] + dt * mid[1], *late, x[4]])


def predicted(x, P, dt, density, rate_density):
    """Mean and covariance after dt; the turn rate takes noise only where it is estimated."""
    step = 1e-6
    F = np.stack([(arc(x + step * e, dt) - arc(x - step * e, dt)) / (2 * step) for e in np.eye(5)], 1)
    Q = np.zeros((5, 5))
    Q[:4, :4] = density * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
    Q[4, 4] = rate_density * dt if P[4, 4] > 0 else 0.0
    return arc(x, dt), F @ P @ F.T + Q


def corrected(x, P, h, residual, variance):
    """Joseph's form; h measures (x, y, vx, vy)."""
    h = np.append(h, 0.0)
    K = P @ h / (h @ P @ h + variance)
    A = np.eye(5) - np.outer(K, h)
    return x + K * residual, A @ P @ A.T + variance * np.outer(K, K)


def turned(v, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def missing_of(c, radius, radius_var, cfg, sonar):
    """[m] a cluster with two free edges is narrower than its body on one side; 0 where noise explains it."""
    edge = 0.25 * 2 * np.pi / sonar.n_ray * c.range_m
    seen = (c.range_m + ARC * radius) * np.sin(np.pi / sonar.n_ray * c.span)
    short = radius - seen - cfg.partial_sigmas * np.sqrt(radius_var + edge**2 + 0.02**2)
    return max(short, 0.0) if cfg.partial_sigmas > 0 and not c.hidden else 0.0


def centre_variances(c, radius, radius_var, cfg, sonar):
    missing = missing_of(c, radius, radius_var, cfg, sonar)
    radial = c.range_var + ARC**2 * radius_var
    cross = (0.25 * 2 * np.pi / sonar.n_ray * c.range_m) ** 2 + 0.02**2
    radial, cross = radial + missing**2, cross + missing**2
    if c.hidden:
        radial, cross = radial + (0.3 * radius) ** 2, cross + (0.5 * radius) ** 2 + radius_var
    return radial, cross


def surprise_of(track, c, along, centre, cfg, sonar):
    """(squared normalised innovations of range, cross range, Doppler), their variances."""
    across = np.array([-along[1], along[0]])
    radial_var, cross_var = centre_variances(c, track.radius, track.radius_var, cfg, sonar)
    s = np.array(
        [along @ track.P[:2, :2] @ along + radial_var, across @ track.P[:2, :2] @ across + cross_var]
    )
    s = np.append(s, along @ track.P[2:4, 2:4] @ along + c.doppler_var)
    offset = centre - track.x[:2]
    e = np.array([offset @ along, offset @ across, c.doppler - along @ track.x[2:4]])
    return e**2 / s, s


def sight_of_centre(c, radius, sonar):
    distance = c.range_m + ARC * radius
    half = radius / distance
    spare = max(half - np.pi / sonar.n_ray * c.span, 0.0)
    bearing = c.bearing + {1: -spare, 2: spare}.get(c.hidden, 0.0)
    return bearing, distance / (1 - half**2 / 6), half


# ------------------------------------------------------------------------------------------------------ track


def associate(tracks, clusters, dt, cfg, sonar):
    """Cheapest pair first; returns {track slot: cluster}."""
    pairs = []
    for t, track in tracks.items():
        for k, c in enumerate(clusters):
            gap = np.hypot(*(c.pos - track.x[:2]))
            if gap >= 2.0:
                continue
            parts, s = surprise_of(track, c, unit(c.bearing), c.pos, cfg, sonar)
            if parts[0] + parts[1] < cfg.turn_gate or gap < cfg.gate_m + dt * np.hypot(*track.x[2:4]):
                pairs.append((parts.sum() + np.log(s.prod()), t, k))
    out = {}
    for _, t, k in sorted(pairs):
        if t not in out and clusters[k].match < 0:
            out[t], clusters[k].match = k, t
    return out


def update(track, c, dt, scan, cfg, sonar):
    before = track.x.copy()
    noise, var = (0.25 * 2 * np.pi / sonar.n_ray * c.range_m) ** 2 + 0.02**2, track.radius_var + 4e-4 * dt
    noise += missing_of(c, track.radius, var, cfg, sonar) ** 2
    if not c.hidden or c.radius > track.radius:
        track.radius += (c.radius - track.radius) * var / (var + noise)
        var = 1 / (1 / var + 1 / noise)
    track.radius_var = min(var, cfg.min_radius_m**2)
    bearing, distance, half = sight_of_centre(c, track.radius, sonar)
    along = unit(bearing)
    across = np.array([-along[1], along[0]])
    centre = scan.pos[:2] + distance * along
    radial_var, cross_var = centre_variances(c, track.radius, track.radius_var, cfg, sonar)
    # the gate of a turn looks along the middle of what is seen
    parts, _ = surprise_of(track, c, unit(c.bearing), centre, cfg, sonar)
    P, x = track.P.copy(), track.x
    if parts.sum() > cfg.turn_gate:
        P[2:4, 2:4] += max(np.hypot(*x[2:4]), 0.5) ** 2 * np.eye(2)
    for h, z, v in (
        (np.append(along, [0, 0]), centre @ along, radial_var),
        (np.append(across, [0, 0]), centre @ across, cross_var),
        (np.append([0, 0], (1 - half**2 / 6) * along), c.doppler, c.doppler_var),
    ):
        x, P = corrected(x, P, h, z - h @ x[:4], v)
    track.x, track.P = x, P
    evidence(track, c, dt, before)
    track.z, track.seen, track.misses = scan.pos[2], scan.step, 0
    track.moving = is_moving(track, c, dt, cfg, sonar)
    turn(track, before, cfg)


def evidence(track, c, dt, before):
    known, new = 1 / (track.doppler_var * (1 + dt / DOPPLER_MEMORY_S)), 1 / c.doppler_var
    track.doppler = (known * track.doppler + new * c.doppler) / (known + new)
    track.doppler_var = 1 / (known + new)
    track.shift = track.shift / (1 + dt / SHIFT_MEMORY_S)
    if not c.hidden:
        track.shift = track.shift + track.x[:2] - before[:2] + dt * before[2:4]
    swing = (c.bearing - track.sight + np.pi) % (2 * np.pi) - np.pi
    track.sweep = track.sweep / (1 + dt / SHIFT_MEMORY_S) + swing
    track.sight = c.bearing


def is_moving(track, c, dt, cfg, sonar):
    v = track.x[2:4]
    fast = np.hypot(*v) > MOVING_M_S
    shown = abs(track.doppler) > max(MOVING_DOPPLER_M_S, 4 * np.sqrt(track.doppler_var))
    noise = np.sqrt(
        np.linalg.eigvalsh(track.P[:2, :2])[-1]
        + centre_variances(c, track.radius, track.radius_var, cfg, sonar)[1]
    )
    reach = MOVING_SHIFT_M + 0.5 * cfg.max_width_m * abs(track.sweep) + 2 * noise
    length = np.hypot(*track.shift)
    shown = shown or (
        length > reach and track.shift @ v > 0.8 * length * np.hypot(*v) and track.age * dt > SHIFT_S
    )
    return int((fast and shown and track.age >= CONFIRMED - 1) or (track.moving and (fast or shown)))


def turn(track, before, cfg):
    v, old = track.x[2:4], before[2:4]
    unsettled = (track.P[2, 2] + track.P[3, 3]) / (0.2 * (v @ v))
    angle = np.arctan2(old[0] * v[1] - old[1] * v[0], old @ v)
    if not track.moving or unsettled >= 1 or abs(angle) >= 0.5:
        track.x[4], track.P[4, :], track.P[:, 4] = 0.0, 0.0, 0.0
    elif track.P[4, 4] == 0:
        track.P[4, 4] = cfg.turn_rate_sigma_rad_s**2
    track.x[4] = np.clip(track.x[4], -4, 4)


def sight_of(track, scan, sonar):
    spacing = 2 * np.pi / sonar.n_ray
    d = track.x[:2] - scan.pos[:2]
    distance = np.hypot(*d)
    middle = int(np.floor((np.arctan2(d[1], d[0]) - scan.yaw) / spacing + 0.5))
    half = int(0.5 * track.radius / (max(distance, track.radius) * spacing))
    slack = track.radius + split_distance(distance, sonar)
    beams = np.arange(middle - half, middle + half + 1) % sonar.n_ray
    past = (scan.hit[beams] == 0) | (scan.range_m[beams] > distance + slack)
    before = (scan.hit[beams] == 1) & (scan.range_m[beams] < distance - slack)
    return "through" if 2 * past.sum() > len(beams) else "blocked" if 2 * before.sum() > len(beams) else ""


def prune(tracks, scan, cfg, sonar, dt_s):
    for t in sorted(tracks):
        track = tracks[t]
        if track.misses == 0:
            continue
        unseen = (scan.step - track.seen) * dt_s
        sight = sight_of(track, scan, sonar)
        gone = sight == "through" and (track.age < CONFIRMED or unseen >= cfg.see_through_s)
        lost = unseen > (cfg.hidden_s if sight == "blocked" else cfg.max_misses * 0.1)
        double = any(
            o.misses == 0 and np.hypot(*(o.x[:2] - track.x[:2])) < 0.5 * (o.radius + track.radius)
            for o in tracks.values()
        )
        if gone or lost or double:
            del tracks[t]


def spawn(tracks, clusters, matched, scan, cfg, sonar):
    for c in clusters:
        if c.match >= 0:
            continue
        for t in sorted(tracks):
            track = tracks[t]
            near = np.hypot(*(c.pos - track.x[:2])) < track.radius + cfg.min_radius_m
            if (
                track.misses == 0
                and near
                and abs(c.doppler - track.doppler) < SPLIT_DOPPLER_M_S + 3 * sonar.doppler_sigma_m_s
            ):
                c.match = t
        if c.match < 0:
            c.match = slot_for(tracks, c, scan, cfg)
            if c.match >= 0:
                if matched.get(c.match, -1) >= 0 and c.match in tracks:
                    clusters[matched[c.match]].match = -1
                matched.pop(c.match, None)
                tracks[c.match] = begun(c, scan, cfg, sonar)


def slot_for(tracks, c, scan, cfg):
    moves = abs(c.doppler) > max(MOVING_DOPPLER_M_S, 4 * np.sqrt(c.doppler_var))
    worst, out = -1.0 if moves else c.range_m + c.radius, -1
    for t in range(cfg.n_track):
        if t not in tracks:
            return t
        score = np.hypot(*(tracks[t].x[:2] - scan.pos[:2])) + 100 * tracks[t].misses
        if not tracks[t].moving and score > worst:
            worst, out = score, t
    return out


def begun(c, scan, cfg, sonar):
    radius, radius_var = c.radius, (0.25 * 2 * np.pi / sonar.n_ray * c.range_m) ** 2 + 0.02**2
    if c.hidden:
        radius, radius_var = max(radius, 0.2), cfg.min_radius_m**2
    bearing, distance, _ = sight_of_centre(c, radius, sonar)
    along = unit(bearing)
    turn_in = np.array([[along[0], -along[1]], [along[1], along[0]]])
    P = np.zeros((5, 5))
    P[:2, :2] = turn_in @ np.diag(centre_variances(c, radius, radius_var, cfg, sonar)) @ turn_in.T
    P[2:4, 2:4] = turn_in @ np.diag([c.doppler_var, cfg.birth_speed_sigma_m_s**2]) @ turn_in.T
    x = np.concatenate([scan.pos[:2] + distance * along, c.doppler * along, [0.0]])
    track = Track(x, P, radius, radius_var, scan.pos[2], c.doppler, c.doppler_var, c.bearing, scan.step)
    clear = max(SIGHT_DOPPLER_M_S, 6 * np.sqrt(c.doppler_var))
    track.moving = int(len(c.beams) >= 3 and abs(c.doppler) > clear)
    return track


def step(tracks, last_step, scan, cfg, sonar, tank, dt_s):
    """One scan: updates the dict {slot: Track} in place; returns (clusters, beam_track)."""
    clusters = clusters_of(scan, cfg, sonar, tank)
    dt = (scan.step - last_step) * dt_s if last_step >= 0 else 0.0
    for track in tracks.values():
        track.x, track.P = predicted(track.x, track.P, dt, cfg.accel_density, cfg.turn_density)
        track.age += 1
        track.misses += 1
    matched = associate(tracks, clusters, dt, cfg, sonar)
    for t, k in matched.items():
        update(tracks[t], clusters[k], dt, scan, cfg, sonar)
    prune(tracks, scan, cfg, sonar, dt_s)
    spawn(tracks, clusters, matched, scan, cfg, sonar)
    beam_track = np.full(sonar.n_ray, -1)
    for c in clusters:
        beam_track[c.beams] = c.match
    return clusters, beam_track
