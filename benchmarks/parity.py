"""The twin beside the simulator: success of one policy on the same scenarios, and errors of the tracks that
it was shown.

Trains nothing: ``--policy RUN`` names a policy that learnt in the twin. It plays the same episodes in both,
in six scenes. Tracks are what the policy is shown ten times a second; a true body is tracked where one of
them lies within ``GATE_M``, and the errors are those of the nearest.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from benchmarks.common import Job, Row
from uuvtai.config.learning import LearningConfig
from uuvtai.learn.checkpoint import Checkpoint
from uuvtai.learn.set_networks import actor_of
from uuvtai.learn.set_pilot import set_pilot_of
from uuvtai.learn.set_policy import MOST_WISH, SetActor
from uuvtai.learn.track_futures import path_places
from uuvtai.learn.world_sims import simulator_of
from uuvtai.measure.episodes.methods import find_policy
from uuvtai.measure.episodes.playing import EpisodeResult, run_episodes
from uuvtai.measure.episodes.playing import Job as Episode
from uuvtai.outcomes import RUNNING, SUCCESS
from uuvtai.scenario import Scene
from uuvtai.sim import Sim
from uuvtai.statistics import wilson_interval
from uuvtai.twin.scenario_bank import draw_bank, scenario_rows
from uuvtai.twin.twin_arrays import AT_POS
from uuvtai.twin.twin_world import Twin

LONGEST_S = 3600
THREADS = 1
SCENES: tuple[tuple[str, Scene], ...] = tuple(
    (world, scene) for world in ("gauntlet", "pool") for scene in ((8, 9, 1.5), (8, 9, 1.0), (8, 6, 0.6))
)
SEED, EPISODES, NUM_ENVS = 77503, 1024, 256
POINTS = 3.0
"""success may differ by so many"""
GATE_M, NEAR_M, HOLD_STEPS, STEP_S = 1.0, 6.0, 5, 0.02
TOLD = ("position error", "velocity error", "birth delay", "bodies tracked")


@dataclass
class TrackErrors:
    """What the tracks were beside the true bodies, of one side in one scene."""

    position_m: list[np.ndarray] = field(default_factory=list)
    velocity_m_s: list[np.ndarray] = field(default_factory=list)
    tracked: int = 0
    near: int = 0
    """true bodies within NEAR_M, counted at every decision"""
    delay_s: list[float] = field(default_factory=list)
    """from a body's first moment within NEAR_M to its first track"""
    never: int = 0
    """bodies that were near and never tracked before the episode ended"""

    def add(self, own: np.ndarray, tracks: np.ndarray, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moments of n vehicles at ``own`` (n, 2), tracks (n, t, 4), bodies (n, b, 4) x, y, vx, vy (NaN =
        none); which bodies are near and which tracked, both (n, b)."""
        away = np.linalg.norm(bodies[:, :, None, :2] - tracks[:, None, :, :2], axis=-1)
        away = np.where(np.isfinite(away), away, np.inf)
        nearest = away.argmin(-1)
        gap = np.take_along_axis(away, nearest[..., None], -1)[..., 0]
        near = np.linalg.norm(bodies[..., :2] - own[:, None], axis=-1) < NEAR_M
        found = near & (gap < GATE_M)
        speed = np.take_along_axis(tracks[..., 2:], nearest[..., None], 1)
        self.position_m.append(gap[found])
        self.velocity_m_s.append(np.linalg.norm(speed - bodies[..., 2:], axis=-1)[found])
        self.near, self.tracked = self.near + int(near.sum()), self.tracked + int(found.sum())
        return near, found

    def summary(self) -> dict[str, float]:
        """Medians and 90th percentiles."""
        out = {}
        for name, parts in (("position error", self.position_m), ("velocity error", self.velocity_m_s)):
            values = np.concatenate(parts)
            out |= {
                f"{name}, median": float(np.median(values)),
                f"{name}, p90": float(np.quantile(values, 0.9)),
            }
        delays = np.array([*self.delay_s, *[np.inf] * self.never])
        out |= {
            f"birth delay, {name}": float(np.quantile(delays, q, method="higher"))
            for name, q in (("median", 0.5), ("p90", 0.9))
        }
        return out | {"bodies tracked": self.tracked / self.near, "never tracked": self.never / len(delays)}


class Births:
    """When bodies of the episodes in rows came near, and when they were first tracked."""

    def __init__(self, errors: TrackErrors, rows: int, lanes: int) -> None:
        self._errors = errors
        self._near_s, self._seen_s = np.full((2, rows, lanes), np.nan)

    def add(self, rows: np.ndarray, now_s: np.ndarray, near: np.ndarray, found: np.ndarray) -> None:
        """A moment of these rows."""
        for times, now in ((self._near_s, near), (self._seen_s, found)):
            part = times[rows]
            times[rows] = np.where(np.isnan(part) & now, now_s[:, None], part)

    def end(self, rows: np.ndarray) -> None:
        """The episodes of these rows are over."""
        near, seen = self._near_s[rows], self._seen_s[rows]
        self._errors.delay_s += (seen - near)[np.isfinite(seen)].tolist()
        self._errors.never += int((np.isfinite(near) & np.isnan(seen)).sum())
        self._near_s[rows] = self._seen_s[rows] = np.nan


def measure(job: Job) -> list[Row]:
    """Success, their difference and the tracks of both sides, scene by scene."""
    checkpoint = _policy(job.policy)
    count = 8 if job.quick else EPISODES
    scenes = SCENES[:1] if job.quick else SCENES
    rows, sims = [], {}
    for world, scene in scenes:
        began = time.perf_counter()
        config = _config(checkpoint.config, world, scene, min(count, NUM_ENVS))
        twin, twin_errors = in_twin(config, scene, actor_of(checkpoint), count)
        if world not in sims:
            sims[world] = simulator_of(config, world, tuple(scene for name, scene in SCENES if name == world))
        sim, sim_errors = in_simulator(sims[world], scene, checkpoint, count)
        rows += _rows(world, scene, (twin, twin_errors), (sim, sim_errors))
        job.say(f"{rows[-1].what}: {rows[-1].note}; {time.perf_counter() - began:.0f} s")
    return rows


def _policy(run: str) -> Checkpoint:
    if not run:
        raise SystemExit("parity: give a policy that learnt in the twin: --policy RUN (uuv train twin)")
    found = find_policy(run)
    if not found.config.twin.enabled:
        raise SystemExit(f"parity: {run} did not learn in the twin; train one: uuv train twin")
    return found


def _config(config: LearningConfig, world: str, scene: Scene, num_envs: int) -> LearningConfig:
    """The run's config for one scene."""
    return config.model_copy(
        update={
            "twin": config.twin.model_copy(update={"worlds": (world,)}),
            "train": config.train.model_copy(update={"num_envs": num_envs, "scenes": (scene,)}),
        }
    )


# ------------------------------------------------------------------------------------------------------- twin


@torch.no_grad()
def in_twin(
    config: LearningConfig, scene: Scene, actor: SetActor, count: int
) -> tuple[np.ndarray, TrackErrors]:
    """(successes (count,), errors of the tracks) in the twin, by the mean action."""
    bank = draw_bank(config, (scene,), SEED, count)
    twin = Twin(config, bank, count, SEED)
    twin.begin(torch.ones(count, dtype=torch.bool), torch.arange(count))
    outcome, errors = np.full(count, RUNNING), TrackErrors()
    births = Births(errors, count, bank.path.shape[1])
    while (outcome == RUNNING).any():
        rows, view = np.flatnonzero(outcome == RUNNING), twin.look()
        now_s, own = twin.time_s.numpy()[rows].copy(), twin.ego[:, AT_POS : AT_POS + 2].numpy()[rows]
        if now_s.any():  # nothing is tracked at the start
            moved = errors.add(own, twin_tracks(twin)[rows], true_bodies(bank.path.numpy()[rows], now_s))
            births.add(rows, now_s, *moved)
        _, now = twin.step(actor(view.bodies, view.own).clamp(-MOST_WISH, MOST_WISH))
        ended = rows[now.numpy()[rows] != RUNNING]
        outcome[ended] = now.numpy()[ended]
        births.end(ended)
    return outcome == SUCCESS, errors


def twin_tracks(twin: Twin) -> np.ndarray:
    """(N, lanes, 4) of the tracks that the policy is shown; NaN = none."""
    there = twin.view.bodies[..., :1].numpy() > 0.5
    return np.where(there, twin.track[..., :4].numpy(), np.nan)


def true_bodies(path: np.ndarray, now_s: np.ndarray) -> np.ndarray:
    """(n, lanes, 4) x, y, vx, vy of bodies on paths (n, lanes, 16) at times (n,); NaN = none."""
    places = path_places(path, now_s[:, None] + np.array([-0.01, 0.0, 0.01]))
    return np.concatenate([places[:, :, 1], (places[:, :, 2] - places[:, :, 0]) / 0.02], axis=-1)


# -------------------------------------------------------------------------------------------------- simulator


def moving_paths(sim: Sim) -> np.ndarray:
    """(N, lanes, 16) of the moving bodies that are there; a lane that an earlier scene left has speed 0."""
    body, path, _ = scenario_rows(sim)
    path[body[:, -path.shape[1] :, 0] == 0, 4] = 0.0
    return path


class TrackWatcher:
    """Looks at the tracks of every playing row at every decision (``playing.EpisodeObserver``)."""

    def __init__(self, sim: Sim, errors: TrackErrors) -> None:
        self._errors = errors
        self._playing = np.zeros(sim.num_envs, bool)
        self._age = np.zeros(sim.num_envs, int)
        self._path, self._is_new = moving_paths(sim), False
        self._births = Births(errors, sim.num_envs, self._path.shape[1])

    def begin(self, sim: Sim, row: int, job: Episode) -> None:
        """An episode has begun in this row."""
        self._playing[row], self._age[row], self._is_new = True, 0, True

    def step(self, sim: Sim) -> None:
        """A control step has been done."""
        self._age += self._playing
        if self._is_new:
            self._path, self._is_new = moving_paths(sim), False
        rows = np.flatnonzero(self._playing & (self._age % HOLD_STEPS == 0))
        if len(rows):
            now_s = self._age[rows] * STEP_S
            own, tracks = sim_tracks(sim, rows)
            moved = self._errors.add(own, tracks, true_bodies(self._path[rows], now_s))
            self._births.add(rows, now_s, *moved)

    def end(self, sim: Sim, row: int, result: EpisodeResult) -> None:
        """The episode of this row is over."""
        self._playing[row] = False
        self._births.end(np.array([row]))


def sim_tracks(sim: Sim, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(true own places (n, 2), tracks (n, t, 4) as the policy is shown them from there); NaN = none. The
    error of the own position is in neither."""
    s, envs = sim.s, [int(row) for row in rows]
    there = sim.rows(s.forecast.radius_m, envs)[..., :1] >= 0
    place, speed = sim.rows(s.forecast.pos_w, envs)[:, :, 0], sim.rows(s.tracks.state, envs)[..., 2:]
    own, believed = (sim.rows(part, envs)[:, :2] for part in (s.vehicle.pos_w, s.ego.pos_w))
    place = place + (own - believed)[:, None]
    return own, np.where(there, np.concatenate([place, speed], axis=-1), np.nan)


def in_simulator(
    sim: Sim, scene: Scene, checkpoint: Checkpoint, count: int
) -> tuple[np.ndarray, TrackErrors]:
    """(successes (count,), errors of the tracks) in the simulator."""
    errors, episodes = TrackErrors(), [Episode(SEED, i, scene) for i in range(count)]
    pilot: Any = set_pilot_of(checkpoint, sim)
    results, _ = run_episodes(sim, episodes, TrackWatcher(sim, errors), driver=pilot)
    return np.array([result.outcome == "success" for result in results]), errors


# ------------------------------------------------------------------------------------------------------- rows


def _rows(
    world: str, scene: Scene, twin: tuple[np.ndarray, TrackErrors], sim: tuple[np.ndarray, TrackErrors]
) -> list[Row]:
    """Success and tracks of one scene."""
    name = f"{world} {scene}"
    (won, errors), (own, sim_errors) = twin, sim
    difference = 100.0 * (won.astype(float) - own)
    half = 1.96 * difference.std() / np.sqrt(len(difference))
    mean = float(difference.mean())
    counts: dict[str, Any] = {
        side: {"success": int(k.sum()), "episodes": len(k), "interval": wilson_interval(int(k.sum()), len(k))}
        for side, k in (("twin", won), ("simulator", own))
    }
    counts |= {"only twin": int((won & ~own).sum()), "only simulator": int((own & ~won).sum())}
    counts |= {"difference": mean, "half": float(half)}
    tracks = {"twin": errors.summary(), "simulator": sim_errors.summary()}
    return [
        Row(f"tracks, {name}", None, "", details={"tracks": tracks}),
        Row(
            f"success, {name}",
            float(won.mean()),
            "twin",
            float(own.mean()),
            "simulator",
            note=f"twin less simulator {mean:+.1f} points, 95 % in {mean - half:+.1f} .. {mean + half:+.1f}: "
            + ("within" if abs(mean) <= POINTS else "NOT within")
            + f" {POINTS:g}",
            details=counts,
        ),
    ]
