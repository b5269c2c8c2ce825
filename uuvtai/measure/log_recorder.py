"""Record chosen episodes: read their rows from the simulator after every step and hand them to the log
writer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uuvtai.config import Config
from uuvtai.kernels.core.grid import grid_origin
from uuvtai.kernels.task.reward import TERMS
from uuvtai.learn.pilot import Pilot
from uuvtai.loader import to_yaml
from uuvtai.logs.closed_form import scenario_document
from uuvtai.logs.mcap_log import Due, McapEpisodeLog
from uuvtai.measure.depth_line import depth_line
from uuvtai.measure.episodes.playing import EpisodeResult, Job
from uuvtai.outcomes import OUTCOMES, RUNNING
from uuvtai.plan_codes import PLANNERS, REASONS, TRIGGERS
from uuvtai.run_folder import git_sha
from uuvtai.scenario import describe_scenario
from uuvtai.sim import Sim
from uuvtai.snapshot import EpisodeEnd, EpisodeHeader, EpisodeSnapshot, MapLayers

_STEP_FIELDS = {
    "clock": ("step",),
    "referee": ("outcome", "clearance_m", "ttc_s"),
    "vehicle": ("pos_w", "quat_wb", "vel_b", "rate_b", "rpm"),
    "current": ("vel_w",),
    "actuation": ("thrust_n",),
    "world": ("kind", "pos_w", "vel_w", "size", "yaw"),
    "ego": ("pos_w", "rpy", "vel_b", "vel_valid", "rate_b", "depth_m"),
    "scan": ("fresh", "ping_step", "ping_vel_b", "range_m", "doppler_m_s", "intensity", "hit"),
    "route": (
        "n_way",
        "way_w",
        "plan_step",
        "planner",
        "fallback_reason",
        "trigger",
        "lookahead_w",
        "path_risk",
    ),
    "tracks": ("alive", "moving", "state", "z_m", "radius_m", "beam_track"),
    "teacher": ("status", "leaf", "action"),
    "reward": ("term",),
    "image": ("fresh",),
}
"""What a log needs of every step, by struct."""

_MAP_FIELDS = {"grid_map": ("static_occ", "dynamic_occ"), "clearance": ("clearance_m",)}


@dataclass(frozen=True)
class PolicyNote:
    """What a log says of the policy that drives."""

    pilot: Pilot
    checkpoint_sha256: str
    distill_lambda: float | None
    """weight of the distillation when the checkpoint was written"""


class EpisodeRecorder:
    """Writes one MCAP file per recorded job; ``paths`` maps each to its file."""

    def __init__(
        self,
        folder: Path,
        world: str,
        controller: str,
        jobs: list[Job],
        depth_images: bool = False,
        policy: PolicyNote | None = None,
    ) -> None:
        """``policy``: who drives; None = the simulator's tree."""
        self._world, self._controller, self._wanted, self._depth, self._policy = (
            world,
            controller,
            set(jobs),
            depth_images,
            policy,
        )
        self._logs: dict[int, McapEpisodeLog] = {}
        self._applied: dict[int, np.ndarray] = {}
        self.paths = {job: folder / f"{controller}_seed{job.seed}_episode{job.episode}.mcap" for job in jobs}

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """Open the log of an episode that was just reset, and write its first snapshot."""
        if job not in self._wanted:
            return
        self._logs[row] = McapEpisodeLog(self.paths[job], self._header(sim, row, job), self._depth)
        self._applied[row] = np.zeros(4, np.float32)
        self._write(sim, [row])

    def step(self, sim: Sim) -> None:
        """Write a snapshot of every recorded row."""
        if self._logs:
            self._write(sim, sorted(self._logs))

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """Close the log with the episode's result."""
        if row in self._logs:
            self._logs.pop(row).close(
                EpisodeEnd(
                    outcome=result.outcome,
                    episode_return=result.episode_return,
                    time_s=result.time_s,
                    min_clearance_m=result.min_clearance_m,
                    replans=result.replans,
                    planned_by=result.planned_by,
                )
            )

    def abort(self) -> None:
        """Leave the unfinished logs as they are (``.part``); ``uuv log repair`` reads them."""
        for log in self._logs.values():
            log.abandon()
        self._logs.clear()

    def _header(self, sim: Sim, row: int, job: Job) -> EpisodeHeader:
        s, c = sim.s, sim.config
        scenario = describe_scenario(lambda field: sim.rows(field, [row])[0], s.world, s.path, s.mission)
        return EpisodeHeader(
            controller=self._controller,
            config_yaml=to_yaml(c),
            scenario=scenario_document(c, scenario, self._world, job.seed, job.episode),
            control_dt_s=c.episode.control_dt_s,
            sonar_max_range_m=c.sensors.sonar.max_range_m,
            camera_offset_b_m=c.sensors.depth.offset_b_m,
            reward_terms=TERMS,
            tree_nodes=sim.tree.names,
            git_sha=git_sha() or "unknown",
            checkpoint_sha256=self._policy.checkpoint_sha256 if self._policy else "",
        )

    def _write(self, sim: Sim, rows: list[int]) -> None:
        read = _read(sim, _STEP_FIELDS, rows)
        due = {
            row: self._due(row, {name: values[i] for name, values in read.items()})
            for i, row in enumerate(rows)
        }
        maps = _read_rows(sim, _MAP_FIELDS, [row for row in rows if due[row].maps])
        images = _read_rows(
            sim,
            {"image": ("depth_m", "shot_rpy")},
            [row for i, row in enumerate(rows) if read["image.fresh"][i]],
        )
        for i, row in enumerate(rows):
            layers = _layers(sim.config, maps[row], int(read["clock.step"][i])) if row in maps else None
            snapshot = _snapshot(
                sim, {name: values[i] for name, values in read.items()}, self._applied[row], layers
            )
            if row in images:
                snapshot = _with_image(sim.config, snapshot, images[row], due[row].depth_image)
            thoughts = _thoughts(self._policy, row) if self._policy else {}
            self._logs[row].write(replace(snapshot, **thoughts))
            self._applied[row] = thoughts.get("action_policy", read["teacher.action"][i])

    def _due(self, row: int, r: dict[str, Any]) -> Due:
        due = self._logs[row].due(int(r["clock.step"]), _is_fresh(r), int(r["referee.outcome"]) != RUNNING)
        return Due(due.maps, due.depth_image and bool(r["image.fresh"]))


def _thoughts(policy: PolicyNote, row: int) -> dict[str, Any]:
    """What the policy chooses and expects in this row, as a snapshot's fields."""
    decision = policy.pilot.decision
    return {
        "action_policy": decision.action[row].cpu().numpy(),
        "policy_value": float(decision.value[row]),
        "policy_std": decision.std.cpu().numpy(),
        "distill_lambda": policy.distill_lambda,
        "wm_residual": float(decision.residual[row]) if policy.pilot.world_model else None,
        "wm_uncertainty": float(decision.uncertainty[row]) if policy.pilot.world_model else None,
    }


def _read(sim: Sim, fields: dict[str, tuple[str, ...]], rows: list[int]) -> dict[str, np.ndarray]:
    return {
        f"{struct}.{name}": sim.rows(getattr(getattr(sim.s, struct), name), rows)
        for struct, names in fields.items()
        for name in names
    }


def _read_rows(
    sim: Sim, fields: dict[str, tuple[str, ...]], rows: list[int]
) -> dict[int, dict[str, np.ndarray]]:
    read = _read(sim, fields, rows) if rows else {}
    return {row: {name: values[i] for name, values in read.items()} for i, row in enumerate(rows)}


def _is_fresh(r: dict[str, Any]) -> bool:
    return bool(r["route.n_way"] > 0 and r["route.plan_step"] == r["clock.step"])


def _layers(config: Config, maps: dict[str, np.ndarray], step: int) -> MapLayers:
    static, dynamic, clearance = (
        maps["grid_map.static_occ"],
        maps["grid_map.dynamic_occ"],
        maps["clearance.clearance_m"],
    )
    c = config.clearance
    return MapLayers(
        origin_m=grid_origin(config.world.tank, config.mapping.cell_m),
        cell_m=config.mapping.cell_m,
        static=static,
        dynamic=dynamic,
        clearance_m=clearance,
        clearance_step=step - step % c.period_steps,
        risk=c.risk_static * static
        + c.risk_dynamic * dynamic
        + c.risk_clearance / (clearance + c.risk_epsilon_m),
    )


def _with_image(
    config: Config, snapshot: EpisodeSnapshot, image: dict[str, np.ndarray], whole: bool
) -> EpisodeSnapshot:
    depth_m = image["image.depth_m"]
    line = depth_line(depth_m, image["image.shot_rpy"], config.sensors.depth, config.mapping)
    return replace(snapshot, depth_line=line, depth_image_m=depth_m if whole else None)


def _snapshot(sim: Sim, r: dict[str, Any], applied: np.ndarray, maps: MapLayers | None) -> EpisodeSnapshot:
    """``r`` maps 'struct.field' to this env's row."""
    return EpisodeSnapshot(
        step=int(r["clock.step"]),
        **_truth(r),
        **_sensed(r),
        **_tracked(r),
        **_planned(r),
        action_applied=applied,
        action_teacher=r["teacher.action"],
        tree_status=r["teacher.status"][: len(sim.tree.names)],
        tree_leaf=int(r["teacher.leaf"]),
        reward=r["reward.term"],
        maps=maps,
    )


def _truth(r: dict[str, Any]) -> dict[str, Any]:
    return {
        "outcome": OUTCOMES[int(r["referee.outcome"])],
        "clearance_m": float(r["referee.clearance_m"]),
        "ttc_s": float(r["referee.ttc_s"]),
        "current_w": r["current.vel_w"],
        "thrust_n": r["actuation.thrust_n"],
        **{name: r[f"vehicle.{name}"] for name in ("pos_w", "quat_wb", "vel_b", "rate_b", "rpm")},
        **{f"obstacle_{name}": r[f"world.{name}"] for name in ("kind", "pos_w", "vel_w", "size", "yaw")},
    }


def _sensed(r: dict[str, Any]) -> dict[str, Any]:
    return {
        "estimate_pos_w": r["ego.pos_w"],
        "estimate_rpy": r["ego.rpy"],
        "measured_vel_b": r["ego.vel_b"],
        "measured_vel_valid": bool(r["ego.vel_valid"]),
        "measured_rate_b": r["ego.rate_b"],
        "depth_m": float(r["ego.depth_m"]),
        "sonar_fresh": bool(r["scan.fresh"]),
        "sonar_ping_step": int(r["scan.ping_step"]),
        **{
            f"sonar_{name}": r[f"scan.{name}"]
            for name in ("range_m", "doppler_m_s", "intensity", "hit", "ping_vel_b")
        },
    }


def _tracked(r: dict[str, Any]) -> dict[str, Any]:
    moving = (r["tracks.alive"] == 1) & (r["tracks.moving"] == 1)
    state, explained = r["tracks.state"][moving], r["tracks.beam_track"]
    return {
        "tracks": np.column_stack(
            [state[:, :2], r["tracks.z_m"][moving], state[:, 2:], r["tracks.radius_m"][moving]]
        ),
        "track_beams": np.flatnonzero((explained >= 0) & moving[np.maximum(explained, 0)]),
    }


def _planned(r: dict[str, Any]) -> dict[str, Any]:
    reason = int(r["route.fallback_reason"])
    return {
        "route_w": r["route.way_w"][: int(r["route.n_way"])],
        "route_fresh": _is_fresh(r),
        "route_planner": _code_name(PLANNERS, int(r["route.planner"])),
        "route_fallback": _code_name(REASONS, reason) if reason else "",
        "replan_trigger": _code_name(TRIGGERS, int(r["route.trigger"])),
        "lookahead_w": r["route.lookahead_w"],
        "path_risk": float(r["route.path_risk"]),
    }


def _code_name(names: tuple[str, ...], code: int) -> str:
    """Name of a code that counts from 1; 0 = none."""
    return names[code - 1] if code > 0 else "none"
