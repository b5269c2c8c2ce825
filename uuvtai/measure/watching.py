"""``uuv watch``: episodes at the clock's pace, one after another, for viewers that come and go."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uuvtai.live.broadcast import Broadcast, RealTime
from uuvtai.live.viewer_server import ViewerServer
from uuvtai.loader import ConfigError
from uuvtai.measure.episodes.methods import Method
from uuvtai.measure.episodes.playing import Job, Recorders, run_episodes
from uuvtai.measure.evaluate.compare import comparison_of, methods_of
from uuvtai.measure.evaluate.eval_request import ORACLE, Request
from uuvtai.measure.evaluate.method_run import Comparison, EvaluationWatch
from uuvtai.shipped import PRESET_DIR

LAYOUT = PRESET_DIR / "layout" / "navigation.json"
"""for Foxglove and Lichtblick"""


@dataclass(frozen=True)
class LiveOptions:
    """How episodes are shown."""

    host: str = "127.0.0.1"
    port: int = 8765
    rate: float = 1.0
    """seconds of the episode in one of the clock's; 0 = as fast as it goes"""
    origins: Sequence[str] = ()
    """of web pages that may connect beside those of this host"""


def watch_episodes(request: Request, live: LiveOptions, watch: EvaluationWatch) -> list[dict[str, Any]]:
    """Play the request's episodes, each by every method in turn, and serve them; ``episodes`` 0 = on and on,
    until it is interrupted. How each ended. Raises LiveError, ConfigError, CheckpointError, PieceError."""
    if ORACLE in request.controllers:
        raise ConfigError("--controller oracle: it drives no vehicle; name who does, for example bt")
    methods = methods_of(request, watch)
    with ViewerServer(live.host, live.port, live.origins) as server:
        shown = "localhost" if live.host in ("127.0.0.1", "0.0.0.0", "::") else live.host
        watch.note(f"serving ws://{shown}:{server.port}; in Foxglove or Lichtblick: open a connection,")
        watch.note(f"Foxglove WebSocket, to that address, and import the layout {LAYOUT}")
        comparison = comparison_of(request, 1, methods, watch)
        try:
            return [
                _watched(comparison, method, job, server, live.rate)
                for job in _jobs(request)
                for method in methods
            ]
        finally:
            for method in methods:
                if method.own:
                    method.own.close()


def _jobs(request: Request) -> Iterable[Job]:
    numbers = range(request.episodes) if request.episodes else itertools.count()
    return (Job(seed, number) for number in numbers for seed in request.seeds)


def _watched(
    comparison: Comparison, method: Method, job: Job, server: ViewerServer, rate: float
) -> dict[str, Any]:
    """Play one episode for all to see; how it ended."""
    request, policy = comparison.request, comparison.policies[method.name]
    sim = comparison.simulator_for(method)
    clock = RealTime(request.config.episode.control_dt_s, rate)
    shown = Broadcast(server, Path(request.world).stem, method.name, request.depth_images, policy)
    driver = policy.pilot if policy else None
    (result,), _ = run_episodes(sim, [job], Recorders([shown, clock]), driver=driver)
    entry = {
        "method": method.name,
        "seed": job.seed,
        "episode": job.episode,
        "outcome": result.outcome,
        "time_s": result.time_s,
        "min_clearance_m": round(result.min_clearance_m, 4),
        "real_time_factor": round(clock.real_time_factor, 2),
    }
    comparison.watch.note(
        f"{method.name}, seed {job.seed}, episode {job.episode}: {result.outcome} after "
        f"{result.time_s:.1f} s ({entry['real_time_factor']:.2f} of real time)"
    )
    return entry
