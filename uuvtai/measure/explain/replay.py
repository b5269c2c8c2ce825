"""Watch failed episodes as they are played again: keep the truth and the vehicle's beliefs of their last
seconds.

An episode is the same in any batch, so only the failed ones are replayed, and their ends are known
beforehand: nothing is kept of the time before the last ``facts.WINDOW_S`` but a coarse diary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from uuvtai.config import Config
from uuvtai.measure.episodes.playing import EpisodeResult, Job
from uuvtai.measure.explain import causes, facts
from uuvtai.measure.explain.causes import Explanation
from uuvtai.measure.explain.history import Bodies, CoarseHistory, History
from uuvtai.scenario import body_slots
from uuvtai.sim import Sim
from uuvtai.tree import FlatTree

_SAMPLE_S, _COARSE_S = 0.1, 0.5
"""Time between samples of the window and between entries of the diary; counted from the start, so that rows
are read together."""

_WINDOW_FIELDS = {
    "vehicle": ("pos_w", "quat_wb", "vel_b", "rate_b"),
    "ego": ("pos_w", "vel_valid"),
    "world": ("pos_w", "vel_w"),
    "scan": ("ping_step", "range_m"),
    "tracks": ("alive", "moving", "state"),
    "forecast": ("pos_w", "radius_m", "above_w", "below_w"),
    "teacher": ("leaf", "conflict_s", "action", "clearance_m"),
}
_COARSE_FIELDS = {"vehicle": ("pos_w",), "mission": ("goal_w",), "route": ("n_way",), "teacher": ("leaf",)}
_BODY_FIELDS = {"world": ("kind", "size", "yaw"), "path": ("n_way", "radius_m", "length_m", "speed_m_s")}

_FORESEEN_S = 1.0e3
"""A predicted conflict; beyond = none (geometry.FAR_M)."""


@dataclass
class _Watched:
    """What is kept of one running episode."""

    end_step: int
    step: int = 0
    bodies: Bodies | None = None
    window: list[dict[str, np.ndarray]] = field(default_factory=list)
    coarse: list[dict[str, np.ndarray]] = field(default_factory=list)


class FailureRecorder:
    """Recorder that watches failed episodes as they are replayed; ``found`` maps each job to its
    explanation."""

    def __init__(
        self, config: Config, tree: FlatTree, failed: list[EpisodeResult], own_code: bool = False
    ) -> None:
        """``own_code``: the user's code drives, which may do otherwise when it is asked again."""
        self._config, self._tree = config, tree
        self._dt = config.episode.control_dt_s
        self._expected = {Job(r.seed, r.episode): r for r in failed}
        self._rows: dict[int, _Watched] = {}
        self.found: dict[Job, Explanation] = {}
        self._own_code = own_code
        self.differed: list[Job] = []
        """episodes that the user's code did not play as before: they are not explained"""

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        """An episode has just been reset in this row."""
        self._rows[row] = _Watched(round(self._expected[job].time_s / self._dt))

    def step(self, sim: Sim) -> None:
        """A control step has been done: read the rows that are due, all together."""
        for watched in self._rows.values():
            watched.step += 1
        new = [row for row, watched in self._rows.items() if watched.step == 1]
        for row, read in _read_rows(sim, _BODY_FIELDS, new).items():
            self._rows[row].bodies = _bodies(sim.config, read)
        for row, read in _read_rows(sim, _WINDOW_FIELDS, self._due(self._is_in_window)).items():
            self._rows[row].window.append(read | {"step": np.array(self._rows[row].step)})
        for row, read in _read_rows(sim, _COARSE_FIELDS, self._due(self._is_coarse_due)).items():
            self._rows[row].coarse.append(read | {"step": np.array(self._rows[row].step)})

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """Explain the episode and forget its history. Raises RuntimeError where the replay ended
        differently."""
        job, watched = Job(result.seed, result.episode), self._rows.pop(row)
        expected = self._expected[job]
        if (result.outcome, result.time_s) != (expected.outcome, expected.time_s):
            if self._own_code:
                self.differed.append(job)
                return
            raise RuntimeError(
                f"replay of seed {job.seed} episode {job.episode} ended with {result.outcome} at "
                f"{result.time_s} s instead of {expected.outcome} at {expected.time_s} s: episodes must be "
                "the same in any batch, please report this"
            )
        assert watched.bodies is not None  # read after the first step
        self.found[job] = causes.explain(result.outcome, self._history(watched), watched.bodies, self._config)

    def _due(self, is_due: Callable[[_Watched], bool]) -> list[int]:
        return [row for row, watched in self._rows.items() if is_due(watched)]

    def _is_in_window(self, watched: _Watched) -> bool:
        left = watched.end_step - watched.step
        return left == 0 or (left * self._dt <= facts.WINDOW_S and self._is_multiple(watched.step, _SAMPLE_S))

    def _is_coarse_due(self, watched: _Watched) -> bool:
        return watched.step in (1, watched.end_step) or self._is_multiple(watched.step, _COARSE_S)

    def _is_multiple(self, step: int, period_s: float) -> bool:
        return step % max(1, round(period_s / self._dt)) == 0

    def _history(self, watched: _Watched) -> History:
        w, d = _stacked(watched.window), _stacked(watched.coarse)
        state = w["tracks.state"]
        return History(
            t_s=w["step"] * self._dt,
            pos_w=w["vehicle.pos_w"].astype(float),
            believed_pos_w=w["ego.pos_w"].astype(float),
            vel_valid=w["ego.vel_valid"],
            quat_wb=w["vehicle.quat_wb"].astype(float),
            vel_b=w["vehicle.vel_b"].astype(float),
            rate_b=w["vehicle.rate_b"].astype(float),
            body_w=w["world.pos_w"].astype(float),
            body_vel_w=w["world.vel_w"].astype(float),
            ping_age_s=(w["step"] - w["scan.ping_step"]) * self._dt,
            range_m=w["scan.range_m"].astype(float),
            track_moving=np.where(w["tracks.alive"] == 1, w["tracks.moving"], -1),
            track_w=state[:, :, :2].astype(float),
            forecast_w=w["forecast.pos_w"].astype(float),
            forecast_m=w["forecast.radius_m"][:, :, 0].astype(float),
            forecast_above_w=w["forecast.above_w"].astype(float),
            forecast_below_w=w["forecast.below_w"].astype(float),
            conflict=w["teacher.conflict_s"] < _FORESEEN_S,
            leaf=self._leaves(w["teacher.leaf"]),
            action=w["teacher.action"].astype(float),
            map_clearance_m=w["teacher.clearance_m"].astype(float),
            coarse=CoarseHistory(
                t_s=d["step"] * self._dt,
                pos_w=d["vehicle.pos_w"].astype(float),
                goal_m=np.linalg.norm(d["mission.goal_w"] - d["vehicle.pos_w"], axis=1),
                has_route=d["route.n_way"] > 0,
                leaf=self._leaves(d["teacher.leaf"]),
            ),
        )

    def _leaves(self, nodes: np.ndarray) -> list[str]:
        return [self._tree.types[node] if node >= 0 else "" for node in nodes]


def _read_rows(
    sim: Sim, fields: dict[str, tuple[str, ...]], rows: list[int]
) -> dict[int, dict[str, np.ndarray]]:
    """Row -> 'struct.field' -> its values."""
    if not rows:
        return {}
    read = {
        f"{struct}.{name}": sim.rows(getattr(getattr(sim.s, struct), name), rows)
        for struct, names in fields.items()
        for name in names
    }
    return {row: {name: values[i].copy() for name, values in read.items()} for i, row in enumerate(rows)}


def _stacked(samples: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}


def _bodies(config: Config, read: dict[str, np.ndarray]) -> Bodies:
    """Path facts are per moving slot; bodies at rest get zeros."""
    kind, first = read["world.kind"], body_slots(config.world).first_dynamic
    used, path_speed = kind[first:] > 0, read["path.speed_m_s"].astype(float)
    speed, circle, lap = np.zeros(len(kind)), np.zeros(len(kind)), np.full(len(kind), np.inf)
    speed[first:] = np.where(used, path_speed, 0.0)
    circle[first:] = np.where(used & (read["path.n_way"] == 0), read["path.radius_m"], 0.0)
    moves = used & (path_speed > 0)
    lap[first:][moves] = read["path.length_m"][moves] / path_speed[moves]
    return Bodies(kind, read["world.size"].astype(float), read["world.yaw"].astype(float), speed, circle, lap)
