"""Float64 oracle of the paper's reward, from plain numbers."""

import math

TERMS = (
    "alive", "progress", "path_distance", "cross_track", "clearance", "ttc", "overspeed", "upright",
    "heading", "success", "failure", "tilt", "effort",
)  # fmt: skip


def terms(cfg, vehicle, s):
    """Weighted terms by name of one step; ``s`` holds the step's numbers (see test_reward)."""
    _, x, y, _ = s["quat"]
    upright = 1 - 2 * (x * x + y * y)
    speed = math.sqrt(sum(v * v for v in s["vel"]))
    limits = (vehicle.max_surge_m_s, vehicle.max_sway_m_s, vehicle.max_heave_m_s, vehicle.max_yaw_rate_rad_s)
    effort = sum((c / limit) ** 2 for c, limit in zip(s["command"], limits, strict=True)) / 4
    routed = s["n_way"] > 0
    return {
        "alive": cfg.alive,
        "progress": cfg.progress * s["progress"],
        "path_distance": -cfg.path_distance * math.dist(s["lookahead"], s["pos"]) * routed,
        "cross_track": -cfg.cross_track * abs(s["cross_track"]) * routed,
        "clearance": -cfg.clearance * min(1.0, max(0.0, 1 - s["clearance"] / cfg.soft_clearance_m)),
        "ttc": -cfg.ttc * min(1.0, max(0.0, 1 - s["ttc"] / cfg.soft_ttc_s)),
        "overspeed": -cfg.overspeed * max(0.0, speed - cfg.safe_speed_m_s) ** 2,
        "upright": cfg.upright * upright,
        "heading": cfg.heading * math.cos(s["heading_error"]) * routed,
        "success": cfg.success * (s["outcome"] == "success"),
        "failure": -cfg.failure * (s["outcome"] in ("collision", "ttc", "out_of_tank")),
        "tilt": -cfg.tilt * math.acos(max(-1.0, min(1.0, upright))),
        "effort": -cfg.effort * effort,
    }
