"""One vehicle that somebody drives through open water, from a start to a goal: ``uuv simulate
--controller``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from uuvtai.config import Config
from uuvtai.errors import SettingError
from uuvtai.measure.episodes.methods import trees_of
from uuvtai.measure.episodes.playing import Stepper
from uuvtai.measure.simulate import Trial, checked_steps, control_step, experiment, roll_pitch_yaw
from uuvtai.outcomes import RUNNING
from uuvtai.sim import Sim

_NOT_BESIDE = ("wrench", "command", "initial_rpy_deg", "initial_velocity")


def drive(config: Config, trial: Trial, name: str) -> dict[str, list]:
    """As ``simulate.simulate``, positions [m] from the start, with "goal" [m] from there. It ends early where
    the goal is reached or the tank is left. ``name``: a tree or a piece of the user's. Raises SettingError,
    ConfigError, PieceError."""
    for given in _NOT_BESIDE:
        if getattr(trial, given) is not None:
            option = "--" + given.replace("_", "-")
            raise SettingError(
                f"{option}: not beside --controller, which drives from rest; leave one of them out"
            )
    substeps, control_dt = control_step(trial.dt)
    n_step = checked_steps(trial.seconds, control_dt, substeps)
    (method,) = trees_of([name], config.teacher.max_node)
    config = method.config_of(experiment(config, trial))
    config = config.model_copy(
        update={"episode": config.episode.model_copy(update={"horizon_steps": n_step + 1})}
    )
    sim = Sim(config, 1, method.tree, "cpu")
    sim.planner, sim.privileged = method.planner_for(sim), method.privileged
    note = method.driver_for(sim)
    stepper = Stepper(sim, note.pilot if note else None)
    one, zero = torch.ones(1, dtype=torch.int32), torch.zeros(1, dtype=torch.int32)
    stepper.reset(one, zero, zero)
    start, goal = (sim.rows(field)[0].astype(float) for field in (sim.s.vehicle.pos_w, sim.s.mission.goal_w))
    samples = [_sample(sim, start, 0.0)]
    for k in range(1, n_step + 1):
        stepper.step()
        samples.append(_sample(sim, start, k * control_dt))
        if sim.rows(sim.s.referee.outcome)[0] != RUNNING:
            break
    if method.own:
        method.own.close()
    return {key: [s[key] for s in samples] for key in samples[0]} | {"goal": (goal - start).tolist()}


def _sample(sim: Sim, start: np.ndarray, time_s: float) -> dict[str, Any]:
    v = sim.s.vehicle
    position, q, vel, rate, rpm = (
        sim.rows(field)[0].astype(float) for field in (v.pos_w, v.quat_wb, v.vel_b, v.rate_b, v.rpm)
    )
    return {
        "t": time_s,
        "position": (position - start).tolist(),
        "rpy_deg": np.degrees(roll_pitch_yaw(q)).tolist(),
        "nu": [*vel.tolist(), *rate.tolist()],
        "rpm": rpm.tolist(),
    }
