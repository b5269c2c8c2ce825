"""Explain failed episodes: play them again, keep the truth and the vehicle's beliefs of their last seconds,
label each (``causes.py``).

An episode is the same in any batch, so only the failed ones are replayed, and their ends are known
beforehand: nothing is kept of the time before the last ``facts.WINDOW_S`` but a coarse diary.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uuvtai.config import Config
from uuvtai.measure.episodes.playing import Driver, EpisodeResult, Job, Progress, run_episodes
from uuvtai.measure.explain import causes, facts
from uuvtai.measure.explain.causes import Explanation
from uuvtai.measure.explain.history import Bodies, Diary, History
from uuvtai.scenario import body_slots
from uuvtai.sim import Sim
from uuvtai.statistics import mean
from uuvtai.tree import FlatTree

if TYPE_CHECKING:
    from uuvtai.measure.log_recorder import PolicyNote

EXAMPLES = 3
"""Episodes named per label in the table."""

_SAMPLE_S, _DIARY_S = 0.1, 0.5
"""Time between samples of the window and between entries of the diary; counted from the start, so that rows
are read together."""

_WINDOW_FIELDS = {
    "vehicle": ("pos_w", "quat_wb", "vel_b", "rate_b"),
    "world": ("pos_w", "vel_w"),
    "scan": ("ping_step", "range_m"),
    "tracks": ("alive", "moving", "state"),
    "forecast": ("pos_w", "radius_m", "above_w", "below_w"),
    "teacher": ("leaf", "conflict_s", "action", "clearance_m"),
}
_DIARY_FIELDS = {"vehicle": ("pos_w",), "mission": ("goal_w",), "route": ("n_way",), "teacher": ("leaf",)}
_BODY_FIELDS = {"world": ("kind", "size", "yaw"), "path": ("n_way", "radius_m", "length_m", "speed_m_s")}

_FORESEEN_S = 1.0e3
"""A predicted conflict; beyond = none (geometry.FAR_M)."""


@dataclass(frozen=True, eq=False)
class Row:
    """A failed episode with its explanation."""

    result: EpisodeResult
    explanation: Explanation

    def document(self) -> dict[str, Any]:
        """One entry of ``explain`` in ``uuv eval --json``."""
        r, e = self.result, self.explanation
        told = {
            "seed": r.seed,
            "episode": r.episode,
            "outcome": r.outcome,
            "label": e.label,
            "remarks": e.remarks,
            "log": None,
        }
        return told | {"killer": vars(e.killer)} | e.facts


@dataclass
class _Watched:
    """What is kept of one running episode."""

    end_step: int
    step: int = 0
    bodies: Bodies | None = None
    window: list[dict[str, np.ndarray]] = field(default_factory=list)
    diary: list[dict[str, np.ndarray]] = field(default_factory=list)


class Coroner:
    """Recorder that watches failed episodes as they are replayed; ``found`` maps each job to its
    explanation."""

    def __init__(self, config: Config, tree: FlatTree, failed: list[EpisodeResult]) -> None:
        self._config, self._tree = config, tree
        self._dt = config.episode.control_dt_s
        self._expected = {Job(r.seed, r.episode): r for r in failed}
        self._rows: dict[int, _Watched] = {}
        self.found: dict[Job, Explanation] = {}

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
        for row, read in _read_rows(sim, _DIARY_FIELDS, self._due(self._is_diary_due)).items():
            self._rows[row].diary.append(read | {"step": np.array(self._rows[row].step)})

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """Explain the episode and forget its history. Raises RuntimeError where the replay ended
        differently."""
        job, watched = Job(result.seed, result.episode), self._rows.pop(row)
        expected = self._expected[job]
        if (result.outcome, result.time_s) != (expected.outcome, expected.time_s):
            raise RuntimeError(
                f"replay of seed {job.seed} episode {job.episode} ended with {result.outcome} at "
                f"{result.time_s} s instead of "
                f"{expected.outcome} at {expected.time_s} s: episodes must be the same in any batch, please "
                "report this"
            )
        assert watched.bodies is not None  # read after the first step
        self.found[job] = causes.explain(result.outcome, self._history(watched), watched.bodies, self._config)

    def _due(self, is_due: Callable[[_Watched], bool]) -> list[int]:
        return [row for row, watched in self._rows.items() if is_due(watched)]

    def _is_in_window(self, watched: _Watched) -> bool:
        left = watched.end_step - watched.step
        return left == 0 or (left * self._dt <= facts.WINDOW_S and self._is_multiple(watched.step, _SAMPLE_S))

    def _is_diary_due(self, watched: _Watched) -> bool:
        return watched.step in (1, watched.end_step) or self._is_multiple(watched.step, _DIARY_S)

    def _is_multiple(self, step: int, period_s: float) -> bool:
        return step % max(1, round(period_s / self._dt)) == 0

    def _history(self, watched: _Watched) -> History:
        w, d = _stacked(watched.window), _stacked(watched.diary)
        state = w["tracks.state"]
        return History(
            t_s=w["step"] * self._dt,
            pos_w=w["vehicle.pos_w"].astype(float),
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
            diary=Diary(
                t_s=d["step"] * self._dt,
                pos_w=d["vehicle.pos_w"].astype(float),
                goal_m=np.linalg.norm(d["mission.goal_w"] - d["vehicle.pos_w"], axis=1),
                has_route=d["route.n_way"] > 0,
                leaf=self._leaves(d["teacher.leaf"]),
            ),
        )

    def _leaves(self, nodes: np.ndarray) -> list[str]:
        return [self._tree.types[node] if node >= 0 else "" for node in nodes]


def explain_failures(
    sim: Sim,
    tree: FlatTree,
    results: list[EpisodeResult],
    progress: Progress | None = None,
    driver: Driver | None = None,
) -> list[Row]:
    """Replay the failed episodes of one method and explain them; in the order of ``results``. Raises
    RuntimeError (see ``Coroner.end``).

    Where a ``driver`` drives, the facts about leaves and actions are those of the tree beside it.
    """
    failed = failures(results)
    if not failed:
        return []
    sim.use_tree(tree)
    coroner = Coroner(sim.config, tree, failed)
    run_episodes(sim, [Job(r.seed, r.episode) for r in failed], coroner, progress, driver)
    return [Row(r, coroner.found[Job(r.seed, r.episode)]) for r in failed]


def failures(results: list[EpisodeResult]) -> list[EpisodeResult]:
    """Everything that is no success."""
    return [r for r in results if r.outcome != "success"]


def table_of(rows: list[Row]) -> list[dict[str, Any]]:
    """Per label, most frequent first: count, share of the failures, meaning and the worst episodes."""
    counts = Counter(row.explanation.label for row in rows)
    order = list(causes.CAUSES)
    return [
        {
            "label": label,
            "count": counts[label],
            "share": counts[label] / len(rows),
            "meaning": causes.CAUSES[label],
            **_typical([row.explanation for row in rows if row.explanation.label == label]),
            "examples": [[row.result.seed, row.result.episode] for row in worst_of(rows, label)[:EXAMPLES]],
        }
        for label in sorted(counts, key=lambda label: (-counts[label], order.index(label)))
    ]


def _typical(found: list[Explanation]) -> dict[str, Any]:
    """What a label's episodes have in common; None where a label has no such fact."""
    errors = [e.facts["forecast_error_m"] for e in found if "forecast_error_m" in e.facts]
    return {
        "remarks": dict(Counter(remark for e in found for remark in e.remarks).most_common()),
        "knew_share": mean([float(error is not None and error <= causes.MISS_M) for error in errors]),
        "unseen_median_s": _median(found, "seen_ago_s", facts.WINDOW_S),
        "evading_median_s": _median(found, "evading_s", 0.0),
        "last_chance_median_s": _median(found, "last_chance_s", facts.CHANCES_S[-1]),
    }


def _median(found: list[Explanation], name: str, beyond: float) -> float | None:
    """Median of the episodes that have the fact; ``beyond`` stands for farther back than was looked."""
    values = [beyond if e.facts[name] is None else e.facts[name] for e in found if name in e.facts]
    return float(np.median(values)) if values else None


def worst_of(rows: list[Row], label: str) -> list[Row]:
    """Episodes of a label, the worst first: the hardest hits, of timeouts those that ended farthest from the
    goal."""

    def badness(row: Row) -> tuple[float, float]:
        return (row.explanation.killer.closing_m_s or 0.0, row.explanation.facts.get("goal_m", 0.0))

    return sorted((row for row in rows if row.explanation.label == label), key=badness, reverse=True)


def chosen_for_recording(rows: list[Row], wanted: int) -> list[Row]:
    """The worst episode of the most frequent label, then of the second, ...; after the last label the next
    worst of the first."""
    queues = [worst_of(rows, entry["label"]) for entry in table_of(rows)]
    rounds = [queue[i] for i in range(max(map(len, queues), default=0)) for queue in queues if i < len(queue)]
    return rounds[:wanted]


def record_worst(
    sim: Sim,
    tree: FlatTree,
    rows: list[Row],
    folder: Path,
    world: str,
    method: str,
    note: Callable[[str], None],
    policy: PolicyNote | None = None,
    methods: Sequence[str] = (),
) -> list[Path]:
    """Play these episodes once more into ``folder``: an MCAP log each, named after the cause, with a picture
    and a video beside it.

    ``methods``: all that are compared, in order, so that each keeps its colour.
    """
    from uuvtai.logs.picture import picture
    from uuvtai.logs.video import SMALL, video
    from uuvtai.measure.log_recorder import EpisodeRecorder

    if not rows:
        return []
    jobs = [Job(row.result.seed, row.result.episode) for row in rows]
    sim.use_tree(tree)
    recorder = EpisodeRecorder(folder, Path(world).stem, method, jobs, policy=policy)
    try:
        run_episodes(sim, jobs, recorder, driver=policy.pilot if policy else None)
    finally:
        recorder.abort()
    paths = [
        _renamed(recorder.paths[job], row.explanation.label) for job, row in zip(jobs, rows, strict=True)
    ]
    for path, row in zip(paths, rows, strict=True):
        note(f"drawing {path.stem}")
        label = row.explanation.label
        cause = label.replace("_", " ")
        picture(path, path.with_suffix(".png"), remark=f"{cause}: {causes.CAUSES[label]}", methods=methods)
        video(path, path.with_suffix(".webm"), remark=cause, methods=methods, **SMALL)
    return paths


def _renamed(path: Path, label: str) -> Path:
    return path.rename(path.with_name(f"{label}_{path.name}"))


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
