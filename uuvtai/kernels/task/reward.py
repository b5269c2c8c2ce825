"""The paper's reward, term by term:

r = r_alive + w_p ds - w_d d - w_ct |e_ct| - w_c C - w_ttc T - w_v |v|_over^2 + w_u U + w_h H + w_s succ - w_f
fail - w_tilt Theta - w_eff E

Safety terms come from the termination check (truth), which the reward may use; the policy never sees them.
"""

import taichi as ti

from uuvtai.common.enums import COLLISION, OUT_OF_TANK, SUCCESS, TIMEOUT
from uuvtai.compile.launch import quick_launch
from uuvtai.config.task import TERMS
from uuvtai.kernels.core.geometry import rotation_wb
from uuvtai.kernels.core.stage import (
    AnyVector,
    Bundle,
    ByteVector,
    Const,
    FloatMatrix,
    FloatVector,
    IntVector,
    n_envs,
)
from uuvtai.kernels.task.io import RewardIO

_PENALTIES = ("path_distance", "cross_track", "clearance", "ttc", "overspeed", "failure", "tilt", "effort")
"""Terms that the equation subtracts."""

N_TERM = len(TERMS)

_UNKNOWN_M = -1.0


def signed_weights(reward_cfg):
    """Weight of every term with the sign of the equation; ``reward_cfg`` is a RewardConfig."""
    return tuple(
        -getattr(reward_cfg, name) if name in _PENALTIES else getattr(reward_cfg, name) for name in TERMS
    )


@ti.func
def is_failure(outcome):
    """1 for collision, time to collision and out of tank."""
    return ti.cast(outcome >= COLLISION and outcome <= OUT_OF_TANK, ti.i32)


@quick_launch
@ti.kernel
def reset_reward(io: Bundle[RewardIO]):
    """Forget the last episode of the active rows."""
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 1:
            for term in range(ti.static(N_TERM)):
                io.reward.term[env, term] = 0.0
                io.reward.episode_sum[env, term] = 0.0
            io.reward.total[env] = 0.0
            io.reward.episode_return[env] = 0.0
            io.reward.last_remaining_m[env] = _UNKNOWN_M


@ti.func
def route_progress(env, dt_s: Const[float], io: Bundle[RewardIO]):
    """Route length gained in this step [m], never more than the vehicle moved, so that no jump of the route
    or of the foot on it pays.

    Where a new route was just adopted (or none is known from before), lengths of two routes would be
    compared: the movement towards the look-ahead point stands in.
    """
    R_wb = rotation_wb(io.vehicle.quat_wb[env])
    vel_w = R_wb @ io.vehicle.vel_b[env]
    step_x, step_y = dt_s * vel_w[0], dt_s * vel_w[1]
    moved = ti.sqrt(step_x * step_x + step_y * step_y)
    remaining = _UNKNOWN_M + 0.0
    gained = 0.0
    if io.route.n_way[env] > 0:
        remaining = io.route.remaining_m[env]
        if io.reward.last_remaining_m[env] < 0.0 or io.route.plan_step[env] == io.clock.step[env]:
            ahead = io.route.lookahead_w[env] - io.vehicle.pos_w[env]
            ahead_m = ti.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1])
            gained = (step_x * ahead[0] + step_y * ahead[1]) / ti.max(ahead_m, 1e-6)
        else:
            gained = ti.math.clamp(io.reward.last_remaining_m[env] - remaining, -moved, moved)
    io.reward.last_remaining_m[env] = remaining
    return gained


@ti.func
def control_effort(env, io: Bundle[RewardIO]):
    """E_t: mean square of the command in units of its limits, 0 to 1."""
    command = io.actuation.command[env]
    surge = command[0] / io.vehicle_cfg.max_surge_m_s
    sway = command[1] / io.vehicle_cfg.max_sway_m_s
    heave = command[2] / io.vehicle_cfg.max_heave_m_s
    yaw = command[3] / io.vehicle_cfg.max_yaw_rate_rad_s
    return 0.25 * (surge * surge + sway * sway + heave * heave + yaw * yaw)


@ti.func
def unweighted_terms(env, progress, io: Bundle[RewardIO]):
    """Every term before its weight, in the order of TERMS. Path terms are 0 while there is no route."""
    upright = rotation_wb(io.vehicle.quat_wb[env])[2, 2]
    over = ti.max(0.0, io.vehicle.vel_b[env].norm() - io.reward_cfg.safe_speed_m_s)
    outcome = io.termination.outcome[env]
    reference = 0.0
    cross_track = 0.0
    heading = 0.0
    if io.route.n_way[env] > 0:
        reference = (io.route.lookahead_w[env] - io.vehicle.pos_w[env]).norm()
        cross_track = ti.abs(io.route.cross_track_m[env])
        heading = ti.cos(io.route.heading_error[env])
    return ti.Vector(
        [
            1.0,
            progress,
            reference,
            cross_track,
            ti.math.clamp(1.0 - io.termination.clearance_m[env] / io.reward_cfg.soft_clearance_m, 0.0, 1.0),
            ti.math.clamp(1.0 - io.termination.ttc_s[env] / io.reward_cfg.soft_ttc_s, 0.0, 1.0),
            over * over,
            upright,
            heading,
            ti.cast(outcome == SUCCESS, ti.f32),
            ti.cast(is_failure(outcome), ti.f32),
            ti.acos(ti.math.clamp(upright, -1.0, 1.0)),
            control_effort(env, io),
        ]
    )


@quick_launch
@ti.kernel
def compute_reward(
    io: Bundle[RewardIO], reward_out: FloatVector, terminated: AnyVector, truncated: AnyVector
):
    """Reward of the step, weighted terms, their sums, and how the step ended. Rows that sleep earn 0 and keep
    their end."""
    weights = ti.Vector(ti.static(list(signed_weights(io.reward_cfg))))
    for env in range(n_envs(io.clock)):
        if io.clock.active[env] == 0 and env < reward_out.shape[0]:
            reward_out[env] = 0.0
        if io.clock.active[env] == 1:
            progress = route_progress(env, io.episode_cfg.control_dt_s, io)
            terms = unweighted_terms(env, progress, io)
            total = 0.0
            for i in ti.static(range(N_TERM)):
                weighted = weights[i] * terms[i]
                io.reward.term[env, i] = weighted
                io.reward.episode_sum[env, i] += weighted
                total += weighted
            io.reward.total[env] = total
            io.reward.episode_return[env] += total
            reward_out[env] = total
            outcome = io.termination.outcome[env]
            terminated[env] = ti.cast(outcome == SUCCESS, ti.i32) | is_failure(outcome)
            truncated[env] = ti.cast(outcome == TIMEOUT, ti.i32)


@quick_launch
@ti.kernel
def write_results(
    io: Bundle[RewardIO],
    terms: FloatMatrix,
    episode_terms: FloatMatrix,
    episode_return: FloatVector,
    episode_steps: IntVector,
    outcome: IntVector,
):
    """How the step and the episode so far went, for whoever learns from it: weighted terms, their sums,
    return, steps and outcome."""
    for env in range(terms.shape[0]):
        for i in ti.static(range(N_TERM)):
            terms[env, i] = ti.cast(io.reward.term[env, i], ti.f32)
            episode_terms[env, i] = ti.cast(io.reward.episode_sum[env, i], ti.f32)
        episode_return[env] = ti.cast(io.reward.episode_return[env], ti.f32)
        episode_steps[env] = io.clock.step[env]
        outcome[env] = io.termination.outcome[env]


@quick_launch
@ti.kernel
def write_ends(io: Bundle[RewardIO], terminated: ByteVector, truncated: ByteVector):
    """Which episodes have ended, and how: 1 or 0."""
    io.reward.n_ended[None] = 0
    for env in range(terminated.shape[0]):
        outcome = io.termination.outcome[env]
        is_late = outcome == TIMEOUT
        is_over = outcome == SUCCESS or is_failure(outcome) == 1
        terminated[env], truncated[env] = ti.cast(is_over, ti.u8), ti.cast(is_late, ti.u8)
        if is_over or is_late:
            ti.atomic_add(io.reward.n_ended[None], 1)
