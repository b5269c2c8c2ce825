"""A training as it runs: a live dashboard on a terminal, one plain line every few seconds otherwise."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from uuvtai.endings import plain, say
from uuvtai.show.progress import Pace, time_left
from uuvtai.tables.wording import bodies, number, percent

_PERIOD_S = 5.0


class TrainingProgress:
    """What ``learn.run`` tells while it runs. The first iteration compiles: it is no part of the speed
    and of the time left."""

    def __init__(self) -> None:
        self._live = None
        self._last = 0.0
        self._pace: Pace | None = None
        self._evaluated: dict[str, float] = {}
        """newest figures of an evaluation"""

    def start(self, folder: Path, config: Any, done: int, total: int) -> None:
        """``done`` of ``total`` iterations are over as the run begins in ``folder``."""
        say(f"run folder: {folder}")
        self._folder, self._total, self._pace = folder, total, None
        world = config.world
        self._title = (
            f"{config.train.num_envs} envs, {bodies(world.bodies)}, v = {world.dynamic_speed_m_s} m/s"
        )
        if sys.stderr.isatty():
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), refresh_per_second=4, transient=False)
            self._live.start()
            self._live.update(Text(f"{self._title}: compiling, and looking around once"))
        else:
            say(f"{self._title}: compiling, and looking around once")

    def note(self, text: str) -> None:
        """A message for the person who waits."""
        if self._live is not None:
            self._live.console.print(text, highlight=False, markup=False)
        else:
            say(text)

    def update(self, done: int, metrics: dict[str, float], success_ci95: tuple[float, float] | None) -> None:
        """Iteration ``done`` is over."""
        now = time.perf_counter()
        is_first = self._pace is None
        if self._pace is None:
            self._pace = Pace(self._total, done)
        self._evaluated |= {name: value for name, value in metrics.items() if name.startswith("eval/")}
        rows = training_rows(self._evaluated | metrics, success_ci95, self._pace.left_s(done), is_first)
        if self._live is not None:
            self._live.update(
                _dashboard(f"{self._folder}: iteration {done} of {self._total}, {self._title}", rows)
            )
        elif now - self._last >= _PERIOD_S or done == self._total:
            self._last = now
            say(
                f"{done}/{self._total}: " + ", ".join(f"{name} {text}".strip() for name, text in rows.items())
            )

    def stop(self) -> None:
        """The run is over."""
        if self._live is not None:
            self._live.stop()
            self._live = None


def _dashboard(title: str, rows: dict[str, str]) -> Group:
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, text in rows.items():
        table.add_row(name, Text(text))
    return Group(Text(plain(title), style="italic"), table)


def training_rows(
    metrics: dict[str, float], success_ci95: tuple[float, float] | None, left_s: float | None, is_first: bool
) -> dict[str, str]:
    """What the dashboard shows: name -> text. ``is_first``: the iteration has compiled, so its speed is
    none."""
    of = metrics.get
    interval = f" [{100 * success_ci95[0]:.0f}, {100 * success_ci95[1]:.0f}]" if success_ci95 else ""
    times = {name: of(f"time/{name}_s", 0.0) for name in ("simulate", "infer", "learn")}
    split = " / ".join(
        f"{name} {100 * spent / max(1e-9, sum(times.values())):.0f} %" for name, spent in times.items()
    )
    rows = {
        "reward": number(of("rollout/ep_rew_mean"), 2),
        "success": percent(of("rollout/success_rate"), 0) + interval,
        "collision": percent(of("rollout/collision_rate"), 0),
        "env-steps/s": "from the second iteration on"
        if is_first
        else f"{of('time/env_steps_per_s', 0.0):,.0f} ({split})",
        "env-steps": f"{of('time/env_steps', 0.0):,.0f}",
        "lambda": number(of("distill/lambda_risk"), 3),
    }
    if left_s is not None:
        rows["ETA"] = time_left(left_s).removeprefix("ETA ")
    if "eval/success_rate" in metrics:
        rows["evaluation"] = (
            f"success {percent(of('eval/success_rate'))}, collision {percent(of('eval/collision_rate'))}"
        )
    return rows
