"""scenario.json: the truth about an episode's world in closed form, to recompute what a log claims."""

from __future__ import annotations

from typing import Any

FRAMES = {
    "world": "z up, x along the tank, y across, z = 0 at the surface [m]",
    "base": "vehicle at its centre of mass, x ahead, y left, z up",
    "sonar": "at the vehicle, turned with its yaw only, always level: the beams lie in its x-y plane, beam 0 "
    "along x, counter-clockwise",
    "camera": "optical: z along the vehicle's x, x to its right, y down; depth is along z",
}
"""of /tf"""

FORMULAS = {
    "obstacle_position": (
        "z stays. Without a path an obstacle rests. arc(t) = (phase_m + speed_m_s * t) mod length_m. circle: "
        "angle = arc / radius_m (radius_m < 0 is clockwise), (x, y) = center + |radius_m| (cos angle, sin "
        "angle). polyline: the point at arc along corners[0], corners[1], .., back to corners[0]; with two "
        "corners that is back and forth. With easing_m = e its turns are parabolas: where the unit vectors p "
        "and q along the legs of a corner differ, the point d < s = e |q - p| / 2 from it, on either leg, is "
        "moved by (s - d)^2 / (2 e) along q - p. Velocity = how it changes. t = step * control_dt_s."
    ),
    "size": (
        "sphere (r, r, r); vertical cylinder (r, r, half height); box half extents along its own axes before "
        "it is turned by yaw about z"
    ),
    "sonar": (
        "Beam i looks along the true yaw + start_angle + i (end_angle - start_angle) / (n - 1), angles of "
        "/sonar/scan (start_angle alone where n = 1), in the horizontal plane of the true position at the "
        "scan's own timestamp. An obstacle is met where the beam enters its horizontal outline (of a sphere: "
        "a circle of radius sqrt(r^2 - g^2), g = max(|dz| - d tan(a), 0), d = horizontal distance of its "
        "centre) if the vertical gap is at most range * tan(a); a = "
        "sensors.sonar.vertical_half_aperture_deg. Side walls are always met, floor and surface never; "
        "nothing beyond sensors.sonar.max_range_m returns. Doppler = (velocity of the obstacle or wall that "
        "is met - own velocity) . beam: how fast that piece of surface recedes; none is measured where "
        "sensors.sonar.doppler is false. Errors as in sensors.sonar. If sensors.sonar.mechanical, a scan "
        "holds the beams taken in that control step; a beam returns the nearest that 16 rays meet, evenly "
        "over beam_width_deg about it. The k-th is taken at the end of the control step in which k (2 "
        "max_range_m / (1500 m/s) + step_overhead_s), to whole microseconds, is; it is beam k mod n_ray of a "
        "whole circle, and of a sector goes 0 .. n_ray - 1 and back."
    ),
    "clearance": (
        "Hull = capsule about the vehicle's x axis (vehicle.hull_half_length_m either side of the origin, "
        "vehicle.hull_radius_m). clearance_m = smallest distance of its surface to any body or side wall."
    ),
    "ttc": (
        "Smallest clearance / closing speed over the obstacles whose closing speed exceeds "
        "episode.ttc_closing_m_s; closing speed = rate at which that obstacle's clearance shrinks, from the "
        "velocities of both nearest points. null = none."
    ),
    "outcome": (
        "The first that holds after a control step: out_of_tank (hull centre outside the tank), collision "
        "(clearance < episode.collision_clearance_m, or hull beyond floor or surface), ttc (< "
        "episode.ttc_s), success (3-D distance to the goal at most episode.goal_radius_m), timeout "
        "(episode.horizon_steps)."
    ),
    "map": (
        "Per mapped scan and cell, with indicators of 0 or 1: static = clip((1 - l_s) static + g_hit [static "
        "return] - g_free [free] + g_depth [depth], 0, 1); dynamic = clip((1 - l_d) dynamic + d_hit [moving "
        "return] - d_free [free], 0, 1); what falls below 1e-6 is 0. Both start at 0. Gains of `mapping` "
        "hold at 10 Hz: per scan min(1, 10 P gain), decays 1 - (1 - decay)^(10 P). P = control_dt_s * "
        "sonar.period_steps * ceil(mapping.period_steps / sonar.period_steps); for depth_hit the longer of P "
        "and control_dt_s * depth.period_steps. A scan is mapped at its log time if the last mapped one is "
        "at least mapping.period_steps steps older. Own position and yaw: /pose_estimate at the scan's "
        "timestamp. The layers of a log time include that step's scan. If sensors.sonar.mechanical: every "
        "scan is mapped, P of the decays is the longer of a step of the beam and control_dt_s, and P of the "
        "gains of returns and [free] is n_ray steps of the beam."
    ),
    "map_free": (
        "[free]: cells of the tank that have no return in this scan and whose centre lies in the triangle "
        "between two neighbouring beams, its two sides along them both as long as the smaller of their "
        "reaches. reach = range - cell_m - sigma for a return, sigma = range_sigma_m + range_sigma_slope * "
        "range; min(free_range_m, max_range_m) without one; at least 0. Of a mechanical beam: the triangle "
        "half a step of the beam to either side of it, both sides as long as its own reach."
    ),
    "map_returns": (
        "A return counts in the cell of its point, but not within wall_margin_m of a side wall or beyond, "
        "(of a mechanical beam, plus half its width in rad times the range), nor where range > wall - error; "
        "error = 3 (sigma + range_jitter_m) + range_quantum_m, wall = range of the known side wall along the "
        "beam. It is a moving one if |velocity + own_velocity . beam| (/sonar/doppler, beam in body axes) > "
        "max(doppler_evidence_m_s, 3 doppler_sigma_m_s), or if the beam is listed in /tracks, or if the cell "
        "speaks against an obstacle at rest: (free_scans >= ceil(free_confident_s / P) or 0 < dynamic_scans "
        "< ceil(promote_s / P)) and no cell within m rows and columns has static >= occupied, P being that "
        "of the gains, m = min(4, 1 + floor((spacing of the beams (or half their width, if more) * range + "
        "error) / cell_m)). All of this as of before the scan. Counters of a cell, to 255: free: free_scans "
        "+ 1, dynamic_scans = 0; any return: free_scans = 0; a moving one: dynamic_scans + 1."
    ),
    "map_depth": (
        "/camera/line has, per image column, the nearest pixel that sees something within "
        "mapping.depth_gate_m of the vehicle's own depth. Its point is p + R (offset_b_m + depth (1, (cols / "
        "2 - 0.5 - column) / f, (rows / 2 - 0.5 - row) / f)), f = cols / 2 / tan(fov_deg / 2), p and R of "
        "/pose_estimate at its timestamp. [depth] holds in the cell of such a point at the next mapped scan "
        "(the same step's included) if the cell is not free, has no moving return and dynamic < occupied, "
        "and if it has a static return or static > 0 already."
    ),
    "map_risk": (
        "risk_static * static + risk_dynamic * dynamic + risk_clearance / (clearance + risk_epsilon_m) of "
        "the layers with the same log time; names are keys of `clearance`."
    ),
    "map_clearance": (
        "Distance between the centre of a cell and the centre of the nearest cell that is occupied (>= "
        "mapping.occupied in the layers named by voronoi.use), less clearance.inflate_m, or whose centre "
        "lies outside the tank; clearance.max_m stands for 'at least'. Computed every clearance.period_steps "
        "from the map of that step: its time is the timestamp of /map/clearance and /map/risk, which on a "
        "replan may lie before their log time."
    ),
    "candidates": (
        "Velocities in the order of `costs` of /evasion; names are keys of `behaviour tree`, followed, asked "
        "and top defined here. followed = `follow`; asked = `asked` of /action one control step before; "
        "top(h) = min(evade_m_s, 1 / max(|cos(h - yaw)| / max_surge_m_s, |sin(h - yaw)| / max_sway_m_s)), "
        "limits of `vehicle`; h0 = heading of followed. First n_heading * n_speed level ones with the "
        "heave of followed: number i has heading h0 + 2 pi (i mod n_heading) / n_heading and speed top "
        "(floor(i / n_heading) + 1) / n_speed. Then stop, asked, followed. If heave_m_s > 0: for "
        "n_heave_heading headings, all round from h0 on, at top speed one that climbs and one that dives "
        "with heave_m_s, and a pair straight up and down. Then stop again, up to a multiple of 16. If "
        "burst_s > 0: 32 headings all round from h0 on, at top speed with the heave of followed, which "
        "last burst_s and then stop. Heaves of asked, climbing and diving ones are held within [min(low - "
        "z, 0), max(high - z, 0)]: low and high are floor and surface, inwards by edge_gap_m "
        "(lost_edge_gap_m, if more, where `given_up` of /action is not 0) + place_sigmas sqrt(z_variance), "
        "half of the water at most."
    ),
    "evasion_cost": (
        "weight_peak peak + weight_mean mean + weight_contact contact + weight_static static_mean + "
        "weight_static_contact static_contact + (weight_deviation |c - followed| + weight_change |c - "
        "asked|) / cruise_m_s. The vehicle approaches c, after burst_s 0, with a first-order lag lag_s "
        "from own_velocity turned by yaw; z is held within [low, high]. For k = 1 .. horizon_s / "
        "forecast_dt_s, t = k forecast_dt_s, body and radius of a hypothesis of /futures: g = "
        "max(min(above - z, z - below), 0) vertical_weight; r = level distance of the axes; distance = r "
        "- radius if g = 0, else sqrt(max(r - radius, 0)^2 + g^2); closing = max(rate at which r shrinks, "
        "0), times max(r - radius, 0) / distance if g > 0, the obstacle's velocity being that of its last "
        "forecast_dt_s; free = distance - hull_reach_m - patience closing_s closing; wanted = contact_m + "
        "patience caution (margin_m + margin_growth_m_s t), the second term times future_margin for "
        "hypotheses other than the forecast; depth = max(wanted - free, 0). Of a hypothesis: largest depth; "
        "mean depth; largest max(contact_m - free, 0). Of a track: their means by weight, where hypotheses "
        "of at most least_share are left out and the forecast has what the others leave. peak and contact "
        "are the largest of all tracks, mean is their sum. static: below = hull_reach_m + contact_m + "
        "place_sigmas sqrt(place_variance) - /map/clearance of the cell there, every static_dt_s up to "
        "static_horizon_s: mean of max(below + static_margin_m, 0), and the largest below, at least 0."
    ),
    "evasion_choice": (
        "Least = the first candidate of least cost. Mean = mean of the candidates with weights exp(-(cost "
        "- least cost) / temperature), those 12 temperature above left out, held for the whole horizon. The "
        "mean is taken if its own cost is at most least cost + temperature, else the least."
    ),
}
"""How an outsider recomputes the log's figures; names such as mapping.occupied are keys of config.yaml."""


def tank_document(tank: Any) -> dict[str, Any]:
    """A TankConfig as scenario.json has it."""
    sides = {name: list(getattr(tank, name)) for name in ("x_m", "y_m", "z_m")}
    return {"shape": tank.shape, **sides, "radius_m": tank.radius_m}


def scenario_document(
    config: Any, described: dict[str, Any], world: str, seed: int, episode: int
) -> dict[str, Any]:
    """Content of scenario.json. ``described``: ``closed_form.describe_scenario`` at step 0."""
    wanted = config.world
    moving = sum(body["path"] is not None for body in described["obstacles"])
    return {
        "schema": 1,
        "world": world,
        "seed": seed,
        "episode": episode,
        "S": len(described["obstacles"]) - moving,
        "D": moving,
        "v_m_s": wanted.dynamic_speed_m_s,
        "control_dt_s": config.episode.control_dt_s,
        "goal_radius_m": config.episode.goal_radius_m,
        "tank": tank_document(wanted.tank),
        **described,
        "frames": FRAMES,
        "formulas": FORMULAS,
    }
