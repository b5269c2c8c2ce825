"""The risk alarm on episodes of the behaviour tree: false alarms where 5 % of the accidents are missed,
beside thresholds of time to collision and of clearance.

``bt`` drives in ``gauntlet`` and ``pool`` among fast bodies, where accidents happen. The head learns from one
seed, is calibrated on a second, where every alarm's threshold is set as well, and all are judged on a third.
An accident is missed by one moment drawn from its last ``risk.horizon_s``, or by all of them; every other
moment whose next ``risk.horizon_s`` are known is safe. Intervals come from resampling episodes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as fn

import uuvtai
from benchmarks.common import Job, Row
from uuvtai.config.learning import RiskConfig
from uuvtai.env import VectorEnv
from uuvtai.learn.calibration import auroc, brier, expected_calibration_error
from uuvtai.learn.normalise import moments_of
from uuvtai.learn.optimiser import PlainAdam
from uuvtai.learn.risk import STRIDE, RiskHead, conformal_threshold, label_events

LONGEST_S = 3000
THREADS = 1
WORLDS = ("gauntlet", "pool")
SCENE = {"world.n_static": 8, "world.n_dynamic": 9, "world.dynamic_speed_m_s": 1.5}
TOLD = {"features.n_track": 4, "features.teacher": True}
"""the head sees what the stack knows: the nearest tracks and the tree's action"""
SEEDS = {"training": 77401, "calibration": 77402, "test": 77403}
HEAD = "risk head"
PEERS = ("TTC of the tracks", "TTC of the beams", "clearance of the beams", "clearance of the tracks")
HULL_M, CLOSING_M_S, FAR, LEVEL_M = 0.22, 0.05, 1e6, 0.25
RESAMPLED = 2000
WAYS = {"a moment": "one moment drawn", "all of the last": "all of its last 2 s"}


@dataclass(frozen=True)
class Watched:
    """Moments of a batch of pilots, a tenth of a second apart, whose next seconds are known."""

    x: torch.Tensor
    """(M, n_obs) observations"""
    peers: torch.Tensor
    """(M, 4) scores of PEERS, larger = more dangerous"""
    event: torch.Tensor
    """(M,) an accident comes within the horizon"""
    episode: torch.Tensor
    """(M,) number of the episode, 0 .. episodes - 1"""
    episodes: int
    accidents: int
    world: torch.Tensor
    """(M,) number of the world"""


def measure(job: Job) -> list[Row]:
    """Rates of every alarm, for both ways to miss an accident, and what the probabilities are worth."""
    num_envs, steps = (32, 600) if job.quick else (320, 1200)
    config = RiskConfig()
    found = {part: watched(seed, num_envs, steps, config, job) for part, seed in SEEDS.items()}
    head = trained_head(found["training"], config, 2 if job.quick else 20, job)
    with torch.no_grad():
        head.calibrate(head.logit(found["calibration"].x), found["calibration"].event)
        scores = {
            part: torch.cat([head.logit(seen.x)[:, None], seen.peers], dim=1) for part, seen in found.items()
        }
    rows = [probabilities(head, found["test"], scores["test"], config)]
    for way in WAYS:
        rows += alarms(way, found, scores, config)
    return rows


# ------------------------------------------------------------------------------------------------- recordings


def watched(seed: int, num_envs: int, steps: int, config: RiskConfig, job: Job) -> Watched:
    """Both worlds, driven by the tree."""
    parts, first = [], 0
    for number, world in enumerate(WORLDS):
        began = time.perf_counter()
        env = uuvtai.make(world, num_envs=num_envs, seed=seed, overrides=SCENE | TOLD)
        parts.append(_watched(env, seed, steps, config, first, number))
        first += parts[-1].episodes
        job.say(
            f"{world}, seed {seed}: {parts[-1].episodes} episodes, {parts[-1].accidents} accidents, "
            f"{time.perf_counter() - began:.0f} s"
        )
    return Watched(
        *(torch.cat([getattr(part, name) for part in parts]) for name in ("x", "peers", "event", "episode")),
        episodes=first,
        accidents=sum(part.accidents for part in parts),
        world=torch.cat([part.world for part in parts]),
    )


def _watched(env: VectorEnv, seed: int, steps: int, config: RiskConfig, first: int, world: int) -> Watched:
    """Moments of one world; episodes are numbered from ``first``."""
    obs, info = env.reset(seed=seed)
    seen, ends = [], []
    bad = torch.tensor([env.outcomes.index(name) for name in ("collision", "ttc")])
    for step in range(steps):
        if step % STRIDE == 0:
            seen.append((obs.clone(), danger(env)))
        obs, _, terminated, truncated, info = env.step(info["teacher_action"])
        ended = terminated | truncated
        ends.append(torch.stack([torch.isin(info["outcome"], bad) & ended, ended, truncated]))
    failed, ended, censored = torch.stack(ends, dim=1)
    labels = label_events(failed, ended, censored, round(config.horizon_s / env.config.episode.control_dt_s))
    number = torch.cumsum(ended.long(), dim=0) - ended.long()
    names, number = torch.unique(number * env.num_envs + torch.arange(env.num_envs), return_inverse=True)
    at = slice(None, None, STRIDE)
    known = labels.known[at]
    return Watched(
        torch.stack([x for x, _ in seen])[known],
        torch.stack([score for _, score in seen])[known],
        labels.event[at][known],
        first + number[at][known],
        len(names),
        int(failed.sum()),
        torch.full((int(known.sum()),), world),
    )


def danger(env: VectorEnv) -> torch.Tensor:
    """(N, 4) scores of PEERS: minus seconds or metres, as the stack knows them."""
    sim = env.sim
    s, rows = sim.s, sim.rows
    pos, yaw, vel = rows(s.ego.pos_w), rows(s.ego.rpy)[:, 2], rows(s.ego.vel_b)
    c, si = np.cos(yaw), np.sin(yaw)
    own = np.stack([c * vel[:, 0] - si * vel[:, 1], si * vel[:, 0] + c * vel[:, 1]], axis=-1)
    state, radius = rows(s.tracks.state), rows(s.tracks.radius_m)
    above, below = rows(s.forecast.above_w) - pos[:, 2:], pos[:, 2:] - rows(s.forecast.below_w)
    there = (rows(s.forecast.radius_m)[..., 0] >= 0) & (np.minimum(above, below) < LEVEL_M)
    way = rows(s.forecast.pos_w)[:, :, 0] - pos[:, None, :2]
    away = np.maximum(np.linalg.norm(way, axis=-1), 1e-6)
    closing = -((state[..., 2:] - own[:, None]) * way).sum(-1) / away
    gap = np.maximum(away - radius - HULL_M, 0.0)
    ttc = np.where(there & (closing > CLOSING_M_S), gap / np.maximum(closing, CLOSING_M_S), FAR).min(1)
    near = np.where(there, gap, FAR).min(1)
    scores = (ttc, rows(s.teacher.ttc_s), rows(s.teacher.nearest_m), near)
    return -torch.from_numpy(np.stack(scores, axis=-1).astype(np.float32))


# ------------------------------------------------------------------------------------------------------- head


def trained_head(seen: Watched, config: RiskConfig, passes: int, job: Job) -> RiskHead:
    """A head after the pass, of ``passes``, that was best on a fifth of the episodes that it did not learn
    from."""
    draws = torch.Generator().manual_seed(0)
    head = RiskHead(seen.x.shape[1], config, draws)
    head.observation_norm.merge(moments_of(seen.x))
    held = seen.episode % 5 == 0
    x, event, rate = seen.x[~held], seen.event[~held].float(), config.learning_rate
    optimiser = PlainAdam(head.parameters(), lr=rate)
    best, kept = float("inf"), {}
    for number in range(passes):
        for rows in torch.randperm(len(event), generator=draws).split(config.batch):
            loss = fn.binary_cross_entropy_with_logits(head.logit(x[rows]), event[rows])
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        with torch.no_grad():
            now = float(
                fn.binary_cross_entropy_with_logits(head.logit(seen.x[held]), seen.event[held].float())
            )
        if now < best:
            best, kept = now, {name: value.clone() for name, value in head.state_dict().items()}
            job.say(f"pass {number + 1}: {now:.4f} nats on held-out episodes")
    head.load_state_dict(kept)
    return head


def probabilities(head: RiskHead, seen: Watched, scores: torch.Tensor, config: RiskConfig) -> Row:
    """What the calibrated probabilities are worth on the test data."""
    with torch.no_grad():
        p = head.calibrated(scores[:, 0])
    base = torch.full_like(p, float(seen.event.double().mean()))
    areas = {name: auroc(scores[:, i], seen.event) for i, name in enumerate((HEAD, *PEERS))}
    return Row(
        "Brier score",
        brier(p, seen.event),
        "1",
        brier(base, seen.event),
        "base rate",
        less_is_better=True,
        note=f"{len(p)} moments, {100 * float(base[0]):.1f} % before an accident; ECE "
        f"{expected_calibration_error(p, seen.event, config.bins):.4f}",
        details={"auroc": areas},
    )


# ----------------------------------------------------------------------------------------------------- alarms


def alarms(
    way: str, found: dict[str, Watched], scores: dict[str, torch.Tensor], config: RiskConfig
) -> list[Row]:
    """A row for every alarm, the head's beside the best threshold of the others."""
    seen, names = found["test"], (HEAD, *PEERS)
    table, counts = {}, []
    for i, name in enumerate(names):
        fit = accident_scores(way, found["calibration"], scores["calibration"][:, i])[0]
        threshold = conformal_threshold(fit, max(config.miss_rate, 1.0 / (len(fit) + 1)))  # quick: few
        counts.append(counted(way, seen, scores["test"][:, i], threshold))
        table[name] = rates(counts[-1]) | {"threshold": threshold}
        for number, world in enumerate(WORLDS):
            part = np.isin(np.arange(seen.episodes), seen.episode[seen.world == number].numpy())
            here = rates(counts[-1][part])
            table[name] |= {f"{key} {world}": here[key] for key in ("false alarms", "missed")}
    best = min(PEERS, key=lambda name: table[name]["false alarms"])
    low, high = ratio_interval(counts[0], counts[1 + PEERS.index(best)])
    about = table[HEAD]
    note = (
        f"95 % in {about['low']:.3f} .. {about['high']:.3f}; in parts of the best threshold's 95 % in "
        f"{low:.2f} .. {high:.2f}; missed {about['missed']:.3f} of {int(about['accidents'])} accidents"
    )
    columns = {key: {name: table[name][key] for name in names} for key in table[HEAD]}
    return [
        Row(
            f"false alarms, missed by {WAYS[way]}",
            about["false alarms"],
            "share of safe moments",
            table[best]["false alarms"],
            best,
            less_is_better=True,
            floor=2.0,
            floor_on="ratio",
            note=note,
            details={"table": columns},
        )
    ]


def accident_scores(way: str, seen: Watched, score: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(score, episode), both (n,), of every accident: of one of its moments, or the largest of all."""
    draws = torch.Generator().manual_seed(1)
    order = torch.randperm(len(score), generator=draws)
    order = order[seen.event[order]]
    if way != "a moment":
        order = order[torch.argsort(score[order], descending=True)]
    rows = {}
    for row, episode in zip(order.tolist(), seen.episode[order].tolist(), strict=True):
        rows.setdefault(episode, row)
    chosen = torch.tensor(list(rows.values()), dtype=torch.int64)
    return score[chosen], seen.episode[chosen]


def counted(way: str, seen: Watched, score: torch.Tensor, threshold: float) -> np.ndarray:
    """(episodes, 4) safe moments, those in alarm, accidents, those missed, of every episode."""
    out = np.zeros((seen.episodes, 4))
    safe = ~seen.event
    np.add.at(out[:, 0], seen.episode[safe].numpy(), 1)
    np.add.at(out[:, 1], seen.episode[safe & (score >= threshold)].numpy(), 1)
    worst, episode = accident_scores(way, seen, score)
    np.add.at(out[:, 2], episode.numpy(), 1)
    np.add.at(out[:, 3], episode[worst < threshold].numpy(), 1)
    return out


def rates(counts: np.ndarray) -> dict[str, float]:
    """False alarms and misses with their 95 % intervals."""
    sums = counts.sum(0)
    many = _resampled(counts)
    false, missed = many[:, 1] / np.maximum(many[:, 0], 1), many[:, 3] / np.maximum(many[:, 2], 1)
    (low, high), (few, most) = (np.quantile(each, [0.025, 0.975]).tolist() for each in (false, missed))
    return {
        "false alarms": float(sums[1] / sums[0]),
        "low": low,
        "high": high,
        "missed": float(sums[3] / max(sums[2], 1)),
        "missed low": few,
        "missed high": most,
        "accidents": float(sums[2]),
        "safe moments": float(sums[0]),
    }


def ratio_interval(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """95 % interval of the ratio of both false-alarm rates on the same episodes."""
    a, b = (_resampled(each) for each in (ours, theirs))
    low, high = np.quantile(a[:, 1] / a[:, 0] / (b[:, 1] / b[:, 0]), [0.025, 0.975]).tolist()
    return low, high


def _resampled(counts: np.ndarray) -> np.ndarray:
    """(RESAMPLED, 4) sums over episodes drawn with replacement, the same draws for every alarm."""
    rng = np.random.default_rng(0)
    return np.stack([counts[rng.integers(len(counts), size=len(counts))].sum(0) for _ in range(RESAMPLED)])
