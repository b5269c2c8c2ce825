"""Why an episode failed: one label from the facts of its last seconds, and remarks. Pure NumPy, nothing runs
here.

Every failed episode gets exactly one label, the first of ``CAUSES`` whose condition holds. The order asks
what a developer would ask: was there a chance at all, did the vehicle *know* of what killed it (sensing,
tracking, forecast: the first half), and if it did, what did the agent make of it (the second half). Remarks
add what may have contributed; any number of them may hold.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uuvtai.common.statistics import mean
from uuvtai.config import Config
from uuvtai.evaluation import failure_facts
from uuvtai.evaluation.episodes import Agent, EpisodeResult, Job, Progress, run_episodes
from uuvtai.evaluation.failure_facts import (
    BACK_RAD,
    BLIND_S,
    CLIMB_S,
    LAST_S,
    LEAD_S,
    CoarseHistory,
    History,
    Obstacles,
    Scene,
    Touched,
    timeout_facts,
    touched_facts,
)
from uuvtai.sim.behavior_tree import FlatTree
from uuvtai.sim.setup import obstacle_slots
from uuvtai.sim.sim import Sim

if TYPE_CHECKING:
    from uuvtai.logs.writer import PolicyNote


START_S = 2.0  # a younger episode starts in danger: evading takes a second, obstacles start 1.5 m away
UNDETECTED_S = 0.3  # out of the sonar's fan all this time before the end (no track 0.3 s before)
TURN_S = 1.2
"""An unannounced turn lies within this before the end, and the forecast made just before it
was off by more than MISS_M at the end, or there was none."""
CLEAR_M = 0.1
"""An obstacle remembered farther above or below counts as clear of the own depth (the termination check's
contact)."""
LATELY_S = 2.5  # Remarks look back this far.
MISS_M = 0.35  # a forecast missed when farther off than the agent's margin at a second (0.25 m + 0.1 m/s)
REACH_M = 0.4  # squeezed: something static this near to the hull leaves no room (0.17 + 0.1 m + margin)
CROWD_M = 0.6  # Crowded: a second moving obstacle came nearer to the hull in the last CROWD_S.
NEAR_M = 1.0
"""Contact with something static is no accident of its own with a mover this near in the last NEAR_S."""
PLACE_M = 0.1
"""Lost its place: the own position was off by more than the margin (``behavior.static_margin_m``)."""
DEPTH_M = 0.05
"""Took floor or surface for farther than it was: the own depth was off by more, towards it; the agent keeps
the hull 0.03 m off and three standard deviations of the depth."""
CLIMB_M = 0.15  # Changed its depth: moved by more, upwards or downwards, in the last second.
PROGRESS_M = 1.0  # A timeout that came this much nearer to the goal in that time was only slow.
STUCK_M = 0.5  # A vehicle that drove less in that time did not move.

CAUSES: dict[str, str] = {
    "out_of_tank": "left the tank",
    "depth_error": f"touched floor or surface, the own depth off by > {DEPTH_M:g} m towards it",
    "localization_error": f"touched a static or wall, the own position off by > {PLACE_M:g} m",
    "velocity_lost": "touched floor, surface, a static or wall, the own velocity unknown in most of the last "
    f"{BLIND_S:g} s",
    "hit_floor": "touched the floor",
    "hit_surface": "touched the surface",
    "evaded_into_static": f"touched a static or wall while evading, or with a moving obstacle within "
    f"{NEAR_M:g} m",
    "hit_static": "touched a static obstacle, no moving obstacle near",
    "hit_wall": "touched a side wall, no moving obstacle near",
    "no_escape_at_start": f"over within the first {START_S:g} s",
    "undetected_beside": f"it was beside or behind the sonar's fan all through the last {UNDETECTED_S:g} s",
    "undetected_depth_change": f"it was above or below the sonar's fan all through the last {UNDETECTED_S:g} "
    f"s, and the own depth changed towards it by > {CLIMB_M:g} m in the last {CLIMB_S:g} s",
    "undetected_above": f"it was above the sonar's fan all through the last {UNDETECTED_S:g} s",
    "undetected_below": f"it was below the sonar's fan all through the last {UNDETECTED_S:g} s",
    "obstacle_reversed": f"it turned back in the last {TURN_S:g} s and the forecast before it was wrong",
    "obstacle_turned": f"it turned a corner in the last {TURN_S:g} s and the forecast before it was wrong",
    "late_detection": f"it came into the sonar's fan less than {LEAD_S:g} s before the end",
    "occluded": f"it was behind something else until {LEAD_S:g} s before the end",
    "untracked": f"it was seen, but no forecast of it {LEAD_S:g} s before the end",
    "obstacle_on_curve": f"it moved on a circle, forecast off by > {MISS_M:g} m",
    "prediction_error": f"it moved on a straight course, forecast off by > {MISS_M:g} m",
    "late_reaction": "forecast right, but evasion began after the last chance to escape, or never",
    "failed_evasion": "forecast right and evading before the last chance to escape: it chose the wrong way",
    "depth_change_needed": "forecast right, but only a change of depth would have escaped",
    "no_depth_left": "forecast right, only below the floor or above the surface was there a way out",
    "blocked_by_static": f"forecast right, no way out: static or wall within {REACH_M:g} m",
    "second_obstacle_near": f"forecast right, no way out: a second moving obstacle within {CROWD_M:g} m",
    "obstacle_too_fast": "forecast right, no way out: the obstacle is too fast to give way to",
    "no_route": f"timeout: no route in most of the last {LAST_S:g} s",
    "too_slow": f"timeout: still came > {PROGRESS_M:g} m nearer to the goal in the last {LAST_S:g} s",
    "waiting": f"timeout: waited on purpose in most of the last {LAST_S:g} s",
    "blocked_by_traffic": f"timeout: evaded in most of the last {LAST_S:g} s",
    "stuck": f"timeout: drove < {STUCK_M:g} m in the last {LAST_S:g} s",
    "no_progress": f"timeout: drove on without coming nearer in the last {LAST_S:g} s",
}
"""Every label with its meaning, in order of precedence (it: what ended the episode; forecasts and
escapes: LEAD_S before the end)."""


Fact = dict[str, Any]

REMARKS: dict[str, Callable[[Fact], bool]] = {
    "second obstacle near": lambda f: _within(f["second_body_m"], CROWD_M),
    "static near": lambda f: f["static_near_m"] < REACH_M,
    "turned lately": lambda f: _within(f["turned_ago_s"], LATELY_S),
    "corner passed in reach before": lambda f: (
        _within(f["turned_ago_s"], TURN_S) and bool(f["turns_in_reach_before"])
    ),
    "changed its depth": lambda f: abs(f["climbed_m"]) > CLIMB_M,
    "remembered to the end": lambda f: _is_undetected(f) and f["belief_error_m"] is not None,
    "remembered clear of the own depth": lambda f: (
        _is_undetected(f) and (f["believed_gap_m"] or 0.0) > CLEAR_M
    ),
    "taken as static": lambda f: _within(f["taken_as_static_ago_s"], LATELY_S),
    "backed off before the last chance": lambda f: (
        f["leaf"] == "BackOff" and f["leaf_s"] > (f["last_chance_s"] or 0.0)
    ),
    "only heave escaped": lambda f: not f["escapes"] and bool(f["escapes_by_heave"]),
}
"""What may have contributed, where what ended the episode moves. "Corner passed in reach before": was
learnable."""

_IMPLIED = {
    ("obstacle_turned", "turned lately"),
    ("obstacle_reversed", "turned lately"),
    ("undetected_depth_change", "changed its depth"),
    ("depth_change_needed", "only heave escaped"),
    ("blocked_by_static", "static near"),
    ("second_obstacle_near", "second obstacle near"),
}
"""Remarks that a label says already."""


@dataclass
class Explanation:
    """Label, facts and remarks of one failed episode."""

    label: str
    touched: Touched
    facts: Fact = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def explain(outcome: str, history: History, obstacles: Obstacles, config: Config) -> Explanation:
    """Label and facts of an episode that ended with ``outcome`` (collision, ttc, out_of_tank or timeout)."""
    if outcome == "timeout":
        facts = timeout_facts(history.coarse)
        return Explanation(timeout_label(facts), Touched(""), facts)
    scene = Scene(history, obstacles, config)
    touched = scene.touched(outcome)
    facts, remarks = scene.facts(touched), []
    if touched.moving and touched.slot is not None:
        facts |= touched_facts(history, obstacles, touched.slot, config)
    label = label_of(outcome, touched, facts)
    if touched.moving:
        remarks = [name for name, holds in REMARKS.items() if holds(facts) and (label, name) not in _IMPLIED]
    if label == "no_escape_at_start":
        remarks.insert(0, f"else {label_of(outcome, touched, facts | {'age_s': START_S})}")
    return Explanation(label, touched, facts, remarks)


# ----------------------------------------------------------------------------------------------------- labels


def label_of(outcome: str, touched: Touched, facts: Fact) -> str:
    """The first cause that holds; its order and meaning are ``CAUSES``."""
    if outcome == "out_of_tank":
        return "out_of_tank"
    if touched.name in ("floor", "surface"):
        towards = facts["depth_error_m"] * (1 if touched.name == "floor" else -1)
        if towards > DEPTH_M:
            return "depth_error"
        return "velocity_lost" if facts["blind_share"] > 0.5 else f"hit_{touched.name}"
    if not touched.moving:
        if facts["place_error_m"] > PLACE_M:
            return "localization_error"
        if facts["blind_share"] > 0.5:
            return "velocity_lost"
        pushed = facts["evading_s"] > 0 or _within(facts["moving_near_m"], NEAR_M)
        return "evaded_into_static" if pushed else "hit_wall" if touched.name == "wall" else "hit_static"
    return _knowledge_label(facts) or _decision_label(facts)


def _knowledge_label(facts: Fact) -> str | None:
    """What kept the vehicle from knowing where what was touched would be; None = it knew."""
    if facts["age_s"] < START_S:
        return "no_escape_at_start"
    if _is_undetected(facts):
        if facts["width_ago_s"] is None or facts["width_ago_s"] >= UNDETECTED_S:
            return "undetected_beside"
        above = facts["vertical_gap_m"] > 0
        if facts["climbed_m"] * (1 if above else -1) > CLIMB_M:
            return "undetected_depth_change"
        return "undetected_above" if above else "undetected_below"
    if _within(facts["turned_ago_s"], TURN_S) and not _within(facts["turn_error_m"], MISS_M):
        return "obstacle_reversed" if facts["turned_deg"] > math.degrees(BACK_RAD) else "obstacle_turned"
    if facts["forecast_error_m"] is None:
        if facts["fan_share"] < 0.5:
            return "late_detection"
        return "occluded" if facts["seen_share"] < 0.5 else "untracked"
    if facts["forecast_error_m"] > MISS_M:
        return "obstacle_on_curve" if facts["circle_m"] else "prediction_error"
    return None


def _decision_label(facts: Fact) -> str:
    """What the agent made of what it knew; where nothing could be made of it, what stood in the way."""
    if facts["escapes"]:
        return "late_reaction" if facts["evading_s"] < facts["last_chance_s"] else "failed_evasion"
    if facts["escapes_by_heave"]:
        return "depth_change_needed"
    if facts["escapes_beyond_edge"]:
        return "no_depth_left"
    if facts["static_near_m"] < REACH_M:
        return "blocked_by_static"
    return "second_obstacle_near" if _within(facts["second_body_m"], CROWD_M) else "obstacle_too_fast"


def timeout_label(facts: Fact) -> str:
    if facts["no_route_share"] > 0.5:
        return "no_route"
    if facts["progress_m"] > PROGRESS_M:
        return "too_slow"
    if facts["waiting_share"] > 0.5:
        return "waiting"
    if facts["evading_share"] > 0.5:
        return "blocked_by_traffic"
    return "stuck" if facts["driven_m"] < STUCK_M else "no_progress"


def _is_undetected(facts: Fact) -> bool:
    return facts["fan_ago_s"] is None or facts["fan_ago_s"] >= UNDETECTED_S


def _within(value: float | None, limit: float) -> bool:
    return value is not None and value <= limit


# ---- Watch failed episodes as they are run again: keep the truth and the vehicle's beliefs of their last
# seconds. An episode is the same in any batch, so only the failed ones are replayed, and their ends are known
# beforehand: nothing is kept of the time before the last ``facts.WINDOW_S`` but a coarse diary.

_SAMPLE_S, _COARSE_S = 0.1, 0.5
"""Time between samples, and entries of the diary; counted from the start, so that rows go together."""

_WINDOW_FIELDS = {
    "vehicle": ("pos_w", "quat_wb", "vel_b", "rate_b"),
    "ego": ("pos_w", "vel_valid"),
    "world": ("pos_w", "vel_w"),
    "scan": ("ping_step", "range_m"),
    "tracks": ("alive", "moving", "state"),
    "forecast": ("pos_w", "radius_m", "above_w", "below_w"),
    "behavior": ("leaf", "conflict_s", "action", "clearance_m"),
}
_COARSE_FIELDS = {"vehicle": ("pos_w",), "mission": ("goal_w",), "route": ("n_way",), "behavior": ("leaf",)}
_OBSTACLE_FIELDS = {"world": ("kind", "size", "yaw"), "path": ("n_way", "radius_m", "length_m", "speed_m_s")}

_FORESEEN_S = 1.0e3  # A predicted conflict; beyond = none (geometry.FAR_M).


@dataclass
class _Watched:
    """What is kept of one running episode."""

    end_step: int
    step: int = 0
    obstacles: Obstacles | None = None
    window: list[dict[str, np.ndarray]] = field(default_factory=list)
    coarse: list[dict[str, np.ndarray]] = field(default_factory=list)


class FailureRecorder:
    """Recorder that watches failed episodes as they are replayed; ``found``: job -> explanation."""

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
        """episodes that the user's code did not run as before: they are not explained"""

    def begin(self, sim: Sim, row: int, job: Job) -> None:
        self._rows[row] = _Watched(round(self._expected[job].time_s / self._dt))

    def step(self, sim: Sim) -> None:
        """A control step has been done: read the rows that are due, all together."""
        for watched in self._rows.values():
            watched.step += 1
        new = [row for row, watched in self._rows.items() if watched.step == 1]
        for row, read in _read_rows(sim, _OBSTACLE_FIELDS, new).items():
            self._rows[row].obstacles = _obstacles(sim.config, read)
        for row, read in _read_rows(sim, _WINDOW_FIELDS, self._due(self._is_in_window)).items():
            self._rows[row].window.append(read | {"step": np.array(self._rows[row].step)})
        for row, read in _read_rows(sim, _COARSE_FIELDS, self._due(self._is_coarse_due)).items():
            self._rows[row].coarse.append(read | {"step": np.array(self._rows[row].step)})

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """Explain the episode, forget its history. Raises RuntimeError where the replay ended differently."""
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
        assert watched.obstacles is not None  # read after the first step
        self.found[job] = explain(result.outcome, self._history(watched), watched.obstacles, self._config)

    def _due(self, is_due: Callable[[_Watched], bool]) -> list[int]:
        return [row for row, watched in self._rows.items() if is_due(watched)]

    def _is_in_window(self, watched: _Watched) -> bool:
        left = watched.end_step - watched.step
        return left == 0 or (
            left * self._dt <= failure_facts.WINDOW_S and self._is_multiple(watched.step, _SAMPLE_S)
        )

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
            obstacle_w=w["world.pos_w"].astype(float),
            obstacle_vel_w=w["world.vel_w"].astype(float),
            ping_age_s=(w["step"] - w["scan.ping_step"]) * self._dt,
            range_m=w["scan.range_m"].astype(float),
            track_moving=np.where(w["tracks.alive"] == 1, w["tracks.moving"], -1),
            track_w=state[:, :, :2].astype(float),
            forecast_w=w["forecast.pos_w"].astype(float),
            forecast_m=w["forecast.radius_m"][:, :, 0].astype(float),
            forecast_above_w=w["forecast.above_w"].astype(float),
            forecast_below_w=w["forecast.below_w"].astype(float),
            conflict=w["behavior.conflict_s"] < _FORESEEN_S,
            leaf=self._leaves(w["behavior.leaf"]),
            action=w["behavior.action"].astype(float),
            map_clearance_m=w["behavior.clearance_m"].astype(float),
            coarse=CoarseHistory(
                t_s=d["step"] * self._dt,
                pos_w=d["vehicle.pos_w"].astype(float),
                goal_m=np.linalg.norm(d["mission.goal_w"] - d["vehicle.pos_w"], axis=1),
                has_route=d["route.n_way"] > 0,
                leaf=self._leaves(d["behavior.leaf"]),
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


def _obstacles(config: Config, read: dict[str, np.ndarray]) -> Obstacles:
    """Path facts are per moving slot; static obstacles get zeros."""
    kind, first = read["world.kind"], obstacle_slots(config.world).first_dynamic
    used, path_speed = kind[first:] > 0, read["path.speed_m_s"].astype(float)
    speed, circle, lap = np.zeros(len(kind)), np.zeros(len(kind)), np.full(len(kind), np.inf)
    speed[first:] = np.where(used, path_speed, 0.0)
    circle[first:] = np.where(used & (read["path.n_way"] == 0), read["path.radius_m"], 0.0)
    moves = used & (path_speed > 0)
    lap[first:][moves] = read["path.length_m"][moves] / path_speed[moves]
    return Obstacles(
        kind, read["world.size"].astype(float), read["world.yaw"].astype(float), speed, circle, lap
    )


# ---- Explain failed episodes: run them again, label each, and record the worst.

EXAMPLES = 3  # Episodes named per label in the table.


@dataclass(frozen=True, eq=False)
class Row:
    result: EpisodeResult
    explanation: Explanation

    def document(self) -> dict[str, Any]:
        r, e = self.result, self.explanation
        shared = {
            "seed": r.seed,
            "episode": r.episode,
            "outcome": r.outcome,
            "label": e.label,
            "remarks": e.remarks,
            "log": None,
        }
        return shared | {"touched": vars(e.touched)} | e.facts


def explain_failures(
    sim: Sim,
    results: list[EpisodeResult],
    progress: Progress | None = None,
    agent: Agent | None = None,
    own_code: bool = False,
) -> list[Row]:
    """Replay the failed episodes of one agent and explain them; in the order of ``results``. Raises
    RuntimeError (see ``FailureRecorder.end``). With ``own_code``, the user's, episodes that it runs
    otherwise this time are left out.

    Where a ``agent`` drives, the facts about leaves and actions are those of the tree beside it.
    """
    failed = failures(results)
    if not failed:
        return []
    recorder = FailureRecorder(sim.config, sim.tree, failed, own_code)
    jobs = [Job(r.seed, r.episode) for r in failed]
    run_episodes(sim, jobs, recorder, progress, agent)
    return [Row(r, recorder.found[job]) for r, job in zip(failed, jobs, strict=True) if job in recorder.found]


def failures(results: list[EpisodeResult]) -> list[EpisodeResult]:
    return [r for r in results if r.outcome != "success"]


def table_of(rows: list[Row]) -> list[dict[str, Any]]:
    """Per label, most frequent first: count, share of the failures, meaning and the worst episodes."""
    counts = Counter(row.explanation.label for row in rows)
    order = list(CAUSES)
    return [
        {
            "label": label,
            "count": counts[label],
            "share": counts[label] / len(rows),
            "meaning": CAUSES[label],
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
        "knew_share": mean([float(error is not None and error <= MISS_M) for error in errors]),
        "undetected_median_s": _median(found, "seen_ago_s", failure_facts.WINDOW_S),
        "evading_median_s": _median(found, "evading_s", 0.0),
        "last_chance_median_s": _median(found, "last_chance_s", failure_facts.CHANCES_S[-1]),
    }


def _median(found: list[Explanation], name: str, beyond: float) -> float | None:
    """Median of the episodes that have the fact; ``beyond`` stands for farther back than was looked."""
    values = [beyond if e.facts[name] is None else e.facts[name] for e in found if name in e.facts]
    return float(np.median(values)) if values else None


def worst_of(rows: list[Row], label: str) -> list[Row]:
    """Episodes of a label, worst first: the hardest hits; timeouts that ended farthest from the goal."""

    def severity(row: Row) -> tuple[float, float]:
        return (row.explanation.touched.closing_m_s or 0.0, row.explanation.facts.get("goal_m", 0.0))

    return sorted((row for row in rows if row.explanation.label == label), key=severity, reverse=True)


def chosen_for_recording(rows: list[Row], wanted: int) -> list[Row]:
    """The worst episode of the most frequent label, of the second, ..., then the next worst of the first."""
    queues = [worst_of(rows, entry["label"]) for entry in table_of(rows)]
    rounds = [queue[i] for i in range(max(map(len, queues), default=0)) for queue in queues if i < len(queue)]
    return rounds[:wanted]


def record_worst(
    sim: Sim,
    rows: list[Row],
    folder: Path,
    world: str,
    agent: str,
    note: Callable[[str], None],
    policy: PolicyNote | None = None,
    agents: Sequence[str] = (),
) -> list[Path]:
    """Run these episodes once more into ``folder``: an MCAP log each, named after the cause, with a picture
    beside it.

    ``agents``: all that are compared, in order, so that each keeps its colour.
    """
    from uuvtai.logs.picture import picture
    from uuvtai.logs.writer import EpisodeRecorder

    if not rows:
        return []
    jobs = [Job(row.result.seed, row.result.episode) for row in rows]
    recorder = EpisodeRecorder(folder, Path(world).stem, agent, jobs, policy=policy)
    try:
        run_episodes(sim, jobs, recorder, agent=policy.agent if policy else None)
    finally:
        recorder.abort()
    paths = [
        (path := recorder.paths[job]).rename(path.with_name(f"{row.explanation.label}_{path.name}"))
        for job, row in zip(jobs, rows, strict=True)
    ]
    for path, row in zip(paths, rows, strict=True):
        note(f"drawing {path.stem}")
        label = row.explanation.label
        remark = f"{label.replace('_', ' ')}: {CAUSES[label]}"
        picture(path, path.with_suffix(".png"), remark=remark, agents=agents)
    return paths
