"""Sampling model-predictive control: MPPI after Williams, Aldrich and Theodorou, "Model Predictive Path
Integral Control: From Theory to Parallel Computation", Journal of Guidance, Control, and Dynamics 40(2),
2017.

Random sequences of velocities around the last plan are rolled out; the plan becomes their mean, weighted by
exp(-cost / temperature), its first velocity is commanded, and the rest is the next decision's start. The
model is the vehicle's velocity loop (a first-order lag), obstacles move as forecast, costs are those of
tracking the wanted velocity, of obstacles and of the map. Adapted: the noise is correlated in time, since
white noise is gone after the lag; one trial each is the plan itself, the wanted velocity, and a stop, and
one in eight samples spreads around the wanted velocity instead of the plan, so that a plan that leads
nowhere is given up.

Random numbers are a function of start and goal, step, sample and time: the same for any batch.
"""

import taichi as ti

from uuvtai.compile.launch import quick_launch
from uuvtai.kernels.baselines.io import LocalPlannerIO
from uuvtai.kernels.baselines.local_planner import (
    decides,
    edge_stopped,
    mapped_m,
    nearest_obstacle_m,
    speed_limited,
    wanted_velocity,
)
from uuvtai.kernels.core.geometry import turned_z3
from uuvtai.kernels.core.noise import STREAM_MPPI, episode_key, normal, stream_key
from uuvtai.kernels.core.stage import Bundle, loop_end

_HEAVE_SIGMA_M_S = 0.2  # Standard deviation of the noise on heave.
_NOISE_TAU_S = 1.0  # Correlation time of the noise.
_PLAIN = 3  # Trials without noise: the plan, the wanted velocity, a stop.

_FRESH = 8  # One in so many samples spreads around the wanted velocity.

_NEGLIGIBLE = 16.0  # A sample whose exponent is lower than the best one's by more has no part in the mean.


@quick_launch
@ti.kernel
def plan_path_integral(io: Bundle[LocalPlannerIO]):
    """One iteration of MPPI for the rows that decide in this step."""
    n, n_sample = ti.static(io.clock.active.shape[0], io.mppi_cfg.n_sample)
    for env in range(loop_end(n, io.clock)):
        if decides(env, io):
            _shift(env, io)
    for env, sample in ti.ndrange(loop_end(n, io.clock), n_sample):
        if decides(env, io):
            io.baselines.score[env, sample] = _cost(env, sample, io)
    for env in range(loop_end(n, io.clock)):
        if decides(env, io):
            _average(env, io)
            first = io.baselines.plan_w[env, 0]
            first[2] = edge_stopped(first[2], io.ego.pos_w[env][2], io)
            io.baselines.vel_w[env] = first


@ti.func
def _shift(env, io: Bundle[LocalPlannerIO]):
    """The last plan, one decision later; in a new episode the wanted velocity."""
    n_control = ti.static(io.baselines.plan_w.shape[1])
    wanted = wanted_velocity(env, io)
    for k in range(n_control):
        if io.clock.step[env] == 0:
            io.baselines.plan_w[env, k] = wanted
        elif k + 1 < n_control:
            io.baselines.plan_w[env, k] = io.baselines.plan_w[env, k + 1]


@ti.func
def _key(env, io: Bundle[LocalPlannerIO]):
    """Of this decision's random numbers. The vehicle knows where it starts and where it is to go, not which
    episode that is."""
    start, goal = io.mission.start_w[env], io.mission.goal_w[env]
    return stream_key(
        episode_key(ti.bit_cast(start[1], ti.i32), ti.bit_cast(goal[1], ti.i32)),
        io.clock.step[env],
        STREAM_MPPI,
    )


@ti.func
def _noise(key, sample, k, before, io: Bundle[LocalPlannerIO]):
    """Noise [m/s] of a sample at a time, from that at the time before: a first-order Gauss-Markov sequence of
    constant variance."""
    step_s = ti.static(io.baselines_cfg.period_steps * io.episode_cfg.control_dt_s)
    keep = ti.static(2.718281828459045 ** (-step_s / _NOISE_TAU_S))
    fresh = ti.select(k == 0, 1.0, ti.static((1.0 - keep * keep) ** 0.5))
    first = 3 * (sample * ti.static(io.baselines.plan_w.shape[1]) + k)
    level, heave = ti.static(io.mppi_cfg.sigma_m_s, _HEAVE_SIGMA_M_S)
    drawn = ti.Vector(
        [level * normal(key, first), level * normal(key, first + 1), heave * normal(key, first + 2)]
    )
    return before * ti.static(keep) + drawn * fresh * ti.cast(sample >= _PLAIN, ti.f32)


@ti.func
def _base(env, sample, k, wanted, io: Bundle[LocalPlannerIO]):
    """Velocity [m/s] around which a sample spreads."""
    out = io.baselines.plan_w[env, k]
    if sample == 1 or (sample >= _PLAIN and sample % _FRESH == 0):
        out = wanted
    elif sample == 2:
        out = ti.Vector([0.0, 0.0, 0.0])
    return out


@ti.func
def _cost(env, sample, io: Bundle[LocalPlannerIO]):
    """Cost of one sample: of its states, and of the control's share that the theory asks for."""
    n_control = ti.static(io.baselines.plan_w.shape[1])
    step_s, lag = ti.static(
        io.baselines_cfg.period_steps * io.episode_cfg.control_dt_s, io.behavior_cfg.lag_s
    )
    decay = ti.static(2.718281828459045 ** (-step_s / lag))
    wanted, key, yaw = wanted_velocity(env, io), _key(env, io), io.ego.rpy[env][2]
    begin, at, own = io.ego.pos_w[env], io.ego.pos_w[env], turned_z3(io.ego.vel_b[env], yaw)
    here = mapped_m(env, at, io)
    cost, noise, is_touching = 0.0, ti.Vector([0.0, 0.0, 0.0]), 0.0
    for k in range(n_control):
        noise = _noise(key, sample, k, noise, io)
        base = _base(env, sample, k, wanted, io)
        command = speed_limited(base + noise, yaw, io)
        command[2] = edge_stopped(command[2], at[2], io)
        at += command * step_s + (own - command) * (lag * (1.0 - decay))
        own = command + (own - command) * decay
        off = at - (begin + wanted * ((k + 1) * step_s))
        off[2] = at[2] - begin[2] - wanted[2]  # 1 s of the wanted heave is the way to the goal's depth
        state, touch = _state_cost(env, k, at, here, io)
        cost += state + off.norm() + _control_cost(base, noise, io)
        is_touching = ti.max(is_touching, touch)
    return cost / n_control + is_touching * ti.static(io.mppi_cfg.weight_contact)


@ti.func
def _control_cost(base, noise, io: Bundle[LocalPlannerIO]):
    """lambda (1 - alpha) u Sigma^-1 epsilon."""
    share = ti.static(io.mppi_cfg.temperature * (1.0 - io.mppi_cfg.exploration))
    level = ti.static(1.0 / io.mppi_cfg.sigma_m_s**2)
    heave = ti.static(1.0 / _HEAVE_SIGMA_M_S**2)
    return share * (level * (base[0] * noise[0] + base[1] * noise[1]) + heave * base[2] * noise[2])


@ti.func
def _state_cost(env, k, at, here, io: Bundle[LocalPlannerIO]):
    """(cost of being at a place after k + 1 decisions, whether something is touched there)."""
    time = (k + 1) * ti.static(io.baselines_cfg.period_steps * io.episode_cfg.control_dt_s)
    sample = ti.min(
        ti.cast(time * ti.static(1.0 / io.tracking_cfg.forecast_dt_s) + 0.5, ti.i32),
        ti.static(io.forecast.radius_m.shape[2] - 1),
    )
    free = nearest_obstacle_m(env, sample, at, io)
    mapped = mapped_m(env, at, io)
    margin = ti.static(io.mppi_cfg.margin_m) + ti.static(io.mppi_cfg.margin_growth_m_s) * time
    cost = ti.static(io.mppi_cfg.weight_obstacle) * ti.max(margin - free, 0.0)
    cost += ti.static(io.mppi_cfg.weight_static) * ti.max(
        ti.static(io.baselines_cfg.static_margin_m) - mapped, 0.0
    )
    return cost, ti.cast(free < 0.0 or mapped < ti.min(here, 0.0), ti.f32)


@ti.func
def _average(env, io: Bundle[LocalPlannerIO]):
    """The plan becomes the weighted mean of the samples."""
    n_sample, n_control = ti.static(io.mppi_cfg.n_sample, io.baselines.plan_w.shape[1])
    wanted, key, yaw = wanted_velocity(env, io), _key(env, io), io.ego.rpy[env][2]
    least = io.baselines.score[env, 0]
    for sample in range(1, n_sample):
        least = ti.min(least, io.baselines.score[env, sample])
    for k in range(n_control):
        io.baselines.change_w[env, k] = ti.Vector([0.0, 0.0, 0.0])
    total = 0.0
    for sample in range(n_sample):
        excess = (io.baselines.score[env, sample] - least) * ti.static(1.0 / io.mppi_cfg.temperature)
        if excess < _NEGLIGIBLE:
            weight, noise = ti.exp(-excess), ti.Vector([0.0, 0.0, 0.0])
            total += weight
            for k in range(n_control):
                noise = _noise(key, sample, k, noise, io)
                io.baselines.change_w[env, k] += weight * (_base(env, sample, k, wanted, io) + noise)
    for k in range(n_control):
        io.baselines.plan_w[env, k] = speed_limited(io.baselines.change_w[env, k] / total, yaw, io)
